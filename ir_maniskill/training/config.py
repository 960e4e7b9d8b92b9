"""Every number of a training run, as frozen dataclasses that survive JSON.

`CONFIGS["paper"]` holds what the paper and its reference code say, `CONFIGS["default"]`
our tuned values; both run the same code.
"""

import dataclasses
import json
import types
import typing
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

from ir_maniskill.agent.config import AgentConfig
from ir_maniskill.checks import ConfigError, require, require_choice
from ir_maniskill.environment.reward_generator import RewardWeights

ControlMode = Literal["pd_joint_target_delta_pos", "pd_joint_pos"]
RewardMode = Literal["dense", "normalized_dense", "sparse"]
SimBackend = Literal["physx_cpu", "physx_cuda"]
RenderBackend = Literal["auto", "cpu"]

Config = TypeVar("Config")


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimization."""

    rollouts: int = 64
    """Roll-outs collected for each update, over all ranks."""
    rollout_length: int = 32
    """Steps of each roll-out (an episode of 32 steps of 50 ms)."""
    epochs: int = 5
    """Passes over the collected steps, at most."""
    minibatch: int | None = 256
    """Steps of each gradient; None: all of them."""
    learning_rate: float = 3e-4
    """Adam's step size, at the start if there is a `target_kl`."""
    gamma: float = 0.95
    """Discount of a step."""
    gae_lambda: float = 0.95
    """Decay of generalized advantage estimation; 1: Monte-Carlo returns."""
    bootstrap: bool = True
    """Whether the value of the last observation stands for what the time limit cut."""
    clip: float = 0.2
    """Largest change of an action's probability ratio that is rewarded."""
    value_weight: float = 0.5
    """Weight of the critic's loss."""
    entropy_weight: float = 0.0
    """Weight of the entropy bonus (only a learned std feels it)."""
    max_kl: float | None = 0.05
    """No further epoch once the policy moved this far [nat]; None: all epochs."""
    target_kl: float | None = 0.015
    """How far an epoch should find the policy moved [nat]: Adam's step size shrinks
    where it is twice as far, to 1e-5 at least, and grows where it is half, to 1e-3 at
    most; None: it stays."""
    max_grad_norm: float | None = 0.5
    """Longest gradient; None: any."""
    normalize_reward: bool = True
    """Whether rewards are divided by the running deviation of the returns."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        for name in ("rollouts", "rollout_length", "epochs"):
            require(getattr(self, name) > 0, name, getattr(self, name), "at least 1")
        batch, total = self.minibatch, self.rollouts * self.rollout_length
        fits = batch is None or 2 <= batch <= total
        require(fits, "minibatch", batch, f"2 to {total} steps, or None")
        for name in ("gamma", "gae_lambda"):
            value = getattr(self, name)
            require(0 <= value <= 1, name, value, "0 to 1")
        for name in ("learning_rate", "clip"):
            require(getattr(self, name) > 0, name, getattr(self, name), "more than 0")
        for name in ("value_weight", "entropy_weight"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "0 or more")
        for name in ("max_kl", "target_kl", "max_grad_norm"):
            value = getattr(self, name)
            require(value is None or value > 0, name, value, "more than 0, or None")


@dataclass(frozen=True)
class TrainConfig:
    """One training run: the task, the learner, the budget, and where it is kept."""

    env_id: str = "NaoTouchCubeSingle-v1"
    """Task to learn."""
    out: str = "runs/default"
    """Folder of the run: checkpoints, metrics, TensorBoard events."""
    seed: int = 0
    """Seed of weights, exploration and scenes."""
    total_steps: int = 60_000
    """Environment steps, over all envs; rounded up to whole updates."""
    num_envs: int = 16
    """Scenes simulated side by side, over all ranks; must divide `ppo.rollouts`."""
    sim_backend: SimBackend = "physx_cpu"
    """Where physics is computed: "physx_cpu" has worker processes on the cores,
    "physx_cuda" all envs in one batch on the GPU."""
    render_backend: RenderBackend = "auto"
    """What draws: "auto" is a GPU if there is one, "cpu" the cores, through Mesa."""
    num_workers: int | None = None
    """Simulator processes of each rank on the CPU; None: one a core."""
    threads: int | None = None
    """Threads of each rank's update; None: one a core."""
    control_mode: ControlMode = "pd_joint_target_delta_pos"
    """What an action means: "pd_joint_target_delta_pos" moves the joint targets,
    "pd_joint_pos" sets them (the paper's)."""
    reward_mode: RewardMode = "dense"
    """Reward to learn from: "sparse" is the paper's, "dense" is shaped toward touching
    the named object alone, "normalized_dense" is that over the most it can give."""
    reward_weights: RewardWeights = field(default_factory=RewardWeights)
    """What counts how much in the dense reward."""
    lenient_steps: int = 0
    """Steps over which the prices of touching other objects (`dense_weights.wrong` and
    `spoiled`) and of pushing the named one (`push`) grow from nothing to what they are:
    first to touch, then to touch alone."""
    shader_pack: str | None = "unlit"
    """Shader pack of the cameras: "unlit" paints base colors and is by far the
    cheapest, "minimal" and "default" are lit; None: the task's own."""
    camera_height: int = 64
    """Height of each image [pixel]."""
    camera_width: int = 32
    """Width of each image [pixel]."""
    frames: int = 3
    """Observations stacked into a state."""
    eval_interval: int = 20_000
    """Steps from one evaluation to the next."""
    eval_episodes: int = 30
    """Episodes of each evaluation, spread evenly over the instructions."""
    eval_seed: int = 1_000_000
    """Seed of the evaluation's scenes; those of training have seeds from 2**30 on."""
    checkpoint_interval: int = 20_000
    """Steps from one complete checkpoint to the next."""
    stop_at_success: float | None = None
    """Stop early once an evaluation's success, of the worst instruction, is this high;
    None: use up all steps."""
    agent: AgentConfig = field(default_factory=AgentConfig)
    """The learner."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """How it learns."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        positive = "total_steps num_envs camera_height camera_width frames "
        positive += "eval_interval eval_episodes checkpoint_interval"
        for name in positive.split():
            require(getattr(self, name) > 0, name, getattr(self, name), "at least 1")
        lenient, total = self.lenient_steps, self.total_steps
        expected = f"0 to {total}, the total_steps (a third of them, say)"
        require(0 <= lenient <= total, "lenient_steps", lenient, expected)
        for name in ("num_workers", "threads"):
            value = getattr(self, name)
            require(value is None or value > 0, name, value, "at least 1, or None")
        require_choice("sim_backend", self.sim_backend, SimBackend)
        require_choice("render_backend", self.render_backend, RenderBackend)
        require_choice("control_mode", self.control_mode, ControlMode)
        require_choice("reward_mode", self.reward_mode, RewardMode)
        for name, bits in (("seed", 31), ("eval_seed", 29)):
            value = getattr(self, name)
            require(0 <= value < 2**bits, name, value, f"0 to 2**{bits} - 1")
        gain = self.agent.posture_gain
        fits = gain == 0 or self.control_mode == "pd_joint_target_delta_pos"
        expected = "0 where actions do not change the joint targets (control_mode)"
        require(fits, "posture_gain", gain, expected)
        rollouts = self.ppo.rollouts
        fits = rollouts % self.num_envs == 0
        require(fits, "num_envs", self.num_envs, f"a divisor of {rollouts} rollouts")
        goal = self.stop_at_success
        fits = goal is None or 0 < goal <= 1
        expected = "more than 0, at most 1, or None"
        require(fits, "stop_at_success", goal, expected)

    @property
    def steps_per_env(self) -> int:
        """T, the steps each env makes for one update."""
        return self.ppo.rollouts * self.ppo.rollout_length // self.num_envs

    @property
    def steps_per_update(self) -> int:
        """T x N, the steps all envs make for one update."""
        return self.ppo.rollouts * self.ppo.rollout_length

    @property
    def needs_state(self) -> bool:
        """Whether training reads the simulator's state, beside what the actor sees."""
        agent = self.agent
        return agent.critic == "asymmetric" or agent.auxiliary_weight > 0

    def env_kwargs(self, *, training: bool) -> dict[str, Any]:
        """Keyword arguments for `gym.make`, for training or for using the policy."""
        senses = self.agent.senses
        sees = senses is None or "vision" in senses
        state = (training and self.needs_state) or "state" in (senses or ())
        modes = {(True, True): "rgb+state_dict", (True, False): "rgb"}
        cameras: dict[str, Any] = {
            "width": self.camera_width,
            "height": self.camera_height,
        }
        if self.shader_pack is not None:
            cameras["shader_pack"] = self.shader_pack
        kwargs = {
            "obs_mode": modes.get((sees, state), "state_dict"),
            "control_mode": self.control_mode,
            "reward_mode": "sparse",
            "sensor_configs": cameras,
        }
        if training:
            kwargs["reward_mode"] = self.reward_mode
            kwargs["reward_weights"] = dataclasses.asdict(self.reward_weights)
        return kwargs


