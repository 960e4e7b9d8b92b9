"""The stage: a table, a floor, a backdrop, the objects, lights and cameras.

World origin = torso origin of the robot, x forward, y left, z up. Everything that
never moves is one body, since on software rendering draw calls and vertices are what
pictures cost.
"""

from __future__ import annotations

import math
from importlib.resources import files

import numpy as np
import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.render.shaders import (
    PREBUILT_SHADER_CONFIGS,
    ShaderConfig,
    default_position_texture_transform,
)
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils.sapien_utils import look_at
from mani_skill.utils.structs import Actor
from torch import Tensor

from ir_maniskill.experiment import OBJECT_SIZE, TABLE, TouchObject
from ir_maniskill.goals import COLORS

TABLE_TOP = 0.03
"""Height of the table top [m]."""
TABLE_THICKNESS = 0.02
"""Thickness of the table top [m]."""
OBJECT_HEIGHT = {"cube": OBJECT_SIZE, "button": 0.024}
"""Height of each shape [m]."""
CUBE_MASS = 0.05
"""[kg]"""


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
    shader_pack=str(files("ir_maniskill.assets") / "shaders" / "unlit"),
    texture_names={"Color": ["rgb"]},
    texture_transforms={"Color": _rgb},
)
"""Our own pack: the colors of "trivial", pixel by pixel, at two thirds of its cost,
since it writes nothing else. It has no depth and no segmentation."""
PREBUILT_SHADER_CONFIGS.setdefault("trivial", TRIVIAL)
PREBUILT_SHADER_CONFIGS.setdefault("unlit", UNLIT)


def build_room(scene: ManiSkillScene) -> Actor:
    """Build all that never moves: one body, one mesh, one collision box."""
    (x0, x1), (y0, y1) = TABLE
    builder = scene.create_actor_builder()
    half = [(x1 - x0) / 2, (y1 - y0) / 2, TABLE_THICKNESS / 2]
    center = [(x0 + x1) / 2, (y0 + y1) / 2, TABLE_TOP - TABLE_THICKNESS / 2]
    builder.add_box_collision(sapien.Pose(center), half_size=half)
    mesh = files("ir_maniskill.assets") / "scene" / "room.glb"
    builder.add_visual_from_file(str(mesh))
    builder.initial_pose = sapien.Pose()
    return builder.build_static(name="room")


def build_object(scene: ManiSkillScene, thing: TouchObject) -> Actor:
    """Build one object: a free cube, or a button that stays where it is put."""
    builder = scene.create_actor_builder()
    height = OBJECT_HEIGHT[thing.shape]
    builder.initial_pose = sapien.Pose([*thing.position, TABLE_TOP + height / 2])
    if thing.shape == "cube":
        half = [OBJECT_SIZE / 2] * 3
        builder.add_box_collision(half_size=half, density=CUBE_MASS / OBJECT_SIZE**3)
        if scene.can_render():
            builder.add_box_visual(half_size=half, material=_material(thing))
        return builder.build(name=thing.name)
    upright = sapien.Pose(q=[math.sqrt(0.5), 0, -math.sqrt(0.5), 0])
    builder.add_cylinder_collision(upright, OBJECT_SIZE / 2, height / 2)
    if scene.can_render():
        mesh = files("ir_maniskill.assets") / "scene" / "button.glb"
        builder.add_visual_from_file(str(mesh), material=_material(thing))
    return builder.build_kinematic(name=thing.name)


def _material(thing: TouchObject) -> sapien.render.RenderMaterial:
    color = [*COLORS[thing.color], 1.0]
    return sapien.render.RenderMaterial(base_color=color, roughness=0.45, specular=0.4)


def add_lights(scene: ManiSkillScene, shadow: bool) -> None:
    """Add a soft ambient light, a key light (with `shadow` or not) and a fill light."""
    scene.set_ambient_light([0.35, 0.35, 0.36])
    scene.add_directional_light(
        [-0.55, -0.35, -1.0],
        [1.9, 1.85, 1.75],
        shadow=shadow,
        shadow_scale=0.8,
        shadow_map_size=2048,
    )
    scene.add_directional_light([-0.6, 0.9, -0.4], [0.5, 0.52, 0.6])


def policy_cameras() -> list[CameraConfig]:
    """Return the two cameras of the Perceptual System (paper, Sec. III-C: K = 2).

    512 high, 256 wide by default; both see the whole of the objects' area.
    """
    top = look_at(eye=[0.18, 0, 0.60], target=[0.17, 0, TABLE_TOP])
    front = look_at(eye=[0.66, 0, 0.36], target=[0.15, 0, 0.06])
    size = {"width": 256, "height": 512, "near": 0.02, "far": 5.0}
    return [
        CameraConfig(uid="top_camera", pose=top, fov=1.10, **size),
        CameraConfig(uid="front_camera", pose=front, fov=1.10, **size),
    ]


def video_camera() -> CameraConfig:
    """Return the camera for videos: a three-quarter view with the full shader."""
    return CameraConfig(
        uid="render_camera",
        pose=look_at(eye=[0.72, 0.46, 0.46], target=[0.10, 0.0, 0.06]),
        width=960,
        height=720,
        fov=0.75,
        near=0.02,
        far=20.0,
        shader_pack="default",
    )


def yaw_quaternion(yaw: np.ndarray) -> np.ndarray:
    """Return rotations about the vertical as quaternions (w, x, y, z).

    Args:
        yaw: Angles of any shape [...] [rad].

    Returns:
        Unit quaternions [..., 4].
    """
    zero = np.zeros_like(yaw)
    return np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=-1)
