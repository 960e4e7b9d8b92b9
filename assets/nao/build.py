"""Builds `nao.urdf` and its meshes from the fact tables: `python -m <this module>`.

The same sources give the same files. Only the 26 driven joints remain; everything
else is merged, in the posture of `facts/posture.csv`, into the link `torso`.
"""

import argparse
import xml.etree.ElementTree as ET
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from . import facts
from .facts import Frames, Inertial, Row
from .parts import PALETTE, parts
from .shapes import bake

FOLDER = Path(__file__).parent
ROOT = "torso"

# A solid capsule of 4 g along x, 5.5 mm in radius with a shaft of 10 mm; its least
# inertia is raised for a stable simulation. The public description has no mass here
# worth the name.
PHALANX = Inertial(
    0.004, np.array([0.00718, 0, 0]), np.diag([1e-7, 1.34371e-7, 1.34371e-7])
)
"""Mass properties of every finger link."""

_Vector = tuple[float, float, float]
Shape = tuple[_Vector, _Vector | float]
"""Middle of a collision shape, and the edges of a box or the radius of a ball [m]."""

_FINGERTIPS = ("Finger13_link", "Finger23_link", "Thumb2_link")

# The links between have no look of their own: shoulder, elbow and forearm are round
# about a joint's axis, so that the link on its other side can carry their surface.
_MESHES = {
    ROOT: "torso",
    "LBicep": "l_bicep",
    "RBicep": "r_bicep",
    "l_wrist": "l_hand",
    "r_wrist": "r_hand",
}

# Shoulders and elbows need none: they are never the first to touch anything.
_COLLISIONS: dict[str, tuple[Shape, ...]] = {
    ROOT: (
        ((0.0, 0.0, 0.0), (0.090, 0.120, 0.220)),
        ((0.0, 0.0, 0.180), 0.060),
    ),
    "Bicep": (((0.025, 0.009, 0.0), (0.070, 0.044, 0.044)),),
    "ForeArm": (((0.030, 0.001, 0.0), (0.046, 0.042, 0.042)),),
    "_wrist": (((0.037, 0.0, -0.001), (0.058, 0.046, 0.042)),),
    # Two balls stand for a phalanx: URDF has no capsule that every parser reads, and
    # evenly spaced along the finger they leave dents of 1.3 mm only.
    "phalanx": (((0.00359, 0, 0), 0.0055), ((0.01077, 0, 0), 0.0055)),
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
    joints, driven = facts.read_joints(), facts.read("actuation")
    moving = [joints[row["joint"]]["child_link"] for row in driven]
    robot = _node(
        "robot",
        ET.Comment(" Written by build.py: change that, not this. "),
        *(_link(name, inertial) for name, inertial in link_inertials(moving).items()),
        *(_joint(joints[row["joint"]], row) for row in driven),
        name="nao",
    )
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def link_inertials(moving: list[str]) -> dict[str, Inertial]:
    """Return the mass properties of the model's links, root first.

    All that never moves, sensor frames aside, is one body of the torso.
    """
    table, frames = facts.read_inertials(), posture_frames()
    fixed = facts.lump(
        body.moved(frames[link])
        for link, body in table.items()
        if link not in moving and body.mass > facts.NEGLIGIBLE_MASS
    )
    links = {link: PHALANX if _is_finger(link) else table[link] for link in moving}
    return {ROOT: fixed, **links}


def _is_finger(link: str) -> bool:
    return "Finger" in link or "Thumb" in link


def _mesh_of(link: str) -> str | None:
    if _is_finger(link):
        return "fingertip" if link[1:] in _FINGERTIPS else "phalanx"
    return _MESHES.get(link)


def _shapes_of(link: str) -> tuple[Shape, ...]:
    if _is_finger(link):
        return _COLLISIONS["phalanx"]
    if link == ROOT:
        return _COLLISIONS[ROOT]
    side = 1 if link[0] in "Ll" else -1
    shapes = _COLLISIONS.get(link[1:], ())
    return tuple(((x, side * y, z), size) for (x, y, z), size in shapes)


def _node(tag: str, *children: Any, **attributes: ArrayLike) -> ET.Element:
    """Return an XML element with what is inside."""
    node = ET.Element(tag, {name: _text(value) for name, value in attributes.items()})
    node.extend(children)
    return node


def _text(value: ArrayLike) -> str:
    if isinstance(value, str):
        return value
    # Rounded first, so that what should be zero is zero on every machine.
    return " ".join(f"{round(x, 15) + 0.0:.6g}" for x in np.atleast_1d(value))


def _link(name: str, inertial: Inertial) -> ET.Element:
    parts = [_inertial(inertial)]
    if mesh := _mesh_of(name):
        geometry = _node("geometry", _node("mesh", filename=f"meshes/{mesh}.glb"))
        parts.append(_node("visual", geometry))
    return _node("link", *parts, *map(_collision, _shapes_of(name)), name=name)


def _inertial(inertial: Inertial) -> ET.Element:
    pairs = combinations_with_replacement(range(3), 2)
    tensor = {f"i{'xyz'[i]}{'xyz'[j]}": inertial.inertia[i, j] for i, j in pairs}
    return _node(
        "inertial",
        _node("origin", xyz=inertial.com, rpy="0 0 0"),
        _node("mass", value=inertial.mass),
        _node("inertia", **tensor),
    )


def _collision(shape: Shape) -> ET.Element:
    center, size = shape
    box = isinstance(size, tuple)
    solid = _node("box", size=size) if box else _node("sphere", radius=size)
    origin = _node("origin", xyz=center, rpy="0 0 0")
    return _node("collision", origin, _node("geometry", solid))


def _joint(row: Row, actuation: Row) -> ET.Element:
    names = ("lower_deg", "upper_deg", "effort_nm", "velocity_rad_s")
    lower, upper, effort, velocity = facts.vector(actuation, *names)
    xyz = " ".join(row[f"origin_{axis}_m"] for axis in "xyz")
    rpy = " ".join(row[f"{angle}_rad"] for angle in ("roll", "pitch", "yaw"))
    limits = {"lower": np.radians(lower), "upper": np.radians(upper)}
    return _node(
        "joint",
        _node("parent", link=row["parent_link"]),
        _node("child", link=row["child_link"]),
        _node("origin", xyz=xyz, rpy=rpy),
        _node("axis", xyz=facts.vector(row, "axis_x", "axis_y", "axis_z")),
        _node("limit", **limits, effort=effort, velocity=velocity),
        name=row["joint"],
        type="revolute",
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=FOLDER, help="where to write")
    build(parser.parse_args().folder)
