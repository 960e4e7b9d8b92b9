"""TouchEnv: ManiSkill's hooks and the wiring of the Environment block (Sec. III-A).

Legend: N envs, b envs being reset, J joints, F fingers, C objects, L tokens.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import Camera, CameraConfig
from mani_skill.utils import common
from mani_skill.utils.structs import Pose
from mani_skill.utils.structs.types import SceneConfig, SimConfig
from torch import Tensor

from ir_maniskill import experiment as catalog
from ir_maniskill.doctor import require_vulkan
from ir_maniskill.environment import reward_generator, table_scene
from ir_maniskill.environment.bodies import positions, speeds
from ir_maniskill.environment.instructional_set import InstructionalSet
from ir_maniskill.environment.reward_generator import DenseWeights, FingerCount
from ir_maniskill.environment.robots.nao import Nao
from ir_maniskill.environment.robots.robot import (
    Robot,
    available_robots,
    require_robot,
)
from ir_maniskill.experiment import Experiment

TOUCH_FORCE = 0.01
"""Force from which a contact counts as a touch [N]."""

CONTROL_FREQ = 20
"""Steps of an episode in a second [Hz]."""

TASK_STATE = ("instruction_index", "success_once", "wrong_once")
"""What of the task belongs to the env state, beside bodies and joint targets."""


class TouchEnv(BaseEnv):
    """A robot behind a table is told by a sentence which object to touch.

    **Task Description:**
    Each episode has one sentence, such as "Touch the blue cube.". The robot is
    rewarded for fingers on the object that it names (paper, Sec. IV).

    **Randomizations:**
    - the sentence, drawn from the experiment's Instructional Set
    - the objects' places and yaws and the joints' start, by `Experiment.jitter`
    - which object lies where, if `Experiment.shuffled`

    **Success Conditions:**
    - a finger touches the named object. This does not end the episode, since holding
      the touch is what is rewarded; the time limit does.
    """

    metadata: ClassVar = {**BaseEnv.metadata, "render_fps": CONTROL_FREQ}
    SUPPORTED_ROBOTS: tuple[str | type[Robot], ...] = (Nao.uid,)
    SUPPORTED_REWARD_MODES = ("sparse", "dense", "normalized_dense", "none")
    agent: Robot

    def __init__(
        self,
        *args: Any,
        experiment: str | Experiment,
        robot_uids: str | type[Robot] = Nao.uid,
        render_backend: str | None = "auto",
        dense_weights: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        """Build the env.

        Args:
            experiment: The experiment or its id.
            robot_uids: Which robot: a subclass of `Robot`, or the uid of a registered
                one.
            render_backend: As for `BaseEnv`; "auto" is a CUDA device where there is
                one and else whatever Vulkan finds, software included.
            dense_weights: Changes of `DenseWeights`, used by the dense reward modes.
            *args: As for `BaseEnv`.
            **kwargs: As for `BaseEnv`.

        Raises:
            UnknownExperimentError: There is no experiment of that id.
            RobotError: The robot cannot be used.
            RuntimeError: No Vulkan device can render here; says what to install.
        """
        if isinstance(experiment, str):
            experiment = catalog.get(experiment)
        self.experiment = experiment
        require_robot(robot_uids)
        # ManiSkill warns of robots that are not in here; ours are not the only ones.
        self.SUPPORTED_ROBOTS = (*available_robots(), robot_uids)
        self.dense_weights = replace(DenseWeights(), **(dense_weights or {}))
        self._colors_only = False  # without a renderer no sensors are set up
        self._drawing = False  # whether pictures of this very state are under way
        self._fresh = True  # whether some env was reset after the last step
        if render_backend == "auto":
            render_backend = "gpu" if torch.cuda.is_available() else "cpu"
        if render_backend not in ("none", None):
            require_vulkan()
        super().__init__(
            *args, robot_uids=robot_uids, render_backend=render_backend, **kwargs
        )

    # -- Scene -----------------------------------------------------------------------

    @property
    def _default_sim_config(self) -> SimConfig:
        return SimConfig(
            sim_freq=100,
            control_freq=CONTROL_FREQ,
            scene_config=SceneConfig(contact_offset=0.005),
        )

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        return table_scene.policy_cameras()

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        return table_scene.video_camera()

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, sapien.Pose())

    def _load_scene(self, options: dict) -> None:
        table_scene.build_room(self.scene)
        self.objects = [
            table_scene.build_object(self.scene, thing)
            for thing in self.experiment.objects
        ]

    def _load_lighting(self, options: dict) -> None:
        table_scene.add_lights(self.scene, shadow=self.enable_shadow)

    def _setup_sensors(self, options: dict) -> None:
        # Picture formats are global: a video camera made earlier leaves floats behind.
        sapien.render.set_picture_format("Color", "r8g8b8a8unorm")
        super()._setup_sensors(options)
        self._sensor_params: dict | None = None
        wanted = {kind for kind, on in vars(self.obs_mode_struct.visual).items() if on}
        self._colors_only = wanted == {"rgb"} and not self._sim_device.is_cuda()
        for name, sensor in self._sensors.items():
            pack = sensor.config.shader_config
            drawn = {kind for kinds in pack.texture_names.values() for kind in kinds}
            if not wanted <= drawn:
                raise ValueError(
                    f"obs_mode: got {self.obs_mode!r}, but the shader pack of {name} "
                    f"draws only {', '.join(sorted(drawn))}; choose another shader_pack"
                )

    def _after_reconfigure(self, options: dict) -> None:
        self.instructional_set = InstructionalSet(self.experiment, self.device)
        self._contact_force = self.agent.touch_query(self.objects)
        things = self.experiment.objects
        heights = [table_scene.OBJECT_HEIGHT[thing.shape] for thing in things]
        self._places = np.array([thing.position for thing in things])  # [C, 2] [m]
        self._object_z = table_scene.TABLE_TOP + np.array(heights) / 2  # [C] [m]
        self.instruction_index = self._zeros(torch.int64)
        self._success_once = self._zeros(torch.bool)
        self._wrong_once = self._zeros(torch.bool)

    def _zeros(self, dtype: torch.dtype) -> Tensor:
        return torch.zeros(self.num_envs, dtype=dtype, device=self.device)

    # -- Episode ---------------------------------------------------------------------

    def _initialize_episode(self, env_idx: Tensor, options: dict) -> None:
        count, joints = len(self.objects), len(self.agent.start_qpos)
        noise = self._batched_episode_rng[env_idx].uniform(size=1 + 4 * count + joints)
        pick, order, place, yaw, joint = np.split(
            noise, np.cumsum([1, count, 2 * count, count]), axis=1
        )
        self._choose_instruction(env_idx, pick[:, 0], options.get("instruction"))
        self._place_objects(order, 2 * place - 1, 2 * yaw - 1)
        jitter = self._tensor(2 * joint - 1) * self.experiment.jitter.joints
        qpos = self.agent.clamp_qpos(self.agent.start_qpos + jitter)
        self.agent.robot.set_qpos(qpos)
        # The last step's info, which others may keep, holds these very tensors.
        self._success_once = self._success_once.index_fill(0, env_idx, False)
        self._wrong_once = self._wrong_once.index_fill(0, env_idx, False)
        self._drawing = False

    def _choose_instruction(
        self, env_idx: Tensor, uniform: np.ndarray, forced: Any
    ) -> None:
        index = self.instructional_set.pick(self._tensor(uniform))
        if forced is not None:
            index = torch.as_tensor(forced, device=self.device)
            in_range = (index >= 0) & (index < len(self.instructional_set))
            if index.shape not in ((), env_idx.shape) or not in_range.all():
                raise ValueError(
                    f"reset option 'instruction': got {forced}, expected indices 0 to "
                    f"{len(self.instructional_set) - 1}, one for all envs or one for "
                    f"each of {len(env_idx)}: {self.experiment.sentences}"
                )
        self.instruction_index[env_idx] = index

    def _place_objects(
        self, order: np.ndarray, place: np.ndarray, yaw: np.ndarray
    ) -> None:
        """Lay the objects out; all arguments are uniform noise with b rows."""
        batch, count = order.shape
        seat = np.argsort(order) if self.experiment.shuffled else np.arange(count)
        jitter = self.experiment.jitter
        xy = np.broadcast_to(self._places[seat], (batch, count, 2))
        xy = xy + jitter.position * place.reshape(batch, count, 2)
        z = np.broadcast_to(self._object_z, (batch, count))
        position = self._tensor(np.concatenate([xy, z[..., None]], axis=-1))
        rotation = self._tensor(table_scene.yaw_quaternion(jitter.yaw * yaw))
        for index, thing in enumerate(self.objects):
            thing.set_pose(Pose.create_from_pq(position[:, index], rotation[:, index]))

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
            seed: Seeds of the envs; None goes on with their random streams.
            options: ManiSkill's, and "instruction": indices of the sentences to give,
                an int or [b] int64, instead of drawing them.

        Raises:
            ValueError: An instruction index is out of range, or there are not b.
        """
        options = dict(options or {})
        if isinstance(seed, np.integer):
            seed = int(seed)  # gymnasium and ManiSkill know no others
        if seed is not None and not self._sim_device.is_cuda():
            options.setdefault("reconfigure", True)
        gym.Env.reset(self, seed=seed if isinstance(seed, int) else None)
        self._fresh = True
        return super().reset(seed, options)

    def step(self, action: Any) -> tuple[Any, Tensor, Tensor, Tensor, dict]:
        """Step as ManiSkill does, except that success does not end the episode."""
        if isinstance(action, np.ndarray) and action.flags.writeable:
            action = torch.from_numpy(action)  # ManiSkill's way takes much longer
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated.zero_(), truncated, info

    # -- What the sentence asks ------------------------------------------------------

    @property
    def target_index(self) -> Tensor:
        """Index in `objects` of the one that the active sentence names [N] int64."""
        return self.instructional_set.targets.index_select(0, self.instruction_index)

    @property
    def named(self) -> Tensor:
        """Which object the active sentence names, one-hot [N, C] bool."""
        return self.instructional_set.named.index_select(0, self.instruction_index)

    def get_language_instruction(self) -> list[str]:
        """Return the active sentence i_t of each env (N strings)."""
        sentences = self.experiment.sentences
        return [sentences[index] for index in self.instruction_index.tolist()]

    # -- Measures --------------------------------------------------------------------

    def get_info(self) -> dict[str, Tensor]:
        """Return what `evaluate` measures, and `elapsed_steps` since the reset [N]."""
        info = super().get_info()
        # On the CPU ManiSkill gives its own counter, which it goes on changing.
        info["elapsed_steps"] = info["elapsed_steps"].clone()
        return info

    def evaluate(self) -> dict[str, Tensor]:
        """Measure contacts and what they mean for the active sentence.

        Returns:
            Per env [N]: `right_fingers` and `wrong_fingers` (int64), `success` (the
            named object is touched now), `success_once` and `wrong_once` (so far in
            this episode), `exclusive_success` (the named object has been touched and
            no other) as bool; and `contact` [N, F, C] bool.
        """
        contact = self._contact_force() > TOUCH_FORCE
        if self._fresh:  # PhysX still holds the contacts of the last episode
            contact &= (self._elapsed_steps > 0)[:, None, None]
        count = reward_generator.count_fingers(contact, self.named)
        success = count.right > 0
        self._success_once = self._success_once | success
        self._wrong_once = self._wrong_once | (count.wrong > 0)
        return {
            "contact": contact,
            "right_fingers": count.right,
            "wrong_fingers": count.wrong,
            "success": success,
            "success_once": self._success_once,
            "wrong_once": self._wrong_once,
            "exclusive_success": self._success_once > self._wrong_once,
        }

    # -- Observation o_t -------------------------------------------------------------

    def _get_obs_agent(self) -> dict[str, Tensor]:
        obs = self.agent.get_proprioception()
        if self.obs_mode_struct.use_state:
            obs["velocity"] = self.agent.joint_velocity()
        return obs

    def _get_obs_extra(self, info: dict[str, Tensor]) -> dict[str, Tensor]:
        index = self.instruction_index
        obs = {
            "touch": info["contact"].any(dim=2).float(),  # [N, F]
            "instruction": self.instructional_set.tokens.index_select(0, index),
        }
        if self.obs_mode_struct.use_state:
            obs |= self._positions()
            obs["target_object"] = self.named.float()  # [N, C]
            obs["wrong_once"] = info["wrong_once"].float()[:, None]  # [N, 1]
        return obs

    def _flatten_raw_obs(self, obs: Any) -> Any:
        """Fetch pictures under way; flatten as ManiSkill does, but all at once."""
        if self._drawing:
            obs["sensor_data"] = self._get_obs_sensor_data()
        if not self.obs_mode_struct.state:
            return obs
        leaves = [*obs.pop("agent").values(), *obs.pop("extra").values()]
        flat = torch.cat([leaf.flatten(1) for leaf in leaves], dim=1)
        return flat if self.obs_mode == "state" else obs | {"state": flat}

    def _positions(self) -> dict[str, Tensor]:
        return {
            "object_position": positions(self.objects),  # [N, C, 3]
            "finger_position": self.agent.finger_position(),  # [N, F, 3]
        }

    def _get_obs_with_sensor_data(
        self, info: dict[str, Tensor], apply_texture_transforms: bool = True
    ) -> dict:
        """Observe; within a step pictures come last, in `_flatten_raw_obs`."""
        if not self._drawing:
            return super()._get_obs_with_sensor_data(info, apply_texture_transforms)
        return {
            "agent": self._get_obs_agent(),
            "extra": self._get_obs_extra(info),
            "sensor_param": self.get_sensor_params(),
            "sensor_data": {},
        }

    def _get_obs_sensor_data(self, apply_texture_transforms: bool = True) -> dict:
        drawing, self._drawing = self._drawing, False
        if not (self._colors_only and apply_texture_transforms):
            return super()._get_obs_sensor_data(apply_texture_transforms)
        if not drawing:
            self._draw_pictures()
        sensors = self.scene.sensors.items()
        return {name: self._fetch_color(sensor) for name, sensor in sensors}

    def _after_control_step(self) -> None:
        self._fresh = False
        # Software renderers draw on other cores while contacts are judged here.
        if self._colors_only:
            self._draw_pictures()
            self._drawing = True

    def _draw_pictures(self) -> None:
        """Have the renderer begin with what all sensors see, and do not wait."""
        self.scene.update_render(update_sensors=True, update_human_render_cameras=False)
        self.capture_sensor_data()

    def _fetch_color(self, sensor: Camera) -> dict[str, Tensor]:
        """Return the picture that `sensor` drew, as its `get_obs` but not copied.

        Torch copies even small pictures on all cores, which wait for each other.
        """
        (camera,) = sensor.camera._render_cameras
        color = camera.get_picture("Color")[None]  # [1, H, W, 4]
        if color.dtype == np.uint8:  # NumPy cuts alpha off in less time than torch
            return {"rgb": torch.from_numpy(color[..., :3])}
        transform = sensor.config.shader_config.texture_transforms["Color"]
        return transform(torch.from_numpy(color))

    def get_sensor_params(self) -> dict:
        """Return the cameras' matrices, computed once: no camera ever moves."""
        if self._sensor_params is None:
            self._sensor_params = super().get_sensor_params()
        return self._sensor_params

    # -- Reward r_t ------------------------------------------------------------------

    def compute_sparse_reward(
        self, obs: Any, action: Tensor, info: dict[str, Tensor]
    ) -> Tensor:
        """Return the paper's reward of this experiment [N]."""
        return reward_generator.sparse_reward(self.experiment, _count(info))

    def compute_dense_reward(
        self, obs: Any, action: Tensor, info: dict[str, Tensor]
    ) -> Tensor:
        """Return the paper's reward with our shaping toward the named object [N]."""
        at = obs["extra"] if self.obs_mode_struct.use_state else self._positions()
        rows = torch.arange(self.num_envs, device=self.device)
        goal = at["object_position"][rows, self.target_index]  # [N, 3]
        distance = (at["finger_position"] - goal[:, None]).norm(dim=-1)
        return reward_generator.dense_reward(
            self.experiment,
            _count(info),
            distance,
            speeds(self.objects)[rows, self.target_index],
            info["wrong_once"],
            self.dense_weights,
        )

    def compute_normalized_dense_reward(
        self, obs: Any, action: Tensor, info: dict[str, Tensor]
    ) -> Tensor:
        """Return the dense reward divided by the most that a step can give [N]."""
        highest = reward_generator.highest_reward(
            self.experiment, len(self.agent.fingers), self.dense_weights
        )
        return self.compute_dense_reward(obs, action, info) / highest

    # -- State -----------------------------------------------------------------------

    def get_state_dict(self) -> dict:
        """Return bodies, joint targets and the task's own state."""
        state = super().get_state_dict()
        task = (self.instruction_index, self._success_once, self._wrong_once)
        state["task"] = {
            name: value.float()[:, None]
            for name, value in zip(TASK_STATE, task, strict=True)
        }
        return state

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
        if "task" in state:
            task = {name: state["task"][name][..., 0] for name in TASK_STATE}
            self.instruction_index[rows] = task["instruction_index"].long()
            self._success_once = self._success_once.clone()
            self._wrong_once = self._wrong_once.clone()
            self._success_once[rows] = task["success_once"].bool()
            self._wrong_once[rows] = task["wrong_once"].bool()

    def set_state(self, state: Tensor, env_idx: Tensor | None = None) -> None:
        """Restore what `get_state` returned: the same, as one flat row per env."""
        state = common.to_tensor(state, device=self.device)
        tail = len(self.agent.start_qpos) + len(TASK_STATE)
        super().set_state(state[:, :-tail], env_idx)
        target, task = state[:, -tail:].split(
            [tail - len(TASK_STATE), len(TASK_STATE)], 1
        )
        columns = dict(zip(TASK_STATE, task.split(1, dim=1), strict=True))
        self.set_state_dict(
            {"controller": {"target_qpos": target}, "task": columns}, env_idx
        )


def _count(info: dict[str, Tensor]) -> FingerCount:
    return FingerCount(info["right_fingers"], info["wrong_fingers"])
