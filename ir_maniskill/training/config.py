"""Every number of a training run, as frozen dataclasses that survive JSON."""

import dataclasses
import math
import typing
from dataclasses import dataclass, field
from typing import Any, Literal

from ir_maniskill.agent.agent import asks
from ir_maniskill.agent.config import AgentConfig
from ir_maniskill.checks import ConfigError, require, require_fields, require_types
from ir_maniskill.environment.reward_generator import RewardWeights
from ir_maniskill.language.splits import KINDS

ControlMode = Literal["pd_joint_target_delta_pos", "pd_joint_pos"]
RewardMode = Literal["dense", "sparse"]
AlgorithmName = Literal["ppo", "sac"]
SimBackend = Literal["physx_cpu", "physx_cuda"]
RenderBackend = Literal["auto", "cpu"]

SCHEMA = 3
"""Version of the form in which configs are written."""

MAY_CHANGE = {
    *("out", "total_steps"),
    *("sim_backend", "render_backend", "num_workers", "threads"),
    *("eval_interval", "eval_episodes", "checkpoint_interval"),
}
"""Fields that a resumed run may have anew."""

WITH_WEIGHTS = (
    *("agent", "algorithm", "robot", "control_mode", "frames"),
    *("camera_height", "camera_width", "shader_pack"),
)
"""Fields that decide what a policy's weights are, and what they mean."""


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimization."""

    steps_per_update: int = 2048
    """Steps of each update, over all envs and ranks; rounded up to steps of all."""
    epochs: int = 5
    """Passes over the collected steps, at most."""
    minibatch: int | None = 256
    """Steps of each gradient; None: all of them."""
    learning_rate: float = 3e-4
    """Adam's learning rate, at the start if there is a `target_kl`."""
    gamma: float = 0.9
    """Discount of a step."""
    gae_lambda: float = 0.95
    """Decay of generalized advantage estimation; 1: Monte-Carlo returns."""
    bootstrap: bool = True
    """Whether the value of the last observation stands for what truncation hides."""
    clip: float = 0.2
    """Largest change of an action's probability ratio that is rewarded."""
    target_kl: float | None = 0.015
    """How far an epoch should find the policy moved [nat]: Adam's learning rate shrinks
    where it is twice as far, and grows where it is half; where it is more than three
    times as far no epoch follows. None: it stays, and all epochs are made."""
    max_grad_norm: float | None = 0.5
    """Longest gradient; None: any."""
    std: float = 1.0
    """Standard deviation of the action noise at the start."""
    std_final: float = 0.05
    """Standard deviation at the end, approached by the same amount each step."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        require_types(self)
        require_fields(self, "steps_per_update epochs", lambda x: x > 0, "at least 1")
        batch, total = self.minibatch, self.steps_per_update
        fits = batch is None or 2 <= batch <= total
        require(fits, "minibatch", batch, f"2 to {total} steps, or None")
        require_fields(self, "gamma gae_lambda", lambda x: 0 <= x <= 1, "0 to 1")
        above, expected = "learning_rate clip std std_final", "more than 0, and finite"
        require_fields(self, above, lambda x: 0 < x < math.inf, expected)
        above, expected = "target_kl max_grad_norm", "more than 0, or None"
        require_fields(self, above, lambda x: x is None or x > 0, expected)


@dataclass(frozen=True)
class SACConfig:
    """Soft actor-critic with hindsight: episodes are judged under many sentences."""

    capacity: int = 200_000
    """Rows that the replay has room for; the oldest make room. An episode has one more
    than steps."""
    random_steps: int = 3_000
    """Rows at the start whose actions are random; learning begins after them."""
    others: int = 8
    """Sentences under which an episode is judged beside its own, at most."""
    batch: int = 256
    """Steps of each gradient."""
    gradients: int = 2
    """Gradients of the critics for each step of all envs. The teacher has one after the
    first and after every second from there."""
    policy_from: float = 0.56
    """Share of the training in which the teacher learns; in the rest, the policy
    learns from it."""
    imitations: int = 2
    """Gradients of the policy for each step of all envs."""
    policy_acts: float = 0.75
    """Share of the envs in which the policy acts at the end, and none at the start."""
    learning_rate: float = 1e-3
    """Adam's learning rate of critics and teacher."""
    policy_rate: float = 2e-3
    """Adam's learning rate of the policy."""
    gamma: float = 0.95
    """Discount of a step."""
    reward_scale: float = 0.2
    """Factor of rewards, beside which entropy counts."""
    polyak: float = 0.005
    """How far the target critics follow at each gradient."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        require_types(self)
        positive = "capacity random_steps batch gradients"
        require_fields(self, positive, lambda x: x > 0, "at least 1")
        require_fields(self, "others imitations", lambda x: x >= 0, "0 or more")
        shares = "gamma policy_acts polyak"
        require_fields(self, shares, lambda x: 0 <= x <= 1, "0 to 1")
        begun = "more than 0, less than 1"
        require_fields(self, "policy_from", lambda x: 0 < x < 1, begun)
        above = "learning_rate policy_rate reward_scale"
        require_fields(self, above, lambda x: 0 < x < math.inf, "more than 0")


@dataclass(frozen=True)
class TrainConfig:
    """One training run: the task, the learner, the budget, and where it is kept."""

    env_id: str = "NaoTouchCubeSingle-v1"
    """Task to learn."""
    out: str = "runs/default"
    """Folder of the run: checkpoints, metrics, TensorBoard events."""
    seed: int = 0
    """Seed of weights, exploration and scenes."""
    robot: str = "nao"
    """Robot that learns it, by the name that `robot_uids` takes."""
    init_from: str | None = None
    """Policy whose weights to begin with: a task whose policy ships, a policy or
    checkpoint file, or a run's folder; None: weights are drawn."""
    total_steps: int = 250_000
    """Environment steps, over all envs; rounded up to whole updates."""
    num_envs: int = 16
    """Scenes simulated side by side, over all ranks."""
    sim_backend: SimBackend = "physx_cpu"
    """Physics: worker processes on the cores, or all envs in a batch on the GPU."""
    render_backend: RenderBackend = "auto"
    """What draws: "auto" is a GPU if there is one, "cpu" the cores, through Mesa."""
    num_workers: int | None = None
    """Simulator processes of each rank on the CPU; None: one a core."""
    threads: int | None = None
    """Pieces of a batch that each rank computes at once; None: one on each core."""
    control_mode: ControlMode = "pd_joint_target_delta_pos"
    """What an action means: "pd_joint_target_delta_pos" moves the joint targets,
    "pd_joint_pos" sets them (the paper's)."""
    reward_mode: RewardMode = "dense"
    """Reward to learn from: "sparse" is the paper's, "dense" leads to the goal."""
    reward_weights: RewardWeights = field(default_factory=RewardWeights)
    """What counts how much in the dense reward."""
    penalty_warmup: float = 1 / 3
    """Share of a training by "ppo" over which the dense reward's penalties grow from
    0."""
    shader_pack: str | None = "unlit"
    """Shader pack of the cameras: "unlit" is the cheapest; None: the task's own."""
    camera_height: int = 64
    """Height of each image [pixel]."""
    camera_width: int = 32
    """Width of each image [pixel]."""
    frames: int = 3
    """Observations stacked into a state."""
    eval_interval: int = 20_000
    """Steps from one evaluation to the next."""
    eval_episodes: int = 90
    """Episodes of each evaluation, spread evenly over the instructions."""
    kinds: tuple[str, ...] | None = None
    """Kinds of spoken sentences to learn from, each as often as it stands here, if the
    task has it; None: each equally often."""
    checkpoint_interval: int = 20_000
    """Steps from one complete checkpoint to the next."""
    agent: AgentConfig = field(default_factory=lambda: AgentConfig(posture_gain=1.0))
    """The learner."""
    algorithm: AlgorithmName = "ppo"
    """How it learns: the paper's proximal policy optimization, or soft actor-critic
    with hindsight."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Numbers of "ppo"."""
    sac: SACConfig = field(default_factory=SACConfig)
    """Numbers of "sac"."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        require_types(self)
        positive = "total_steps num_envs num_workers threads camera_height camera_width"
        positive += " frames eval_interval eval_episodes checkpoint_interval"
        require_fields(self, positive, lambda x: x is None or x > 0, "at least 1")
        require_fields(self, "penalty_warmup", lambda x: 0 <= x <= 1, "0 to 1")
        require_fields(self, "seed", lambda x: 0 <= x < 2**31, "0 to 2**31 - 1")
        known = self.kinds is None or {*KINDS} >= {*self.kinds} > set()
        require(known, "kinds", self.kinds, f"some of {KINDS}, or None")
        gain = self.agent.posture_gain
        fits = gain == 0 or self.control_mode == "pd_joint_target_delta_pos"
        expected = "0 where actions do not change the joint targets (control_mode)"
        require(fits, "posture_gain", gain, expected)
        agent, sac = self.agent, self.algorithm == "sac"
        fits = (agent.actor == "squashed", agent.critic == "none") == (sac, sac)
        expected = "'squashed' and 'none' with 'sac', others with 'ppo'"
        require(fits, "actor and critic", (agent.actor, agent.critic), expected)
        if sac:
            self._require_fit_for_sac()

    def _require_fit_for_sac(self) -> None:
        senses, start = self.agent.senses, self.sac.random_steps
        fits = "state" not in (senses or ())
        require(fits, "senses", senses, "no 'state', which tells one sentence's")
        least = math.floor(start / self.sac.policy_from) + 1
        expected = f"at least {least}: the teacher learns from {start} "
        expected += f"(sac.random_steps) on, in {self.sac.policy_from:g} of the steps"
        require(self.total_steps >= least, "total_steps", self.total_steps, expected)

    @property
    def steps_per_env(self) -> int:
        """T, the steps each env makes for one update."""
        return -(-self.ppo.steps_per_update // self.num_envs)

    def env_kwargs(self, *, training: bool) -> dict[str, Any]:
        """Keyword arguments for `gym.make`, for training or for using the policy."""
        agent, senses = self.agent, self.agent.senses
        sees = senses is None or "vision" in senses
        # The critic and the auxiliary loss read the simulator's state.
        learns_from = agent.critic == "asymmetric" or agent.auxiliary_weight > 0
        learns_from &= self.algorithm == "ppo"  # hindsight asks for snapshots instead
        state = (training and learns_from) or "state" in (senses or ())
        modes = {(True, True): "rgb+state_dict", (True, False): "rgb"}
        cameras: dict[str, Any] = {"width": self.camera_width}
        cameras["height"] = self.camera_height
        if self.shader_pack is not None:
            cameras["shader_pack"] = self.shader_pack
        kwargs = {
            "robot_uids": self.robot,
            "obs_mode": modes.get((sees, state), "state_dict"),
            "control_mode": self.control_mode,
            "reward_mode": "sparse",
            "sensor_configs": cameras,
        }
        asked = asks(self.agent)
        if training and self.algorithm == "sac":
            more = ("snapshot", "joint_velocity", "text")
            asked = tuple(dict.fromkeys((*asked, *more)))
        if asked:
            kwargs["observe"] = asked
        if training:
            if self.kinds is not None:
                kwargs["kinds"] = self.kinds
            kwargs["reward_mode"] = self.reward_mode
            kwargs["reward_weights"] = dataclasses.asdict(self.reward_weights)
        return kwargs


CONFIGS: dict[str, TrainConfig] = {
    "default": TrainConfig(),
    "listen": TrainConfig(
        algorithm="sac",
        total_steps=880_000,
        eval_interval=100_000,
        frames=1,
        penalty_warmup=0.0,
        reward_weights=RewardWeights(
            hold=1.5, approach=3.0, gather=2.0, foul=1.0, speed=2.0
        ),
        agent=AgentConfig(
            language="lexicon",
            vision="objects",
            actor="squashed",
            posture_gain=2.0,
            critic="none",
            language_length=40,
            auxiliary_weight=2.0,
        ),
    ),
    "vision": TrainConfig(
        total_steps=60_000,
        eval_episodes=30,
        agent=AgentConfig(senses=("vision",)),
        ppo=PPOConfig(gamma=0.95, std=0.5),
    ),
    "paper": TrainConfig(
        total_steps=150_000,
        num_envs=24,
        control_mode="pd_joint_pos",
        reward_mode="sparse",
        camera_height=128,
        camera_width=64,
        eval_episodes=30,
        agent=AgentConfig(
            senses=None,
            language_length=5,
            vision="paper",
            critic="separate",
            auxiliary_weight=0.0,
        ),
        ppo=PPOConfig(
            steps_per_update=24 * 32,
            epochs=60,
            minibatch=None,
            learning_rate=1e-5,
            gamma=0.99,
            gae_lambda=1.0,
            bootstrap=False,
            clip=0.25,
            target_kl=None,
            max_grad_norm=None,
            std=0.36,
            std_final=0.36,
        ),
    ),
}
"""The named configurations: "default" for all that feel their joints, "vision" for
pictures alone, "paper" as published, "listen" for many sentences, by hindsight."""


# -- Files -----------------------------------------------------------------------------


def to_data(config: TrainConfig) -> dict[str, Any]:
    """Return a configuration as plain data, with the version of its form."""
    return {"schema": SCHEMA, **dataclasses.asdict(config)}


def from_data(data: object) -> TrainConfig:
    """Return the configuration from plain data of this version.

    Raises:
        ConfigError: If a field is unknown, missing, of another type or out of its
            range, or another version of the package wrote it.
    """
    if isinstance(data, dict):
        schema = data.get("schema", 1)
        expected = f"{SCHEMA}: another version of ir_maniskill wrote this; use that one"
        require(schema == SCHEMA, "schema", schema, expected)
        data = {name: value for name, value in data.items() if name != "schema"}
    config: TrainConfig = _decode(TrainConfig, data)
    return config


def _decode(cls: Any, data: Any) -> Any:
    """Return the dataclass `cls` from plain data that has exactly its fields."""
    require(isinstance(data, dict), cls.__name__, data, "an object of its fields")
    hints, fields = typing.get_type_hints(cls), dict[str, Any]()
    unknown, missing = sorted(data.keys() - hints), sorted(hints.keys() - data)
    expected = f"exactly its fields (missing: {missing}, unknown: {unknown})"
    require(not unknown and not missing, cls.__name__, sorted(data), expected)
    for name, value in data.items():
        part = dataclasses.is_dataclass(hints[name])
        value = _decode(hints[name], value) if part else value
        fields[name] = tuple(value) if isinstance(value, list) else value
    return cls(**fields)


# -- Resuming --------------------------------------------------------------------------


def require_same(stored: TrainConfig, now: TrainConfig) -> None:
    """Raise ConfigError unless a config is the run's, but for what may change."""
    given = leaves(now)
    different = [
        f"{name} (run: {value!r}, now: {given[name]!r})"
        for name, value in leaves(stored).items()
        if name not in MAY_CHANGE and given[name] != value
    ]
    if different:
        raise ConfigError(
            f"{stored.out} was begun with another config: {', '.join(different)}; "
            "resume without them, or train in another folder"
        )


def leaves(config: object, prefix: str = "") -> dict[str, Any]:
    """Return the fields of a config by name; those of its parts are `part.name`."""
    found: dict[str, Any] = {}
    for part in dataclasses.fields(config):  # type: ignore[arg-type]
        value, name = getattr(config, part.name), prefix + part.name
        inner = dataclasses.is_dataclass(value)
        found |= leaves(value, f"{name}.") if inner else {name: value}
    return found
