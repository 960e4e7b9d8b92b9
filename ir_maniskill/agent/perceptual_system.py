"""Perceptual System: images become V_t; proprioception and touch become H_t."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from ir_maniskill.agent.alignment import FiLM


def pixels(images: Tensor) -> Tensor:
    """Return uint8 images [N,H,W,C] as floats [N,C,H,W] in [-1,1], channels last."""
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
        """Return V_t [N,D] of images [N,S,K,H,W,3]; the sentence plays no part."""
        del language
        wide = [torch.cat(frame.unbind(1), dim=2) for frame in images.unbind(1)]
        joined = pixels(torch.cat(wide, dim=-1))  # [N,3S,H,K*W]
        size = (self.height, self.width * images.shape[2])
        if joined.shape[-2:] != size:
            joined = functional.interpolate(joined, size, mode="area")
        return self.embedding(self.maps(joined).flatten(1))


class CameraVision(nn.Module):
    """Feature maps of one camera: stride-2 convolutions, modulated by the sentence."""

    def __init__(self, frames: int, channels: Sequence[int], film_width: int) -> None:
        """Make one convolution for each of `channels`; no FiLM if `film_width` is 0."""
        super().__init__()
        inputs = (3 * frames, *channels[:-1])
        kernels = (5, *(3 for _ in inputs[1:]))
        self.convolutions = nn.ModuleList(
            nn.Conv2d(into, out, kernel, stride=2, padding=kernel // 2)
            for into, out, kernel in zip(inputs, channels, kernels, strict=True)
        )
        self.films = nn.ModuleList(
            FiLM(film_width, out) if film_width and i else nn.Identity()
            for i, out in enumerate(channels)
        )

    def forward(self, images: Tensor, language: Tensor) -> Tensor:
        """Return the flat maps [N,D] of this camera's images [N,S,H,W,3]."""
        maps = pixels(torch.cat(images.unbind(1), dim=-1))  # [N,3S,H,W]
        for convolve, film in zip(self.convolutions, self.films, strict=True):
            maps = convolve(maps)
            if isinstance(film, FiLM):
                maps = film(maps, language)
            maps = functional.relu(maps, inplace=True)
        return maps.flatten(1)


class StridedVision(nn.Module):
    """V_t for small images: few cheap convolutions for each camera, then one layer."""

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
        for _ in channels:
            height, width = (height + 1) // 2, (width + 1) // 2
        self.cameras = nn.ModuleList(
            CameraVision(frames, channels, film_width) for _ in range(cameras)
        )
        flat = cameras * channels[-1] * height * width
        self.embedding = nn.Sequential(nn.Linear(flat, features), nn.ReLU())

    def forward(self, images: Tensor, language: Tensor) -> Tensor:
        """Return V_t [N,D] of images [N,S,K,H,W,3], looked at as G_t [N,D'] asks."""
        maps = [
            camera(images[:, :, k], language) for k, camera in enumerate(self.cameras)
        ]
        return self.embedding(torch.cat(maps, dim=1))


class BodySense(nn.Module):
    """H_t: proprioception and touch together, through one linear layer."""

    def __init__(self, inputs: int, features: int) -> None:
        """Make the layer from `inputs` numbers to `features` units."""
        super().__init__()
        self.embedding = nn.Sequential(nn.Linear(inputs, features), nn.Tanh())

    def forward(self, *senses: Tensor) -> Tensor:
        """Return H_t [N,D] of senses [N,...], flattened side by side."""
        return self.embedding(torch.cat([sense.flatten(1) for sense in senses], dim=1))
