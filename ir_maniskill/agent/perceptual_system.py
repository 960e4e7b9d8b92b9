"""Perceptual System: images become V_t; proprioception and touch become H_t."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from ir_maniskill.agent.alignment import FiLM

VISION_WIDTH, BODY_WIDTH = 256, 128
"""Units of V_t and of H_t."""
CHANNELS, PATCH = 32, 4
"""Maps of each convolution of "patches", and the side of its patches [pixel]."""


def pixels(images: Tensor) -> Tensor:
    """Return uint8 images [N, H, W, C] as floats [N, C, H, W] in [-1, 1].

    In memory the channels stay last.
    """
    return images.permute(0, 3, 1, 2).float().mul_(2 / 255).sub_(1)


class PaperVision(nn.Module):
    """V_t as in the paper: two 5x5 convolutions over all cameras set side by side."""

    width = VISION_WIDTH

    def __init__(self, frames: int, size: Sequence[int], film_width: int) -> None:
        """Make the net for `frames` stacked images of size[0] cameras."""
        super().__init__()
        self.size = 128, 64 * size[0]  # what the images are brought to [pixel]
        maps = [((side - 4) // 2 - 4) // 2 for side in self.size]  # after pooling
        self.maps = nn.Sequential(
            *(nn.Conv2d(3 * frames, 12, 5), nn.ReLU(), nn.MaxPool2d(2)),
            *(nn.Conv2d(12, 12, 5), nn.ReLU(), nn.MaxPool2d(2)),
        )
        self.embedding = nn.Sequential(
            *(nn.Linear(12 * maps[0] * maps[1], VISION_WIDTH), nn.ReLU()),
            *(nn.Linear(VISION_WIDTH, VISION_WIDTH), nn.ReLU()),
        )

    def forward(self, images: Tensor, language: Tensor) -> Tensor:
        """Return V_t [N, D] of images [N, S, K, H, W, 3]; the sentence has no part."""
        del language
        wide = [torch.cat(frame.unbind(1), dim=2) for frame in images.unbind(1)]
        joined = pixels(torch.cat(wide, dim=-1))  # [N, 3S, H, K*W]
        if joined.shape[-2:] != self.size:
            joined = functional.interpolate(joined, self.size, mode="area")
        return self.embedding(self.maps(joined).flatten(1))


class CameraVision(nn.Module):
    """Feature maps of one camera: patches, then convolutions, as the sentence asks.

    The maps are normalized after the sentence has modulated them, with no shift of
    their own: a ReLU passes something on then, whatever is learned. Without that,
    training was seen to shift all maps below zero, and the agent was blind.
    """

    def __init__(self, frames: int, film_width: int) -> None:
        """Make the layers for `frames` stacked images and `film_width` units of G_t."""
        super().__init__()
        self.convolutions = nn.ModuleList(
            (
                nn.Conv2d(3 * frames, CHANNELS, PATCH, stride=PATCH),
                nn.Conv2d(CHANNELS, CHANNELS, 3, stride=2, padding=1),
                nn.Conv2d(CHANNELS, CHANNELS, 3, padding=1),
            )
        )
        films = (FiLM(film_width, CHANNELS) for _ in range(2))
        self.films = nn.ModuleList((nn.Identity(), *films))

    def forward(self, images: Tensor, language: Tensor) -> Tensor:
        """Return the flat maps [N, D] of this camera's images [N, S, H, W, 3]."""
        maps = pixels(torch.cat(images.unbind(1), dim=-1))  # [N, 3S, H, W]
        for convolve, film in zip(self.convolutions, self.films, strict=True):
            maps = convolve(maps)
            if isinstance(film, FiLM):
                maps = film(maps, language)
            maps = functional.relu(functional.group_norm(maps, 1), inplace=True)
        return maps.flatten(1)


class PatchVision(nn.Module):
    """V_t for small images: few cheap convolutions for each camera, then one layer.

    V_t is brought to the scale of G_t, so that the actor hears both from the start.
    """

    width = VISION_WIDTH

    def __init__(self, frames: int, size: Sequence[int], film_width: int) -> None:
        """Make the nets for images of `size` (cameras, height, width)."""
        super().__init__()
        cameras, *sides = size
        self.cameras = nn.ModuleList(
            CameraVision(frames, film_width) for _ in range(cameras)
        )
        cells = math.prod((side // PATCH + 1) // 2 for side in sides)
        self.embedding = nn.Sequential(
            nn.Linear(cameras * CHANNELS * cells, VISION_WIDTH),
            nn.LayerNorm(VISION_WIDTH),
            nn.Tanh(),
        )

    def forward(self, images: Tensor, language: Tensor) -> Tensor:
        """Return V_t [N, D] of images [N, S, K, H, W, 3], seen as G_t [N, D'] asks."""
        maps = [
            camera(images[:, :, k], language) for k, camera in enumerate(self.cameras)
        ]
        return self.embedding(torch.cat(maps, dim=1))


class BodySense(nn.Module):
    """H_t: proprioception and touch together, through one linear layer."""

    def __init__(self, inputs: int, *, normalize: bool) -> None:
        """Make the layer for `inputs` numbers; `normalize`: to the scale of G_t."""
        super().__init__()
        norm = nn.LayerNorm(BODY_WIDTH) if normalize else nn.Identity()
        self.embedding = nn.Sequential(nn.Linear(inputs, BODY_WIDTH), norm, nn.Tanh())

    def forward(self, *senses: Tensor) -> Tensor:
        """Return H_t [N, D] of senses [N, ...], flattened side by side."""
        return self.embedding(torch.cat([sense.flatten(1) for sense in senses], dim=1))
