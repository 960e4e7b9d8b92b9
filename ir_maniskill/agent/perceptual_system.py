"""Perceptual System: images become V_t; proprioception and touch become H_t."""

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from ir_maniskill.agent.alignment import FiLM


def pixels(images: Tensor) -> Tensor:
    """Return uint8 images [N, H, W, C] as floats [N, C, H, W] in [-1, 1].

    In memory the channels stay last.
    """
    return images.permute(0, 3, 1, 2).float().mul_(2 / 255).sub_(1)


class PaperVision(nn.Module):
    """V_t as in the paper: two 5x5 convolutions over all cameras set side by side."""

    height, width = 128, 64
    """Size each camera's image is brought to [pixel]."""

    def __init__(self, frames: int, cameras: int, features: int) -> None:
        """Make the net for `frames` stacked images of `cameras` cameras."""
        super().__init__()
        sides = (self.height, self.width * cameras)
        maps = [((side - 4) // 2 - 4) // 2 for side in sides]  # [pixel] after pooling
        self.maps = nn.Sequential(
            *(nn.Conv2d(3 * frames, 12, 5), nn.ReLU(), nn.MaxPool2d(2)),
            *(nn.Conv2d(12, 12, 5), nn.ReLU(), nn.MaxPool2d(2)),
        )
        self.embedding = nn.Sequential(
            *(nn.Linear(12 * maps[0] * maps[1], features), nn.ReLU()),
            *(nn.Linear(features, features), nn.ReLU()),
        )

    def forward(self, images: Tensor, language: Tensor) -> Tensor:
        """Return V_t [N, D] of images [N, S, K, H, W, 3]; the sentence has no part."""
        del language
        wide = [torch.cat(frame.unbind(1), dim=2) for frame in images.unbind(1)]
        joined = pixels(torch.cat(wide, dim=-1))  # [N, 3S, H, K*W]
        size = (self.height, self.width * images.shape[2])
        if joined.shape[-2:] != size:
            joined = functional.interpolate(joined, size, mode="area")
        return self.embedding(self.maps(joined).flatten(1))


class CameraVision(nn.Module):
    """Feature maps of one camera: patches, then convolutions, as the sentence asks.

    The maps are normalized after the sentence has modulated them, with no shift of
    their own: a ReLU passes something on then, whatever is learned. Without that,
    training was seen to shift all maps below zero, and the agent was blind.
    """

    PATCH = 4
    """Side of the patches that the first convolution reads [pixel]."""

    def __init__(self, frames: int, channels: Sequence[int], film_width: int) -> None:
        """Make one convolution for each of `channels`; no FiLM if `film_width` is 0."""
        super().__init__()
        patches = nn.Conv2d(3 * frames, channels[0], self.PATCH, stride=self.PATCH)
        pairs = itertools.pairwise(channels)
        self.convolutions = nn.ModuleList(
            [patches]
            + [
                nn.Conv2d(into, out, 3, stride=1 if i else 2, padding=1)
                for i, (into, out) in enumerate(pairs)
            ]
        )
        self.norms = nn.ModuleList(
            nn.GroupNorm(1, out, affine=False) for out in channels
        )
        self.films = nn.ModuleList(
            FiLM(film_width, out) if film_width and i else nn.Identity()
            for i, out in enumerate(channels)
        )

    @classmethod
    def cells(cls, height: int, width: int, convolutions: int) -> int:
        """Return how many places the maps of an image [pixel] have in the end."""
        sides = (height // cls.PATCH, width // cls.PATCH)
        if convolutions > 1:
            sides = ((sides[0] + 1) // 2, (sides[1] + 1) // 2)
        return sides[0] * sides[1]

    def forward(self, images: Tensor, language: Tensor) -> Tensor:
        """Return the flat maps [N, D] of this camera's images [N, S, H, W, 3]."""
        maps = pixels(torch.cat(images.unbind(1), dim=-1))  # [N, 3S, H, W]
        layers = zip(self.convolutions, self.norms, self.films, strict=True)
        for convolve, normalize, film in layers:
            maps = convolve(maps)
            if isinstance(film, FiLM):
                maps = film(maps, language)
            maps = functional.relu(normalize(maps), inplace=True)
        return maps.flatten(1)


class PatchVision(nn.Module):
    """V_t for small images: few cheap convolutions for each camera, then one layer.

    V_t is brought to the scale of G_t, so that the actor hears both from the start.
    """

    def __init__(
        self,
        frames: int,
        size: tuple[int, int, int],
        channels: Sequence[int],
        features: int,
        *,
        film_width: int,
    ) -> None:
        """Make the nets for images of `size` (cameras, height, width)."""
        super().__init__()
        cameras, height, width = size
        self.cameras = nn.ModuleList(
            CameraVision(frames, channels, film_width) for _ in range(cameras)
        )
        cells = CameraVision.cells(height, width, len(channels))
        flat = cameras * channels[-1] * cells
        self.embedding = nn.Sequential(
            nn.Linear(flat, features), nn.LayerNorm(features), nn.Tanh()
        )

    def forward(self, images: Tensor, language: Tensor) -> Tensor:
        """Return V_t [N, D] of images [N, S, K, H, W, 3], seen as G_t [N, D'] asks."""
        maps = [
            camera(images[:, :, k], language) for k, camera in enumerate(self.cameras)
        ]
        return self.embedding(torch.cat(maps, dim=1))


class BodySense(nn.Module):
    """H_t: proprioception and touch together, through one linear layer."""

    def __init__(self, inputs: int, features: int, *, normalize: bool) -> None:
        """Make the layer from `inputs` numbers to `features` units.

        Args:
            inputs: Numbers felt.
            features: Units of H_t.
            normalize: Whether to bring H_t to the scale of G_t.
        """
        super().__init__()
        norm = nn.LayerNorm(features) if normalize else nn.Identity()
        self.embedding = nn.Sequential(nn.Linear(inputs, features), norm, nn.Tanh())

    def forward(self, *senses: Tensor) -> Tensor:
        """Return H_t [N, D] of senses [N, ...], flattened side by side."""
        return self.embedding(torch.cat([sense.flatten(1) for sense in senses], dim=1))
