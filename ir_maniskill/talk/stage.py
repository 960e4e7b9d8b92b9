"""Stage: the robot, the table and the objects in the visitor's browser."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh
import viser

from ir_maniskill.environment.table_scene import TABLE_TOP
from ir_maniskill.talk import meshes
from ir_maniskill.talk.cards import COLORS
from ir_maniskill.talk.session import Session

EYE, TARGET = (0.80, 0.34, 0.44), (0.10, 0.0, 0.06)
"""Where visitors look from, and at, at NAO's scale [m]."""
LIGHT = 0.011
"""Radius of the light at a fingertip [m]."""
RING = (0.038, 0.0025)
"""Radii of the ring around an object that is meant [m]."""

Drag = Callable[[int, float, float], None]


class Stage:
    """What is drawn of a session."""

    def __init__(self, server: viser.ViserServer, drag: Drag, drop: Callable) -> None:
        """Light the stage; `drag` and `drop` hear of what visitors do to objects."""
        self._server, self._drag, self._drop = server, drag, drop
        self._nodes: list[Any] = []
        self._lights: list[Any] = []
        self._rings: list[Any] = []
        self._built: tuple[str, ...] = ()
        scene = server.scene
        scene.world_axes.visible = False
        scene.configure_environment_map("studio", environment_intensity=0.5)
        scene.set_background_image(np.full((2, 2, 3), 24, dtype=np.uint8))

    def build(self, session: Session) -> None:
        """Bring what the session's scene has, unless it is there already."""
        robot = type(session.env.agent).uid
        names = (robot, *(body.name for body in session.bodies()))
        if names == self._built:
            return
        for node in (*self._nodes, *self._lights, *self._rings):
            node.remove()
        if self._built[:1] != names[:1]:
            self._look(session.env.agent.scale)
        self._built, self._moved = names, np.zeros((len(names) - 1, 7))
        things = [thing._objs[0].name for thing in session.env.objects]
        self._nodes = []
        for place, body in enumerate(session.bodies()):
            name = f"/scene/{place}_{body.name.replace('/', '_')}"
            node = self._server.scene.add_glb(name, meshes.glb(body))
            if body.name in things:
                self._make_draggable(node, things.index(body.name))
            self._nodes.append(node)
        self._add_marks(session)

    def _add_marks(self, session: Session) -> None:
        add, scale = self._server.scene, session.env.agent.scale
        ball = trimesh.creation.icosphere(3, LIGHT * scale)
        ring = trimesh.creation.torus(*(scale * radius for radius in RING))
        self._lights = [
            add.add_mesh_simple(
                f"/lights/{finger}", ball.vertices, ball.faces,
                opacity=0.8, cast_shadow=False, visible=False,
            )
            for finger in session.env.agent.fingers
        ]  # fmt: skip
        self._rings = [
            add.add_mesh_simple(
                f"/rings/{place}", ring.vertices, ring.faces,
                color=(255, 255, 255), cast_shadow=False, visible=False,
            )
            for place in range(len(session.names))
        ]  # fmt: skip

    def _look(self, scale: float) -> None:
        """Have those who are here and those who come look at the table."""
        clients = self._server.get_clients().values()
        for camera in (self._server.initial_camera, *(c.camera for c in clients)):
            camera.position = tuple(scale * value for value in EYE)
            camera.look_at = tuple(scale * value for value in TARGET)
            camera.fov = 0.6

    def _make_draggable(self, node: Any, index: int) -> None:
        """Let visitors drag an object along the table."""

        async def on_drag(event: viser.SceneNodeDragEvent) -> None:
            if event.phase == "end":
                self._drop()
                return
            eye = np.asarray(event.client.camera.position)
            ray = np.asarray(event.end_position) - eye
            height = event.start_position[2] - eye[2]
            if ray[2] * height > 0:  # it points to where the object can be
                x, y, _ = eye + ray * height / ray[2]
                self._drag(index, float(x), float(y))

        node.on_drag(on_drag)

    def move(self, session: Session, poses: np.ndarray) -> None:
        """Draw all where it is: the bodies' poses [B, 7]."""
        moved = np.abs(poses - self._moved).max(axis=1) > 1e-5
        for place in moved.nonzero()[0]:
            self._nodes[place].position = poses[place, :3]
            self._nodes[place].wxyz = poses[place, 3:]
        self._moved[moved] = poses[moved]

    def mark(self, session: Session) -> None:
        """Light the fingertips that touch, and ring the objects that are meant."""
        states = [s for hand in session.lights().values() for s in hand.values()]
        tips = session.fingertips()
        for light, state, tip in zip(self._lights, states, tips, strict=True):
            if state:
                light.position = tip
                light.color = tuple(bytes.fromhex(COLORS[state][1:]))
            light.visible = bool(state)
        scale = session.env.agent.scale
        where = session.scene.position[0].numpy()
        for place, ring in enumerate(self._rings):
            ring.visible = place in session.reading.objects
            if ring.visible:
                ring.position = scale * np.array([*where[place, :2], TABLE_TOP])
