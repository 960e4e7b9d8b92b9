"""Robot: what the tasks ask of any robot, and how its joints are driven.

A robot of your own is a subclass of `Robot` that names its file, joints, fingers and
drives, in a file like `nao.py`; tasks take it as `gym.make(ID, robot_uids=...)`.
Legend: N envs, J joints, F fingers, C objects.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np
import sapien
import torch
from mani_skill.agents.base_agent import BaseAgent, Keyframe
from mani_skill.agents.controllers import (
    PDJointPosController,
    PDJointPosControllerConfig,
)
from mani_skill.agents.registration import REGISTERED_AGENTS
from mani_skill.utils.structs import Actor, Link
from torch import Tensor

from ir_maniskill.environment import contacts
from ir_maniskill.environment.bodies import positions


class RobotError(ValueError):
    """A robot cannot be used: says what was got, what was expected, what to do."""


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


class TargetController(PDJointPosController):
    """Joint position targets, kept within the limits, absolute or changed by a delta.

    Differs from its parent in three ways: a delta never winds the target up beyond a
    joint's limit, all that an action needs is computed once, where it can be, and a
    reset of the env leaves the targets of other envs, and those of a restored state.
    """

    config: PDJointPosControllerConfig
    _stale: Tensor | None = None
    """While the env is being reset: whose targets `reset` is to set anew [N] bool."""

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

        Raises:
            ValueError: They hold NaN (checked on the CPU only).
        """
        targets = targets.clamp(self.lower, self.upper)
        if self.scene.gpu_sim_enabled:
            # Of a batch ManiSkill takes the rows of the envs being reset alone.
            super().set_drive_targets(targets[self.scene._reset_mask])
        else:
            angles = targets.tolist()[0]
            if math.isnan(sum(angles)):
                raise ValueError(
                    f"joint targets: got {angles}, expected no NaN: look at the action"
                )
            for joint, angle in zip(self._physx_joints, angles, strict=True):
                joint.set_drive_target(angle)
        self._target_qpos = targets

    def begin_reset(self) -> None:
        """Take note of the envs being reset, which ManiSkill forgets before `reset`."""
        self._stale = self.scene._reset_mask.clone()

    def reset(self) -> None:
        """Make the current positions the targets.

        Within a reset of the env: of the envs being reset, unless `set_state` has
        restored their targets since.
        """
        everyone = self.scene._reset_mask
        if self._stale is not None:
            self.scene._reset_mask, self._stale = self._stale, None
        super().reset()
        self.scene._reset_mask = everyone
        self.set_drive_targets(self._target_qpos)

    def get_state(self) -> dict[str, Tensor]:
        """Return the targets, which are state in every mode."""
        return {"target_qpos": self._target_qpos.clone()}

    def set_state(self, state: dict[str, Tensor]) -> None:
        """Restore what `get_state` returned."""
        self.set_drive_targets(state["target_qpos"])
        if self._stale is not None:
            self._stale = torch.zeros_like(self._stale)


@dataclass
class TargetControllerConfig(PDJointPosControllerConfig):
    """Config of `TargetController`; the fields are its parent's."""

    controller_cls = TargetController


