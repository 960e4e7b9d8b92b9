"""Robot: the NAO humanoid as a ManiSkill agent (paper, Sec. III-A and III-C).

Sections: joints, fingers, actuation, collision, the agent. Replacing the robot means
another file like this one; the environment uses `Nao`'s public methods only.
Legend: N envs, J joints (26), F fingers (6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from xml.etree import ElementTree

import numpy as np
import sapien
import torch
from mani_skill.agents.base_agent import BaseAgent, Keyframe
from mani_skill.agents.controllers import (
    PDJointPosController,
    PDJointPosControllerConfig,
)
from mani_skill.agents.registration import register_agent
from mani_skill.utils.structs import Actor, Link
from torch import Tensor

from ir_maniskill.environment.bodies import positions
from ir_maniskill.environment.contacts import ContactQuery, contact_query

# -- Joints: the action's order, all left then all right --------------------------

ARM_JOINTS = ("ShoulderPitch", "ShoulderRoll", "ElbowYaw", "ElbowRoll", "WristYaw")
FINGER_JOINTS = (
    "Finger11",
    "Finger12",
    "Finger13",
    "Finger21",
    "Finger22",
    "Finger23",
    "Thumb1",
    "Thumb2",
)
JOINTS = tuple(side + joint for side in "LR" for joint in ARM_JOINTS + FINGER_JOINTS)
"""The 26 actuated joints in the order of the action."""

# -- Fingers: the order of the tactile bits ----------------------------------------

FINGERS = ("LFinger1", "LFinger2", "LThumb", "RFinger1", "RFinger2", "RThumb")
"""The six fingers in the order of the tactile bits."""

# -- Actuation -----------------------------------------------------------------------


@dataclass(frozen=True)
class JointGroup:
    """Drive of one kind of joint."""

    stiffness: float
    """Proportional gain [N m / rad]."""
    damping: float
    """Derivative gain [N m s / rad]."""
    armature: float
    """Rotor inertia seen by the joint; without it light fingers explode [kg m^2]."""
    delta: float
    """Largest change of the target in one step [half the joint's range]."""


ARM = JointGroup(stiffness=20.0, damping=2.0, armature=1e-2, delta=0.2)
HAND = JointGroup(stiffness=2.0, damping=0.1, armature=1e-3, delta=0.2)

# -- Collision -----------------------------------------------------------------------

ARM_BIT = {"L": 0, "R": 1}
"""An arm never collides with itself."""
TORSO_BIT = {"L": 2, "R": 3}
"""The torso never collides with the upper arms, which are always close to it; forearms
and hands do collide with it and with the other arm."""
UPPER_ARM = ("Shoulder", "Bicep", "Elbow")

# -- The agent -----------------------------------------------------------------------


class TargetController(PDJointPosController):
    """Joint position targets, kept within the limits, absolute or changed by a delta.

    Differs from its parent in two ways: a delta never winds the target up beyond a
    joint's limit, and all that an action needs is computed once, where it can be.
    """

    config: PDJointPosControllerConfig

    def _initialize_joints(self) -> None:
        super()._initialize_joints()
        limits = self.articulation.get_qlimits()[0, self.active_joint_indices]
        self.lower, self.upper = limits.unbind(-1)  # [J] [rad]
        self._physx_joints = [joint._objs[0] for joint in self.joints]

    def _clip_and_scale_action_space(self) -> None:
        super()._clip_and_scale_action_space()
        low, high = self.action_space_low, self.action_space_high  # [J] [rad]
        self._action_middle, self._action_scale = 0.5 * (high + low), 0.5 * (high - low)

    def _clip_and_scale_action(self, action: Tensor) -> Tensor:
        return self._action_middle + self._action_scale * action.clamp(-1, 1)

    @property
    def target(self) -> Tensor:
        """Current joint position targets [N, J] [rad]."""
        return self._target_qpos

    def set_action(self, action: Tensor) -> None:
        """Set the targets, or change them if the config says `use_delta`.

        Args:
            action: In the order of `config.joint_names` [N, J] in [-1, 1].
        """
        angle = self._preprocess_action(action)
        self.set_drive_targets(self.target + angle if self.config.use_delta else angle)

    def set_drive_targets(self, targets: Tensor) -> None:
        """Send targets to the simulator.

        Args:
            targets: Positions in the order of `config.joint_names` [N, J] [rad].
        """
        self._target_qpos = targets.clamp(self.lower, self.upper)
        if self.scene.gpu_sim_enabled:
            super().set_drive_targets(self._target_qpos)
            return
        for joint, angle in zip(
            self._physx_joints, self._target_qpos[0].tolist(), strict=True
        ):
            joint.set_drive_target(angle)

    def reset(self) -> None:
        """Make the current positions the targets of the envs being reset."""
        super().reset()
        self.set_drive_targets(self._target_qpos)

    def get_state(self) -> dict[str, Tensor]:
        """Return the targets, which are state in every mode."""
        return {"target_qpos": self._target_qpos.clone()}

    def set_state(self, state: dict[str, Tensor]) -> None:
        """Restore what `get_state` returned."""
        self.set_drive_targets(state["target_qpos"])


@dataclass
class TargetControllerConfig(PDJointPosControllerConfig):
    """Config of `TargetController`; the fields are its parent's."""

    controller_cls = TargetController


@register_agent()
class Nao(BaseAgent):
    """NAO V5 with a fixed torso and 26 actuated joints: arms, hands and fingers."""

    uid = "nao"
    urdf_path = str(files("ir_maniskill.assets") / "nao" / "nao.urdf")
    fingers = FINGERS
    start_qpos: Tensor
    """Start of every episode, before jitter: hands over the table [J] [rad]."""

    # -- Loading ---------------------------------------------------------------------

    def _after_loading_articulation(self) -> None:
        effort, speed = _actuator_limits(self.urdf_path)
        self._effort = effort
        for name in JOINTS:
            for joint in self.robot.joints_map[name]._objs:
                joint.set_armature([[_group(name).armature]])
                joint.set_max_velocity(speed[name])
        for link in self.robot.links:
            for bit in _collision_bits(link.name):
                link.set_collision_group_bit(group=2, bit_idx=bit, bit=1)

    def _after_init(self) -> None:
        self.finger_links = tuple(self._links_of(finger) for finger in FINGERS)
        controller = self.controller
        self._order = controller.active_joint_indices  # [J] action order -> qpos
        self._middle = (controller.lower + controller.upper) / 2  # [J] [rad]
        self._half_range = (controller.upper - controller.lower) / 2  # [J] [rad]
        self.keyframes = {
            "hands_over_table": self._keyframe(HANDS_OVER_TABLE),
            "rest": self._keyframe(REST),
        }
        start = self.keyframes["hands_over_table"].qpos
        self.start_qpos = torch.as_tensor(start, device=self.device)

    def _links_of(self, finger: str) -> tuple[Link, ...]:
        names = [n for n in self.robot.links_map if n.startswith(finger)]
        return tuple(self.robot.links_map[n] for n in sorted(names))

    def _keyframe(self, angles: dict[str, float]) -> Keyframe:
        position = self._middle.clone()
        for index, name in enumerate(JOINTS):
            position[index] = angles.get(name, position[index])
        return Keyframe(pose=sapien.Pose(), qpos=self.to_qpos(position).cpu().numpy())

    # -- Control ---------------------------------------------------------------------

    @property
    def _controller_configs(self) -> dict[str, TargetControllerConfig]:
        groups = [_group(name) for name in JOINTS]
        limits = [self.robot.joints_map[j]._objs[0].limits[0] for j in JOINTS]
        delta = np.array([g.delta for g in groups]) * np.ptp(limits, axis=1) / 2
        drive = {
            "joint_names": list(JOINTS),
            "stiffness": [g.stiffness for g in groups],
            "damping": [g.damping for g in groups],
            "force_limit": [self._effort[name] for name in JOINTS],
        }
        return {
            "pd_joint_pos": TargetControllerConfig(lower=None, upper=None, **drive),
            "pd_joint_target_delta_pos": TargetControllerConfig(
                lower=-delta, upper=delta, use_delta=True, use_target=True, **drive
            ),
        }

    def set_action(self, action: Tensor) -> None:
        """Execute an action with the next control step.

        Args:
            action: As the control mode asks, in the order of `JOINTS` [N, J].

        Raises:
            ValueError: It holds NaN (checked on the CPU only).
        """
        if not self.scene.gpu_sim_enabled and bool(action.isnan().any()):
            raise ValueError(f"action: got NaN, expected numbers in [-1, 1]: {action}")
        self.controller.set_action(action)

    def to_qpos(self, position: Tensor) -> Tensor:
        """Reorder joint positions from the action's order to the simulator's.

        Args:
            position: Joint positions in the order of `JOINTS` [..., J] [rad].
        """
        qpos = torch.empty_like(position)
        qpos[..., self._order] = position
        return qpos

    def clamp_qpos(self, qpos: Tensor) -> Tensor:
        """Keep joint positions in the simulator's order within the limits [..., J]."""
        limits = self.robot.get_qlimits()[0]  # [J, 2]
        return qpos.clamp(limits[:, 0], limits[:, 1])

    # -- Senses ----------------------------------------------------------------------

    def get_proprioception(self) -> dict[str, Tensor]:
        """Return what the robot feels of its own joints, in the action's order.

        Returns:
            `proprioception`: joint positions and `target`: joint targets, both
            [N, J] with the joints' limits mapped to [-1, 1].
        """
        return {
            "proprioception": self._normalize(self.robot.get_qpos()[:, self._order]),
            "target": self._normalize(self.controller.target),
        }

    def touch_query(self, objects: Sequence[Actor]) -> ContactQuery:
        """Return a query for the force of each finger on each object [N, F, C] [N].

        Args:
            objects: What the fingers may touch; anything else is not felt.
        """
        return contact_query(self.scene, self.finger_links, objects)

    def joint_velocity(self) -> Tensor:
        """Return joint velocities in the action's order [N, J] [rad/s]."""
        return self.robot.get_qvel()[:, self._order]

    def finger_position(self) -> Tensor:
        """Return where the last link of each finger is [N, F, 3] [m]."""
        return positions([links[-1] for links in self.finger_links])

    def _normalize(self, position: Tensor) -> Tensor:
        return ((position - self._middle) / self._half_range).clamp(-1, 1)


HANDS_OVER_TABLE = {"LShoulderPitch": -0.13, "RShoulderPitch": -0.13}
"""Hands hovering over the objects; joints not named are at the middle [rad]."""

REST = {
    "LShoulderPitch": 1.40,
    "LShoulderRoll": 0.15,
    "LElbowYaw": -1.20,
    "LElbowRoll": -0.40,
    "RShoulderPitch": 1.40,
    "RShoulderRoll": -0.15,
    "RElbowYaw": 1.20,
    "RElbowRoll": 0.40,
}
"""Arms hanging at the sides; joints not named are at the middle [rad]."""


def _group(joint: str) -> JointGroup:
    return HAND if joint[1:] in FINGER_JOINTS else ARM


def _collision_bits(link: str) -> tuple[int, ...]:
    """Return the bits of a link; links that share one never collide."""
    if link == "torso":
        return tuple(TORSO_BIT.values())
    side = link[0].upper()
    if side not in ARM_BIT:
        return ()
    upper = link[1:] in UPPER_ARM
    return (ARM_BIT[side], TORSO_BIT[side]) if upper else (ARM_BIT[side],)


def _actuator_limits(urdf_path: str) -> tuple[dict[str, float], dict[str, float]]:
    """Read effort [N m] and velocity [rad/s] limits, which SAPIEN's loader skips."""
    effort, speed = {}, {}
    for joint in ElementTree.parse(urdf_path).iter("joint"):
        limit = joint.find("limit")
        if limit is not None:
            effort[joint.attrib["name"]] = float(limit.attrib["effort"])
            speed[joint.attrib["name"]] = float(limit.attrib["velocity"])
    return effort, speed
