"""Shape of the learner, as a frozen dataclass that survives JSON."""

import math
from dataclasses import dataclass
from typing import Literal

from ir_maniskill.checks import require, require_choice

Sense = Literal["vision", "proprioception", "touch", "state"]
Vision = Literal["patches", "paper"]
CriticInput = Literal["asymmetric", "separate"]


@dataclass(frozen=True)
class AgentConfig:
    """Shape of the learner: which boxes it has, and how wide they are."""

    senses: tuple[Sense, ...] | None = ("vision", "proprioception", "touch")
    """What the actor perceives beside the sentence; None: the experiment's own senses.
    "state" is the simulator's own state, for finding out what can be learned."""
    sees_target: bool = True
    """Whether proprioception includes the joint targets (needed by delta actions)."""
    vocabulary: int = 10
    """Number of token ids, <pad> = 0 included; training takes the experiment's."""
    language_layers: int = 3
    """Transformer encoder layers."""
    language_heads: int = 2
    """Attention heads a layer."""
    language_width: int = 50
    """Units of each token's representation."""
    vision: Vision = "patches"
    """"paper": two 5x5 convolutions over the cameras side by side; "patches": a
    convolution over 4x4 patches of each camera, then 3x3 ones, all normalized, and
    so is H_t then."""
    vision_channels: tuple[int, ...] = (32, 32, 32)
    """Channels of the convolutions of "patches"; the second halves the maps."""
    film: bool = True
    """Whether the sentence modulates the convolutions over patches (FiLM)."""
    vision_width: int = 256
    """Units of V_t."""
    body_width: int = 128
    """Units of H_t."""
    posture_gain: float = 0.0
    """How strongly mean actions, changes of the joint targets, draw these toward the
    posture that the actor's layers then give; 0: the layers give the action itself."""
    hidden: tuple[int, ...] = (500, 256, 128)
    """Units of the actor's and the critic's tanh layers."""
    critic: CriticInput = "asymmetric"
    """What the critic reads: the simulator's state instead of images, or what the actor
    senses, by an encoder of its own."""
    auxiliary_weight: float = 3.0
    """Weight of the loss that predicts where the named object is; 0: no such head."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        for sense in self.senses or ():
            require_choice("senses", sense, Sense)
        require(self.senses != (), "senses", self.senses, "at least one, or None")
        require_choice("vision", self.vision, Vision)
        require_choice("critic", self.critic, CriticInput)
        positive = "vocabulary language_layers language_heads vision_width body_width"
        for name in positive.split():
            require(getattr(self, name) > 0, name, getattr(self, name), "at least 1")
        width, heads = self.language_width, self.language_heads
        fits = width > 0 and width % heads == 0
        require(fits, "language_width", width, f"a multiple of {heads} heads")
        for name in ("vision_channels", "hidden"):
            units = getattr(self, name)
            fits = bool(units) and min(units) > 0
            require(fits, name, units, "one or more positive sizes")
        weight = self.auxiliary_weight
        require(weight >= 0, "auxiliary_weight", weight, "0 or more")
        gain, senses = self.posture_gain, self.senses
        require(
            0 <= gain < math.inf, "posture_gain", gain, "a finite number of at least 0"
        )
        felt = senses is None or bool({"proprioception", "state"} & set(senses))
        fits = gain == 0 or (felt and self.sees_target)
        expected = "0 where the actor does not feel its joint targets"
        require(fits, "posture_gain", gain, expected)
