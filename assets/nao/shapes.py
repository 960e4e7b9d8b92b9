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
    center: tuple[float, float] = (0.0, 0.0)
    """Middle of the section in the plane of u and v [m]."""
    power: float = 2.0
    """2 is an ellipse, more is boxier."""


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
    corners = [len(part.vertices) for part in surfaces]
    groups = [part.groups.max() + 1 for part in surfaces]
    cells = [part.cells.max() + 1 for part in surfaces]
    return Surface(
        np.concatenate([part.vertices for part in surfaces]),
        _renumbered([part.faces for part in surfaces], corners),
        np.concatenate([part.colors for part in surfaces]),
        _renumbered([part.groups for part in surfaces], groups),
        _renumbered([part.cells for part in surfaces], cells),
    )


def loft(
    axis: str,
    colors: int | Sequence[int],
    sections: Sequence[Section],
    segments: int = 10,
    caps: str = "both",
    lid: int | None = None,
) -> Surface:
    """Return the skin over a row of cross sections.

    Args:
        axis: The axis the sections are strung on, "x", "y" or "z"; u and v are the
            two axes that follow it in the order x, y, z, x, y.
        colors: One color, or one per span between sections.
        sections: From low to high along the axis.
        segments: Points per section.
        caps: Which ends not closed in a point get a flat lid: "low", "high", "both"
            or "none"; leave off what nobody can see.
        lid: Color of the lids, else that of the span next to them.
    """
    spans = len(sections) - 1
    colors = [colors] * spans if isinstance(colors, int) else list(colors)
    builder = _Builder(segments)
    for section in sections:
        builder.add_ring(section)
    for span, color in enumerate(colors):
        builder.add_span(span, color)
    if caps in ("low", "both") and any(sections[0].half):
        color = colors[0] if lid is None else lid
        builder.add_lid(0, color, up=False)
    if caps in ("high", "both") and any(sections[-1].half):
        color = colors[-1] if lid is None else lid
        builder.add_lid(spans, color, up=True)
    return builder.surface("xyz".index(axis))


def knob(
    colors: Sequence[int], profile: Sequence[tuple[float, float]], segments: int
) -> Surface:
    """Return a round knob standing on the origin along +x.

    Args:
        colors: One per span of the profile, and one for the lid.
        profile: (height, radius) pairs [m] from the foot up; the foot stays open.
        segments: Points per ring.
    """
    rings = [Section(height, (radius, radius)) for height, radius in profile]
    return loft("x", colors[:-1], rings, segments, caps="high", lid=colors[-1])


def palette(colors: Sequence[tuple[int, int, int]]) -> Image.Image:
    """Return the palette: a column per color, the brightest row on top."""
    brightness = np.linspace(1.0, _DARKEST, _LEVELS)[:, None, None]  # [L, 1, 1]
    row = np.repeat(np.array(colors, float), _SWATCH_WIDTH, axis=0)  # [W, 3]
    return Image.fromarray(np.rint(row * brightness).astype(np.uint8), "RGB")


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


def _renumbered(indices: Sequence[np.ndarray], counts: Sequence[int]) -> np.ndarray:
    """Return the index arrays as one, each shifted past those before it."""
    shifts = np.cumsum([0, *counts[:-1]])
    return np.concatenate([i + n for i, n in zip(indices, shifts, strict=True)])


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


class _Builder:
    """Collects the triangles of one loft along its axis w, in (w, u, v)."""

    def __init__(self, segments: int) -> None:
        self._segments = segments
        self._vertices: list[np.ndarray] = []
        self._rings: list[np.ndarray] = []
        self._faces: list[tuple[int, int, int]] = []
        self._colors: list[int] = []
        self._groups: list[int] = []
        self._cells: list[int] = []
        self._group = 0
        self._cell = 0

    def add_ring(self, section: Section) -> None:
        """Add the points of a section, or the one point of a closed end."""
        first = len(self._vertices)
        if not any(section.half):
            self._vertices.append(np.array([section.at, *section.center]))
            self._rings.append(np.full(self._segments, first))
            return
        angle = (np.arange(self._segments) + 0.5) * 2 * np.pi / self._segments
        for wave in np.stack([np.cos(angle), np.sin(angle)], -1):
            point = np.sign(wave) * np.abs(wave) ** (2 / section.power)
            u, v = section.center + np.array(section.half) * point
            self._vertices.append(np.array([section.at, u, v]))
        self._rings.append(first + np.arange(self._segments))

    def add_span(self, span: int, color: int) -> None:
        """Add the skin between section `span` and the next."""
        low, high = self._rings[span : span + 2]
        for i in range(self._segments):
            j = (i + 1) % self._segments
            self._add_face((low[i], low[j], high[j]), color)
            self._add_face((low[i], high[j], high[i]), color)
            self._cell += 1

    def add_lid(self, ring: int, color: int, up: bool) -> None:
        """Add a flat lid that looks up or down the axis, with a hard edge."""
        self._group += 1
        points = self._rings[ring]
        points = points if up else points[::-1]
        for a, b in pairwise(points[1:]):
            self._add_face((points[0], a, b), color)
        self._cell += 1

    def surface(self, axis: int) -> Surface:
        """Return the surface with w along the given axis."""
        return Surface(
            np.roll(np.array(self._vertices), axis, axis=1),
            np.array(self._faces),
            np.array(self._colors),
            np.array(self._groups),
            np.array(self._cells),
        )

    def _add_face(self, corners: tuple[int, int, int], color: int) -> None:
        if len(set(corners)) == 3:
            self._faces.append(corners)
            self._colors.append(color)
            self._groups.append(self._group)
            self._cells.append(self._cell)
