"""Reads a NAO URDF that the user has, and turns it into one like ours.

Official descriptions have joints that we do not drive, fingers that mimic the hand and
weigh nothing, sensor frames, and meshes in ROS packages. What `adapt` returns has the
26 actuated joints of our model, each on its own, and nothing else that moves: every
other link is merged, in our posture, into the moving link that carries it. Kinematics,
masses, shapes and limits are the user's; where they say nothing, ours.

Frames are 4x4 homogeneous transforms, lengths in [m], angles in [rad].
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import combinations_with_replacement
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from trimesh.transformations import euler_from_matrix, euler_matrix, rotation_matrix

from ir_maniskill.assets.nao import facts
from ir_maniskill.environment.robots.robot import RobotError

ROOT = "torso"
"""The link that stays at the origin; what it hangs on is left out."""
PACKAGE = "package://"
"""Start of a file's name that is relative to a ROS package."""


def adapt(path: Path, ours: str) -> str:
    """Return the text of a URDF like ours that describes the user's NAO.

    A file `package://NAME/REST` is looked for in the folders of `ROS_PACKAGE_PATH`, in
    `share` of those of `AMENT_PREFIX_PATH`, and in the folders above the URDF.

    Args:
        path: The user's URDF.
        ours: File of our URDF, which says what is actuated.

    Raises:
        RobotError: The file, a joint, a link, a finger's shape or a mesh is missing.
    """
    model = ElementTree.parse(ours).getroot()
    try:
        robot = _read(path)
        bodies = _merge(robot, _by_name(model, "joint"))
        _require_fingers(bodies)
        adapted = Element("robot", name="nao")
        adapted.extend(robot.findall("material"))
        for name, our_link in _by_name(model, "link").items():
            adapted.append(bodies[name].link(our_link))
        adapted.extend(body.joint for body in bodies.values() if body.joint is not None)
        _find_files(adapted, path.absolute().parent)
    except ValueError as error:  # of ours, or a number that is none
        raise RobotError(f"NAO URDF {path}: {error}") from error
    return ElementTree.tostring(adapted, encoding="unicode")


def _read(path: Path) -> Element:
    if not path.is_file():
        raise RobotError("no such file")
    try:
        robot = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise RobotError(f"not XML, hence no URDF: {error}") from error
    if robot.tag != "robot":
        raise RobotError(f"got <{robot.tag}>, expected the <robot> of a URDF")
    return robot


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
                self.inertials.append(_inertial(part).moved(place))
            elif part.tag in ("visual", "collision"):
                self.shapes.append(_move(part, place))

    def link(self, ours: Element) -> Element:
        """Return the URDF's link, with the inertia of ours if it weighs nothing."""
        heavy = [x for x in self.inertials if x.mass > facts.NEGLIGIBLE_MASS]
        link = Element("link", ours.attrib)
        link.append(_inertial_of(heavy) if heavy else _part(ours, "inertial"))
        link.extend(self.shapes)
        return link


def _merge(robot: Element, ours: Mapping[str, Element]) -> dict[str, _Body]:
    """Return the root and what each of our joints moves, by our links' names."""
    links, joints = _by_name(robot, "link"), _by_name(robot, "joint")
    if missing := [name for name in ours if name not in joints]:
        raise RobotError(f"missing joints: {', '.join(missing)}")
    below: dict[str, list[Element]] = {}
    for joint in joints.values():
        below.setdefault(_get(joint, "parent", "link"), []).append(joint)
    posture, bodies = facts.read_posture(), {ROOT: _Body()}
    pending = [(ROOT, ROOT, np.eye(4))]
    while pending:
        name, carrier, frame = pending.pop()
        if name not in links:
            raise RobotError(f"missing link: {name!r} (or two joints move it)")
        bodies[carrier].add(links.pop(name), frame)
        for joint in below.get(name, ()):
            child, place = _get(joint, "child", "link"), frame @ _frame(joint)
            if (model := ours.get(key := joint.attrib["name"])) is not None:
                moved = _get(model, "child", "link")
                bodies[moved] = _Body(_joint(joint, model, carrier, place))
                pending.append((child, moved, np.eye(4)))
            else:
                place = place @ _motion(joint, posture.get(key, 0.0))
                pending.append((child, carrier, place))
    return _in_our_order(bodies, ours)


def _in_our_order(
    bodies: Mapping[str, _Body], ours: Mapping[str, Element]
) -> dict[str, _Body]:
    moved = {name: _get(joint, "child", "link") for name, joint in ours.items()}
    if loose := [name for name, link in moved.items() if link not in bodies]:
        raise RobotError(f"joints that the {ROOT} does not carry: {', '.join(loose)}")
    return {name: bodies[name] for name in (ROOT, *moved.values())}