class Robot(BaseAgent, ABC):
    """A robot for the tasks, its root fixed at the origin behind the table.

    A subclass sets `uid` and `urdf_path`, which are ManiSkill's, and what follows. Its
    joints need position, effort and velocity limits in the URDF.
    """

    joints: tuple[str, ...]
    """The actuated joints in the order of the action."""
    fingers: tuple[str, ...]
    """What feels touch, in the order of the tactile bits: the links of a finger are
    those whose names start with its name."""
    postures: Mapping[str, Mapping[str, float]]
    """Keyframes: angles of joints by name; those not named are at the middle [rad]. The
    first is the start of every episode, before jitter."""
    start_qpos: Tensor
    """Start of every episode, in the simulator's order [J] [rad]."""

    @abstractmethod
    def drive(self, joint: str) -> JointGroup:
        """Return how a joint is driven."""

    # -- Loading ---------------------------------------------------------------------

    def _load_articulation(self, initial_pose: Any = None) -> None:
        super()._load_articulation(initial_pose)
        self._effort, self._speed = _actuator_limits(self.urdf_path)

    def _after_loading_articulation(self) -> None:
        self._require_joints()
        for name in self.joints:
            for joint in self.robot.joints_map[name]._objs:
                joint.set_armature([[self.drive(name).armature]])
                joint.set_max_velocity(self._speed[name])

    def _require_joints(self) -> None:
        """Raise unless the actuated joints are those that move and have limits."""
        got = {joint.name for joint in self.robot.active_joints} & self._effort.keys()
        wrong = sorted(got.symmetric_difference(self.joints))
        if wrong:
            raise RobotError(
                f"joints of the robot {self.uid!r}: its class and {self.urdf_path} "
                f"differ in {', '.join(wrong)}; expected `joints` to name all that "
                "move, each with a limit of position, effort and velocity in the file"
            )

    def _after_init(self) -> None:
        self.finger_links = tuple(self._links_of(finger) for finger in self.fingers)
        controller = self.controller
        self._order = controller.active_joint_indices  # [J] action order -> qpos
        self._middle = (controller.lower + controller.upper) / 2  # [J] [rad]
        self._half_range = (controller.upper - controller.lower) / 2  # [J] [rad]
        self.keyframes = {
            name: self._keyframe(angles) for name, angles in self.postures.items()
        }
        start = next(iter(self.keyframes.values())).qpos
        self.start_qpos = torch.as_tensor(start, device=self.device)

    def _links_of(self, finger: str) -> tuple[Link, ...]:
        names = [n for n in self.robot.links_map if n.startswith(finger)]
        if not names:
            raise RobotError(
                f"finger {finger!r} of the robot {self.uid!r}: no link has a name that "
                f"starts so, available: {', '.join(self.robot.links_map)}"
            )
        return tuple(self.robot.links_map[n] for n in sorted(names))

    def _keyframe(self, angles: Mapping[str, float]) -> Keyframe:
        position = self._middle.clone()
        for index, name in enumerate(self.joints):
            position[index] = angles.get(name, position[index])
        return Keyframe(pose=sapien.Pose(), qpos=self.to_qpos(position).cpu().numpy())

    # -- Control ---------------------------------------------------------------------

    def reset(self, init_qpos: Tensor | None = None) -> None:
        """Bring the envs being reset to rest; ManiSkill's reset begins with it.

        Args:
            init_qpos: Joint positions to take, in the simulator's order [N, J] [rad].
        """
        super().reset(init_qpos)
        self.controller.begin_reset()

    @property
    def _controller_configs(self) -> dict[str, TargetControllerConfig]:
        groups = [self.drive(name) for name in self.joints]
        limits = [self.robot.joints_map[j]._objs[0].limits[0] for j in self.joints]
        delta = np.array([g.delta for g in groups]) * np.ptp(limits, axis=1) / 2
        drive = {
            "joint_names": list(self.joints),
            "stiffness": [g.stiffness for g in groups],
            "damping": [g.damping for g in groups],
            "force_limit": [self._effort[name] for name in self.joints],
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
            action: As the control mode asks, in the order of `joints` [N, J].

        Raises:
            ValueError: It leads to NaN (checked on the CPU only).
        """
        self.controller.set_action(action)

    def to_qpos(self, position: Tensor) -> Tensor:
        """Reorder joint positions from the action's order to the simulator's.

        Args:
            position: Joint positions in the order of `joints` [..., J] [rad].
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
            "proprioception": self._normalize(self._ordered(self.robot.get_qpos())),
            "target": self._normalize(self.controller.target),
        }

    def touch_sensor(
        self, objects: Sequence[Actor]
    ) -> contacts.CpuTouchSensor | contacts.GpuTouchSensor:
        """Return a sensor of which finger touches which object [N, F, C].

        Args:
            objects: What the fingers may touch; anything else is not felt.
        """
        return contacts.touch_sensor(self.scene, self.finger_links, objects)

    def joint_velocity(self) -> Tensor:
        """Return joint velocities in the action's order [N, J] [rad/s]."""
        return self._ordered(self.robot.get_qvel())

    def finger_position(self) -> Tensor:
        """Return where the last link of each finger is [N, F, 3] [m]."""
        return positions([links[-1] for links in self.finger_links])

    def _ordered(self, joints: Tensor) -> Tensor:
        """Reorder [N, J] from the simulator's order to the action's."""
        return joints.index_select(1, self._order)

    def _normalize(self, position: Tensor) -> Tensor:
        return ((position - self._middle) / self._half_range).clamp(-1, 1)


def available_robots() -> tuple[str, ...]:
    """Return the uids of the registered robots that the tasks can use."""
    agents = {uid: spec.agent_cls for uid, spec in REGISTERED_AGENTS.items()}
    return tuple(uid for uid, cls in agents.items() if issubclass(cls, Robot))


def require_robot(robot: str | type[BaseAgent]) -> None:
    """Raise unless the tasks can use a robot, given by uid or class.

    Raises:
        RobotError: It is not registered, or not a `Robot`.
    """
    known = isinstance(robot, type) and issubclass(robot, Robot)
    if not known and robot not in available_robots():
        raise RobotError(
            f"robot_uids: got {robot!r}, expected a subclass of Robot or the uid of a "
            f"registered one, available: {', '.join(available_robots())}"
        )


def _actuator_limits(urdf_path: str) -> tuple[dict[str, float], dict[str, float]]:
    """Read effort [N m] and velocity [rad/s] limits, which SAPIEN's loader skips."""
    effort, speed = {}, {}
    for joint in ElementTree.parse(urdf_path).iter("joint"):
        limit = joint.find("limit")
        if limit is not None and {"effort", "velocity"} <= limit.attrib.keys():
            effort[joint.attrib["name"]] = float(limit.attrib["effort"])
            speed[joint.attrib["name"]] = float(limit.attrib["velocity"])
    return effort, speed
