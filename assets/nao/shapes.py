"""Low-poly surfaces: lofts through superellipses, and what is done to them.

A surface knows the color and the smoothing group of every face. Normals are smooth
within a group and break between groups; `bake` gives the mesh its texture
coordinates, which point into one palette: across, the colors; down, the brightness,
so that even a renderer without lights shows the shape.

Shapes: V vertices, F faces, R sections of a loft, P points of a section.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import trimesh
from PIL import Image
from trimesh.transformations import euler_matrix
from trimesh.visual.material import PBRMaterial

_SWATCH_WIDTH = 8  # [px] wide, so that filtering does not mix neighboring colors
_LEVELS = 16  # brightness levels of the palette
_DARKEST = 0.64  # brightness of what faces away from the light


@dataclass(frozen=True)
class Section:
    """One cross section of a loft: |u/a|^power + |v/b|^power = 1."""

    at: float
    """Place along the axis of the loft [m]."""
    half: tuple[float, float]
    """Half widths a and b [m]; (0, 0) closes the loft in a point."""
    color: int | None = None
    """Index into the palette, of the skin up to the next section; of the last one, of
    its flat lid, None: it is open."""
    center: tuple[float, float] = (0.0, 0.0)
    """Middle of the section in the plane of u and v [m]."""
    power: float = 2.0
    """2 is an ellipse, more is boxier."""

    def points(self, count: int) -> np.ndarray:
        """Return points around the section in (w, u, v), one where it is closed."""
        if not any(self.half):
            return np.array([[self.at, *self.center]])
        angle = (np.arange(count) + 0.5) * 2 * np.pi / count
        wave = np.stack([np.cos(angle), np.sin(angle)], -1)  # [P, 2]
        curve = np.sign(wave) * np.abs(wave) ** (2 / self.power)
        return np.column_stack(
            [np.full(count, self.at), self.center + self.half * curve]
        )


@dataclass(frozen=True)
class Surface:
    """Triangles with a color and a smoothing group each."""

    vertices: np.ndarray
    """Corners [m], shape [V, 3]."""
    faces: np.ndarray
    """Corner indices, counterclockwise from outside, shape [F, 3]."""
    colors: np.ndarray
    """Index into the palette, shape [F]."""
    groups: np.ndarray
    """Smoothing group, shape [F]."""
    cells: np.ndarray
    """Which flat cell, a quadrilateral or a lid, the face is a part of, shape [F]."""

    def moved(self, frame: np.ndarray) -> "Surface":
        """Return the surface carried by the homogeneous transform `frame`."""
        vertices = self.vertices @ frame[:3, :3].T + frame[:3, 3]
        return replace(self, vertices=vertices)

    def shifted(self, x: float, y: float, z: float) -> "Surface":
        """Return the surface moved by (x, y, z) [m]."""
        return replace(self, vertices=self.vertices + np.array([x, y, z]))

    def turned(self, roll: float, pitch: float, yaw: float) -> "Surface":
        """Return the surface turned about the fixed axes x, y, z in turn [rad]."""
        return self.moved(euler_matrix(roll, pitch, yaw, axes="sxyz"))

    def mirrored(self) -> "Surface":
        """Return the mirror image left for right."""
        vertices = self.vertices * np.array([1, -1, 1])
        return replace(self, vertices=vertices, faces=self.faces[:, ::-1])

    def painted(
        self, color: int, where: Callable[[np.ndarray], np.ndarray]
    ) -> "Surface":
        """Return the surface with other cells colored.

        Args:
            color: The new color.
            where: Given x, y, z of the cells' middles, stacked, says which.
        """
        centers = self.vertices[self.faces].mean(axis=1)  # [F, 3]
        sums = np.zeros((self.cells.max() + 1, 3))
        np.add.at(sums, self.cells, centers)
        middles = (sums / np.bincount(self.cells)[:, None])[self.cells]  # [F, 3]
        return replace(self, colors=np.where(where(middles.T), color, self.colors))


def join(surfaces: Sequence[Surface]) -> Surface:
    """Return the surfaces as one, their smoothing groups kept apart."""

    def renumbered(name: str, counts: Sequence[int]) -> np.ndarray:
        shifts = np.cumsum([0, *counts[:-1]])
        arrays = [getattr(part, name) for part in surfaces]
        return np.concatenate([i + n for i, n in zip(arrays, shifts, strict=True)])

    return Surface(
        np.concatenate([part.vertices for part in surfaces]),
        renumbered("faces", [len(part.vertices) for part in surfaces]),
        np.concatenate([part.colors for part in surfaces]),
        renumbered("groups", [part.groups.max() + 1 for part in surfaces]),
        renumbered("cells", [part.cells.max() + 1 for part in surfaces]),
    )


def loft(
    axis: str, points: int, sections: Sequence[Section], base: int | None = None
) -> Surface:
    """Return the skin over a row of cross sections.

    Args:
        axis: The axis w that the sections are strung on, "x", "y" or "z"; u and v are
            the two that follow it in the order x, y, z, x, y.
        points: P, points per section.
        sections: From low to high along the axis.
        base: Color of a flat lid at the low end; None: it is open, or closed.
    """
    corners = [section.points(points) for section in sections]
    starts = np.cumsum([0, *map(len, corners)])
    # A closed section has one corner, which stands for all P.
    rings = [
        start + np.arange(points) % len(own)
        for start, own in zip(starts, corners, strict=False)
    ]
    patches = [  # faces, color and smoothing group
        (_skin(low, high), section.color, 0)
        for section, (low, high) in zip(sections, pairwise(rings), strict=False)
    ]
    if base is not None:
        patches.append((_lid(rings[0][::-1]), base, 1))
    if sections[-1].color is not None:
        patches.append((_lid(rings[-1]), sections[-1].color, 2))
    sizes = [len(faces) for faces, _, _ in patches]
    faces = np.concatenate([faces for faces, _, _ in patches])
    colors = np.repeat([color for _, color, _ in patches], sizes)
    groups = np.repeat([group for _, _, group in patches], sizes)
    cells = np.where(groups > 0, -groups, np.arange(len(faces)) // 2)
    real = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    _, cells = np.unique(cells[real], return_inverse=True)
    vertices = np.roll(np.concatenate(corners), "xyz".index(axis), axis=1)
    return Surface(vertices, faces[real], colors[real], groups[real], cells)


def _skin(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return two triangles between each two points of two rings, [2P, 3]."""
    low_next, high_next = np.roll(low, -1), np.roll(high, -1)
    return np.stack([low, low_next, high_next, low, high_next, high], -1).reshape(-1, 3)


