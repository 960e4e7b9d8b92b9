"""Reward Generator: from measured goals to reward, pure tensor functions (Sec. IV).

Nothing here knows the simulator, or any kind of goal.
Legend: N envs, F fingers, C objects, K reward terms.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ir_maniskill.checks import require
from ir_maniskill.experiment import Experiment
from ir_maniskill.goals import MOVED, Measure
from ir_maniskill.snapshot import Snapshot

TERMS = (
    "hold",
    "hold_after_foul",
    "approach",
    "gather",
    "gather_after_foul",
    "foul",
    "speed",
)
"""Names of the K terms of the dense reward, as measured: all but `hold` at least 0."""

NEAR = 0.1
"""Distance at which nearness has fallen to a quarter, about [m]."""

TOP_SPEED = 0.3
"""Speed from which on a moving object is penalized no more [m/s]."""


@dataclass(frozen=True)
class Verdict:
    """What the contacts and motions mean for the goal of each scene."""

    right: Tensor
    """Which fingers touch as the goal asks [N, F] bool."""
    wrong: Tensor
    """Which fingers touch as it does not allow [N, F] bool."""
    disturbed: Tensor
    """Whether an object was moved that may not be [N] bool."""

    @property
    def foul(self) -> Tensor:
        """Whether anything is touched or moved that the goal does not allow [N]."""
        return self.wrong.any(dim=1) | self.disturbed


def judge(scene: Snapshot, measure: Measure) -> Verdict:
    """Tell right from wrong contacts, and whether something was disturbed."""
    serves, fouls = measure.serves, forbidden(measure)  # [N, F, C]
    if measure.has("bars"):
        serves = serves & ~measure.bars
    disturbed = torch.zeros_like(measure.holds)
    if measure.has("may_move"):
        moved = scene.moved.norm(dim=2) > MOVED  # [N, C]
        disturbed = (moved & ~measure.may_move).any(dim=1)
    return Verdict(
        right=(scene.contact & serves).any(dim=2),
        wrong=(scene.contact & fouls).any(dim=2),
        disturbed=disturbed,
    )


def forbidden(measure: Measure) -> Tensor:
    """Return which contacts a goal does not allow [N, F, C] bool."""
    asks = measure.serves.flatten(1).any(dim=1)[:, None, None]
    fouls = asks & ~measure.serves
    return fouls | measure.bars if measure.has("bars") else fouls


def sparse_reward(
    experiment: Experiment, holds: Tensor, level: Tensor, wrong_fingers: Tensor
) -> Tensor:
    """Return the paper's reward of the experiment [N] float32.

    "binary" (experiments I, II): 1 while the goal holds. "per_finger" (experiment III):
    its level, which for a touch is the number of fingers. Both take `wrong_penalty` for
    each wrong finger (0.1 in experiment III).
    """
    gain = holds.float() if experiment.reward == "binary" else level
    return gain - experiment.wrong_penalty * wrong_fingers


def reward_terms(
    scene: Snapshot, measure: Measure, verdict: Verdict, fouled: Tensor
) -> Tensor:
    """Return the terms of the dense reward, which is ours [N, K], as in `TERMS`.

    `fouled` says whether there was a foul in the episode, this step's too [N] bool.
    """
    clean, fouled = (~fouled).float(), fouled.float()
    away = scene.to_object - measure.aim[:, None]  # [N, F, C, 3]
    each = away.norm(dim=3).where(measure.serves, torch.inf).amin(dim=2)  # [N, F]
    gather = (1 - torch.tanh(each / NEAR)).sum(dim=1)  # fingers that may not: 0
    gather = gather / measure.serves.any(dim=2).sum(dim=1).clamp(min=1)
    speed = scene.velocity.norm(dim=2) * measure.still  # [N, C]
    terms = (
        measure.level * clean,
        measure.level * fouled,
        1 - torch.tanh(measure.gap / NEAR),
        gather * clean,
        gather * fouled,
        verdict.foul.float(),
        speed.amax(dim=1).clamp(max=TOP_SPEED),
    )
    return torch.stack(terms, dim=1)


@dataclass(frozen=True)
class RewardWeights:
    """Weights of the dense reward's terms, each finite and at least 0."""

    hold: float = 1.0
    """Of the goal's level: for a touch, of each finger."""
    approach: float = 0.5
    """Of bringing the gap to 0, at most."""
    gather: float = 4.0
    """Of bringing all fingers that may touch to what they may touch, at most."""
    foul: float = 0.5
    """Penalty while something is touched or moved that the goal does not allow."""
    speed: float = 6.0
    """Penalty for each m/s at which a touched object moves, up to `TOP_SPEED`: what
    makes holding it better than sweeping it along."""
    after_foul: float = 0.25
    """Share of `hold` and `gather` that is left after a foul in the episode: what makes
    a goal worth reaching without one."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            most = 1 if name == "after_foul" else sys.float_info.max
            expected = "a finite number of at least 0 (after_foul: at most 1)"
            fits = isinstance(value, float | int) and 0 <= value <= most
            require(fits, f"reward_weights.{name}", value, expected)

    def changed(self, weights: Mapping[str, float]) -> RewardWeights:
        """Return these with other values; ConfigError: there is no such weight."""
        known = isinstance(weights, Mapping) and weights.keys() <= vars(self).keys()
        expected = f"a dict of some of {', '.join(vars(self))}"
        require(known, "reward_weights", weights, expected)
        return replace(self, **weights)

    def vector(self) -> Tensor:
        """Return the weight of each of `TERMS`, penalties with their sign [K]."""
        kept = self.after_foul
        hold, gather = self.hold, self.gather
        terms = (hold, hold * kept, self.approach, gather, gather * kept)
        return torch.tensor((*terms, -self.foul, -self.speed))

    def highest(self, fingers: int) -> float:
        """Return the largest dense reward that one step of a touch can give."""
        return self.hold * fingers + self.approach + self.gather
