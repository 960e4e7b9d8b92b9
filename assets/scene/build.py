"""Builds the meshes beside it: `python -m ir_maniskill.assets.scene.build`.

The room (table, floor, wall) is one mesh with one material, hence one draw call.
"""

from pathlib import Path

import numpy as np
import trimesh

from ir_maniskill.assets.nao import SOLE_HEIGHT
from ir_maniskill.assets.nao.shapes import Section, Surface, bake, join, loft
from ir_maniskill.environment.table_scene import TABLE_THICKNESS, TABLE_TOP
from ir_maniskill.experiment import TABLE

FOLDER = Path(__file__).parent

TABLE_X, TABLE_Y = TABLE
TABLE_Z = (TABLE_TOP - TABLE_THICKNESS, TABLE_TOP)
"""Extents of the table top [m], those of its collision box."""
LEG_WIDTH = 0.03
"""Edge of a table leg [m]."""
ROOM_X, ROOM_Y, ROOM_HEIGHT = (-0.8, 1.2), (-3.2, 3.2), 1.8
"""Extents of the floor, and height of the wall behind the robot [m]."""
SKIRTING_HEIGHT = 0.05
"""Height of the skirting board [m]."""
BUTTON_PROFILE = ((-0.012, 0.020), (0.006, 0.020), (0.011, 0.016), (0.012, 0.0))
"""(height, radius) of the button from the foot up, about its center [m]."""
CAN_PROFILE = ((-0.0210, 0.0), (-0.0210, 0.020), (0.0210, 0.020))
"""(height, radius) of the can's side, about its center [m]."""
LID_PROFILE = ((0.0215, 0.019), (0.0215, 0.0))
"""The same of its lid, just above."""
SEGMENTS = 12
"""Points per ring of what is round."""
PYRAMID_EDGE, PYRAMID_HEIGHT = 0.044, 0.044
"""[m]"""
TIP = 0.4
"""Share of the pyramid's height that is its tip."""

TOP, EDGE, LEG, FLOOR, WALL, SKIRTING = range(6)
PALETTE = (
    (214, 206, 194),  # TOP: warm, darker than the robot and paler than the objects
    (158, 128, 94),  # EDGE: wood
    (112, 116, 124),  # LEG: steel
    (120, 126, 134),  # FLOOR
    (88, 110, 134),  # WALL: blue grey, so that the white robot stands out
    (62, 78, 98),  # SKIRTING
)
_LIGHT = (0.6, 0.15, 1.0)
_SIDES = ("+x", "+y", "+z", "-x", "-y", "-z")


def box(
    *extents: tuple[float, float], color: int, sides: tuple[str, ...] = _SIDES
) -> Surface:
    """Return a box along the axes, hard-edged.

    Args:
        *extents: (low, high) along x, y and z [m].
        color: Index into the palette.
        sides: Those to draw, the ones that can be seen, such as "+x".
    """
    low, high = np.array(extents, float).T
    mesh = trimesh.creation.box(high - low)
    side = np.argmax(mesh.face_normals @ np.vstack([np.eye(3), -np.eye(3)]).T, axis=1)
    seen = np.isin(side, [_SIDES.index(name) for name in sides])
    faces, side = mesh.faces[seen], side[seen]
    vertices = mesh.vertices + (low + high) / 2
    return Surface(vertices, faces, np.full(len(faces), color), side, side)


def room() -> Surface:
    """Return the table, the floor and the wall."""
    top = box(TABLE_X, TABLE_Y, TABLE_Z, color=EDGE)
    parts = [top.painted(TOP, lambda c: c[2] > TABLE_Z[1] - 1e-6)]
    for x in (TABLE_X[0], TABLE_X[1] - LEG_WIDTH):
        for y in (TABLE_Y[0], TABLE_Y[1] - LEG_WIDTH):
            leg = ((x, x + LEG_WIDTH), (y, y + LEG_WIDTH), (SOLE_HEIGHT, TABLE_Z[0]))
            parts.append(box(*leg, color=LEG, sides=("+x", "+y", "-x", "-y")))
    ground = (SOLE_HEIGHT - 0.02, SOLE_HEIGHT)
    behind = (ROOM_X[0] - 0.02, ROOM_X[0])
    before = (ROOM_X[0], ROOM_X[0] + 0.01)
    wall = (SOLE_HEIGHT, SOLE_HEIGHT + ROOM_HEIGHT)
    skirting = (SOLE_HEIGHT, SOLE_HEIGHT + SKIRTING_HEIGHT)
    parts.append(box(ROOM_X, ROOM_Y, ground, color=FLOOR, sides=("+z",)))
    parts.append(box(behind, ROOM_Y, wall, color=WALL, sides=("+x",)))
    parts.append(box(before, ROOM_Y, skirting, color=SKIRTING, sides=("+x", "+z")))
    return join(parts)


def turned(profile: tuple[tuple[float, float], ...]) -> trimesh.Trimesh:
    """Return a round body that stands upright; its color is given at load."""
    sections = [Section(at, (radius, radius), 0) for at, radius in profile]
    upright = loft("x", SEGMENTS, sections).turned(0, -np.pi / 2, 0)
    mesh = bake(upright, ((255, 255, 255),), _LIGHT)
    normals = mesh.vertex_normals  # all that is kept of it
    return trimesh.Trimesh(
        mesh.vertices, mesh.faces, vertex_normals=normals, process=False
    )


def pyramid(low: float, high: float) -> trimesh.Trimesh:
    """Return a slice of the pyramid, between shares of its height; likewise."""
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * PYRAMID_EDGE / 2
    rings = [
        np.column_stack([corners * (1 - at), np.full(4, PYRAMID_HEIGHT * (at - 0.5))])
        for at in (low, high)
    ]
    mesh = trimesh.convex.convex_hull(np.vstack(rings))
    mesh.unmerge_vertices()  # flat faces
    return mesh


def main() -> None:
    """Write the meshes beside this file."""
    bake(room(), PALETTE, _LIGHT).export(FOLDER / "room.glb")
    meshes = {
        "button": turned(BUTTON_PROFILE),
        "can": turned(CAN_PROFILE),
        "can_top": turned(LID_PROFILE),
        "pyramid": pyramid(0, 1 - TIP),
        "pyramid_top": pyramid(1 - TIP, 1),
        "pyramid_hull": pyramid(0, 1),
    }
    for name, mesh in meshes.items():
        mesh.export(FOLDER / f"{name}.glb")


if __name__ == "__main__":
    main()