def _lid(ring: np.ndarray) -> np.ndarray:
    """Return the triangles of a flat lid, counterclockwise as the ring, [P - 2, 3]."""
    return np.stack([np.full(len(ring) - 2, ring[0]), ring[1:-1], ring[2:]], -1)


def palette(colors: Sequence[tuple[int, int, int]]) -> Image.Image:
    """Return the palette: a column per color, the brightest row on top."""
    brightness = np.linspace(1.0, _DARKEST, _LEVELS)[:, None, None]  # [L, 1, 1]
    row = np.repeat(np.array(colors, float), _SWATCH_WIDTH, axis=0)  # [W, 3]
    return Image.fromarray(np.rint(row * brightness).astype(np.uint8))


def bake(
    surface: Surface, colors: Sequence[tuple[int, int, int]], light: Sequence[float]
) -> trimesh.Trimesh:
    """Return the surface as a mesh with normals and one textured material.

    Args:
        surface: What to bake.
        colors: The palette that the surface's colors point into.
        light: Where the baked light comes from, in the frame of the surface.
    """
    tags = np.stack([surface.groups, surface.colors], -1)  # [F, 2]
    keys = np.concatenate(
        [surface.faces.reshape(-1, 1), np.repeat(tags, 3, axis=0)], axis=-1
    )  # [3F, 3]: corner, group, color
    unique, faces = np.unique(keys, axis=0, return_inverse=True)
    corner, group, color = unique.T  # [V] each: a vertex per corner, group, color
    normals = _smooth_normals(surface)[corner, group]  # [V, 3]
    uv = _texture_coordinates(color, normals, len(colors), light)
    material = PBRMaterial(
        name="palette",
        baseColorTexture=palette(colors),
        metallicFactor=0.0,
        roughnessFactor=0.55,
    )
    return trimesh.Trimesh(
        surface.vertices[corner],
        faces.reshape(-1, 3),
        vertex_normals=normals,
        visual=trimesh.visual.TextureVisuals(uv, material=material),
        process=False,
    )


def _texture_coordinates(
    color: np.ndarray, normals: np.ndarray, colors: int, light: Sequence[float]
) -> np.ndarray:
    """Return where in the palette each vertex looks, shape [V, 2]."""
    toward = np.asarray(light, float) / np.linalg.norm(light)
    shade = (1 + normals @ toward) / 2  # [V] in [0, 1]
    return np.stack(
        [(color + 0.5) / colors, (0.5 + shade * (_LEVELS - 1)) / _LEVELS], axis=-1
    )


def _smooth_normals(surface: Surface) -> np.ndarray:
    """Return area-weighted normals by vertex and group, shape [V, groups, 3]."""
    a, b, c = np.moveaxis(surface.vertices[surface.faces], 1, 0)
    areas = np.cross(b - a, c - a)  # [F, 3]
    normals = np.zeros((len(surface.vertices), surface.groups.max() + 1, 3))
    for corner in surface.faces.T:
        np.add.at(normals, (corner, surface.groups), areas)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return normals / np.where(length > 0, length, 1)
