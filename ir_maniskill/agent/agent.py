"""Agent: the paper's boxes wired together."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import Normal

from ir_maniskill.agent.actor import Actor, tanh_layers
from ir_maniskill.agent.alignment import Alignment
from ir_maniskill.agent.config import AgentConfig
from ir_maniskill.agent.critic import Critic, Standardize
from ir_maniskill.agent.language_system import LanguageSystem
from ir_maniskill.agent.perceptual_system import BodySense, PaperVision, PatchVision
from ir_maniskill.environment.state import State


@dataclass(frozen=True)
class StateSpec:
    """Shapes of the state s_t and of the action a_t."""

    tokens: int
    """L, tokens of a sentence."""
    frames: int
    """S, stacked observations."""
    cameras: int
    """K, cameras; 0 without images."""
    height: int
    """Height of an image [pixel]."""
    width: int
    """Width of an image [pixel]."""
    joints: int
    """J, joints felt by proprioception."""
    fingers: int
    """F, fingers that feel touch."""
    privileged: int
    """P, numbers of the simulator's own state; 0 if it is not given."""
    actions: int
    """A, numbers of an action."""

    @classmethod
    def of(cls, state: State, actions: int) -> "StateSpec":
        """Return the shapes of a state."""
        frames, joints = state["proprioception"].shape[1:]
        cameras = height = width = 0
        if "images" in state:
            cameras, height, width = state["images"].shape[2:5]
        privileged = state["privileged"].shape[1] if "privileged" in state else 0
        tokens, fingers = state["instruction"].shape[1], state["touch"].shape[2]
        image = (cameras, height, width)
        return cls(tokens, frames, *image, joints, fingers, privileged, actions)

    def require(self, state: State, needed: Iterable[str]) -> None:
        """Raise ValueError unless the state has these shapes in the fields needed."""
        got = StateSpec.of(state, self.actions)
        for name in needed:
            if getattr(got, name) != getattr(self, name):
                raise ValueError(
                    f"{name} of the state: got {getattr(got, name)}, but this agent "
                    f"was made for {getattr(self, name)}; make the environment with "
                    "the camera size, obs_mode and frames of the agent's config"
                )


class Act(NamedTuple):
    """What the agent does in a state, and what it thinks of it."""

    action: Tensor  # [N, A], not yet clipped to [-1, 1]
    log_prob: Tensor  # [N]
    value: Tensor  # [N]


class Judgement(NamedTuple):
    """How likely past actions are under the present policy."""

    log_prob: Tensor  # [N]
    entropy: Tensor  # [N]
    value: Tensor  # [N]
    named_position: Tensor | None  # [N, 3] [m], where the named object is thought to be


class StateEncoder(nn.Module):
    """s_t -> B_t: Language System, Perceptual System and Alignment."""

    def __init__(
        self, config: AgentConfig, spec: StateSpec, senses: tuple[str, ...]
    ) -> None:
        """Make the parts that the senses need."""
        super().__init__()
        self.body_keys = self._body_keys(config, senses)
        self.language = LanguageSystem(
            config.vocabulary,
            spec.tokens,
            layers=config.language_layers,
            heads=config.language_heads,
            width=config.language_width,
        )
        self.width = self.language.width
        """Size of B_t."""
        self.vision = self._vision(config, spec) if "vision" in senses else None
        if self.vision is not None:
            self.width += config.vision_width
        self.standardize = Standardize(spec.privileged) if "state" in senses else None
        joints, fingers = spec.frames * spec.joints, spec.frames * spec.fingers
        sizes = {"proprioception": joints, "target": joints, "touch": fingers}
        sizes["privileged"] = spec.privileged
        self.body = None
        if self.body_keys:
            inputs = sum(sizes[key] for key in self.body_keys)
            patches = config.vision == "patches"
            self.body = BodySense(inputs, config.body_width, normalize=patches)
            self.width += config.body_width
        self.alignment = Alignment()

    def forward(self, state: State) -> Tensor:
        """Return B_t [N, D] = [G_t, V_t, H_t]."""
        embeddings = [self.language(state["instruction"])]
        if self.vision is not None:
            embeddings.append(self.vision(state["images"], embeddings[0]))
        if self.body is not None:
            embeddings.append(
                self.body(*(self._sense(state, k) for k in self.body_keys))
            )
        return self.alignment(*embeddings)

    def _sense(self, state: State, key: str) -> Tensor:
        if key == "privileged" and self.standardize is not None:
            return self.standardize(state[key])
        return state[key]

    @staticmethod
    def _body_keys(config: AgentConfig, senses: tuple[str, ...]) -> tuple[str, ...]:
        """Return the entries of the state that the body senses consist of."""
        keys: dict[str, tuple[str, ...]]
        keys = {"state": ("privileged",), "touch": ("touch",)}
        felt = (
            ("proprioception", "target") if config.sees_target else ("proprioception",)
        )
        keys["proprioception"] = felt
        return tuple(key for sense in senses for key in keys.get(sense, ()))

    @staticmethod
    def _vision(config: AgentConfig, spec: StateSpec) -> nn.Module:
        if config.vision == "paper":
            return PaperVision(spec.frames, spec.cameras, config.vision_width)
        language = spec.tokens * config.language_width
        return PatchVision(
            spec.frames,
            (spec.cameras, spec.height, spec.width),
            config.vision_channels,
            config.vision_width,
            film_width=language if config.film else 0,
        )


