"""Reward Generator: pure tensor functions from contacts to reward (Sec. III-A, IV).

Nothing here knows the simulator. Legend: N envs, F fingers, C objects.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ir_maniskill.experiment import Experiment


@dataclass(frozen=True)
class FingerCount:
    """How many fingers touch what."""

    right: Tensor
    """Fingers on the named object [N] int64."""
    wrong: Tensor
    """Fingers on any other object [N] int64."""


def split_fingers(contact: Tensor, named: Tensor) -> tuple[Tensor, Tensor]:
    """Return which fingers are on the named object, and which on others [N, F] bool.

    A finger that touches both is in both.

    Args:
        contact: Whether finger f touches object c [N, F, C] bool.
        named: Which object is named, one-hot [N, C] bool.
    """
    named = named[:, None]  # [N, 1, C]
    return (contact & named).any(2), (contact > named).any(2)


def count_fingers(contact: Tensor, named: Tensor) -> FingerCount:
    """Count the fingers on the named object and on the others, as `split_fingers`."""
    right, wrong = split_fingers(contact, named)
    return FingerCount(right.sum(1), wrong.sum(1))


def sparse_reward(experiment: Experiment, count: FingerCount) -> Tensor:
    """Return the paper's reward of the experiment [N] float32.

    "binary" (experiments I, II): 1 while any finger is on the named object.
    "per_finger" (experiment III): 1 for each such finger. Both take
    `wrong_penalty` for each finger on another object (0.1 in experiment III).
    """
    return _touch_reward(experiment, count, experiment.reward == "per_finger")


def _touch_reward(
    experiment: Experiment, count: FingerCount, each_finger: bool
) -> Tensor:
    right = count.right if each_finger else count.right.clamp(max=1)
    return right.float() - experiment.wrong_penalty * count.wrong


PUSH_LIMIT = 0.3
"""Speed from which on a moving object costs no more [m/s]."""


@dataclass(frozen=True)
class DenseWeights:
    """Weights of the dense reward, which is ours and not the paper's."""

    reach: float = 0.5
    """Reward of bringing a hand to the named object, at most."""
    reach_scale: float = 0.1
    """Distance at which `reach` has fallen to a quarter, about [m]."""
    each_finger: bool = False
    """Whether each finger on the named object counts in all experiments, also where
    the paper's reward is for touching it at all (I, II)."""
    gather: float = 4.0
    """Reward of bringing all fingers to the named object, at most; only where each
    finger counts."""
    gather_scale: float = 0.1
    """Distance at which a finger's part of `gather` has fallen to a quarter [m]."""
    wrong: float = 0.5
    """Taken while another object is touched by any finger."""
    push: float = 0.0
    """Taken for each m/s at which the named object moves, counted up to `PUSH_LIMIT`:
    what makes holding it better than sweeping it along."""
    spoiled: float = 0.25
    """Share of touch and `gather` that is left once another object has been touched
    in the episode: what makes touching only the named object worth learning."""

    def counts_each_finger(self, experiment: Experiment) -> bool:
        """Whether each finger on the named object adds to the reward."""
        return self.each_finger or experiment.reward == "per_finger"

    def at_price(self, share: float) -> DenseWeights:
        """Return the weights with a share, 0 to 1, of `wrong`, `push` and `spoiled`."""
        spoiled = self.spoiled + (1 - share) * (1 - self.spoiled)
        wrong, push = share * self.wrong, share * self.push
        return replace(self, wrong=wrong, push=push, spoiled=spoiled)

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            ValueError: A weight is negative or not finite, a scale is 0, or the share
                `spoiled` is more than 1.
        """
        for name, value in vars(self).items():
            scale, share = name.endswith("_scale"), name == "spoiled"
            fits = 0 <= value < math.inf and (value > 0 or not scale)
            if not fits or (share and value > 1):
                raise ValueError(
                    f"dense_weights: got {name}={value!r}, expected a finite number of "
                    "at least 0 (scales: more than 0; spoiled: at most 1)"
                )


def dense_reward(
    experiment: Experiment,
    count: FingerCount,
    distance: Tensor,
    speed: Tensor,
    wrong_once: Tensor,
    weights: DenseWeights,
) -> Tensor:
    """Return the sparse reward shaped toward touching the named object alone [N].

    With `weights.each_finger` it is that of experiment III that is shaped.

    Args:
        experiment: Whose reward to shape.
        count: Fingers on the named and on other objects.
        distance: From each finger to the named object's center [N, F] [m].
        speed: Of the named object [N] [m/s].
        wrong_once: Whether another object has been touched so far [N] bool.
        weights: How much each term counts.
    """
    kept = torch.where(wrong_once, weights.spoiled, 1.0)  # [N]
    each_finger = weights.counts_each_finger(experiment)
    touch = _touch_reward(experiment, count, each_finger)
    touch = torch.where(touch > 0, kept * touch, touch)
    nearest = distance.min(dim=1).values  # [N]
    reach = weights.reach * (1 - torch.tanh(nearest / weights.reach_scale))
    if each_finger:
        near = 1 - torch.tanh(distance / weights.gather_scale)  # [N, F]
        reach = reach + kept * weights.gather * near.mean(dim=1)
    price = weights.wrong * count.wrong.clamp(max=1)
    price = price + weights.push * speed.clamp(max=PUSH_LIMIT)
    return touch + reach - price


def highest_reward(
    experiment: Experiment, fingers: int, weights: DenseWeights
) -> float:
    """Return the largest dense reward that one step can give."""
    if weights.counts_each_finger(experiment):
        return fingers + weights.reach + weights.gather
    return 1.0 + weights.reach
