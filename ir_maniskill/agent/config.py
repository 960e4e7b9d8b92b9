"""Shape of the learner, as a frozen dataclass that survives JSON."""

import math
from dataclasses import dataclass
from typing import Literal

from ir_maniskill.checks import require, require_fields, require_types
from ir_maniskill.environment.senses import available
from ir_maniskill.language.tokens import VOCABULARY

Vision = Literal["patches", "paper", "objects"]
ActorKind = Literal["gaussian", "squashed"]
CriticInput = Literal["asymmetric", "separate", "none"]


@dataclass(frozen=True)
class AgentConfig:
    """Shape of the learner: which boxes it has, and what they read."""

    senses: tuple[str, ...] | None = ("vision", "proprioception", "target", "touch")
    """What the actor perceives beside the sentence, as `environment.senses` lists it;
    None: the experiment's own. "target" are the joint targets, good to know for who
    changes them; "state" is the simulator's own, to find out what can be learned."""
    vocabulary: tuple[str, ...] = VOCABULARY
    """Tokens by their ids; training takes the experiment's."""
    language: str = "tokens"
    """Language System, by the name under which it is registered; "tokens" is the
    paper's transformer over token ids."""
    language_length: int = 16
    """Tokens of the longest sentence that can be read."""
    vision: Vision = "patches"
    """"paper": two 5x5 convolutions over the cameras side by side; "patches": a
    convolution over 4x4 patches of each camera, then 3x3 ones, all normalized, and
    so is H_t then; the sentence modulates them (FiLM); "objects": what lies where, of
    which the sentence then chooses, and G_t is brought to 128 units."""
    actor: ActorKind = "gaussian"
    """"gaussian": a deviation that a schedule sets; "squashed": one that is read from
    the state, and a tanh that keeps actions within [-1, 1]."""
    posture_gain: float = 0.0
    """How strongly mean actions (of a squashed actor: before the tanh), changes of the
    joint targets, draw these toward the posture that its layers then give. It then
    knows the targets, whatever its senses are. 0: the layers give the action itself."""
    hidden: tuple[int, ...] = (500, 256, 128)
    """Units of the actor's and the critic's tanh layers."""
    critic: CriticInput = "asymmetric"
    """What the critic reads: the simulator's state instead of images, or what the actor
    senses, by an encoder of its own; "none": the algorithm has critics of its own."""
    auxiliary_weight: float = 3.0
    """Weight of the loss that predicts where the named object is; 0: no such head."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        require_types(self)
        for sense in self.senses or ():
            known = ", ".join(map(repr, available()))
            require(sense in available(), "senses", sense, f"one of {known}")
        require(self.senses != (), "senses", self.senses, "at least one, or None")
        words, units = self.vocabulary, self.hidden
        require(len(words) > 1, "vocabulary", words, "<pad>, <unk> and words")
        fits = 1 <= len(units) <= 100 and min(units) > 0
        require(fits, "hidden", units, "1 to 100 positive sizes")
        require_fields(self, "language_length", lambda x: x > 0, "at least 1")
        finite = "a finite number of at least 0"
        weights = "auxiliary_weight posture_gain"
        require_fields(self, weights, lambda x: 0 <= x < math.inf, finite)
        gain, senses = self.posture_gain, self.senses
        felt = {"proprioception", "target", "state"} & set(senses or ())
        fits = gain == 0 or senses is None or bool(felt)
        require(fits, "posture_gain", gain, "0 where joints are not felt")
