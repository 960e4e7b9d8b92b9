"""Reads a NAO URDF that the user has, and turns it into one like ours.

Official descriptions have joints that we do not drive, fingers that mimic the hand and
weigh nothing, sensor frames, and meshes in ROS packages. What `adapt` returns has the
26 actuated joints of our model, each on its own, and nothing else that moves: every
other link is merged, in our posture, into the moving link that carries it. Kinematics,
masses, shapes and limits are the user's; where they say nothing, ours.

Frames are 4x4 homogeneous transforms, lengths in [m], angles in [rad].
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from trimesh.transformations import euler_from_matrix, euler_matrix, rotation_matrix

from ir_maniskill.assets.nao import facts
from ir_maniskill.environment.robots import urdf
from ir_maniskill.environment.robots.urdf import RobotError, naming

ROOT = "torso"
"""The link that stays at the origin; what it hangs on is left out."""


def adapt(path: Path, ours: str) -> str:
    """Return the text of a URDF like ours that describes the user's NAO.

    A file `package://NAME/REST` or `model://NAME/REST` is looked for in the folders of
    `ROS_PACKAGE_PATH` and `GAZEBO_MODEL_PATH`, in `share` of those of
    `AMENT_PREFIX_PATH`, and in the folders above the URDF.

    Args:
        path: The user's URDF.
        ours: File of our URDF, which says what is actuated.

    Raises:
        RobotError: The file, a joint, a link, a finger's shape, a mesh or a texture is
            missing, or is not fit for a simulator.
    """
    model, robot = urdf.read_urdf(Path(ours)), urdf.read_urdf(path)
    try:
        bodies = _merge(robot, urdf.by_name(model, "joint"))
        _require_fingers(bodies)
        adapted = Element("robot", name="nao")
        adapted.extend(robot.findall("material"))
        for name, our_link in urdf.by_name(model, "link").items():
            adapted.append(bodies[name].link(our_link))
        adapted.extend(body.joint for body in bodies.values() if body.joint is not None)
        _find_files(adapted, path.absolute().parent)
    except RobotError as error:
        raise RobotError(f"NAO URDF {path}: {error}") from error
    return ElementTree.tostring(adapted, encoding="unicode")


# -- Merging -------------------------------------------------------------------------


@dataclass
class _Body:
    """What becomes one link: a link that moves, and all that is fixed to it."""

    joint: Element | None = None
    """The actuated joint that moves it; None for the root."""
    inertials: list[facts.Inertial] = field(default_factory=list)
    """Mass properties of its parts, in its frame."""
    shapes: list[Element] = field(default_factory=list)
    """`visual` and `collision` elements of its parts, in its frame."""

    def add(self, link: Element, frame: np.ndarray) -> None:
        """Add a link that is fixed to this body at `frame`."""
        for part in link:
            place = frame @ _frame(part)
            if part.tag == "inertial":
                mass, inertia = urdf.mass_and_inertia(part)
                body = facts.Inertial(mass, np.zeros(3), inertia)
                self.inertials.append(body.moved(place))
            elif part.tag in ("visual", "collision"):
                self.shapes.append(_move(part, place))

    def link(self, ours: Element) -> Element:
        """Return the URDF's link, with the inertia of ours if it weighs nothing."""
        heavy = [x for x in self.inertials if x.mass > facts.NEGLIGIBLE_MASS]
        link = Element("link", ours.attrib)
        link.append(_inertial_of(heavy) if heavy else urdf.part(ours, "inertial"))
        link.extend(self.shapes)
        return link


def _merge(robot: Element, ours: Mapping[str, Element]) -> dict[str, _Body]:
    """Return the root and what each of our joints moves, by our links' names."""
    links, joints = urdf.by_name(robot, "link"), urdf.by_name(robot, "joint")
    if missing := [name for name in ours if name not in joints]:
        raise RobotError(f"missing joints: {', '.join(missing)}")
    below: dict[str, list[Element]] = {}
    for joint in joints.values():
        with naming(joint):
            below.setdefault(urdf.get(joint, "parent", "link"), []).append(joint)
    bodies = {ROOT: _Body()}
    pending = [(ROOT, ROOT, np.eye(4))]
    while pending:
        name, carrier, frame = pending.pop()
        if name not in links:
            raise RobotError(f"missing link: {name!r} (or two joints move it)")
        link = links.pop(name)
        with naming(link):
            urdf.check_link(link)
            bodies[carrier].add(link, frame)
        for joint in below.get(name, ()):
            with naming(joint):
                pending.append(_follow(joint, ours, bodies, carrier, frame))
    return _in_our_order(bodies, ours)


def _follow(
    joint: Element,
    ours: Mapping[str, Element],
    bodies: dict[str, _Body],
    carrier: str,
    frame: np.ndarray,
) -> tuple[str, str, np.ndarray]:
    """Return a joint's link, what carries it and where; a driven one is a new body."""
    child, place = urdf.get(joint, "child", "link"), frame @ _frame(joint)
    name = joint.attrib["name"]
    if (model := ours.get(name)) is None:
        posture = facts.read_posture().get(name, 0.0)
        if posture:
            place = place @ rotation_matrix(posture, urdf.axis(joint))
        return child, carrier, place
    moved = urdf.get(model, "child", "link")
    bodies[moved] = _Body(_joint(joint, model, carrier, place))
    return child, moved, np.eye(4)


