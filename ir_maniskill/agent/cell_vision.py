"""Vision that learns from many stored pictures: few products, of bytes as stored.

Legend: N states, S stacked observations, K cameras, H x W pixels, D units.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from ir_maniskill.agent.alignment import FiLM

CELL, CHANNELS, WIDTH = 4, 32, 256
"""Side of a cell [pixel], maps of each convolution, units of V_t."""


def cells(images: Tensor) -> Tensor:
    """Cut uint8 images [N, S, K, H, W, 3] into cells [K, N, H / 4, W / 4, S * 48].

    The 12 bytes of a cell's row move as three words: one by one they take four times
    as long.
    """
    n, s, k, h, w, _ = images.shape
    high, wide = h // CELL, w // CELL
    images = images[:, :, :, : high * CELL, : wide * CELL].contiguous()
    words = images.view(n, s, k, high, CELL, wide, 3 * CELL).view(torch.int32)
    return words.permute(2, 0, 3, 5, 1, 4, 6).flatten(4).contiguous().view(torch.uint8)


class Convolution(nn.Conv2d):
    """One that computes in the numbers it is given, whatever its weights are."""

    def forward(self, maps: Tensor) -> Tensor:
        """Return the convolved maps [N, C, H, W]."""
        assert self.bias is not None
        weight, bias = self.weight.to(maps.dtype), self.bias.to(maps.dtype)
        return self._conv_forward(maps, weight, bias)


class CameraCells(nn.Module):
    """Feature maps of one camera: cells, then convolutions, as the sentence asks."""

    def __init__(self, frames: int, film_width: int) -> None:
        """Make the layers for `frames` stacked images and `film_width` units of G_t."""
        super().__init__()
        self.cells = nn.Linear(3 * frames * CELL**2, CHANNELS)
        self.convolutions = nn.ModuleList(
            Convolution(CHANNELS, CHANNELS, 3, stride=stride, padding=1)
            for stride in (2, 1)
        )
        self.films = nn.ModuleList(FiLM(film_width, CHANNELS) for _ in range(2))

    def forward(self, cells: Tensor, language: Tensor, dtype: torch.dtype) -> Tensor:
        """Return the flat maps [N, D] of the cells [N, H, W, S * 48]."""
        maps = _normed(self.read(cells, dtype))
        for convolve, film in zip(self.convolutions, self.films, strict=True):
            maps = convolve(maps.permute(0, 3, 1, 2))  # in memory, channels stay last
            maps = film(maps, language).permute(0, 2, 3, 1)
            maps = _normed(maps)
        return maps.flatten(1)

    def read(self, cells: Tensor, dtype: torch.dtype) -> Tensor:
        """Return a linear map of cells [N, H, W, S * 48] as numbers from -1 to 1."""
        # Bytes are exact in 16 bits, and scaling weights is less than scaling them.
        weight = self.cells.weight * (2 / 255)
        bias = self.cells.bias - self.cells.weight.sum(dim=1)
        return functional.linear(cells.to(dtype), weight.to(dtype), bias.to(dtype))


def _normed(maps: Tensor) -> Tensor:
    """Return maps [N, H, W, C] normalized over channels, so that no cell is blind."""
    return functional.relu(functional.layer_norm(maps, maps.shape[-1:]), inplace=True)


class CellVision(nn.Module):
    """V_t for small images, made for batches of hundreds of states."""

    dtype = torch.float32
    """What maps are computed in; training may set 16 bits where that is faster."""

    def __init__(
        self, frames: int, size: tuple[int, int, int], film_width: int
    ) -> None:
        """Make the nets for images of `size` (cameras, height, width)."""
        super().__init__()
        count, high, wide = size[0], size[1] // CELL, size[2] // CELL
        self.cameras = nn.ModuleList(
            CameraCells(frames, film_width) for _ in range(count)
        )
        inputs = count * CHANNELS * ((high + 1) // 2) * ((wide + 1) // 2)
        self.embedding = nn.Linear(inputs, WIDTH)
        self.norm = nn.Sequential(nn.LayerNorm(WIDTH), nn.Tanh())

    def forward(self, images: Tensor, language: Tensor) -> Tensor:
        """Return V_t [N, D] of images [N, S, K, H, W, 3], seen as G_t [N, D'] asks."""
        maps = [
            camera(each, language, self.dtype)
            for camera, each in zip(self.cameras, cells(images), strict=True)
        ]
        weight, bias = self.embedding.weight, self.embedding.bias
        joined = torch.cat(maps, dim=1)
        seen = functional.linear(joined, weight.to(self.dtype), bias.to(self.dtype))
        return self.norm(seen.float())
