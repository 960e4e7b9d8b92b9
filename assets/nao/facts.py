"""Reads the fact tables, and does what little mechanics the model needs of them.

Shapes: J joints. Frames are 4x4 homogeneous transforms, lengths in [m], angles in
[rad], masses in [kg], inertias in [kg m^2].
"""

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from trimesh.transformations import euler_matrix, rotation_matrix

FOLDER = Path(__file__).with_name("facts")

NEGLIGIBLE_MASS = 1e-5
"""Mass that the description gives to frames that are no bodies, at most [kg]."""

Row = dict[str, str]
Frames = dict[str, np.ndarray]


@dataclass(frozen=True)
class Inertial:
    """Mass properties of one rigid body, in the frame of its link."""

    mass: float
    """Mass [kg]."""
    com: np.ndarray
    """Center of mass [m], shape [3]."""
    inertia: np.ndarray
    """Inertia about the center of mass, axes of the link [kg m^2], shape [3, 3]."""

    def moved(self, frame: np.ndarray) -> "Inertial":
        """Return the same body seen from the frame that `frame` leads to."""
        rotation = frame[:3, :3]
        com = rotation @ self.com + frame[:3, 3]
        return Inertial(self.mass, com, rotation @ self.inertia @ rotation.T)


def read(table: str) -> list[Row]:
    """Return the rows of `facts/<table>.csv`."""
    with (FOLDER / f"{table}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def read_joints() -> dict[str, Row]:
    """Return the joint table by joint name, its figures still as written."""
    return {row["joint"]: row for row in read("joints")}


def read_inertials() -> dict[str, Inertial]:
    """Return the mass properties by link name."""
    return {row["link"]: _inertial(row) for row in read("links")}


def read_posture() -> dict[str, float]:
    """Return the angles of the joints that never move; those not named are 0."""
    return {row["joint"]: float(row["angle_rad"]) for row in read("posture")}


def forward_kinematics(
    joints: Mapping[str, Row], angles: Mapping[str, float], root: str = "torso"
) -> Frames:
    """Return the frame of every link below `root`, in the frame of `root`."""
    frames = {root: np.eye(4)}
    pending = [row for row in joints.values() if row["child_link"] != root]
    while ready := [row for row in pending if row["parent_link"] in frames]:
        for row in ready:
            motion = _joint_motion(row, angles.get(row["joint"], 0.0))
            frames[row["child_link"]] = frames[row["parent_link"]] @ motion
        pending = [row for row in pending if row["child_link"] not in frames]
    return frames


def lump(bodies: Iterable[Inertial]) -> Inertial:
    """Return the one rigid body that `bodies`, all in one frame, make together."""
    bodies = list(bodies)
    mass = sum(body.mass for body in bodies)
    com = sum((body.mass * body.com for body in bodies), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for body in bodies:
        off = body.com - com  # Steiner's theorem
        inertia += body.inertia + body.mass * (
            off @ off * np.eye(3) - np.outer(off, off)
        )
    return Inertial(mass, com, inertia)


def vector(row: Row, *columns: str) -> np.ndarray:
    """Return some columns of a row as numbers."""
    return np.array([float(row[name]) for name in columns])


def _inertial(row: Row) -> Inertial:
    tensor = vector(row, "ixx", "ixy", "ixz", "ixy", "iyy", "iyz", "ixz", "iyz", "izz")
    com = vector(row, "com_x_m", "com_y_m", "com_z_m")
    return Inertial(float(row["mass_kg"]), com, tensor.reshape(3, 3))


def _joint_motion(row: Row, angle: float) -> np.ndarray:
    rpy = vector(row, "roll_rad", "pitch_rad", "yaw_rad")
    motion = euler_matrix(*rpy, axes="sxyz")
    motion[:3, 3] = vector(row, "origin_x_m", "origin_y_m", "origin_z_m")
    if row["type"] == "fixed":
        return motion
    return motion @ rotation_matrix(angle, vector(row, "axis_x", "axis_y", "axis_z"))
