"""Stage: the robot, the table and the objects in the visitors' browsers."""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Lock
from typing import Any

import numpy as np
import sapien
import trimesh
import viser

from ir_maniskill.environment.table_scene import TABLE_TOP
from ir_maniskill.talk import meshes
from ir_maniskill.talk.cards import COLORS
from ir_maniskill.talk.session import Session

EYE, TARGET = (0.80, 0.34, 0.44), (0.10, 0.0, 0.06)
"""Where visitors look from, and at, at NAO's scale [m]."""
SUN = (0.55, 0.35, 1.0)
"""Where light comes from, as for films."""
LIGHT = 0.011
"""Radius of the light at a fingertip [m]."""
RING = (0.038, 0.002)
"""Radii of the ring around an object that is meant [m]."""
STILL = 1e-5
"""What moves less is not sent anew [m, or of a quaternion]."""


class Stage:
    """What is drawn of a session: a node for each body that can be seen.

    All calls come from the simulator's thread, but for `draw`, which may have another.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        drag: Callable[[int, float, float], None],
        drop: Callable[[], None],
    ) -> None:
        """Light the stage; `drag` and `drop` hear of what visitors do to objects."""
        self._server, self._drag, self._drop = server, drag, drop
        self._robot = ""
        self._bodies: dict[str, Any] = {}
        self._lock = Lock()
        self._nodes: list[Any] = []
        self._before = self._now = self._sent = np.empty((0, 7))
        self._shown = self._lasts = 0.0
        self._lights: list[Any] = []
        self._rings: list[Any] = []
        self._things: dict[str, int] = {}
        scene = server.scene
        scene.world_axes.visible = False
        scene.set_background_image(np.full((2, 2, 3), 24, dtype=np.uint8))
        scene.configure_default_lights(enabled=False)
        sky, ground = (235, 236, 240), (130, 118, 104)
        scene.configure_environment_map("studio", environment_intensity=0.15)
        scene.add_light_hemisphere(
            "/sky", sky_color=sky, ground_color=ground, intensity=0.8
        )
        scene.add_light_directional(
            "/sun", position=SUN, intensity=1.5, cast_shadow=True
        )

    def show(self, session: Session, lasts: float) -> None:
        """Bring what the session's scene has; `draw` moves it as its last step did.

        Args:
            session: What is shown.
            lasts: How long the motion of that step takes [s].
        """
        with self._lock:
            self._build(session)
            nodes = [self._bodies[body.name] for body in session.bodies]
            if nodes != self._nodes:
                self._nodes, self._sent = nodes, np.full((len(nodes), 7), np.inf)
            self._before, self._now = session.before, session.now
            self._shown, self._lasts = time.perf_counter(), lasts
        self._mark(session)

    def draw(self) -> None:
        """Draw the bodies where they are by now, on the way that `show` began."""
        with self._lock:
            gone = time.perf_counter() - self._shown
            share = min(gone / self._lasts, 1.0) if self._lasts else 1.0
            poses = between(self._before, self._now, share)
            moved = np.abs(poses - self._sent).max(axis=1) >= STILL
            self._sent[moved] = poses[moved]
            for place in moved.nonzero()[0]:
                node, pose = self._nodes[place], poses[place]
                node.position, node.wxyz = pose[:3], pose[3:]

    def _build(self, session: Session) -> None:
        """Bring bodies and marks; most are there already."""
        if self._robot != session.choice.robot:
            self._change_robot(session)
        bodies = {body.name: body for body in session.bodies}
        things = {
            session.thing(place)._objs[0].name: place
            for place, name in enumerate(session.names)
            if name
        }
        if self._things == things and self._bodies.keys() == bodies.keys():
            return
        self._things = things
        for name in self._bodies.keys() - bodies.keys():
            self._bodies.pop(name).remove()
        for name in bodies.keys() - self._bodies.keys():
            self._bodies[name] = self._add(bodies[name])
        self._add_marks(session)

    def _change_robot(self, session: Session) -> None:
        """Clear the stage; have those who are here, and who come, look at the table."""
        self._robot, scale = session.choice.robot, session.env.agent.scale
        for node in self._bodies.values():
            node.remove()
        self._bodies, self._things = {}, {}
        cameras: list[Any] = [self._server.initial_camera]
        cameras += [client.camera for client in self._server.get_clients().values()]
        for camera in cameras:
            camera.position = tuple(scale * value for value in EYE)
            camera.look_at = tuple(scale * value for value in TARGET)
            camera.fov, camera.near, camera.far = 0.6, 0.05 * scale, 20 * scale

    def _add(self, body: sapien.Entity) -> Any:
        name = f"/{self._robot}/{body.name.replace('/', '_')}"
        shadow = not body.name.endswith("room")  # it would throw one on itself
        add = self._server.scene.add_glb
        node: Any = add(name, meshes.glb(body), cast_shadow=shadow)
        if body.name in self._things:
            self._make_draggable(node, body.name)
        return node

    def _make_draggable(self, node: Any, name: str) -> None:
        """Let visitors drag an object along the table."""

        async def on_drag(event: viser.SceneNodeDragEvent) -> None:
            if event.phase == "end" or name not in self._things:
                self._drop()
                return
            eye = np.asarray(event.client.camera.position)
            ray = np.asarray(event.end_position) - eye
            height = event.start_position[2] - eye[2]
            if ray[2] * height > 0:  # it points to where the object can be
                x, y, _ = eye + ray * height / ray[2]
                self._drag(self._things[name], float(x), float(y))

        node.on_drag(on_drag)

    def _add_marks(self, session: Session) -> None:
        """Bring a light for each finger and a ring for each object, not yet shown."""
        for mark in (*self._lights, *self._rings):
            mark.remove()
        scale, add = session.env.agent.scale, self._server.scene.add_mesh_simple
        ball = trimesh.creation.icosphere(3, LIGHT * scale)
        ring = trimesh.creation.torus(*(scale * radius for radius in RING))
        looks: dict[str, Any] = {"cast_shadow": False, "visible": False}
        self._lights = [
            add(f"/marks/{finger}", ball.vertices, ball.faces, opacity=0.7, **looks)
            for finger in session.env.agent.fingers
        ]
        self._rings = [
            add(f"/marks/{n}", ring.vertices, ring.faces, color=(255,) * 3, **looks)
            for n in range(len(session.names))
        ]

    def _mark(self, session: Session) -> None:
        """Light the fingertips that touch, and ring the objects that are meant."""
        states = [s for hand in session.lights().values() for s in hand.values()]
        tips = session.env.agent.finger_position()[0].numpy()  # [F, 3]
        for light, state, tip in zip(self._lights, states, tips, strict=True):
            if state:
                light.position = tip
                light.color = tuple(bytes.fromhex(COLORS[state][1:]))
            _show(light, bool(state))
        scale = session.env.agent.scale
        where = session.scene.position[0].numpy()
        for place, ring in enumerate(self._rings):
            _show(ring, meant := place in session.reading.objects)
            if meant:
                ring.position = scale * np.array([*where[place, :2], TABLE_TOP])


def between(before: np.ndarray, now: np.ndarray, share: float) -> np.ndarray:
    """Return poses a share of the way from those before to those now [B, 7]."""
    same = np.sign((before[:, 3:] * now[:, 3:]).sum(axis=1, keepdims=True))
    start = np.concatenate([before[:, :3], same * before[:, 3:]], axis=1)
    poses = start + share * (now - start)
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    return poses


def _show(node: Any, visible: bool) -> None:
    if node.visible != visible:
        node.visible = visible
