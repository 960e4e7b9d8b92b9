"""Reads a NAO URDF that the user has, and adds what it leaves out.

Official descriptions have meshes in ROS packages, and fingers that mimic the hand, have
no limits and weigh nothing. What `adapt` returns is the same robot from the torso on,
ready for `Robot`, which holds all joints that we do not drive. Kinematics, masses,
shapes and limits are the user's; where they say nothing, ours.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from ir_maniskill.environment.robots import urdf
from ir_maniskill.environment.robots.urdf import NEGLIGIBLE_MASS, RobotError, naming

ROOT = "torso"
"""The link that stays at the origin; what it hangs on is left out."""


def adapt(path: Path, ours: str) -> str:
    """Return the text of a URDF that describes the user's NAO, with our joints.

    A file `package://NAME/REST` or `model://NAME/REST` is looked for in the folders of
    `ROS_PACKAGE_PATH` and `GAZEBO_MODEL_PATH`, in `share` of those of
    `AMENT_PREFIX_PATH`, and in the folders above the URDF.

    Args:
        path: The user's URDF.
        ours: File of our URDF, which says what is actuated.

    Raises:
        RobotError: The file, a joint, a link, a mesh or a texture is missing, or is not
            fit for a simulator.
    """
    model, robot = urdf.read_urdf(Path(ours)), urdf.read_urdf(path)
    try:
        urdf.check(robot)
        adapted = Element("robot", name="nao")
        adapted.extend([*robot.findall("material"), *_from_the_root_on(robot)])
        _complete(adapted, model)
        _find_files(adapted, path.absolute().parent)
    except RobotError as error:
        raise RobotError(f"NAO URDF {path}: {error}") from error
    return ElementTree.tostring(adapted, encoding="unicode")


def _from_the_root_on(robot: Element) -> list[Element]:
    """Return the root, and all joints and links that it carries."""
    links = urdf.by_name(robot, "link")
    below: dict[str, list[tuple[Element, str]]] = {}
    for joint in robot.findall("joint"):
        with naming(joint):
            child = urdf.get(joint, "child", "link")
            below.setdefault(urdf.get(joint, "parent", "link"), []).append(
                (joint, child)
            )
    found, pending = [], [ROOT]
    while pending:
        name = pending.pop()
        if name not in links:
            raise RobotError(f"missing link: {name!r} (or two joints move it)")
        found.append(links.pop(name))
        for joint, child in below.get(name, ()):
            found.append(joint)
            pending.append(child)
    return found


def _complete(robot: Element, ours: Element) -> None:
    """Give driven joints limits, and links a mass, where they have none."""
    joints, links = urdf.by_name(robot, "joint"), urdf.by_name(robot, "link")
    models = urdf.by_name(ours, "joint")
    if missing := [name for name in models if name not in joints]:
        raise RobotError(
            f"missing joints that the {ROOT} carries: {', '.join(missing)}"
        )
    for name, model in models.items():
        joint = joints[name]
        with naming(joint):
            limit, turns = joint.find("limit"), joint.get("type") == "revolute"
            said = set() if limit is None else set(limit.attrib)
            if not (turns and said >= set(urdf.LIMITS)):
                _replace(joint, limit, urdf.part(model, "limit"))
                joint.set("type", "revolute")
            urdf.read_motor(joint)
    for name, model in urdf.by_name(ours, "link").items():
        if name not in links:
            raise RobotError(f"missing link: {name!r}")
        inertial = links[name].find("inertial")
        if inertial is None or urdf.mass_and_inertia(inertial)[0] <= NEGLIGIBLE_MASS:
            _replace(links[name], inertial, urdf.part(model, "inertial"))


def _replace(element: Element, old: Element | None, new: Element) -> None:
    """Put a new part in place of an old one, if there is one."""
    if old is not None:
        element.remove(old)
    element.append(new)


# -- Files ---------------------------------------------------------------------------


def _find_files(robot: Element, home: Path) -> None:
    """Make the names of all meshes and textures absolute.

    Raises:
        RobotError: Some are missing; names them, and the folders that were searched.
    """
    missing = []
    for element in [*robot.iter("mesh"), *robot.iter("texture")]:
        name = element.get("filename", "")
        found = next((place for place in _places(name, home) if place.is_file()), None)
        if found is None:
            missing.append(name)
        element.set("filename", str(found))
    if missing:
        listed = ", ".join(list(dict.fromkeys(missing))[:5])
        roots = ", ".join(f"{key}={os.environ.get(key, '')}" for key in _ROOTS)
        raise RobotError(
            f"missing files: {listed}; looked in {roots}, and above {home}"
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
