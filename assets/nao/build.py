"""Builds `nao.urdf` and its meshes from the fact tables: `python -m <this module>`.

The same sources give the same files. Only the 26 driven joints remain; everything
else is merged, in the posture of `facts/posture.csv`, into the link `torso`.
"""

import argparse
import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from . import facts
from .facts import Actuation, Frames, Inertial, Row
from .parts import PALETTE, parts
from .shapes import bake

FOLDER = Path(__file__).parent
ROOT = "torso"

PHALANX_MASS = 0.004
"""Mass of every finger link [kg]; the public description has none worth the name."""
PHALANX_RADIUS = 0.0055
"""Radius of a phalanx [m]."""
PHALANX_SHAFT = 0.010
"""Length of the straight part of a phalanx [m]."""
PHALANX_PITCH = 0.01436
"""Distance between the joints of a finger [m]."""
PHALANX_LEAST_INERTIA = 1e-7
"""Least principal inertia of a finger link, for a stable simulation [kg m^2]."""

_Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Box:
    """A collision box along the axes of its link."""

    center: _Vector
    """Middle [m]."""
    size: _Vector
    """Edge lengths [m]."""


@dataclass(frozen=True)
class Ball:
    """A collision sphere."""

    center: _Vector
    """Middle [m]."""
    radius: float
    """Radius [m]."""


Shape = Box | Ball

# Two balls a phalanx stand for its capsule: URDF has no capsule that every parser
# reads, and evenly spaced along the finger they leave dents of 1.3 mm only.
_PHALANX_SHAPES = tuple(
    Ball((PHALANX_PITCH * share, 0, 0), PHALANX_RADIUS) for share in (0.25, 0.75)
)

# The links between have no look of their own: shoulder, elbow and forearm are round
# about a joint's axis, so that the link on its other side can carry their surface.
_ARM_MESHES = {"Bicep": "bicep", "_wrist": "hand"}

_FINGERTIPS = ("Finger13_link", "Finger23_link", "Thumb2_link")

# Shoulders and elbows need none: they are never the first to touch anything.
_COLLISIONS: dict[str, tuple[Shape, ...]] = {
    ROOT: (
        Box((0.0, 0.0, 0.0), (0.090, 0.120, 0.220)),
        Ball((0.0, 0.0, 0.180), 0.060),
    ),
    "Bicep": (Box((0.025, 0.009, 0.0), (0.070, 0.044, 0.044)),),
    "ForeArm": (Box((0.030, 0.001, 0.0), (0.046, 0.042, 0.042)),),
    "_wrist": (Box((0.037, 0.0, -0.001), (0.058, 0.046, 0.042)),),
}


def build(folder: Path = FOLDER) -> None:
    """Write the URDF and every mesh below `folder`."""
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    (folder / "nao.urdf").write_text(urdf(), encoding="utf-8")
    for name, content in meshes().items():
        (folder / "meshes" / name).write_bytes(content)


def meshes() -> dict[str, bytes]:
    """Return the content of every mesh file by file name."""
    frames = posture_frames()
    return {
        f"{name}.glb": bake(part.surface, PALETTE, part.light).export(
            file_type="glb", include_normals=True
        )
        for name, part in parts(frames).items()
    }


def posture_frames() -> Frames:
    """Return the frame of every link in the torso's, in the resting posture."""
    return facts.forward_kinematics(
        facts.read_joints(), facts.read_posture(), root=ROOT
    )


def urdf() -> str:
    """Return the text of the URDF."""
    joints, driven = facts.read_joints(), facts.read_actuation()
    inertials = link_inertials(joints, driven)
    robot = ET.Element("robot", name="nao")
    robot.append(ET.Comment(" Written by build.py: change that, not this. "))
    for link, inertial in inertials.items():
        robot.append(_link(link, inertial))
    for name, actuation in driven.items():
        robot.append(_joint(joints[name], actuation))
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def link_inertials(
    joints: Mapping[str, Row], driven: Mapping[str, Actuation]
) -> dict[str, Inertial]:
    """Return the mass properties of the model's links, root first."""
    table = facts.read_inertials()
    moving = [joints[name]["child_link"] for name in driven]
    inertials = {ROOT: merged_inertial(table, moving)}
    for link in moving:
        inertials[link] = phalanx_inertial() if _is_finger(link) else table[link]
    return inertials


