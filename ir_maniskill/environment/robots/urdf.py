"""Reads a URDF and says what is wrong with it, before a simulator does or does not.

Pure: knows XML and numbers. Errors name the link or joint; `read_urdf` and
`read_motors` name the file too.
"""

from __future__ import annotations

import math
from codecs import BOM_UTF8
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations_with_replacement
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np


class RobotError(ValueError):
    """A robot cannot be used: says what was got, what was expected, what to do."""


NEGLIGIBLE_MASS = 1e-5
"""Mass of what is no body but a frame, at most: its inertia does not matter [kg]."""


def read_urdf(path: Path) -> Element:
    """Return the `robot` element of a file.

    Raises:
        RobotError: There is no such file, or it is no URDF.
    """
    if not path.is_file():
        raise RobotError(f"{path}: no such file")
    try:  # a declaration must come first, but what editors put before it does no harm
        robot = ElementTree.fromstring(path.read_bytes().removeprefix(BOM_UTF8).strip())
    except ElementTree.ParseError as error:
        raise RobotError(f"{path}: not XML, hence no URDF: {error}") from error
    if robot.tag != "robot":
        raise RobotError(f"{path}: got <{robot.tag}>, expected the <robot> of a URDF")
    return robot


@contextmanager
def naming(element: Element) -> Iterator[None]:
    """Have errors within name the link or joint that they are about."""
    try:
        yield
    except ValueError as error:
        name = element.get("name")
        raise RobotError(f"{element.tag} {name!r}: {error}") from error


# -- Motors --------------------------------------------------------------------------


@dataclass(frozen=True)
class Motor:
    """What moves a joint; SAPIEN's loader takes over its range alone."""

    slides: bool
    """Whether the joint is prismatic."""
    effort: float
    """Largest torque [N m], of a slide force [N]."""
    velocity: float
    """Largest speed [rad/s], of a slide [m/s]."""


def read_motors(path: Path, joints: Collection[str]) -> dict[str, Motor]:
    """Return the motors of the named joints, of a file that is found to be sound.

    Raises:
        RobotError: It is not, or a joint is missing or has no limits.
    """
    robot = read_urdf(path)
    try:
        check(robot)
        elements = by_name(robot, "joint")
        if missing := [name for name in joints if name not in elements]:
            moving = [n for n, j in elements.items() if j.get("type") != "fixed"]
            raise RobotError(
                f"missing joints: {', '.join(missing)}; those that move are "
                f"{', '.join(moving) or 'none'}"
            )
        motors = {}
        for name in joints:
            with naming(elements[name]):
                motors[name] = read_motor(elements[name])
    except RobotError as error:
        raise RobotError(f"{path}: {error}") from error
    return motors


def read_motor(joint: Element) -> Motor:
    """Return the motor of a joint.

    Raises:
        RobotError: It has no range, or a limit is missing or not positive.
    """
    kind, limit = joint.get("type"), joint.find("limit")
    given = {} if limit is None else limit.attrib
    try:
        numbers = [float(given[name]) for name in LIMITS]
    except (KeyError, ValueError):
        numbers = [math.nan]
    if kind in ("revolute", "prismatic") and all(map(math.isfinite, numbers)):
        lower, upper, effort, velocity = numbers
        if lower < upper and effort > 0 and velocity > 0:
            return Motor(kind == "prismatic", effort, velocity)
    shown = " ".join(f'{name}="{value}"' for name, value in given.items())
    raise RobotError(
        f"got type {kind!r} with <limit {shown}/>, expected a driven joint to be "
        "revolute or prismatic, with lower < upper and a positive effort and velocity"
    )


LIMITS = ("lower", "upper", "effort", "velocity")
"""What the limit of a driven joint has to say."""


# -- Checks --------------------------------------------------------------------------


def check(robot: Element) -> None:
    """Raise RobotError if a link, or a joint that moves, is one SAPIEN cannot use."""
    for link in by_name(robot, "link").values():
        with naming(link):
            check_link(link)
    for joint in by_name(robot, "joint").values():
        if joint.get("type") != "fixed":
            with naming(joint):
                check_axis(joint)


