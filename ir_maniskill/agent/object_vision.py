"""Vision in two steps: what lies where, then which of that the sentence means.

Legend: N states, S stacked observations, K cameras, H x W pixels, T cells of a picture,
O kinds of objects (each color in each shape), C objects, D units.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from ir_maniskill.goals import COLORS, SHAPES
from ir_maniskill.snapshot import Snapshot

CELL, CHANNELS, WIDTH = 4, 32, 128
"""Side of a cell [pixel], maps of a camera, units of what is found."""
HEADS, ROUNDS, NAME = 4, 2, 16
"""Objects looked at together, how often in a row, units of a kind's name."""
KINDS, FLAGS = len(COLORS) * len(SHAPES), len(COLORS) + len(SHAPES)
"""O, and how many colors and shapes there are."""
LENGTH = 0.1
"""What lengths are divided by, to be about as large as other numbers [m]."""
SHARP = 12.0
"""Factor of how well a cell fits a kind, so that few cells count from the start."""


def kinds(like: Tensor) -> Tensor:
    """Return the color and the shape of each kind of object, as flags [O, FLAGS].

    They are numbers as `like` has them, and where it is.
    """
    color, shape = (torch.eye(n).to(like) for n in (len(COLORS), len(SHAPES)))
    color = color.repeat_interleave(len(SHAPES), dim=0)
    return torch.cat([color, shape.repeat(len(COLORS), 1)], dim=1)


def truth(scene: Snapshot) -> tuple[Tensor, Tensor]:
    """Return which kinds lie there [N, O], and where [N, O, 3], 0 for the others.

    Places are divided by `LENGTH`.
    """
    kind = (scene.color * len(SHAPES) + scene.shape).where(scene.color >= 0, KINDS)
    there = scene.position.new_zeros(len(kind), KINDS + 1).scatter(1, kind, 1.0)
    place = scene.position.new_zeros(len(kind), KINDS + 1, 3)
    place.scatter_(1, kind[..., None].expand(-1, -1, 3), scene.position / LENGTH)
    return there[:, :KINDS], place[:, :KINDS]


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


class CameraView(nn.Module):
    """What one camera sees of each kind of object, where it fits best."""

    def __init__(self, frames: int) -> None:
        """Make the layers for `frames` stacked images."""
        super().__init__()
        self.cells = nn.Linear(3 * frames * CELL**2, CHANNELS)
        self.convolutions = nn.ModuleList(
            nn.Conv2d(CHANNELS, CHANNELS, 3, padding=1) for _ in range(2)
        )
        self.fit = nn.Linear(CHANNELS, FLAGS)

    def forward(self, cells: Tensor) -> Tensor:
        """Return how well each kind fits, where, and the maps there [N, O, 3 + D]."""
        maps = _normed(self.read(cells))
        for convolve in self.convolutions:
            maps = convolve(maps.permute(0, 3, 1, 2))  # in memory, channels stay last
            maps = _normed(maps.permute(0, 2, 3, 1))
        grid = _places(maps)
        maps = maps.flatten(1, 2)  # [N, T, D]
        # A kind fits as well as its color and its shape do.
        fits = SHARP * kinds(maps) @ self.fit(maps).transpose(1, 2)  # [N, O, T]
        looks = fits.softmax(dim=2)
        best, at = fits.amax(dim=2, keepdim=True), looks @ grid.to(looks)
        return torch.cat([best / SHARP, at, looks @ maps], dim=2)

    def read(self, cells: Tensor) -> Tensor:
        """Return a linear map of cells [N, H, W, S * 48] as numbers from -1 to 1."""
        # Bytes are exact in 16 bits, and scaling weights is less than scaling them.
        weight = self.cells.weight * (2 / 255)
        bias = self.cells.bias - self.cells.weight.sum(dim=1)
        fast = torch.is_autocast_enabled("cpu")
        number = torch.get_autocast_dtype("cpu") if fast else weight.dtype
        return functional.linear(cells.to(number), weight, bias)


def _places(maps: Tensor) -> Tensor:
    """Return where the cells of maps [N, H, W, C] are, each from -1 to 1 [H W, 2]."""
    sides = (torch.linspace(-1, 1, n, device=maps.device) for n in maps.shape[1:3])
    return torch.stack(torch.meshgrid(*sides, indexing="ij"), dim=-1).flatten(0, 1)


def _normed(maps: Tensor) -> Tensor:
    """Return maps [N, H, W, C] normalized over channels, so that no cell is blind."""
    return functional.relu(functional.layer_norm(maps, maps.shape[-1:]), inplace=True)


