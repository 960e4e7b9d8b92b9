"""The stage: a table, a floor, a backdrop, the objects, lights and cameras.

World origin = torso origin of NAO, x forward, y left, z up; for another robot all is as
many times larger as its `scale` says. Everything that never moves is one body, since on
software rendering draw calls and vertices are what pictures cost.
"""

from __future__ import annotations

import math

import numpy as np
import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.render.shaders import (
    PREBUILT_SHADER_CONFIGS,
    ShaderConfig,
    default_position_texture_transform,
)
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils.building import ActorBuilder
from mani_skill.utils.sapien_utils import look_at
from mani_skill.utils.structs import Actor, Pose
from torch import Tensor

from ir_maniskill.assets import FOLDER
from ir_maniskill.assets.nao import SOLE_HEIGHT
from ir_maniskill.environment.robots.robot import Robot
from ir_maniskill.experiment import OBJECT_SIZE, TABLE, TouchObject
from ir_maniskill.goals import COLORS, FIXED

TABLE_TOP = 0.03
"""Height of the table top [m]."""
TABLE_THICKNESS = 0.02
"""Thickness of the table top [m]."""
OBJECT_HEIGHT = {"cube": OBJECT_SIZE, "button": 0.024, "can": 0.042, "pyramid": 0.044}
"""Height of each shape [m]."""
DENSITY = 0.05 / OBJECT_SIZE**3
"""Of what is free: cube and pyramid have 50 g at NAO's scale [kg/m^3]."""
PYRAMID_FRICTION = (1.0, 1.0)
"""Static and dynamic: a finger that comes from above does not slip off its sides."""
TOP_COLOR = {"can": (0.45, 0.45, 0.47), "pyramid": (0.85, 0.85, 0.85)}
"""Linear RGB of the tops of shapes that are told by them, seen from above."""
SHELF = (-3.0, 0.0, -1.0)
"""Middle of what carries objects that are not on the table; no camera sees it [m]."""
SHELF_STEP = 0.2
"""Distance between objects on the shelf [m]."""
STAND_COLOR = (0.18, 0.19, 0.21)
"""Linear RGB of the pillar of a robot that has no feet."""

_MESHES = FOLDER / "scene"


def _rgb(data: Tensor) -> dict[str, Tensor]:
    """Return the picture as bytes, whatever format the renderer was left in."""
    color = data[..., :3]
    return {"rgb": (color * 255).byte() if color.is_floating_point() else color}


TRIVIAL = ShaderConfig(
    shader_pack="trivial",
    texture_names={
        "Color": ["rgb"],
        "Position": ["position", "depth"],
        "Segmentation": ["segmentation"],
    },
    texture_transforms={
        "Color": _rgb,
        "Position": default_position_texture_transform,
        "Segmentation": lambda data: {"segmentation": data[..., 1:2]},
    },
)
"""SAPIEN's cheapest pack: base colors without lights. ManiSkill has no entry for it."""
UNLIT = ShaderConfig(
    shader_pack=str(FOLDER / "shaders" / "unlit"),
    texture_names={"Color": ["rgb"]},
    texture_transforms={"Color": _rgb},
)
"""Our own pack: the colors of "trivial", pixel by pixel, at two thirds of its cost,
since it writes nothing else. It has no depth and no segmentation."""
PREBUILT_SHADER_CONFIGS.setdefault("trivial", TRIVIAL)
PREBUILT_SHADER_CONFIGS.setdefault("unlit", UNLIT)


def build_room(scene: ManiSkillScene, robot: Robot) -> Actor:
    """Build all that never moves: one body, one mesh, one collision box.

    A robot without feet gets a pillar to stand on.
    """
    (x0, x1), (y0, y1) = TABLE
    scale, builder = robot.scale, scene.create_actor_builder()
    half = np.array([(x1 - x0) / 2, (y1 - y0) / 2, TABLE_THICKNESS / 2])
    center = np.array([(x0 + x1) / 2, (y0 + y1) / 2, TABLE_TOP - TABLE_THICKNESS / 2])
    builder.add_box_collision(sapien.Pose(scale * center), half_size=scale * half)
    builder.add_visual_from_file(str(_MESHES / "room.glb"), scale=[scale] * 3)
    if robot.stand and scene.can_render():
        x, y, top = robot.mount.p
        ground = scale * SOLE_HEIGHT
        half = np.array([robot.stand, robot.stand, top - ground]) / 2
        pose = sapien.Pose([x, y, (top + ground) / 2])
        builder.add_box_visual(pose, half_size=half, material=_paint(STAND_COLOR))
    builder.initial_pose = sapien.Pose()
    return builder.build_static(name="room")