class Agent(nn.Module):
    """The learner: reads the state s_t, acts, and judges how good the state is."""

    def __init__(
        self, config: AgentConfig, spec: StateSpec, *, policy_only: bool = False
    ) -> None:
        """Make an untrained agent.

        Args:
            config: Its parts; `senses` must be given.
            spec: Shapes of what it reads and does.
            policy_only: Leave out what only training needs (critic, auxiliary head).
        """
        super().__init__()
        if config.senses is None:
            raise ValueError("senses: got None, expected the experiment's senses")
        self.config, self.spec = config, spec
        self.encoder = StateEncoder(config, spec, config.senses)
        self.actor = Actor(
            self.encoder.width,
            config.hidden,
            spec.actions,
            posture_gain=config.posture_gain,
        )
        self.critic_encoder: StateEncoder | None = None
        self.critic: Critic | None = None
        self.locator: nn.Sequential | None = None
        if not policy_only:
            self._make_critic(config, spec)
            if config.auxiliary_weight > 0:
                self.locator = tanh_layers(self.encoder.width, (128,), 3, gain=0.1)

    def _make_critic(self, config: AgentConfig, spec: StateSpec) -> None:
        if config.critic == "asymmetric":
            if not spec.privileged:
                raise ValueError(
                    "the asymmetric critic reads the simulator's state, but the "
                    "observation has none; got an obs_mode without it, expected "
                    "'rgb+state_dict' or 'state_dict'"
                )
            senses = ("proprioception", "touch", "state")
            self.critic_encoder = StateEncoder(config, spec, senses)
        elif config.critic == "separate":
            self.critic_encoder = StateEncoder(config, spec, config.senses or ())
        width = (self.critic_encoder or self.encoder).width
        self.critic = Critic(width, config.hidden)

    def act(self, state: State, deterministic: bool = False) -> Act:
        """Return an action for each state: sampled, or the policy's mean."""
        aligned = self.encoder(state)
        policy = self._distribution(state, aligned)
        action = policy.mean if deterministic else policy.sample()
        log_prob = policy.log_prob(action).sum(-1)
        return Act(action, log_prob, self._value(state, aligned))

    @torch.no_grad()
    def policy(self, state: State) -> Tensor:
        """Return the policy's mean action [N, A] in [-1, 1], without any noise."""
        needed = ["tokens", "frames", "joints", "fingers"]
        if self.encoder.vision is not None:
            needed += ["cameras", "height", "width"]
        if self.encoder.standardize is not None:
            needed += ["privileged"]
        self.spec.require(state, needed)
        device = self.actor.log_std.device
        here = {key: value.to(device) for key, value in state.items()}
        return self._distribution(here, self.encoder(here)).mean.clamp(-1, 1)

    def value(self, state: State) -> Tensor:
        """Return the value of each state [N]."""
        aligned = self.encoder(state) if self.critic_encoder is None else None
        return self._value(state, aligned)

    def evaluate_actions(self, state: State, action: Tensor) -> Judgement:
        """Return how likely the actions [N, A] are now, and the states' values."""
        aligned = self.encoder(state)
        policy = self._distribution(state, aligned)
        return Judgement(
            policy.log_prob(action).sum(-1),
            policy.entropy().sum(-1),
            self._value(state, aligned),
            None if self.locator is None else self.locator(aligned),
        )

    def observe(self, privileged: Tensor) -> None:
        """Let the scales of the simulator's state follow what was seen [N, P]."""
        for encoder in (self.encoder, self.critic_encoder):
            if encoder is not None and encoder.standardize is not None:
                encoder.standardize.update(privileged)

    def _distribution(self, state: State, aligned: Tensor) -> Normal:
        return self.actor(aligned, state["target"][:, 0])

    def _value(self, state: State, aligned: Tensor | None) -> Tensor:
        if self.critic is None:
            raise RuntimeError(
                "this agent was loaded as a policy, without its critic: use `policy`, "
                "or load a complete checkpoint"
            )
        if self.critic_encoder is not None:
            aligned = self.critic_encoder(state)
        return self.critic(aligned)