def _joint(given: Element, ours: Element, parent: str, place: np.ndarray) -> Element:
    """Return the user's joint at `place` of our link `parent`, driven on its own."""
    joint = Element("joint", name=given.attrib["name"], type="revolute")
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=_get(ours, "child", "link"))
    _move(joint, place)
    SubElement(joint, "axis", xyz=_text(_axis(given)))
    limit, wanted = given.find("limit"), ("lower", "upper", "effort", "velocity")
    turns = given.get("type") == "revolute"
    if limit is None or not turns or not set(wanted) <= limit.attrib.keys():
        limit = _part(ours, "limit")
    joint.append(limit)
    lower, upper, *_ = (_number(joint, "limit", name) for name in wanted)
    if lower >= upper:
        name = given.attrib["name"]
        raise RobotError(f"<limit> of {name!r}: got {lower} to {upper}, no range")
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
    missing = []
    for element in robot.iter():
        if element.tag in ("mesh", "texture"):
            name = element.get("filename", "")
            places = _places(name, home)
            found = next((place for place in places if place.is_file()), None)
            if found is None:
                missing.append(name)
            element.set("filename", str(found))
    if missing:
        names = list(dict.fromkeys(missing))
        more = f" and {len(names) - 3} more" if len(names) > 3 else ""
        roots = (f"{key}={os.environ.get(key, '')}" for key in _ROOTS)
        raise RobotError(
            f"missing meshes: {', '.join(names[:3])}{more}; looked in "
            f"{' and '.join(roots)}, and above {home}"
        )


_ROOTS = {"ROS_PACKAGE_PATH": "", "AMENT_PREFIX_PATH": "share"}
"""Environment variables that list folders, and where in these packages are."""


def _places(name: str, home: Path) -> Iterator[Path]:
    """Yield the places where a file of that name may be."""
    if not name.startswith(PACKAGE):
        yield home / name.removeprefix("file://")
        return
    inside = name.removeprefix(PACKAGE)
    for variable, below in _ROOTS.items():
        for folder in filter(None, os.environ.get(variable, "").split(os.pathsep)):
            yield Path(folder) / below / inside
    for parent in (home, *home.parents):
        yield parent / inside


# -- Elements ------------------------------------------------------------------------

_MOMENTS = {
    f"i{'xyz'[i]}{'xyz'[j]}": (i, j)
    for i, j in combinations_with_replacement(range(3), 2)
}
"""Names of the moments of inertia, and where they stand in the tensor."""


def _by_name(parent: Element, tag: str) -> dict[str, Element]:
    found = parent.findall(tag)
    if any("name" not in element.attrib for element in found):
        raise RobotError(f"a <{tag}> has no name")
    return {element.attrib["name"]: element for element in found}


def _part(element: Element, tag: str) -> Element:
    part = element.find(tag)
    if part is None:
        raise RobotError(f"{element.tag} {element.get('name')!r}: missing <{tag}>")
    return part


def _get(element: Element, tag: str, attribute: str) -> str:
    value = _part(element, tag).get(attribute)
    if value is None:
        raise RobotError(f"<{tag}> of {element.get('name')!r}: missing {attribute!r}")
    return value


def _vector(element: Element | None, attribute: str, default: str) -> list[float]:
    text = default if element is None else element.get(attribute, default)
    values = [float(number) for number in text.split()]
    if len(values) != 3 or not all(map(math.isfinite, values)):
        raise RobotError(f"{attribute}: got {text!r}, expected three numbers")
    return values


def _number(element: Element, tag: str, attribute: str) -> float:
    value = float(_get(element, tag, attribute))
    if not math.isfinite(value):
        raise RobotError(f"<{tag}> {attribute}: got {value}, expected a finite number")
    return value


def _frame(element: Element) -> np.ndarray:
    """Return where the element's origin puts it."""
    origin = element.find("origin")
    frame = euler_matrix(*_vector(origin, "rpy", "0 0 0"), axes="sxyz")
    frame[:3, 3] = _vector(origin, "xyz", "0 0 0")
    return frame


def _move(element: Element, frame: np.ndarray) -> Element:
    """Put the element at `frame`, and return it."""
    origin = element.find("origin")
    if origin is None:
        origin = SubElement(element, "origin")
    origin.set("xyz", _text(frame[:3, 3]))
    origin.set("rpy", _text(euler_from_matrix(frame, axes="sxyz")))
    return element


def _axis(joint: Element) -> list[float]:
    return _vector(joint.find("axis"), "xyz", "1 0 0")


def _motion(joint: Element, angle: float) -> np.ndarray:
    return rotation_matrix(angle, _axis(joint)) if angle else np.eye(4)


def _inertial(element: Element) -> facts.Inertial:
    """Return mass and inertia, as if the element's origin were that of the link."""
    mass, tensor = _number(element, "mass", "value"), np.zeros((3, 3))
    for name, (i, j) in _MOMENTS.items():
        tensor[i, j] = tensor[j, i] = _number(element, "inertia", name)
    return facts.Inertial(mass, np.zeros(3), tensor)


def _inertial_of(bodies: list[facts.Inertial]) -> Element:
    """Return the element for all bodies together."""
    body, element = facts.lump(bodies), Element("inertial")
    SubElement(element, "origin", xyz=_text(body.com), rpy="0 0 0")
    SubElement(element, "mass", value=str(body.mass))
    moments = {name: str(body.inertia[at]) for name, at in _MOMENTS.items()}
    SubElement(element, "inertia", moments)
    return element


def _text(values: np.ndarray | list[float] | tuple[float, ...]) -> str:
    return " ".join(str(float(value)) for value in values)