def _in_our_order(
    bodies: Mapping[str, _Body], ours: Mapping[str, Element]
) -> dict[str, _Body]:
    moved = {name: urdf.get(joint, "child", "link") for name, joint in ours.items()}
    if loose := [name for name, link in moved.items() if link not in bodies]:
        raise RobotError(f"joints that the {ROOT} does not carry: {', '.join(loose)}")
    return {name: bodies[name] for name in (ROOT, *moved.values())}


def _joint(given: Element, ours: Element, parent: str, place: np.ndarray) -> Element:
    """Return the user's joint at `place` of our link `parent`, driven on its own."""
    joint = Element("joint", name=given.attrib["name"], type="revolute")
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=urdf.get(ours, "child", "link"))
    _move(joint, place)
    SubElement(joint, "axis", xyz=_text(urdf.axis(given)))
    limit, turns = given.find("limit"), given.get("type") == "revolute"
    if limit is None or not turns or not set(urdf.LIMITS) <= limit.attrib.keys():
        limit = urdf.part(ours, "limit")
    joint.append(limit)
    urdf.read_motor(joint)
    return joint


def _require_fingers(bodies: Mapping[str, _Body]) -> None:
    """Raise unless every finger link has a shape that can touch."""
    numb = [
        name
        for name, body in bodies.items()
        if ("Finger" in name or "Thumb" in name)
        and not any(shape.tag == "collision" for shape in body.shapes)
    ]
    if numb:
        raise RobotError(
            f"finger links without a collision shape: {', '.join(numb)}; touch is "
            "felt by these shapes"
        )


# -- Files ---------------------------------------------------------------------------


def _find_files(robot: Element, home: Path) -> None:
    """Make the names of all meshes and textures absolute.

    Raises:
        RobotError: Some are missing; the message names them and where they could be.
    """
    missing: dict[str, list[str]] = {"mesh": [], "texture": []}
    for element in robot.iter():
        if element.tag in missing:
            name = element.get("filename", "")
            places = _places(name, home)
            found = next((place for place in places if place.is_file()), None)
            if found is None and name not in missing[element.tag]:
                missing[element.tag].append(name)
            element.set("filename", str(found))
    if any(missing.values()):
        kinds = {"meshes": missing["mesh"], "textures": missing["texture"]}
        listed = (f"missing {k}: {', '.join(n[:3])}" for k, n in kinds.items() if n)
        roots = (f"{key}={os.environ.get(key, '')}" for key in _ROOTS)
        raise RobotError(
            f"{'; '.join(listed)}; looked in {', '.join(roots)}, and above {home}"
        )


_ROOTS = {"ROS_PACKAGE_PATH": "", "GAZEBO_MODEL_PATH": "", "AMENT_PREFIX_PATH": "share"}
"""Environment variables that list folders, and where in these packages are."""


def _places(name: str, home: Path) -> Iterator[Path]:
    """Yield the places where a file of that name, or URL, may be."""
    for spelled in dict.fromkeys((name, unquote(name))):
        scheme, _, rest = spelled.rpartition("://")
        if scheme not in ("package", "model"):
            yield home / (rest.removeprefix("localhost") if scheme == "file" else rest)
            continue
        for variable, below in _ROOTS.items():
            for folder in filter(None, os.environ.get(variable, "").split(os.pathsep)):
                yield Path(folder) / below / rest
        for parent in (home, *home.parents):
            yield parent / rest


# -- Elements ------------------------------------------------------------------------


def _frame(element: Element) -> np.ndarray:
    """Return where the element's origin puts it."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    frame = euler_matrix(*urdf.numbers(origin, "rpy", 3, "0 0 0"), axes="sxyz")
    frame[:3, 3] = urdf.numbers(origin, "xyz", 3, "0 0 0")
    return frame


def _move(element: Element, frame: np.ndarray) -> Element:
    """Put the element at `frame`, and return it."""
    origin = element.find("origin")
    if origin is None:
        origin = SubElement(element, "origin")
    origin.set("xyz", _text(frame[:3, 3]))
    origin.set("rpy", _text(euler_from_matrix(frame, axes="sxyz")))
    return element


def _inertial_of(bodies: list[facts.Inertial]) -> Element:
    """Return the element for all bodies together."""
    body, element = facts.lump(bodies), Element("inertial")
    SubElement(element, "origin", xyz=_text(body.com), rpy="0 0 0")
    SubElement(element, "mass", value=str(body.mass))
    moments = {name: str(body.inertia[at]) for name, at in urdf.MOMENTS.items()}
    SubElement(element, "inertia", moments)
    return element


def _text(values: np.ndarray | list[float] | tuple[float, ...]) -> str:
    return " ".join(str(float(value)) for value in values)
