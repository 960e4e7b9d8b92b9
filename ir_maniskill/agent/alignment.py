"""Alignment: what was read, seen and felt becomes one vector B_t."""

import torch
from torch import Tensor, nn


class Alignment(nn.Module):
    """B_t = [G_t, V_t, H_t]: the embeddings of all senses side by side."""

    def forward(self, *embeddings: Tensor) -> Tensor:
        """Return the embeddings [N, D_i] concatenated to [N, sum D_i]."""
        return torch.cat(embeddings, dim=1)


class FiLM(nn.Module):
    """Lets the sentence scale and shift each channel of an image's feature maps.

    Where the place of the named object changes from episode to episode, seeing has to
    depend on what was read: x -> (1 + scale(G_t)) x + shift(G_t).
    """

    def __init__(self, language_width: int, channels: int) -> None:
        """Make the modulation of `channels` maps; at first it changes nothing."""
        super().__init__()
        self.scale_and_shift = nn.Linear(language_width, 2 * channels)
        nn.init.zeros_(self.scale_and_shift.weight)
        nn.init.zeros_(self.scale_and_shift.bias)

    def forward(self, maps: Tensor, language: Tensor) -> Tensor:
        """Return the maps [N, C, H, W] modulated by G_t [N, D]."""
        said = self.scale_and_shift(language).to(maps.dtype)[..., None, None]
        scale, shift = said.chunk(2, dim=1)
        return torch.addcmul(maps + shift, maps, scale)
