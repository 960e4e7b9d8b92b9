"""Gradients of a batch, a piece of it on each core.

A thread computes its piece alone, so that none waits for another at every operation:
two cores halve the time, and one that is busy with something else slows it by no more.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import torch
from torch import Tensor

Loss = tuple[Tensor, dict[str, Tensor]]
"""A mean over some rows of a batch, and means to log; all are scalars."""

SMALLEST = 32
"""Rows that are worth a thread."""

executor = cache(ThreadPoolExecutor)


def backward(
    loss: Callable[[slice], Loss], rows: int, weights: Sequence[Tensor], threads: int
) -> dict[str, Tensor]:
    """Set the gradients of a mean over a batch's rows; return the means to log.

    `loss` is that mean over a part of the rows. Weights that it does not depend on have
    no gradient then. On a GPU there is one piece.
    """
    on_cpu = weights[0].device.type == "cpu"
    pieces = min(threads, math.ceil(rows / SMALLEST)) if on_cpu else 1
    ends = [rows * piece // pieces for piece in range(pieces + 1)]
    parts = [slice(*each) for each in itertools.pairwise(ends)]

    def learn(part: slice) -> tuple[Sequence[Tensor | None], dict[str, Tensor]]:
        value, means = loss(part)
        share = (part.stop - part.start) / rows
        gradients = torch.autograd.grad(value * share, weights, allow_unused=True)
        return gradients, {name: mean.detach() * share for name, mean in means.items()}

    run = executor(pieces).map if pieces > 1 else map
    gradients, means = zip(*run(learn, parts), strict=True)
    for weight, *each in zip(weights, *gradients, strict=True):
        found = [gradient for gradient in each if gradient is not None]
        # Fused Adam reads a gradient as it lies in memory, channels last or not.
        weight.grad = sum(found[1:], found[0]).contiguous() if found else None
    return {
        name: torch.stack([mean[name] for mean in means]).sum() for name in means[0]
    }
