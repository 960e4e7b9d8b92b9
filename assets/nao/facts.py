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


@dataclass(frozen=True)
class Actuation:
    """What one driven joint may do."""

    lower_deg: float
    """Lower limit [deg]."""
    upper_deg: float
    """Upper limit [deg]."""
    effort: float
    """Largest torque [N m]."""
    velocity: float
    """Largest speed [rad/s]."""


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


def read_actuation() -> dict[str, Actuation]:
    """Return the driven joints in the order of the robot's action."""
    return {
        row["joint"]: Actuation(
            float(row["lower_deg"]),
            float(row["upper_deg"]),
            float(row["effort_nm"]),
            float(row["velocity_rad_s"]),
        )
        for row in read("actuation")
    }


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
    inertia = sum(
        (body.inertia + _steiner(body.mass, body.com - com) for body in bodies),
        np.zeros((3, 3)),
    )
    return Inertial(mass, com, inertia)


def capsule_inertial(mass: float, radius: float, shaft: float, x: float) -> Inertial:
    """Return a solid capsule lying along x, its center at (x, 0, 0)."""
    density = mass / (np.pi * radius**2 * (shaft + 4 / 3 * radius))
    rod, ball = (
        density * np.pi * radius**2 * shaft,
        density * 4 / 3 * np.pi * radius**3,
    )
    axial = rod * radius**2 / 2 + ball * 2 / 5 * radius**2
    lateral = rod * (shaft**2 / 12 + radius**2 / 4) + ball * (
        2 / 5 * radius**2 + shaft**2 / 4 + 3 / 8 * shaft * radius
    )
    return Inertial(mass, np.array([x, 0, 0]), np.diag([axial, lateral, lateral]))


def _inertial(row: Row) -> Inertial:
    ixx, ixy, ixz, iyy, iyz, izz = (
        float(row[key]) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    return Inertial(
        float(row["mass_kg"]),
        np.array([float(row[f"com_{axis}_m"]) for axis in "xyz"]),
        np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]]),
    )


def _joint_motion(row: Row, angle: float) -> np.ndarray:
    rpy = [float(row[f"{name}_rad"]) for name in ("roll", "pitch", "yaw")]
    motion = euler_matrix(*rpy, axes="sxyz")
    motion[:3, 3] = [float(row[f"origin_{axis}_m"]) for axis in "xyz"]
    if row["type"] == "fixed":
        return motion
    axis = [float(row[f"axis_{name}"]) for name in "xyz"]
    return motion @ rotation_matrix(angle, axis)


def _steiner(mass: float, offset: np.ndarray) -> np.ndarray:
    return mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