def build_object(
    scene: ManiSkillScene, thing: TouchObject, place: np.ndarray, scale: float
) -> Actor:
    """Build one object at a place [3] [m]: a free one, or one that stays where put."""
    builder = scene.create_actor_builder()
    builder.initial_pose = sapien.Pose(place)
    size, height = scale * OBJECT_SIZE, scale * OBJECT_HEIGHT[thing.shape]
    if thing.shape == "cube":
        builder.add_box_collision(half_size=[size / 2] * 3, density=DENSITY)
    elif thing.shape == "pyramid":
        hull = str(_MESHES / "pyramid_hull.glb")
        rough = sapien.physx.PhysxMaterial(*PYRAMID_FRICTION, 0.0)
        builder.add_convex_collision_from_file(
            hull, scale=[scale] * 3, material=rough, density=2.25 * DENSITY
        )
    else:
        upright = sapien.Pose(q=[math.sqrt(0.5), 0, -math.sqrt(0.5), 0])
        builder.add_cylinder_collision(upright, size / 2, height / 2, density=DENSITY)
    if scene.can_render():
        _paint_object(builder, thing, scale)
    if thing.shape in FIXED:
        return builder.build_kinematic(name=thing.name)
    return builder.build(name=thing.name)


def _paint_object(builder: ActorBuilder, thing: TouchObject, scale: float) -> None:
    paint = _paint(COLORS[thing.color])
    if thing.shape == "cube":
        half = [scale * OBJECT_SIZE / 2] * 3
        builder.add_box_visual(half_size=half, material=paint)
        return
    parts = {thing.shape: paint}
    if thing.shape in TOP_COLOR:
        parts[f"{thing.shape}_top"] = _paint(TOP_COLOR[thing.shape])
    for name, material in parts.items():
        mesh = str(_MESHES / f"{name}.glb")
        builder.add_visual_from_file(mesh, scale=[scale] * 3, material=material)


def build_shelf(scene: ManiSkillScene, count: int, scale: float) -> np.ndarray:
    """Build a shelf out of sight; return places for objects [count, 3] [m]."""
    row = math.ceil(math.sqrt(count))
    half = np.array([row * SHELF_STEP, row * SHELF_STEP, 0.02])
    builder = scene.create_actor_builder()
    builder.add_box_collision(half_size=scale * half)
    builder.initial_pose = sapien.Pose(scale * np.array(SHELF))
    builder.build_static(name="shelf")
    steps = np.stack(np.divmod(np.arange(count), row), axis=1) - row / 2
    above = np.full((count, 1), 0.02)  # of the shelf's middle
    return scale * (np.array(SHELF) + np.hstack([SHELF_STEP * steps, above]))


def _paint(color: tuple[float, float, float]) -> sapien.render.RenderMaterial:
    rgba = [*color, 1.0]
    return sapien.render.RenderMaterial(base_color=rgba, roughness=0.45, specular=0.4)


def add_lights(scene: ManiSkillScene, scale: float, shadow: bool) -> None:
    """Add a soft ambient light, a key light (with `shadow` or not) and a fill light."""
    scene.set_ambient_light([0.35, 0.35, 0.36])
    scene.add_directional_light(
        [-0.55, -0.35, -1.0],
        [1.9, 1.85, 1.75],
        shadow=shadow,
        shadow_scale=0.8 * scale,
        shadow_map_size=2048,
    )
    scene.add_directional_light([-0.6, 0.9, -0.4], [0.5, 0.52, 0.6])


def policy_cameras(scale: float) -> list[CameraConfig]:
    """Return the two cameras of the Perceptual System (paper, Sec. III-C: K = 2).

    512 high, 256 wide by default; both see the whole of the objects' area.
    """
    top = view(scale, eye=(0.18, 0, 0.60), target=(0.17, 0, TABLE_TOP))
    front = view(scale, eye=(0.66, 0, 0.36), target=(0.15, 0, 0.06))
    size = {"width": 256, "height": 512, "near": 0.02 * scale, "far": 5.0 * scale}
    return [
        CameraConfig(uid="top_camera", pose=top, fov=1.10, **size),
        CameraConfig(uid="front_camera", pose=front, fov=1.10, **size),
    ]


def video_camera(scale: float) -> CameraConfig:
    """Return the camera for videos: a three-quarter view with the full shader."""
    return CameraConfig(
        uid="render_camera",
        pose=view(scale, eye=(0.72, 0.46, 0.46), target=(0.10, 0.0, 0.06)),
        width=960,
        height=720,
        fov=0.75,
        near=0.02 * scale,
        far=20.0 * scale,
        shader_pack="default",
    )


Point = tuple[float, float, float]
"""A place at NAO's scale (x, y, z) [m]."""


def view(scale: float, eye: Point, target: Point) -> Pose:
    """Return the pose of a camera that looks from `eye` at `target`."""
    return look_at([scale * value for value in eye], [scale * v for v in target])


def yaw_quaternion(yaw: np.ndarray) -> np.ndarray:
    """Return rotations about the vertical [...] [rad] as (w, x, y, z) [..., 4]."""
    zero = np.zeros_like(yaw)
    return np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=-1)
