"""Weights of linear layers as whole numbers of 4 or 8 bits, for small policy files.

Rounding each weight by itself changes what a layer gives more than need be. GPTQ
(Frantar et al., 2023, section 3) goes through a layer's inputs one by one and lets the
weights not rounded yet make up for what rounding the last ones changed, by least
squares over inputs that the layer was seen to get.

Legend: N states, O outputs and I inputs of a layer.
"""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from ir_maniskill.agent.agent import Agent
from ir_maniskill.environment.state import State

LARGE = 100_000
"""From so many weights on a layer gets 4 bits a weight; smaller ones get 8."""

DAMPING = 0.01
"""What is added to every input's second moment, as a share of their mean."""

BATCH = 256
"""States that the policy acts in at a time, so that little memory is needed."""

SCALE = ".scale"
"""Ends the name of the scales that belong to a layer's whole numbers."""


@torch.no_grad()
def quantize(
    agent: Agent, weights: Mapping[str, Tensor], states: State
) -> dict[str, Tensor]:
    """Return the weights in few bits, so that the policy acts much as it did.

    Args:
        agent: The learner.
        weights: Those of its weights that shall be kept, by name.
        states: What the policy has seen [N, ...]; it shall act alike there.

    Returns:
        For the linear layers of the policy whole numbers and, under that name and
        `SCALE`, the scale of each row [O]; two numbers of 4 bits share a byte. Other
        weights have 16 bits.
    """
    moments = _moments(agent, states)
    stored: dict[str, Tensor] = {}
    for name, weight in weights.items():
        if name in moments:
            pairs = weight.numel() >= LARGE and weight.shape[1] % 2 == 0
            bits = 4 if pairs else 8
            numbers, scale = round_weights(weight, moments[name], bits)
            stored[name] = _pair(numbers) if pairs else numbers
            stored[name + SCALE] = scale
        else:
            stored[name] = weight.half() if weight.is_floating_point() else weight
    return stored


def dequantize(stored: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return all weights as 32-bit numbers, whether they were quantized or not."""
    weights: dict[str, Tensor] = {}
    for name, tensor in stored.items():
        if name.endswith(SCALE) and name.removesuffix(SCALE) in stored:
            continue
        scale = stored.get(name + SCALE)
        if scale is not None:
            numbers = _part(tensor) if tensor.dtype == torch.uint8 else tensor
            tensor = numbers * scale[:, None]
        weights[name] = tensor.float() if tensor.is_floating_point() else tensor
    return weights


def round_weights(weight: Tensor, moment: Tensor, bits: int) -> tuple[Tensor, Tensor]:
    """Round a layer's weights so that its outputs change little.

    Args:
        weight: [O, I].
        moment: Sum of x x^T [I, I] over the inputs x that the layer was seen to get.
        bits: Bits of each number, at most 8.

    Returns:
        Whole numbers [O, I] and the scale of each row [O], whose product stands for the
        weights.
    """
    top = 2 ** (bits - 1) - 1
    left = weight.to("cpu", torch.double, copy=True)  # still to be expressed
    scale = (left.abs().amax(dim=1) / top).float().clamp_min(1e-12)
    unit = scale.double()
    extra = (DAMPING * moment.diagonal().mean()).clamp_min(1e-12)
    damped = moment.double() + extra * torch.eye(len(moment), dtype=torch.double)
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(damped))
    factor = torch.linalg.cholesky(inverse, upper=True)  # [I, I]
    numbers = torch.empty_like(left)
    for i in range(weight.shape[1]):
        numbers[:, i] = (left[:, i] / unit).round().clamp(-top - 1, top)
        error = (left[:, i] - numbers[:, i] * unit) / factor[i, i]
        left -= torch.outer(error, factor[i])
    return numbers.to(torch.int8), scale


def _moments(agent: Agent, states: State) -> dict[str, Tensor]:
    """Return the sum of x x^T [I, I] over the inputs x of each linear layer that acts.

    By the name of its weights.
    """
    moments: dict[str, Tensor] = {}

    def watch(name: str, layer: nn.Linear) -> torch.utils.hooks.RemovableHandle:
        def add(_: nn.Module, inputs: tuple[Tensor, ...]) -> None:
            x = inputs[0].reshape(-1, layer.in_features).cpu().double()
            moments[name] = moments.get(name, 0) + x.T @ x

        return layer.register_forward_pre_hook(add)

    layers = agent.named_modules()
    hooks = [watch(f"{k}.weight", m) for k, m in layers if isinstance(m, nn.Linear)]
    try:
        for first in range(0, len(states["instruction"]), BATCH):
            agent.policy({k: v[first : first + BATCH] for k, v in states.items()})
    finally:
        for hook in hooks:
            hook.remove()
    return moments


def _pair(numbers: Tensor) -> Tensor:
    """Return numbers of 4 bits [O, I] two to a byte [O, I / 2]."""
    nibbles = (numbers + 8).to(torch.uint8)
    return nibbles[:, ::2] | nibbles[:, 1::2] << 4


def _part(pairs: Tensor) -> Tensor:
    """Return the numbers [O, I] that `_pair` brought together."""
    nibbles = torch.stack([pairs & 15, pairs >> 4], dim=2).flatten(1)
    return nibbles.to(torch.int8) - 8
