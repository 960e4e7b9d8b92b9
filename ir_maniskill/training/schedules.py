"""Schedules: numbers that follow the share of a training that is done, from 0 to 1."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ir_maniskill.checks import require
from ir_maniskill.environment.reward_generator import RewardWeights


@dataclass(frozen=True)
class Linear:
    """Goes from `start` to `end` by the same amount each step, and stays outside."""

    start: float
    """Value up to `begin_share`."""
    end: float
    """Value from `end_share` on."""
    begin_share: float = 0.0
    """Share of the training after which it begins to change."""
    end_share: float = 1.0
    """Share of the training after which it changes no more."""

    def __post_init__(self) -> None:
        """Refuse shares that are not in order."""
        shares = (self.begin_share, self.end_share)
        fits = 0 <= shares[0] <= shares[1] <= 1
        require(fits, "begin_share, end_share", shares, "0 <= begin <= end <= 1")

    def __call__(self, share: float) -> float:
        """Return the value after this share of the training."""
        if share >= self.end_share:
            return self.end
        passed = max(0.0, share - self.begin_share)
        passed /= self.end_share - self.begin_share
        return self.start + passed * (self.end - self.start)


@dataclass(frozen=True)
class Curriculum:
    """First to reach the goal, then to reach it without a foul.

    Penalties that count in full from the start teach to keep away from objects: they
    grow from 0, and what a foul leaves of the reward falls from all of it.
    """

    weights: RewardWeights
    """Weights of the reward's terms once the penalties count in full."""
    warmup: float
    """Share of the training over which the penalties grow; 0: in full at once."""

    def penalty(self, share: float) -> float:
        """Return which part of the penalties counts, 0 to 1."""
        return Linear(0.0, 1.0, end_share=self.warmup)(share)

    def at(self, share: float) -> RewardWeights:
        """Return the weights after this share of the training."""
        weights, part = self.weights, self.penalty(share)
        return replace(
            weights,
            foul=part * weights.foul,
            speed=part * weights.speed,
            after_foul=1 - part * (1 - weights.after_foul),
        )