CONFIGS: dict[str, TrainConfig] = {
    "default": TrainConfig(),
    "posture": TrainConfig(
        total_steps=250_000,
        eval_episodes=90,
        lenient_steps=80_000,
        agent=AgentConfig(posture_gain=1.0, std=1.0),
        ppo=PPOConfig(gamma=0.9),
    ),
    "paper": TrainConfig(
        out="runs/paper",
        total_steps=150_000,
        num_envs=24,
        control_mode="pd_joint_pos",
        reward_mode="sparse",
        camera_height=128,
        camera_width=64,
        agent=AgentConfig(
            senses=None,
            sees_target=False,
            vision="paper",
            film=False,
            critic="separate",
            std_mode="fixed",
            std=0.36,
            auxiliary_weight=0.0,
        ),
        ppo=PPOConfig(
            rollouts=24,
            epochs=60,
            minibatch=None,
            learning_rate=1e-5,
            gamma=0.99,
            gae_lambda=1.0,
            bootstrap=False,
            clip=0.25,
            max_kl=None,
            target_kl=None,
            max_grad_norm=None,
        ),
    ),
}
"""The named configurations: "paper" as published, "default" as tuned to touch,
"posture" as tuned to hold with many fingers."""


LATER: dict[str, dict[str, object]] = {
    "AgentConfig": {"posture_gain": 0.0, "posture_gain_final": None},
    "TrainConfig": {
        "lenient_steps": 0,
        "render_backend": "auto",
        "sim_backend": "physx_cpu",
    },
}
"""Fields that older files lack, by class, with the values that those files meant."""