def merged_inertial(table: Mapping[str, Inertial], moving: list[str]) -> Inertial:
    """Return all that never moves, sensor frames aside, as one body of the torso."""
    frames = posture_frames()
    return facts.lump(
        body.moved(frames[link])
        for link, body in table.items()
        if link not in moving and body.mass > facts.NEGLIGIBLE_MASS
    )


def phalanx_inertial() -> Inertial:
    """Return the mass properties of a finger link."""
    solid = facts.capsule_inertial(
        PHALANX_MASS, PHALANX_RADIUS, PHALANX_SHAFT, PHALANX_PITCH / 2
    )
    inertia = np.maximum(solid.inertia, PHALANX_LEAST_INERTIA * np.eye(3))
    return Inertial(solid.mass, solid.com, inertia)


def _is_finger(link: str) -> bool:
    return "Finger" in link or "Thumb" in link


def _mesh_of(link: str) -> str | None:
    if link == ROOT:
        return "torso"
    if _is_finger(link):
        return "fingertip" if link[1:] in _FINGERTIPS else "phalanx"
    name = _ARM_MESHES.get(link[1:])
    return name and f"{link[0].lower()}_{name}"


def _shapes_of(link: str) -> tuple[Shape, ...]:
    if link == ROOT:
        return _COLLISIONS[ROOT]
    if _is_finger(link):
        return _PHALANX_SHAPES
    shapes = _COLLISIONS.get(link[1:], ())
    return shapes if link[0] in "Ll" else tuple(map(_mirrored, shapes))


def _mirrored(shape: Shape) -> Shape:
    x, y, z = shape.center
    return replace(shape, center=(x, -y, z))


def _link(name: str, inertial: Inertial) -> ET.Element:
    link = ET.Element("link", name=name)
    link.append(_inertial(inertial))
    if mesh := _mesh_of(name):
        geometry = ET.SubElement(ET.SubElement(link, "visual"), "geometry")
        ET.SubElement(geometry, "mesh", filename=f"meshes/{mesh}.glb")
    link.extend(_collision(shape) for shape in _shapes_of(name))
    return link


def _inertial(inertial: Inertial) -> ET.Element:
    element = ET.Element("inertial")
    ET.SubElement(element, "origin", xyz=_text(inertial.com), rpy="0 0 0")
    ET.SubElement(element, "mass", value=_number(inertial.mass))
    tensor = inertial.inertia
    values = {
        f"i{'xyz'[i]}{'xyz'[j]}": _number(tensor[i, j])
        for i in range(3)
        for j in range(i, 3)
    }
    ET.SubElement(element, "inertia", values)
    return element


def _collision(shape: Shape) -> ET.Element:
    element = ET.Element("collision")
    ET.SubElement(element, "origin", xyz=_text(shape.center), rpy="0 0 0")
    geometry = ET.SubElement(element, "geometry")
    if isinstance(shape, Box):
        ET.SubElement(geometry, "box", size=_text(shape.size))
    else:
        ET.SubElement(geometry, "sphere", radius=_number(shape.radius))
    return element


def _joint(row: Row, actuation: Actuation) -> ET.Element:
    joint = ET.Element("joint", name=row["joint"], type="revolute")
    ET.SubElement(joint, "parent", link=row["parent_link"])
    ET.SubElement(joint, "child", link=row["child_link"])
    xyz = " ".join(row[f"origin_{axis}_m"] for axis in "xyz")
    rpy = " ".join(row[f"{angle}_rad"] for angle in ("roll", "pitch", "yaw"))
    ET.SubElement(joint, "origin", xyz=xyz, rpy=rpy)
    axis = [float(row[f"axis_{name}"]) for name in "xyz"]
    ET.SubElement(joint, "axis", xyz=_text(axis))
    ET.SubElement(
        joint,
        "limit",
        lower=_number(math.radians(actuation.lower_deg)),
        upper=_number(math.radians(actuation.upper_deg)),
        effort=_number(actuation.effort),
        velocity=_number(actuation.velocity),
    )
    return joint


def _number(value: float) -> str:
    # Rounded first, so that what should be zero is zero on every machine.
    return f"{round(value, 15) + 0.0:.6g}"


def _text(values: np.ndarray | list[float] | _Vector) -> str:
    return " ".join(_number(value) for value in values)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=FOLDER, help="where to write")
    build(parser.parse_args().folder)
