"""Robot: what the tasks ask of any robot, and how its joints are driven.

A robot of your own is a subclass of `Robot` that describes it, in a file like `nao.py`;
tasks take it as `gym.make(ID, robot_uids=...)`.
Legend: N envs, J joints, F fingers, C objects.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.agents.base_agent import BaseAgent, Keyframe
from mani_skill.agents.registration import REGISTERED_AGENTS
from mani_skill.utils.structs import Actor
from torch import Tensor

from ir_maniskill.checks import require, require_choice
from ir_maniskill.environment.bodies import poses
from ir_maniskill.environment.contacts import CpuTouchSensor, GpuTouchSensor
from ir_maniskill.environment.robots.controller import TargetControllerConfig
from ir_maniskill.environment.robots.loader import read_builder
from ir_maniskill.environment.robots.urdf import RobotError, read_motors
from ir_maniskill.experiment import Drawn, Experiment, ExperimentError

SLACK = 1e-3
"""How far a posture may be beyond a limit, by rounding [rad, m]."""


@dataclass(frozen=True)
class JointGroup:
    """Drive of one kind of joint; of a slide, read N for N m and m for rad."""

    stiffness: float
    """Proportional gain [N m / rad]."""
    damping: float
    """Derivative gain [N m s / rad]."""
    armature: float
    """Rotor inertia seen by the joint; without it light fingers explode [kg m^2]."""
    delta: float
    """Largest change of the target in one step [half the joint's range]."""
    speed: float = math.inf
    """Largest speed, where the file allows more [rad/s]."""


class Robot(BaseAgent, ABC):
    """A robot for the tasks, its root fixed behind the table.

    A subclass sets `uid` and `urdf_path`, which are ManiSkill's, and what follows. The
    world has x forward, y left, z up, and the objects' places are `scale` times those
    of the experiment.
    """

    joints: tuple[str, ...]
    """The actuated joints in the order of the action, revolute or prismatic, each with
    its limits in the file. Other joints are held where the first posture has them, or
    at 0; a joint that mimics another is driven on its own if it is named here."""
    hands: Mapping[str, tuple[str, ...]]
    """Names of the hands, and the fingers of each: what feels touch."""
    fingertips: Mapping[str, str]
    """The link of each finger that is to reach an object."""
    phalanges: Mapping[str, tuple[str, ...]] = {}
    """The links by which a finger feels. Of a finger that is left out, they are those
    whose names start with its name."""
    postures: Mapping[str, Mapping[str, float]]
    """Keyframes: angles of joints by name; those not named are at the middle [rad]. The
    first is the start of every episode, before jitter."""
    mount: sapien.Pose = sapien.Pose()
    """Where the root link stands in the world."""
    stand: float = 0.0
    """Width of the pillar under the root link, 0 if there are feet [m]."""
    rebound: float = math.inf
    """Fastest that a link is pushed out of what it got into; a strong arm with light
    fingers explodes without a limit [m/s]."""
    solver_iterations: int = 15
    """Position iterations of the solver in a physics step of `Spoken` tasks: what
    physics costs most. With too few, limits give way and fingers slip off things."""
    scale: float = 1.0
    """How large table, objects, layout and cameras are, beside NAO's."""
    shoulders: tuple[tuple[float, float], ...]
    """Where the arm of each hand starts in the world, seen from above (x, y) [m]."""
    reach: float
    """Farthest that an object may be from a shoulder, seen from above [m]."""
    mirror: Mapping[str, tuple[str, float]] = {}
    """If left and right are alike: of each joint and finger the one on the other side,
    and the sign of its angle there. The learner `sac` then learns from what it did as
    if it had been the other way round, too; cameras must stand in the middle."""

    @abstractmethod
    def drive(self, joint: str) -> JointGroup:
        """Return how a joint is driven."""

    def collision_bits(self, link: str) -> tuple[int, ...]:
        """Return the bits (0 to 31) of a link; links that share one never collide."""
        return ()

    @property
    def fingers(self) -> tuple[str, ...]:
        """The fingers of all hands, in the order of the tactile bits."""
        return tuple(finger for hand in self.hands.values() for finger in hand)

    @classmethod
    def require_reach(cls, experiment: Experiment) -> None:
        """Raise unless the robot can reach whatever an experiment lays out.

        Raises:
            ExperimentError: An object may lie too far from every shoulder.
        """
        if isinstance(experiment.objects, Drawn):
            return  # what is drawn is drawn within reach
        slack = experiment.jitter.position * math.sqrt(2)
        for thing in experiment.objects:
            place = [cls.scale * value for value in thing.position]
            far = min(math.dist(place, shoulder) for shoulder in cls.shoulders)
            if (far := far + cls.scale * slack) > cls.reach + 1e-9:
                raise ExperimentError(
                    f"{thing.name} at {thing.position}: {far:.3f} m from the nearest "
                    f"shoulder of the robot {cls.uid!r} with jitter, at its scale of "
                    f"{cls.scale:g}, expected at most {cls.reach} m"
                )

    # -- Loading ---------------------------------------------------------------------

    def _load_articulation(self, initial_pose: Any = None) -> None:
        what, positive = f"of the robot {self.uid!r}", "a finite number above 0"
        for name in ("scale", "reach"):
            value = getattr(self, name)
            require(0 < value < math.inf, f"{name} {what}", value, positive, RobotError)
        shoulders, each = self.shoulders, f"one for each of {tuple(self.hands)}"
        paired = len(shoulders) == len(self.hands)
        require(paired, f"shoulders {what}", shoulders, each, RobotError)
        named = len(self.postures) > 0
        require(named, f"postures {what}", self.postures, "at least one", RobotError)
        path = str(self.urdf_path)
        self._motors = read_motors(Path(path), self.joints)
        held = next(iter(self.postures.values()))
        builder = read_builder(self.scene, path, self.joints, held, self.urdf_config)
        known = [link.joint_record.name for link in builder.link_builders]
        for name in chain.from_iterable(self.postures.values()):
            require_choice(f"joint of a posture {what}", name, known, RobotError)
        builder.set_name(self.uid)
        builder.initial_pose = self.mount
        self.robot = builder.build()
        self.robot_link_names = [link.name for link in self.robot.links]
        self._shapes = {b.name: len(b.collision_records) for b in builder.link_builders}

    def _require_shapes(self) -> None:
        """Raise unless all collision shapes were made: SAPIEN says nothing if not."""
        links = self.robot.links_map
        made = {n: len(links[n]._bodies[0].collision_shapes) for n in self._shapes}
        broken = [name for name, count in self._shapes.items() if made[name] < count]
        if broken:
            raise RobotError(
                f"{self.urdf_path}: links with a collision shape that cannot be made: "
                f"{', '.join(broken)}; expected meshes with a volume"
            )
        for finger in self.fingers:
            names = self._phalanges_of(finger)
            if not any(made[name] for name in names):
                raise RobotError(
                    f"{self.urdf_path}: finger {finger!r} of the robot {self.uid!r}: "
                    f"no collision shape in {', '.join(names)}, so it feels nothing"
                )

    def _after_loading_articulation(self) -> None:
        self._require_shapes()
        for name, motor in self._motors.items():
            drive = self.drive(name)
            for joint in self.robot.joints_map[name]._objs:
                joint.set_armature([[drive.armature]])
                joint.set_max_velocity(min(motor.velocity, drive.speed))
        for link in self.robot.links:
            for body in link._bodies if self.rebound < math.inf else ():
                body.set_max_depenetration_velocity(self.rebound)
            for bit in self.collision_bits(link.name):
                link.set_collision_group_bit(group=2, bit_idx=bit, bit=1)

    def _after_init(self) -> None:
        links = self.robot.links_map
        self.finger_links = tuple(
            tuple(links[name] for name in self._phalanges_of(finger))
            for finger in self.fingers
        )
        self.fingertip_links = tuple(links[self._tip_of(f)] for f in self.fingers)
        controller = self.controller
        self._order = controller.active_joint_indices  # [J] action order -> qpos
        # ManiSkill's `get_qlimits` goes through all envs, so it is asked only once.
        self._limits = [self._to_qpos(x) for x in (controller.lower, controller.upper)]
        self._middle = (controller.lower + controller.upper) / 2  # [J] [rad]
        self._half_range = (controller.upper - controller.lower) / 2  # [J] [rad]
        slides = torch.tensor([self._motors[name].slides for name in self.joints])
        unit = self._half_range / (math.pi / 2)
        unit = unit.where(slides.to(self.device), 1.0)
        self._jitter_unit = self._to_qpos(unit)
        self.keyframes = {
            name: self._keyframe(angles) for name, angles in self.postures.items()
        }
        start = next(iter(self.keyframes.values())).qpos
        self._start = torch.as_tensor(start, device=self.device)

    def _phalanges_of(self, finger: str) -> tuple[str, ...]:
        """Return the names of a finger's links."""
        links = list(self.robot.links_map)
        mine = sorted(name for name in links if name.startswith(finger))
        return self._require_links(finger, self.phalanges.get(finger, tuple(mine)))

    def _tip_of(self, finger: str) -> str:
        tip = self.fingertips.get(finger)
        return self._require_links(finger, () if tip is None else (tip,))[0]

    def _require_links(self, finger: str, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return names of links of a finger if there are any and the robot has them."""
        available = self.robot.links_map
        if not names or not set(names) <= available.keys():
            raise RobotError(
                f"finger {finger!r} of the robot {self.uid!r}: got the links "
                f"{names}, expected `fingertips` to name its last one, and `phalanges` "
                f"those that feel, available: {', '.join(available)}"
            )
        return names

    def _keyframe(self, angles: Mapping[str, float]) -> Keyframe:
        position, controller = self._middle.clone(), self.controller
        for index, name in enumerate(self.joints):
            angle = angles.get(name, float(position[index]))
            low, high = (float(x[index]) for x in (controller.lower, controller.upper))
            expected = f"from {low:g} to {high:g}, the joint's limits"
            fits = low - SLACK <= angle <= high + SLACK
            what = f"posture of the robot {self.uid!r}: {name}"
            require(fits, what, angle, expected, RobotError)
            position[index] = angle
        return Keyframe(pose=self.mount, qpos=self._to_qpos(position).cpu().numpy())

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
            "force_limit": [self._motors[name].effort for name in self.joints],
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
            ValueError: It is not finite (checked on the CPU only).
        """
        if not self.scene.gpu_sim_enabled and not action.isfinite().all():
            raise ValueError(f"action: got {action.tolist()}, expected finite numbers")
        self.controller.set_action(action)

    def start(self, jitter: Tensor) -> Tensor:
        """Return the start of episodes in the simulator's order [N, J] [rad].

        Args:
            jitter: By how much each joint is moved, in the same order [N, J] [rad]; a
                slide by as much of its range as a radian is of half a turn.
        """
        return (self._start + jitter * self._jitter_unit).clamp(*self._limits)

    def _to_qpos(self, position: Tensor) -> Tensor:
        """Reorder [..., J] from the action's order to the simulator's."""
        qpos = torch.empty_like(position)
        qpos[..., self._order] = position
        return qpos

    # -- Senses ----------------------------------------------------------------------

    def get_proprioception(self) -> dict[str, Tensor]:
        """Return what the robot feels of its own joints, in the action's order.

        Returns:
            `proprioception`: joint positions and `target`: joint targets, both
            [N, J] with the joints' limits mapped to [-1, 1].
        """
        return {
            "proprioception": self._normalize(self.controller.qpos),
            "target": self._normalize(self.controller.target),
        }

    def touch_sensor(self, objects: Sequence[Actor]) -> CpuTouchSensor | GpuTouchSensor:
        """Return a sensor of which finger touches which object [N, F, C].

        Args:
            objects: What the fingers may touch; anything else is not felt.
        """
        kind = GpuTouchSensor if self.scene.gpu_sim_enabled else CpuTouchSensor
        return kind(self.scene, self.finger_links, objects)

    def joint_velocity(self) -> Tensor:
        """Return joint velocities in the action's order [N, J] [rad/s]."""
        return self.controller.qvel

    def finger_position(self) -> Tensor:
        """Return where the fingertips' links are [N, F, 3] [m]."""
        return poses(self.fingertip_links)[..., :3]

    def _normalize(self, position: Tensor) -> Tensor:
        return ((position - self._middle) / self._half_range).clamp(-1, 1)


def available_robots() -> dict[str, type[Robot]]:
    """Return the registered robots that the tasks can use, by uid."""
    agents = {uid: spec.agent_cls for uid, spec in REGISTERED_AGENTS.items()}
    return {uid: cls for uid, cls in agents.items() if issubclass(cls, Robot)}


def robot_class(robot: str | type[BaseAgent]) -> type[Robot]:
    """Return the class of a robot.

    Args:
        robot: A subclass of `Robot`, the uid of a registered one, or its short name:
            the uid of one of ours without `OURS`.

    Raises:
        RobotError: It is not registered, or not a `Robot`.
    """
    if isinstance(robot, type) and issubclass(robot, Robot):
        return robot
    uids = available_robots()
    for uid in sorted(uids, key=lambda uid: uid != robot):  # its own uid comes first
        if robot in (uid, short_name(uid)):
            return uids[uid]
    raise RobotError(
        f"robot_uids: got {robot!r}, expected a subclass of Robot or the name of a "
        f"registered one, available: {', '.join(map(short_name, uids))}"
    )


OURS = "ir_"
"""Start of a uid that would else clash with one of ManiSkill's, such as "panda"."""


def short_name(uid: str) -> str:
    """Return what the tasks call the robot of that uid, such as "panda"."""
    return uid.removeprefix(OURS)
