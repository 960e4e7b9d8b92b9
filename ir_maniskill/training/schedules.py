"""Schedules: numbers that follow the share of a training that is done, from 0 to 1."""

from dataclasses import dataclass, replace

from ir_maniskill.environment.reward_generator import RewardWeights


def linear(start: float, end: float, share: float, end_share: float = 1.0) -> float:
    """Return what goes from `start` evenly to `end`, and stays there."""
    return end if share >= end_share else start + share / end_share * (end - start)


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
        return linear(0.0, 1.0, share, self.warmup)

    def at(self, share: float) -> RewardWeights:
        """Return the weights after this share of the training."""
        weights, part = self.weights, self.penalty(share)
        return replace(
            weights,
            foul=part * weights.foul,
            speed=part * weights.speed,
            after_foul=1 - part * (1 - weights.after_foul),
        )