def check_link(link: Element) -> None:
    """Raise RobotError if a link has an unfit inertia or shape.

    SAPIEN leaves out a shape without a size, and ends the process, later, over one
    that is mirrored.
    """
    for element in link:
        if element.tag == "inertial":
            mass, inertia = mass_and_inertia(element)
            turns = mass <= NEGLIGIBLE_MASS or np.linalg.eigvalsh(inertia).min() > 0
            if mass < 0 or not turns:
                raise RobotError(
                    f"<inertial>: got a mass of {mass:g} kg with moments of inertia "
                    f"{_text(inertia.diagonal())} kg m^2, expected positive ones"
                )
        elif element.tag in ("visual", "collision"):
            _check_geometry(element)


def _check_geometry(shape: Element) -> None:
    geometry = shape.find("geometry")
    if geometry is None or len(geometry) != 1 or geometry[0].tag not in _SIZES:
        got = "none" if geometry is None else _text([part.tag for part in geometry])
        raise RobotError(
            f"<geometry> of its <{shape.tag}>: got {got or 'nothing'}, expected one of "
            f"{', '.join(_SIZES)}"
        )
    body = geometry[0]
    for name, (count, default) in _SIZES[body.tag].items():
        size = numbers(body, name, count, default)
        if min(size) <= 0:
            raise RobotError(
                f"<{body.tag}> {name}: got {_text(size)}, expected positive numbers (a "
                "mesh cannot be mirrored here: mirror its file)"
            )
    if body.tag == "mesh" and not body.get("filename"):
        raise RobotError("<mesh>: missing 'filename'")


_SIZES: dict[str, dict[str, tuple[int, str | None]]] = {
    "box": {"size": (3, None)},
    "sphere": {"radius": (1, None)},
    "cylinder": {"radius": (1, None), "length": (1, None)},
    "capsule": {"radius": (1, None), "length": (1, None)},
    "mesh": {"scale": (3, "1 1 1")},
}
"""For each geometry its sizes: how many numbers, and what they are if left out."""


# -- Elements ------------------------------------------------------------------------


def by_name(robot: Element, tag: str) -> dict[str, Element]:
    """Return the elements of a kind, each of which has a name of its own."""
    found: dict[str, Element] = {}
    for element in robot.findall(tag):
        name = element.get("name")
        if not name:
            raise RobotError(f"a <{tag}> has no name")
        if name in found:
            raise RobotError(f"{tag} {name!r}: got two of that name, expected one")
        found[name] = element
    return found


def part(element: Element, tag: str) -> Element:
    """Return the element within another."""
    found = element.find(tag)
    if found is None:
        raise RobotError(f"missing <{tag}>")
    return found


def get(element: Element, tag: str, attribute: str) -> str:
    """Return an attribute of the element within another."""
    value = part(element, tag).get(attribute)
    if value is None:
        raise RobotError(f"<{tag}>: missing {attribute!r}")
    return value


def numbers(
    element: Element, attribute: str, count: int, default: str | None = None
) -> list[float]:
    """Return an attribute's numbers, of which there must be `count`, all finite."""
    text = element.get(attribute, default)
    try:
        values = [float(word) for word in (text or "").split()]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        kind = "a finite number" if count == 1 else "three numbers"
        raise RobotError(f"<{element.tag}> {attribute}: got {text!r}, expected {kind}")
    return values


def check_axis(joint: Element) -> None:
    """Raise RobotError if the axis of a joint is 0."""
    element = joint.find("axis")
    xyz = [1.0, 0.0, 0.0] if element is None else numbers(element, "xyz", 3, "1 0 0")
    if np.linalg.norm(xyz) < 1e-6:
        raise RobotError(f"<axis> xyz: got {_text(xyz)}, expected a direction")


def mass_and_inertia(inertial: Element) -> tuple[float, np.ndarray]:
    """Return a link's mass [kg] and inertia about its center [kg m^2], [3, 3]."""
    (mass,), tensor = numbers(part(inertial, "mass"), "value", 1), np.zeros((3, 3))
    for name, (i, j) in MOMENTS.items():
        (moment,) = numbers(part(inertial, "inertia"), name, 1)
        tensor[i, j] = tensor[j, i] = moment
    return mass, tensor


MOMENTS = {
    f"i{'xyz'[i]}{'xyz'[j]}": (i, j)
    for i, j in combinations_with_replacement(range(3), 2)
}
"""Names of the moments of inertia, and where they stand in the tensor."""


def _text(values: Collection[object] | np.ndarray) -> str:
    return " ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in values)
