"""Agent: the paper's boxes wired together."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ir_maniskill.agent import language_system
from ir_maniskill.agent.actor import Actor, SquashedActor, tanh_layers
from ir_maniskill.agent.alignment import Alignment
from ir_maniskill.agent.config import AgentConfig
from ir_maniskill.agent.critic import Critic, Standardize
from ir_maniskill.agent.object_vision import ObjectVision
from ir_maniskill.agent.perceptual_system import (
    BODY_WIDTH,
    BodySense,
    PaperVision,
    PatchVision,
)
from ir_maniskill.checks import require
from ir_maniskill.environment.senses import State, askable
from ir_maniskill.environment.senses import entries as entries_of

VISIONS: dict[str, Any] = {
    "patches": PatchVision,
    "paper": PaperVision,
    "objects": ObjectVision,
}
"""What `AgentConfig.vision` names."""
READING_WIDTH = 128
"""Units that G_t is brought to where vision is "objects"."""


@dataclass(frozen=True)
class StateSpec:
    """Shapes of the state s_t and of the action a_t."""

    shapes: dict[str, tuple[int, ...]]
    """Shape of each entry of the state but for N, e.g. {"touch": (3, 6)}."""
    actions: int
    """A, numbers of an action."""

    @classmethod
    def of(cls, state: State, actions: int) -> "StateSpec":
        """Return the shapes of a state."""
        return cls({k: tuple(v.shape[1:]) for k, v in state.items()}, actions)

    @classmethod
    def from_data(cls, data: dict[str, Any]) -> "StateSpec":
        """Return the spec from plain JSON data (`dataclasses.asdict`)."""
        shapes = {name: tuple(map(int, s)) for name, s in data["shapes"].items()}
        return cls(shapes, int(data["actions"]))

    def require(self, state: State, entries: Iterable[str]) -> None:
        """Raise ValueError unless the state has these entries in these shapes."""
        for name in entries:
            got, expected = state.get(name), self.shapes[name]
            if got is None or tuple(got.shape[1:]) != expected:
                found = "nothing" if got is None else tuple(got.shape[1:])
                raise ValueError(
                    f"{name} of the state: got {found}, but this agent was made for "
                    f"{expected}; make the environment with the robot, camera size, "
                    "obs_mode and frames of the agent's config"
                )


def asks(config: AgentConfig) -> tuple[str, ...]:
    """Return what an env must be asked to observe for this agent: its `observe`."""
    said = language_system.encoder_of(config).reads
    reads = (*said, *entries_of(config.senses or ()))
    return tuple(name for name in reads if name in askable())


class Act(NamedTuple):
    """What the agent does in a state, and what it thinks of it."""

    action: Tensor  # [N, A], not yet clipped to [-1, 1]
    log_prob: Tensor  # [N]
    value: Tensor  # [N]


class Judgement(NamedTuple):
    """How likely past actions are under the present policy."""

    log_prob: Tensor  # [N]
    value: Tensor  # [N]
    named_position: Tensor | None  # [N, 3] [m], where the named object is thought to be


class StateEncoder(nn.Module):
    """s_t -> B_t: Language System, Perceptual System and Alignment."""

    def __init__(
        self, config: AgentConfig, spec: StateSpec, senses: tuple[str, ...]
    ) -> None:
        """Make the parts that the senses need.

        Raises:
            ConfigError: A sense is not among what the env observes.
        """
        super().__init__()
        entries, observed = entries_of(senses), ", ".join(spec.shapes)
        fits = entries.keys() <= spec.shapes.keys()
        require(fits, "senses", senses, f"those observed: {observed}")
        self.sensed = tuple(entries)
        """Entries of the state that it needs, beside the sentence."""
        self.felt = tuple(name for name in entries if name != "images")
        self.language = language_system.encoder_of(config)(config)
        self.reading: nn.Module | None = None
        width = self.language.width
        if config.vision == "objects":
            norm = nn.LayerNorm(READING_WIDTH), nn.Tanh()
            self.reading = nn.Sequential(nn.Linear(width, READING_WIDTH), *norm)
            width = READING_WIDTH
        self.vision: nn.Module | None = None
        self.standardize: Standardize | None = None
        self.body: BodySense | None = None
        self.width = width  # of G_t, and below of B_t
        if "images" in entries:
            frames, *size, _ = spec.shapes["images"]
            self.vision = vision = VISIONS[config.vision](frames, size, width)
            self.width += vision.width
        self.seen = slice(width, self.width)
        """Where V_t is in B_t."""
        if "privileged" in entries:
            self.standardize = Standardize(*spec.shapes["privileged"])
        if self.felt:
            inputs = sum(math.prod(spec.shapes[name]) for name in self.felt)
            self.body = BodySense(inputs, normalize=config.vision != "paper")
            self.width += BODY_WIDTH
        self.alignment = Alignment()

    def forward(self, state: State) -> Tensor:
        """Return B_t [N, D] = [G_t, V_t, H_t]."""
        said: Tensor = self.language(*(state[name] for name in self.language.reads))
        expected = len(state[self.language.reads[0]]), self.language.width
        if said.shape != expected:
            name, got = type(self.language).__name__, tuple(said.shape)
            raise ValueError(f"{name}: got G_t {got}, expected {expected}: [N, width]")
        if self.reading is not None:
            said = self.reading(said)
        embeddings = [said]
        if self.vision is not None:
            embeddings.append(self.vision(state["images"], said))
        if self.body is not None:
            felt = {name: state[name] for name in self.felt}
            if self.standardize is not None:
                felt["privileged"] = self.standardize(felt["privileged"])
            embeddings.append(self.body(*felt.values()))
        return self.alignment(*embeddings)


class Agent(nn.Module):
    """The learner: reads the state s_t, acts, and judges how good the state is."""

    def __init__(
        self, config: AgentConfig, spec: StateSpec, *, policy_only: bool = False
    ) -> None:
        """Make an untrained agent; the config must say which `senses` it has.

        `policy_only` leaves out what only training needs: critic and auxiliary head.
        """
        super().__init__()
        if config.senses is None:
            raise ValueError("senses: got None, expected the experiment's senses")
        self.config, self.spec = config, spec
        self.encoder = StateEncoder(config, spec, config.senses)
        width, gain = self.encoder.width, config.posture_gain
        self.actor: Any  # an algorithm knows which of them it trains
        kind = SquashedActor if config.actor == "squashed" else Actor
        self.actor = kind(width, config.hidden, spec.actions, posture_gain=gain)
        self.critic_encoder: StateEncoder | None = None
        self.critic: Critic | None = None
        self.locator: nn.Sequential | None = None
        if not policy_only:
            if config.critic != "none":
                self._make_critic(config, spec)
            if config.auxiliary_weight > 0:
                self.locator = tanh_layers(width, (128,), 3, gain=0.1)

    def _make_critic(self, config: AgentConfig, spec: StateSpec) -> None:
        senses = config.senses or ()
        if config.critic == "asymmetric":
            expected = "the simulator's state, which the asymmetric critic reads: make "
            expected += "the env with obs_mode 'rgb+state_dict' or 'state_dict'"
            found = tuple(spec.shapes)
            require("privileged" in found, "observation", found, expected)
            # All that is felt; of the actor's senses only pictures are left out, which
            # the state stands for.
            every = ("proprioception", "target", "touch", "state", *senses)
            senses = tuple(sense for sense in dict.fromkeys(every) if sense != "vision")
        self.critic_encoder = StateEncoder(config, spec, senses)
        self.critic = Critic(self.critic_encoder.width, config.hidden)

    def act(self, state: State) -> Act:
        """Return an action for each state, sampled."""
        policy = self._distribution(state, self.encoder(state))
        action = policy.sample()
        log_prob = policy.log_prob(action).sum(-1)
        return Act(action, log_prob, self.value(state))

    @torch.no_grad()
    def policy(self, state: State) -> Tensor:
        """Return the policy's mean action [N, A] in [-1, 1], without any noise."""
        target = ("target",) if self.config.posture_gain > 0 else ()
        self.spec.require(state, (*self.encoder.sensed, *target))
        device = next(self.actor.parameters()).device
        here = {key: value.to(device) for key, value in state.items()}
        return self._distribution(here, self.encoder(here)).mean.clamp(-1, 1)

    def value(self, state: State) -> Tensor:
        """Return the value of each state [N]."""
        if self.critic is None or self.critic_encoder is None:
            raise RuntimeError(
                "this agent was loaded as a policy, without its critic: use `policy`, "
                "or load a complete checkpoint"
            )
        return self.critic(self.critic_encoder(state))

    def evaluate_actions(self, state: State, action: Tensor) -> Judgement:
        """Return how likely the actions [N, A] are now, and the states' values."""
        aligned = self.encoder(state)
        policy = self._distribution(state, aligned)
        return Judgement(
            policy.log_prob(action).sum(-1),
            self.value(state),
            None if self.locator is None else self.locator(aligned),
        )

    def observe(self, privileged: Tensor) -> None:
        """Let the scales of the simulator's state follow what was seen [N, P]."""
        for encoder in (self.encoder, self.critic_encoder):
            if encoder is not None and encoder.standardize is not None:
                encoder.standardize.update(privileged)

    def _distribution(self, state: State, aligned: Tensor) -> Any:
        """Return a `Normal`, or what is `Squashed`."""
        drawn = self.config.posture_gain > 0
        return self.actor(aligned, state["target"][:, 0] if drawn else None)
