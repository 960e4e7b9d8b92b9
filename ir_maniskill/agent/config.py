"""Shape of the learner, as a frozen dataclass that survives JSON."""

import math
from dataclasses import dataclass
from typing import Any, Literal

from ir_maniskill.checks import require, require_choice
from ir_maniskill.environment.senses import available
from ir_maniskill.experiment import VOCABULARY

Vision = Literal["patches", "paper"]
CriticInput = Literal["asymmetric", "separate"]

MOST_LAYERS = 100
"""Of any part of the learner: so deep a net is a mistake, and takes long to make."""


@dataclass(frozen=True)
class AgentConfig:
    """Shape of the learner: which boxes it has, and how wide they are."""

    senses: tuple[str, ...] | None = ("vision", "proprioception", "target", "touch")
    """What the actor perceives beside the sentence, as `environment.senses` lists it;
    None: the experiment's own senses. "target" are the joint targets, good to know for
    who changes them; "state" is the simulator's own state, for finding out what
    can be learned."""
    vocabulary: tuple[str, ...] = VOCABULARY
    """Tokens by their ids; training takes the experiment's."""
    language: str = "tokens"
    """Language System, by the name under which it is registered; "tokens" is the
    paper's transformer over token ids."""
    language_length: int = 16
    """Tokens of the longest sentence that can be read."""
    language_layers: int = 3
    """Transformer encoder layers."""
    language_heads: int = 2
    """Attention heads a layer."""
    language_width: int = 50
    """Units of each token's representation."""
    vision: Vision = "patches"
    """"paper": two 5x5 convolutions over the cameras side by side; "patches": a
    convolution over 4x4 patches of each camera, then 3x3 ones, all normalized, and
    so is H_t then; the sentence modulates them (FiLM)."""
    vision_channels: tuple[int, ...] = (32, 32, 32)
    """Channels of the convolutions of "patches"; the second halves the maps."""
    vision_width: int = 256
    """Units of V_t."""
    body_width: int = 128
    """Units of H_t."""
    posture_gain: float = 0.0
    """How strongly mean actions, changes of the joint targets, draw these toward the
    posture that the actor's layers then give (it then knows the targets, whatever its
    senses are); 0: the layers give the action itself."""
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
            known = ", ".join(map(repr, available()))
            require(sense in available(), "senses", sense, f"one of {known}")
        require(self.senses != (), "senses", self.senses, "at least one, or None")
        require_choice("vision", self.vision, Vision)
        require_choice("critic", self.critic, CriticInput)
        positive = "language_length language_heads language_width vision_width"
        for name in (*positive.split(), "body_width"):
            require(getattr(self, name) > 0, name, getattr(self, name), "at least 1")
        words, layers = self.vocabulary, self.language_layers
        require(len(words) > 1, "vocabulary", words, "<pad>, <unk> and words")
        fits = 1 <= layers <= MOST_LAYERS
        require(fits, "language_layers", layers, f"1 to {MOST_LAYERS}")
        width, heads = self.language_width, self.language_heads
        fits = width % heads == 0
        require(fits, "language_width", width, f"a multiple of {heads} heads")
        for name in ("vision_channels", "hidden"):
            units = getattr(self, name)
            fits = 1 <= len(units) <= MOST_LAYERS and min(units) > 0
            require(fits, name, units, f"1 to {MOST_LAYERS} positive sizes")
        weight = self.auxiliary_weight
        require(weight >= 0, "auxiliary_weight", weight, "0 or more")
        gain, senses = self.posture_gain, self.senses
        require(
            0 <= gain < math.inf, "posture_gain", gain, "a finite number of at least 0"
        )
        felt = {"proprioception", "target", "state"} & set(senses or ())
        fits = gain == 0 or senses is None or bool(felt)
        require(fits, "posture_gain", gain, "0 where joints are not felt")


def from_version_1(old: dict[str, Any]) -> dict[str, Any]:
    """Return the plain data that 0.1 wrote in today's form; its policies act as before.

    What is not whole is left to whoever decodes it.
    """
    new = {"posture_gain": 0.0, "language": "tokens", **old}
    new.setdefault("language_length", 5)  # of the paper's sentences
    senses, told = new.get("senses"), new.pop("sees_target", True)
    if isinstance(senses, list | tuple) and told and "proprioception" in senses:
        place = senses.index("proprioception") + 1
        new["senses"] = [*senses[:place], "target", *senses[place:]]
    size = new.get("vocabulary")
    if type(size) is int and 1 < size < 10**5:  # else it is no file of ours
        others = (f"<{index}>" for index in range(len(VOCABULARY), size))
        new["vocabulary"] = [*VOCABULARY, *others][:size]
    if new.get("critic") == "shared":  # nothing of it is left where a policy acts
        new["critic"] = "separate"
    film = new.pop("film", True)
    fits = film or new.get("vision") == "paper"
    require(fits, "film", film, "true: without it there is only the paper's vision")
    return new
