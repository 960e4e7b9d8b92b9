"""Loads a URDF into a scene with SAPIEN's loader.

Only the joints that the robot names can move, each on its own. All others are fixed, so
qpos always has J entries.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from pathlib import Path

import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.building.articulation_builder import ArticulationBuilder
from mani_skill.utils.sapien_utils import apply_urdf_config, parse_urdf_config

from ir_maniskill.environment.robots.urdf import RobotError


def read_builder(
    scene: ManiSkillScene,
    path: str,
    joints: Collection[str],
    held: Mapping[str, float],
    config: dict | None = None,
) -> ArticulationBuilder:
    """Return a builder of the articulation in a file; only `joints` can move.

    Args:
        scene: Where it is to be built.
        path: The file.
        joints: Driven joints. One that mimics another is driven on its own.
        held: Positions of the fixed joints, 0 if left out [rad] or [m].
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
    """Return the motion of a joint from 0 to a position; its axis is x."""
    if kind == "prismatic":
        return sapien.Pose([position, 0, 0])
    return sapien.Pose(q=[math.cos(position / 2), math.sin(position / 2), 0, 0])
