"""Critic: from B_t to the value of the state."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ir_maniskill.agent.actor import tanh_layers


class Critic(nn.Module):
    """V(s): the discounted reward still to come, read from B_t."""

    def __init__(self, inputs: int, hidden: Sequence[int]) -> None:
        """Make the layers."""
        super().__init__()
        self.value = tanh_layers(inputs, hidden, 1, gain=1.0)

    def forward(self, aligned: Tensor) -> Tensor:
        """Return the value [N] given B_t [N, D]."""
        return self.value(aligned).squeeze(-1)


class Standardize(nn.Module):
    """Brings the simulator's state, [m] and [rad/s], to mean 0 and deviation 1."""

    mean: Tensor
    variance: Tensor
    count: Tensor

    def __init__(self, size: int) -> None:
        """Start with mean 0 and variance 1 until something was seen."""
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("variance", torch.ones(size))
        self.register_buffer("count", torch.zeros(()))

    def forward(self, values: Tensor) -> Tensor:
        """Return the values [N, P] standardized, cut at 10 deviations."""
        deviation = self.variance.sqrt().clamp_min(1e-4)
        return ((values - self.mean) / deviation).clamp(-10, 10)

    @torch.no_grad()
    def update(self, values: Tensor) -> None:
        """Take values [N, P] into account (Chan's parallel mean and variance)."""
        count = len(values)
        total = self.count + count
        variance, mean = torch.var_mean(values, dim=0, correction=0)
        shift = mean - self.mean
        spread = self.variance * self.count + variance * count
        spread += shift.square() * self.count * count / total
        self.variance.copy_(spread / total)
        self.mean.add_(shift * (count / total))
        self.count.copy_(total)
