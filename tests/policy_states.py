"""States for the shipped policies, the same wherever they are drawn."""

import torch
from torch import Tensor

TOKENS = ([3, 4, 5, 8, 2], [3, 4, 6, 8, 2], [3, 4, 7, 8, 2], [3, 4, 5, 9, 2])
"""Sentences, by the paper's vocabulary: three cubes and a button."""


def fixed_states(count: int = 20) -> dict[str, Tensor]:
    """Return states [count, ...] of smooth pictures, joints and touches."""
    generator = torch.Generator().manual_seed(7)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(count, *shape, generator=generator)

    coarse = uniform(3 * 2 * 3, 8, 4)
    smooth = torch.nn.functional.interpolate(coarse, (64, 32), mode="bilinear")
    images = (255 * smooth).byte().view(count, 3, 2, 3, 64, 32)
    return {
        "images": images.permute(0, 1, 2, 4, 5, 3).contiguous(),
        "proprioception": 2 * uniform(3, 26) - 1,
        "target": 2 * uniform(3, 26) - 1,
        "touch": (uniform(3, 6) < 0.3).float(),
        "instruction": torch.tensor([TOKENS[i % 4] for i in range(count)]),
    }
