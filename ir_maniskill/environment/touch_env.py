"""TouchEnv: ManiSkill's hooks and the wiring of the Environment block (Sec. III-A).

Legend: N envs, b envs being reset, J joints, F fingers, C objects, L tokens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import common
from mani_skill.utils.structs.types import SceneConfig, SimConfig
from torch import Tensor

from ir_maniskill import experiment as catalog
from ir_maniskill.checks import require_whole
from ir_maniskill.doctor import require_vulkan
from ir_maniskill.environment import reward_generator, senses, table_scene
from ir_maniskill.environment.arguments import (
    action_of,
    instructions_of,
    require_reset,
    seeds_of,
    simulator_of,
)
from ir_maniskill.environment.instructional_set import GoalBatch, InstructionalSet
from ir_maniskill.environment.layout import layout_of
from ir_maniskill.environment.rendering import RenderedEnv
from ir_maniskill.environment.reward_generator import RewardWeights
from ir_maniskill.environment.robots import Nao
from ir_maniskill.environment.robots.robot import Robot, robot_class
from ir_maniskill.environment.speaker import Speaker
from ir_maniskill.environment.table_objects import TableObjects
from ir_maniskill.experiment import Spoken
from ir_maniskill.goals import Instruction
from ir_maniskill.snapshot import Snapshot, later

CONTROL_FREQ = 20
"""Steps of an episode in a second [Hz]."""
LISTED = SceneConfig(contact_offset=0.005)
"""Physics of tasks that list their sentences, with ManiSkill's 15 solver iterations:
the policies that ship learned in it, and with 4 they touch wrong objects more often."""
CONTACT_OFFSET = 0.0025
"""How near two shapes come before contacts are looked for in other tasks, at NAO's
scale [m]."""


class TouchEnv(RenderedEnv):
    """A robot behind a table is told by a sentence what to do.

    **Task Description:**
    Each episode has one sentence, such as "Touch the blue cube.", and a goal that it
    asks for. The robot is rewarded while the goal holds (paper, Sec. IV).

    **Randomizations:**
    - the sentence, drawn from the experiment's Instructional Set
    - the objects' places and yaws and the joints' start, by `Experiment.jitter`
    - which object lies where, if `Experiment.shuffled`
    - which objects lie anywhere in reach, and sentences true of them, if they are
      `Drawn` and `Spoken`

    **Success Conditions:**
    - the goal holds, e.g. a finger touches the named object. This does not end the
      episode, since holding it is what is rewarded; the time limit does.

    **Order of calls:**
    - once: `_load_scene`, `_after_reconfigure`
    - a reset: `_initialize_episode` lays objects out, chooses sentences, and looks up
      what they refer to
    - a step: `_before_control_step` forgets contacts, `_after_simulation_step` collects
      them after each physics step, `evaluate` judges, then come reward and observation
    """

    metadata: ClassVar = {**BaseEnv.metadata, "render_fps": CONTROL_FREQ}
    SUPPORTED_REWARD_MODES = ("sparse", "dense", "normalized_dense", "none")
    agent: Robot

    def __init__(
        self,
        *args: Any,
        experiment: str,
        robot_uids: str | type[Robot] = Nao.uid,
        render_backend: str | None = "auto",
        reward_weights: dict[str, float] | None = None,
        observe: Sequence[str] = (),
        split: str | None = None,
        kinds: Sequence[str] | None = None,
        **kwargs: Any,
    ) -> None:
        """Build the env.

        Args:
            experiment: The id of the experiment.
            robot_uids: Which robot: "nao", "g1", "panda", the uid of another that is
                registered, or a subclass of `Robot`.
            render_backend: As for `BaseEnv`; "auto" is a CUDA device where there is
                one and else whatever Vulkan finds, software included.
            reward_weights: Changes of `RewardWeights`, for the dense reward modes.
            observe: What to observe beside the usual: "text" is the sentence's bytes.
            split: Of a task with `Spoken` instructions: "train", or what is held out
                of it, "wording", "objects", "pairs" or "places"; None: its own.
            kinds: Of such a task: the kinds of sentences to draw, each as often as it
                stands here; None: each equally often.
            *args: As for `BaseEnv`.
            **kwargs: As for `BaseEnv`.

        Raises:
            ExperimentError: There is no such experiment, or its goals or places don't
                fit the robot.
            RobotError: The robot cannot be used.
            ValueError: Several envs are asked for, but physics is on the CPU; or there
                is nothing of that name to observe.
            RuntimeError: No Vulkan device can render here; says what to install.
        """
        self.experiment = catalog.get(experiment).in_split(split, kinds)
        _require_one_on_cpu(kwargs)
        robot = robot_class(robot_uids)
        if not isinstance(robot_uids, type):
            robot_uids = robot.uid
        self._reward_weights = RewardWeights().changed(reward_weights or {})
        self.asked = senses.require_askable(observe)
        self._stepped = False  # whether a step was made that is not judged yet
        self._ready = self._closed = False  # for a step; for ever
        if render_backend == "auto":
            render_backend = "gpu" if torch.cuda.is_available() else "cpu"
        render_backend = render_backend or "none"
        if render_backend != "none":
            require_vulkan()
        super().__init__(
            *args, robot_uids=robot_uids, render_backend=render_backend, **kwargs
        )

    # -- Scene -----------------------------------------------------------------------

    @property
    def _default_sim_config(self) -> SimConfig:
        robot = robot_class(self.robot_uids)
        cheap = SceneConfig(
            contact_offset=CONTACT_OFFSET * robot.scale,
            solver_position_iterations=robot.solver_iterations,
        )
        spoken = isinstance(self.experiment.instructions, Spoken)
        scene = cheap if spoken else LISTED
        return SimConfig(sim_freq=100, control_freq=CONTROL_FREQ, scene_config=scene)

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        return table_scene.policy_cameras(self.agent.scale)

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        return table_scene.video_camera(self.agent.scale)

    def _load_scene(self, options: dict) -> None:
        self.agent.require_reach(self.experiment)
        table_scene.build_room(self.scene, self.agent)
        self.table = TableObjects(self.scene, self.experiment, self.agent.scale)
        self.objects = self.table.bodies

    def _load_lighting(self, options: dict) -> None:
        scale = self.agent.scale
        table_scene.add_lights(self.scene, scale, shadow=self.enable_shadow)

    def _after_reconfigure(self, options: dict) -> None:
        task, count, device = self.experiment, self.num_envs, self.device
        hands = {
            hand: torch.tensor([f in mine for f in self.agent.fingers], device=device)
            for hand, mine in self.agent.hands.items()
        }
        self.instructional_set = InstructionalSet(task, hands, device, count)
        self.layout = layout_of(task, self.agent)
        spoken = isinstance(task.instructions, Spoken)
        self._speaker = Speaker(task, self.layout) if spoken else None
        self._touch = self.agent.touch_sensor(self.objects)
        self._weights = self._reward_weights.vector().to(device)
        self.instruction_index = torch.zeros(count, dtype=torch.int64, device=device)
        self._stage = torch.zeros_like(self.instruction_index)
        self._stage_before = self._stage  # with which the last step began
        self._success_once = torch.zeros(count, dtype=torch.bool, device=device)
        self._wrong_once = torch.zeros_like(self._success_once)
        self._start = torch.zeros(count, task.slots, 7, device=device)
        # Poses are divided by this to be at NAO's scale.
        self._size = torch.tensor([self.agent.scale] * 3 + [1.0] * 4, device=device)

    # -- Episode ---------------------------------------------------------------------

    def _initialize_episode(self, env_idx: Tensor, options: dict) -> None:
        slots, joints = self.experiment.slots, len(self.agent.joints)
        laid = self.layout.noise if self._speaker is None else 0  # it draws its own
        sizes = [1, laid, slots, joints]
        noise = self._batched_episode_rng[env_idx].uniform(size=sum(sizes))
        pick, layout, yaw, joint = np.split(noise, np.cumsum(sizes)[:-1], axis=1)
        told = options.get("instruction")
        if told is not None:
            told = instructions_of(told, self.experiment, len(env_idx))
        if self._speaker is None:
            slot, xy = self.layout.lay_out(layout)
        else:
            streams = [self._batched_episode_rng[env] for env in env_idx.tolist()]
            slot, xy, told = self._speaker.draw(streams, told)
        if told is None:
            index = self.instructional_set.pick(self._tensor(pick[:, 0]))
            self.instruction_index = self.instruction_index.index_put((env_idx,), index)
        else:
            self.instructional_set, self.instruction_index = self._told(env_idx, told)
        self._place_objects(env_idx, slot, xy, 2 * yaw - 1)
        jitter = self._tensor(2 * joint - 1) * self.experiment.jitter.joints
        self.agent.robot.set_qpos(self.agent.start(jitter))
        self._touch.clear(env_idx)
        self._drawing = False
        self._begin(env_idx)
        self._resolve_goals()

    def _begin(self, env_idx: Tensor) -> None:
        """Forget successes and fouls."""
        # Not in place: the info of the last step holds these very tensors.
        self._success_once = self._success_once.index_fill(0, env_idx, False)
        self._wrong_once = self._wrong_once.index_fill(0, env_idx, False)
        self._stage = self._stage.index_fill(0, env_idx, 0)
        self._stage_before = self._stage_before.index_fill(0, env_idx, 0)
        self._stepped = False

    def _resolve_goals(self) -> None:
        """Look up what the sentences of all envs refer to, as their episodes began."""
        table = self.instructional_set.goals
        self._goals: GoalBatch = table.deal(self.instruction_index, self.snapshot())

    def _place_objects(
        self, env_idx: Tensor, slot: np.ndarray, xy: np.ndarray, turn: np.ndarray
    ) -> None:
        """Lay the objects out; turns are from -1 to 1 [b, C]."""
        yaw = table_scene.yaw_quaternion(self.experiment.jitter.yaw * turn)
        at = torch.tensor(slot, device=self.device)
        place, rotation = self._tensor(self.agent.scale * xy), self._tensor(yaw)
        pose = self.table.lay_out(env_idx, at, place, rotation)
        self._start = self._start.index_put((env_idx,), pose)

    # -- Sentences -------------------------------------------------------------------

    @property
    def instructions(self) -> list[Instruction]:
        """The active sentence i_t and the goal of each env [N]."""
        known = self.instructional_set.instructions
        return [known[index] for index in self.instruction_index.tolist()]

    def get_language_instruction(self) -> list[str]:
        """Return the active sentence i_t of each env (N strings)."""
        return [instruction.text for instruction in self.instructions]

    def tell(self, said: Any) -> None:
        """Give other instructions without a reset.

        What they ask for counts from here on: pushes from where things are now, and
        what was reached or fouled before is forgotten.

        Args:
            said: A sentence, an `Instruction` or an index of the task's own, for all
                envs or a list of one for each.

        Raises:
            ValueError: A sentence means nothing that the task or the language knows.
            GoalError: It does not fit the scene, or is too long; nothing has changed.
        """
        self._require_open()
        everyone = torch.arange(self.num_envs, device=self.device)
        told = instructions_of(said, self.experiment, self.num_envs)
        known, index = self._told(everyone, told)
        start = self.table.poses()
        scene = replace(self.snapshot(), start=start / self._size)
        self._goals = known.goals.deal(index, scene)  # what fits no object ends here
        self.instructional_set, self.instruction_index = known, index
        self._start = start
        self._begin(everyone)

    def _told(
        self, env_idx: Tensor, said: Sequence[Instruction]
    ) -> tuple[InstructionalSet, Tensor]:
        """Return the Instructional Set once envs were told this, and all rows [N]."""
        known = self.instructional_set
        own, envs = known.instructions[: len(known)], env_idx.tolist()
        each = list(zip(envs, said, strict=True))
        rows = [own.index(i) if i in own else len(own) + env for env, i in each]
        index = self.instruction_index.clone()
        index[env_idx] = torch.tensor(rows, device=self.device)
        return known.told({env: i for env, i in each if i not in own}), index

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.as_tensor(array, dtype=torch.float32, device=self.device)

    def reset(
        self, seed: int | list[int] | None = None, options: dict | None = None
    ) -> tuple[Any, dict]:
        """Start an episode; with a seed, in a scene built anew.

        PhysX on the CPU remembers the order in which contacts were made, so that a
        trajectory depends on earlier episodes in its last bits. A seeded reset
        therefore rebuilds the scene (some 0.1 s) unless
        `options["reconfigure"]` is False: then the same seed and actions give the
        same trajectory, bit for bit, whatever happened before.

        Args:
            seed: Env i gets seed + i, or the i-th of a list; None goes on with their
                random streams.
            options: ManiSkill's, and "instruction": the sentences to give instead of
                drawing them, as text or index, one for all envs or b of them.

        Raises:
            ValueError: A seed or an option cannot be used.
            GoalError: A sentence refers to no object of its scene, or to several.
        """
        options = {} if options is None else options
        require_reset(options)
        options = dict(options)
        seeds = None if seed is None else seeds_of(seed, self.num_envs)
        if seeds is not None and not self._sim_device.is_cuda():
            options.setdefault("reconfigure", True)
        self._require_open()
        self._ready = False
        gym.Env.reset(self, seed=None if seeds is None else seeds[0])
        begun = super().reset(seeds, options)
        self._ready = True
        return begun

    def close(self) -> None:
        """Let go of the scene; nothing can be done afterwards."""
        self._closed = True
        super().close()

    def _require_open(self) -> None:
        if self._closed:
            raise RuntimeError("this env is closed: make a new one")

    def step(self, action: Any) -> tuple[Any, Tensor, Tensor, Tensor, dict]:
        """Step as ManiSkill does, except that success does not end the episode.

        Raises:
            ValueError: The action has another shape, or is not finite (checked on the
                CPU only).
            RuntimeError: The env is closed, or the last reset failed.
        """
        self._require_open()
        if not self._ready:
            raise RuntimeError("step: the last reset failed; reset the env again")
        if action is not None and not isinstance(action, dict):  # ManiSkill's matter
            action = action_of(action, (self.num_envs, *self.single_action_space.shape))
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated.zero_(), truncated, info

    def _before_control_step(self) -> None:
        self._stage_before = self._stage
        self._touch.clear()

    def _after_simulation_step(self) -> None:
        self._touch.update()

    def _after_control_step(self) -> None:
        self._stepped = True
        super()._after_control_step()

    # -- Measures --------------------------------------------------------------------

    def snapshot(self) -> Snapshot:
        """Return what goals are measured on, as of now.

        Contacts are those of the last step; after a reset or a change of the state
        there are none until the next step.
        """
        return Snapshot(*self._scene(self._stage).values())

    def _scene(self, stage: Tensor) -> Snapshot:
        """Return a snapshot whose fields are partly read when they are first used.

        Use it within this step only: later the simulator would say something else.
        """
        robot, table = self.agent, self.table
        return Snapshot(
            contact=table.contact(self._touch.read()),
            fingertip=later(lambda: robot.finger_position() / robot.scale),
            pose=table.poses() / self._size,
            start=self._start / self._size,
            velocity=later(lambda: table.velocities() / robot.scale),
            color=table.color,
            shape=table.shape,
            stage=stage,
        )

    def judged(self) -> Snapshot:
        """Return the snapshot that `evaluate` judged, at the stage it led to."""
        return self._judged.at_stage(self._stage)

    def evaluate(self) -> dict[str, Tensor]:
        """Measure the goals; a step counts for the episode once, however often asked.

        Returns:
            Per env [N]: `elapsed_steps` since the reset; `right_fingers` and
            `wrong_fingers` (int64): fingers that touch as the goal asks, and as it does
            not allow; `success` (the goal holds), `success_once` and `wrong_once` (so
            far in this episode; wrong is a foul), `exclusive_success` (it has held,
            without any foul) as bool; `contact` [N, F, C] bool; and in the dense reward
            modes `reward_terms` [N, K].
        """
        self._judged = scene = self._scene(self._stage_before)
        self.measure = self._goals.measure(scene)
        self.verdict = reward_generator.judge(scene, self.measure)
        if self._stepped:
            self._stepped = False
            self._stage = self.measure.stage
            self._success_once = self._success_once | self.measure.holds
            self._wrong_once = self._wrong_once | self.verdict.foul
        info = {
            "elapsed_steps": self.elapsed_steps.clone(),  # ManiSkill's own goes on
            "contact": scene.contact,
            "right_fingers": self.verdict.right.sum(dim=1),
            "wrong_fingers": self.verdict.wrong.sum(dim=1),
            "success": self.measure.holds,
            "success_once": self._success_once,
            "wrong_once": self._wrong_once,
            "exclusive_success": self._success_once > self._wrong_once,
        }
        if self._reward_mode in ("dense", "normalized_dense"):
            info["reward_terms"] = reward_generator.reward_terms(
                scene, self.measure, self.verdict, self._wrong_once
            )
        return info

    # -- Observation o_t -------------------------------------------------------------

    def _get_obs_agent(self) -> dict[str, Tensor]:
        return self.agent.get_proprioception() | senses.observe(self, "agent", {})

    def _get_obs_extra(self, info: dict[str, Tensor]) -> dict[str, Tensor]:
        return senses.observe(self, "extra", info)

    # -- Reward r_t ------------------------------------------------------------------

    def compute_sparse_reward(
        self, obs: Any, action: Tensor, info: dict[str, Tensor]
    ) -> Tensor:
        """Return the paper's reward of this experiment [N]."""
        return reward_generator.sparse_reward(
            self.experiment, info["success"], self.measure.level, info["wrong_fingers"]
        )

    def compute_dense_reward(
        self, obs: Any, action: Tensor, info: dict[str, Tensor]
    ) -> Tensor:
        """Return the sum of our weighted terms that lead to the goal [N]."""
        return info["reward_terms"] @ self._weights

    def compute_normalized_dense_reward(
        self, obs: Any, action: Tensor, info: dict[str, Tensor]
    ) -> Tensor:
        """Return the dense reward divided by the most that a touch can give [N]."""
        highest = self._reward_weights.highest(len(self.agent.fingers))
        return self.compute_dense_reward(obs, action, info) / highest

    # -- State -----------------------------------------------------------------------

    def _task_state(self) -> dict[str, Tensor]:
        """Return the task's own state, beside bodies and joint targets [N, ...]."""
        return {
            "instruction_index": self.instruction_index.float()[:, None],
            "told": self.instructional_set.text[-self.num_envs :].float(),
            "slot": self.table.slot.float(),
            "stage": self._stage.float()[:, None],
            "success_once": self._success_once.float()[:, None],
            "wrong_once": self._wrong_once.float()[:, None],
            "start": self._start.flatten(1).clone(),
        }

    def get_state_dict(self) -> dict:
        """Return bodies, joint targets and the task's own state."""
        return super().get_state_dict() | {"task": self._task_state()}

    def set_state_dict(self, state: dict, env_idx: Tensor | None = None) -> None:
        """Restore what `get_state_dict` returned, for all envs or for `env_idx`.

        A row of a recorded trajectory will do: arrays, without the dimension of envs.
        """
        state = common.to_tensor(state, device=self.device)
        super().set_state_dict(state, env_idx)
        rows = slice(None) if env_idx is None else env_idx
        if "controller" in state:
            target = self.agent.controller.target.clone()
            target[rows] = state["controller"]["target_qpos"].to(target)
            self.agent.controller.set_state({"target_qpos": target})
        self._touch.clear(env_idx)
        self._stepped = False
        if "task" in state:
            self._set_task_state(state["task"], rows)

    def _set_task_state(self, given: dict[str, Tensor], rows: slice | Tensor) -> None:
        task = self._task_state()
        for name, value in given.items():
            task[name][rows] = value.to(task[name])
        self.instruction_index = task["instruction_index"][:, 0].long()
        self._restore_told(task["told"].byte())
        self.table.put(slice(None), task["slot"].long())
        self._stage_before = self._stage = task["stage"][:, 0].long()
        self._success_once = task["success_once"][:, 0].bool()
        self._wrong_once = task["wrong_once"][:, 0].bool()
        self._start = task["start"].view_as(self._start)
        self._resolve_goals()

    def _restore_told(self, text: Tensor) -> None:
        """Tell envs the sentences [N, B] that they had been told, if they count."""
        if not torch.equal(text, self.instructional_set.text[-self.num_envs :]):
            counts = (self.instruction_index >= len(self.instructional_set)).tolist()
            texts = zip(counts, senses.read_text(text), strict=True)
            said = {env: s for env, (c, s) in enumerate(texts) if c and s}
            told = instructions_of(list(said.values()), self.experiment, len(said))
            told_then = dict(zip(said, told, strict=True))
            self.instructional_set = self.instructional_set.told(told_then)

    def set_state(self, state: Tensor, env_idx: Tensor | None = None) -> None:
        """Restore what `get_state` returned: the same, as one flat row per env."""
        tree = self.get_state_dict()
        sizes = [leaf.shape[1] for part in tree.values() for leaf in part.values()]
        leaves = iter(common.to_tensor(state, device=self.device).split(sizes, dim=1))
        given = {kind: {name: next(leaves) for name in tree[kind]} for kind in tree}
        self.set_state_dict(given, env_idx)


def _require_one_on_cpu(kwargs: dict[str, Any]) -> None:
    """Raise if several envs are asked for where physics can only be on the CPU."""
    count, backend = kwargs.get("num_envs", 1), kwargs.get("sim_backend", "auto")
    require_whole("num_envs", count, 1)
    if simulator_of(backend) == "physx_cpu" and count > 1:
        raise ValueError(
            f"num_envs: got {count}, expected 1 with physics on the CPU; "
            "`ir_maniskill.make_vec(id, num_envs)` runs several in worker processes"
        )
