"""Reads the fact tables, and says where the links are.

Frames are 4x4 homogeneous transforms, lengths in [m], angles in [rad].
"""

import csv
from pathlib import Path

import numpy as np
from trimesh.transformations import euler_matrix, rotation_matrix

FOLDER = Path(__file__).with_name("facts")

Row = dict[str, str]
Frames = dict[str, np.ndarray]


def read(table: str) -> list[Row]:
    """Return the rows of `facts/<table>.csv`."""
    with (FOLDER / f"{table}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def read_posture() -> dict[str, float]:
    """Return the angles of the joints that never move; those not named are 0."""
    return {row["joint"]: float(row["angle_rad"]) for row in read("posture")}


def link_frames() -> Frames:
    """Return the frame of every link in the torso's, joints at rest."""
    angles, frames = read_posture(), {"torso": np.eye(4)}
    pending = [row for row in read("joints") if row["child_link"] != "torso"]
    while ready := [row for row in pending if row["parent_link"] in frames]:
        for row in ready:
            motion = joint_motion(row, angles.get(row["joint"], 0.0))
            frames[row["child_link"]] = frames[row["parent_link"]] @ motion
        pending = [row for row in pending if row["child_link"] not in frames]
    return frames


def _vector(row: Row, *columns: str) -> np.ndarray:
    return np.array([float(row[name]) for name in columns])


def joint_motion(row: Row, angle: float) -> np.ndarray:
    """Return the frame of a joint's child in that of its parent, of a row of joints."""
    rpy = _vector(row, "roll_rad", "pitch_rad", "yaw_rad")
    motion = euler_matrix(*rpy, axes="sxyz")
    motion[:3, 3] = _vector(row, "origin_x_m", "origin_y_m", "origin_z_m")
    if row["type"] == "fixed":
        return motion
    return motion @ rotation_matrix(angle, _vector(row, "axis_x", "axis_y", "axis_z"))