class Finder(nn.Module):
    """Attention of the sentence to what lies there; who looks again knows more.

    How well a thing fits is a sum over its color, its shape and where it lies, and what
    is found is where. So a pair of color and shape that was never named is found as
    others are.
    """

    def __init__(self, said: int) -> None:
        """Make the layers for `said` units of G_t."""
        super().__init__()
        self.where = nn.Sequential(nn.Linear(4, 64), nn.ReLU())
        sizes = [said] + [said + WIDTH] * (ROUNDS - 1)
        self.queries = nn.ModuleList(nn.Linear(size, WIDTH) for size in sizes)
        self.keys = nn.ModuleList(nn.Linear(NAME + 4, WIDTH) for _ in sizes)
        self.values = nn.ModuleList(nn.Linear(64, WIDTH) for _ in sizes)
        self.joins = nn.ModuleList(
            nn.Sequential(
                nn.Linear(WIDTH + size, WIDTH), nn.LayerNorm(WIDTH), nn.ReLU()
            )
            for size in sizes
        )

    def forward(self, entries: Tensor, there: Tensor, said: Tensor) -> Tensor:
        """Return what is found [N, WIDTH] among entries [N, O, NAME + 4].

        `there` are logits [N, O]: what does not lie there is not looked at.
        """
        where = self.where(entries[..., NAME:])
        absent = functional.logsigmoid(there.float()).clamp(min=-9)[..., None]
        known, found = said, said
        layers = zip(self.queries, self.keys, self.values, self.joins, strict=True)
        for query, key, value, join in layers:
            asked = query(known)[:, None] * key(entries) * (WIDTH // HEADS) ** -0.5
            fits = asked.unflatten(2, (HEADS, -1)).sum(dim=3)  # [N, O, heads]
            looks = (fits + absent).softmax(dim=1).to(asked.dtype)
            seen = value(where).unflatten(2, (HEADS, -1)) * looks[..., None]
            found = join(torch.cat([seen.sum(dim=1).flatten(1), known], dim=1))
            known = torch.cat([said, found], dim=1)
        return found


class ObjectVision(nn.Module):
    """V_t: what was found; then of each kind a logit that it lies there, and where."""

    width = WIDTH + 4 * KINDS

    def __init__(self, frames: int, size: tuple[int, int, int], said: int) -> None:
        """Make the nets for images of `size` (cameras, height, width)."""
        super().__init__()
        count = size[0]
        self.cameras = nn.ModuleList(CameraView(frames) for _ in range(count))
        self.name = nn.Linear(FLAGS, NAME)
        inputs = count * (3 + CHANNELS) + NAME
        hidden = nn.Linear(inputs, 64), nn.LayerNorm(64), nn.ReLU()
        self.place = nn.Sequential(*hidden, nn.Linear(64, 4))
        self.sure = nn.Linear(count, 1)
        nn.init.constant_(self.sure.weight, 0.3 * SHARP)
        nn.init.constant_(self.sure.bias, -2.0)
        """That something fits well says most of whether it is there."""
        self.finder = Finder(said)

    def forward(self, images: Tensor, language: Tensor) -> Tensor:
        """Return V_t [N, D] of images [N, S, K, H, W, 3], seen as G_t [N, D'] asks."""
        views = zip(self.cameras, cells(images), strict=True)
        flags = kinds(self.name.weight)
        names = self.name(flags).expand(len(images), -1, -1)  # [N, O, NAME]
        seen = torch.cat([*(camera(each) for camera, each in views), names], dim=2)
        there, place = self.place(seen).float().split((1, 3), dim=2)
        best = seen[..., :: 3 + CHANNELS][..., : len(self.cameras)]  # of each camera
        there = there + self.sure(best).float()
        lies = torch.cat([names, there.sigmoid(), place], dim=2)
        found = self.finder(lies, there.squeeze(2), language)
        return torch.cat([found, there.squeeze(2), place.flatten(1)], dim=1)

    def misseen(self, seen: Tensor, scene: Snapshot) -> Tensor:
        """Return how far V_t [N, D] is off what lies there, a mean over the states."""
        there, place = truth(scene)
        told, placed = seen[:, WIDTH:].float().split((KINDS, 3 * KINDS), dim=1)
        wrong = functional.binary_cross_entropy_with_logits(
            told, there, reduction="sum"
        )
        off = functional.huber_loss(placed.view_as(place), place, reduction="none")
        return (0.2 * wrong + (off.sum(dim=2) * there).sum()) / len(seen)
