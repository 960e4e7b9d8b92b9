"""Schedules: numbers that follow the share of a training that is done, from 0 to 1."""

from dataclasses import replace

from ir_maniskill.environment.reward_generator import RewardWeights


def linear(start: float, end: float, share: float, end_share: float = 1.0) -> float:
    """Return what goes from `start` evenly to `end`, and stays there."""
    return end if share >= end_share else start + share / end_share * (end - start)


def softened(weights: RewardWeights, part: float) -> RewardWeights:
    """Return weights with which a part of the penalties counts, 0 to 1.

    Penalties that count in full from the start teach to keep away from objects: they
    grow from 0, and what a foul leaves of the reward falls from all of it.
    """
    return replace(
        weights,
        foul=part * weights.foul,
        speed=part * weights.speed,
        after_foul=1 - part * (1 - weights.after_foul),
    )
