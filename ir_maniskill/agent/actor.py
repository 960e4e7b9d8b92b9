"""Actor: from B_t to the action a_t."""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import Normal
from torch.nn import functional


def tanh_layers(
    inputs: int, hidden: Sequence[int], outputs: int, gain: float
) -> nn.Sequential:
    """Return linear layers with tanh between them; `gain` scales the last one."""
    widths = (inputs, *hidden, outputs)
    gains = (*(math.sqrt(2) for _ in hidden), gain)
    layers: list[nn.Module] = []
    for into, out, scale in zip(widths, widths[1:], gains, strict=False):
        linear = nn.Linear(into, out)
        nn.init.orthogonal_(linear.weight, scale)
        nn.init.zeros_(linear.bias)
        layers += [linear, nn.Tanh()]
    return nn.Sequential(*layers[:-1])


def drawn(posture: Tensor, target: Tensor | None, gain: float) -> Tensor:
    """Return g (p - q) for a posture p and joint targets q; p itself without a gain.

    As long as p stays, such changes of the targets bring them to p and hold them there,
    whatever noise did to them before.
    """
    if gain == 0:
        return posture
    assert target is not None
    return gain * (posture - target)


class Actor(nn.Module):
    """pi(a|s): a Gaussian whose mean is read from B_t, whose deviation is not.

    With a `posture_gain` the layers give a posture, to which the mean is `drawn`.
    """

    log_std: Tensor

    def __init__(
        self, inputs: int, hidden: Sequence[int], actions: int, posture_gain: float = 0
    ) -> None:
        """Make the layers; at first they give about 0, the middle of each joint."""
        super().__init__()
        self.posture_gain = posture_gain
        self.mean = tanh_layers(inputs, hidden, actions, gain=0.01)
        self.register_buffer("log_std", torch.zeros(actions))

    def forward(self, aligned: Tensor, target: Tensor | None) -> Normal:
        """Return the distribution of a_t [N, A], of B_t [N, D].

        The joint targets [N, A] in [-1, 1] are unused without `posture_gain`.
        """
        mean = drawn(self.mean(aligned), target, self.posture_gain)
        std = self.log_std.exp().expand_as(mean)
        return Normal(mean, std, validate_args=False)

    def set_std(self, std: float) -> None:
        """Set the deviation of every action (a schedule's)."""
        self.log_std.data.fill_(math.log(std))


class Squashed(NamedTuple):
    """A Gaussian put through tanh: actions that stay in [-1, 1] by themselves."""

    center: Tensor  # [N, A], before the tanh
    log_std: Tensor  # [N, A]

    @property
    def mean(self) -> Tensor:
        """The action in the middle [N, A]."""
        return torch.tanh(self.center)

    def rsample(self) -> tuple[Tensor, Tensor]:
        """Return actions [N, A] through which gradients flow, and log pi(a|s) [N]."""
        noise = torch.randn_like(self.center)
        free = self.center + self.log_std.exp() * noise
        # log N(free) - log |d tanh(free) / d free|, the latter without cancellation
        density = -0.5 * noise.square() - self.log_std - 0.5 * math.log(2 * math.pi)
        slope = 2 * (math.log(2) - free - functional.softplus(-2 * free))
        return torch.tanh(free), (density - slope).sum(-1)


def normed_layers(inputs: int, hidden: Sequence[int], outputs: int) -> nn.Sequential:
    """Return linear layers, each but the last one normalized and with a ReLU."""
    widths = (inputs, *hidden)
    layers: list[nn.Module] = []
    for into, out in itertools.pairwise(widths):
        layers += [nn.Linear(into, out), nn.LayerNorm(out), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(widths[-1], outputs))


class SquashedActor(nn.Module):
    """pi(a|s): a Gaussian within [-1, 1] of which both parameters are read from B_t.

    With a `posture_gain` its center, before the tanh, is `drawn` to a posture.
    """

    LOG_STD = (-4.0, 0.5)
    """Between which the logarithm of the deviation stays."""

    def __init__(
        self, inputs: int, hidden: Sequence[int], actions: int, posture_gain: float = 0
    ) -> None:
        """Make the layers."""
        super().__init__()
        self.posture_gain = posture_gain
        self.layers = normed_layers(inputs, hidden, 2 * actions)

    def forward(self, aligned: Tensor, target: Tensor | None) -> Squashed:
        """Return the distribution of a_t [N, A], of B_t [N, D].

        The joint targets [N, A] in [-1, 1] are unused without `posture_gain`.
        """
        center, log_std = self.layers(aligned).float().chunk(2, dim=-1)
        center = drawn(center, target, self.posture_gain)
        return Squashed(center, log_std.clamp(*self.LOG_STD))
