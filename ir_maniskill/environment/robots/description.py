"""A robot's description (URDF): what it says of motors, and how it is loaded.

Of all that moves in a description, the joints that the robot names are driven, each on
its own, and the others are held: so qpos is J joints, whatever the file has.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.building.articulation_builder import ArticulationBuilder
from mani_skill.utils.sapien_utils import apply_urdf_config, parse_urdf_config


class RobotError(ValueError):
    """A robot cannot be used: says what was got, what was expected, what to do."""


@dataclass(frozen=True)
class Motor:
    """What moves a joint; SAPIEN's loader takes over its range alone."""

    slides: bool
    """Whether the joint is prismatic."""
    lower: float
    """Least position [rad], of a slide [m]."""
    upper: float
    """Greatest position [rad], of a slide [m]."""
    effort: float
    """Largest torque [N m], of a slide force [N]."""
    velocity: float
    """Largest speed [rad/s], of a slide [m/s]."""


def read_urdf(path: Path) -> Element:
    """Return the `robot` element of a file.

    Raises:
        RobotError: There is no such file, or it is no URDF.
    """
    if not path.is_file():
        raise RobotError(f"{path}: no such file")
    try:  # a declaration must come first, but what editors put before it does no harm
        robot = ElementTree.fromstring(path.read_bytes().removeprefix(_BOM).strip())
    except ElementTree.ParseError as error:
        raise RobotError(f"{path}: not XML, hence no URDF: {error}") from error
    if robot.tag != "robot":
        raise RobotError(f"{path}: got <{robot.tag}>, expected the <robot> of a URDF")
    return robot


_BOM = b"\xef\xbb\xbf"
"""The mark with which some editors begin a file in UTF-8."""


def read_motors(path: Path, joints: Collection[str]) -> dict[str, Motor]:
    """Return the motors of the named joints.

    Raises:
        RobotError: A joint is missing, or has no limits; the message names it.
    """
    elements = {j.get("name", ""): j for j in read_urdf(path).findall("joint")}
    if missing := [name for name in joints if name not in elements]:
        moving = [name for name, j in elements.items() if j.get("type") != "fixed"]
        raise RobotError(
            f"{path}: missing joints: {', '.join(missing)}; those that move are "
            f"{', '.join(moving) or 'none'}"
        )
    return {name: _read_motor(elements[name], path) for name in joints}


def _read_motor(joint: Element, path: Path) -> Motor:
    kind, limit = joint.get("type"), joint.find("limit")
    given = {} if limit is None else limit.attrib
    try:
        numbers = [float(given[name]) for name in _LIMITS]
    except (KeyError, ValueError):
        numbers = [math.nan]
    if kind in ("revolute", "prismatic") and all(map(math.isfinite, numbers)):
        motor = Motor(kind == "prismatic", *numbers)
        if motor.lower < motor.upper and motor.effort > 0 and motor.velocity > 0:
            return motor
    shown = " ".join(f'{name}="{value}"' for name, value in given.items())
    raise RobotError(
        f"{path}: joint {joint.get('name')!r}: got type {kind!r} with <limit {shown}/>,"
        " expected a driven joint to be revolute or prismatic, with lower < upper and "
        "a positive effort and velocity"
    )


_LIMITS = ("lower", "upper", "effort", "velocity")


def read_builder(
    scene: ManiSkillScene,
    path: str,
    joints: Collection[str],
    held: Mapping[str, float],
    config: dict | None = None,
) -> ArticulationBuilder:
    """Return a builder of what a file describes, in which only `joints` move.

    Args:
        scene: Where it is to be built.
        path: The file.
        joints: Those that are driven. One that mimics another is driven on its own.
        held: Where the other joints stand still, 0 if left out [rad] or [m].
        config: ManiSkill's `urdf_config`: materials of links.

    Raises:
        RobotError: SAPIEN cannot make sense of the file.
    """
    loader = scene.create_urdf_loader()
    loader.name, loader.fix_root_link = Path(path).stem, True
    if config is not None:
        apply_urdf_config(loader, parse_urdf_config(config))
    try:
        (builder,) = loader.parse(path)["articulation_builders"]
    except Exception as error:  # of urchin, lxml or SAPIEN, and of any kind
        raise RobotError(f"{path}: SAPIEN cannot load it: {error!r}") from error
    builder.mimic_joint_records.clear()
    for link in builder.link_builders:
        joint = link.joint_record
        if joint.joint_type not in ("fixed", "undefined") and joint.name not in joints:
            motion = _motion(joint.joint_type, held.get(joint.name, 0.0))
            joint.pose_in_parent = joint.pose_in_parent * motion
            joint.joint_type = "fixed"
    return builder


def _motion(kind: str, position: float) -> sapien.Pose:
    """Return what a joint, which moves along or about x, does from 0 to a position."""
    if kind == "prismatic":
        return sapien.Pose([position, 0, 0])
    return sapien.Pose(q=[math.cos(position / 2), math.sin(position / 2), 0, 0])
