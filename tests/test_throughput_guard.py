"""What pictures cost, in counts: they don't depend on what else the machine does.

A bound that breaks asks a question, it doesn't forbid: raise it if the work is worth
it, and say so in docs/throughput.md.
"""

from contextlib import closing

import gymnasium as gym
import numpy as np
import pytest
import sapien
import torch

PARTS = 25  # draw calls for each picture: 21 of the robot, the room, three objects
TRIANGLES = 1_650


def render_parts(scene):
    """Return (vertices, triangles) of everything that is drawn."""
    bodies = [
        component
        for entity in scene.entities
        for component in entity.components
        if isinstance(component, sapien.render.RenderBodyComponent)
    ]
    for body in bodies:
        for shape in body.render_shapes:
            if isinstance(shape, sapien.render.RenderShapeTriangleMesh):
                for part in shape.parts:
                    yield len(part.vertices), len(part.triangles)
            else:
                assert isinstance(shape, sapien.render.RenderShapeBox)
                yield 24, 12


@pytest.mark.render
def test_the_scene_stays_cheap_to_draw(multi_env):
    parts = list(render_parts(multi_env.unwrapped.scene.sub_scenes[0]))
    assert len(parts) <= PARTS
    assert sum(triangles for _, triangles in parts) <= TRIANGLES


@pytest.mark.render
def test_pictures_begun_early_show_the_end_of_the_step(multi_env):
    multi_env.reset(seed=0)
    base = multi_env.unwrapped
    sight = multi_env.step(np.full(26, 0.5, dtype=np.float32))[0]["sensor_data"]
    anew = base.get_obs()["sensor_data"]
    base.agent.robot.set_qpos(base.agent.keyframes["rest"].qpos)
    moved = base.get_obs()["sensor_data"]
    for name in sight:
        assert torch.equal(sight[name]["rgb"], anew[name]["rgb"])
        assert not torch.equal(moved[name]["rgb"], anew[name]["rgb"])


@pytest.mark.render
@pytest.mark.slow
def test_unlit_pictures_are_those_of_trivial():
    pictures = {}
    for shader in ("trivial", "unlit"):
        cameras = {"width": 64, "height": 128, "shader_pack": shader}
        env = gym.make("NaoTouchCubeMulti-v1", obs_mode="rgb", sensor_configs=cameras)
        with closing(env):
            env.reset(seed=0)
            obs, *_ = env.step(np.full(26, 0.3, dtype=np.float32))
            pictures[shader] = obs["sensor_data"]
    for name in ("top_camera", "front_camera"):
        expected = pictures["trivial"][name]["rgb"]
        assert expected.float().std() > 10
        assert torch.equal(pictures["unlit"][name]["rgb"], expected)