def to_json(config: object) -> str:
    """Return the JSON text of a configuration dataclass."""
    return json.dumps(dataclasses.asdict(config), indent=2)  # type: ignore[call-overload]


def decode(cls: type[Config], data: object) -> Config:
    """Return the dataclass `cls` from plain JSON data, strictly but for `LATER`.

    Raises:
        ConfigError: If a field is unknown, missing, of another type than declared, or
            out of its range.
    """
    require(isinstance(data, dict), cls.__name__, data, "an object of its fields")
    known = LATER.get(cls.__name__, {})
    values = known | typing.cast("dict[str, object]", data)
    hints = typing.get_type_hints(cls)
    unknown, missing = sorted(values.keys() - hints), sorted(hints.keys() - values)
    expected = f"exactly its fields (missing: {missing}, unknown: {unknown})"
    require(not unknown and not missing, cls.__name__, sorted(values), expected)
    fields = {name: _decode(hints[name], values[name], name) for name in hints}
    try:
        return cls(**fields)
    except ValueError as error:  # the environment's classes know no ConfigError
        raise ConfigError(str(error)) from error


def _decode(hint: Any, value: Any, name: str) -> Any:
    """Return the JSON value as the annotated type, or raise ConfigError."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        return decode(typing.cast("type", hint), value)
    if origin in (types.UnionType, typing.Union):
        if value is None and type(None) in arguments:
            return None
        return _decode(arguments[0], value, name)
    if origin is tuple:
        require(isinstance(value, list | tuple), name, value, "a list")
        return tuple(_decode(arguments[0], item, name) for item in value)
    if origin is Literal:
        require(value in arguments, name, value, f"one of {arguments}")
        return value
    if hint is float and type(value) is int:
        return float(value)
    require(type(value) is hint, name, value, f"a value of type {hint.__name__}")
    return value
