"""What a step costs, in counts: they don't depend on what else the machine does.

A bound that breaks asks a question, it doesn't forbid: raise it if the work is worth
it, and say so in docs/throughput.md.
"""

from contextlib import closing

import gymnasium as gym
import numpy as np
import pytest
import sapien
import torch

from ir_maniskill.environment import table_scene

CAMERAS = 2
PARTS = 25  # draw calls for each picture: 21 of the robot, the room, three objects
TRIANGLES = 1_650
SUBSTEPS = 5
PIPE_BYTES = 200  # for one worker and one step, there and back


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


class CountingSystem:
    """Stands in for the physics system and counts queries of contacts."""

    def __init__(self, system):
        self.system, self.queries, self.timestep = system, 0, system.timestep

    def get_contacts(self):
        self.queries += 1
        return self.system.get_contacts()


class CountingPipe:
    """Stands in for a pipe and counts the bytes that pass."""

    def __init__(self, pipe):
        self.pipe, self.bytes = pipe, 0

    def fileno(self):
        return self.pipe.fileno()

    def send_bytes(self, message):
        self.bytes += len(message)
        self.pipe.send_bytes(message)

    def recv_bytes(self):
        message = self.pipe.recv_bytes()
        self.bytes += len(message)
        return message


def count_calls(monkeypatch, owner, method):
    calls, original = [], getattr(owner, method)

    def counted(*args, **kwargs):
        calls.append(method)
        return original(*args, **kwargs)

    monkeypatch.setattr(owner, method, counted)
    return calls


@pytest.mark.render
def test_the_scene_stays_cheap_to_draw(multi_env):
    parts = list(render_parts(multi_env.unwrapped.scene.sub_scenes[0]))
    assert len(parts) <= PARTS
    assert sum(triangles for _, triangles in parts) <= TRIANGLES


@pytest.mark.render
def test_a_step_does_everything_once(multi_env, monkeypatch):
    multi_env.reset()
    base = multi_env.unwrapped
    system = CountingSystem(base._touch._system)
    monkeypatch.setattr(base._touch, "_system", system)
    substeps = count_calls(monkeypatch, base.scene, "step")
    updates = count_calls(monkeypatch, base.scene, "update_render")
    drawn = [
        count_calls(monkeypatch, sensor, "capture")
        for sensor in base.scene.sensors.values()
    ]
    multi_env.step(np.zeros(26, dtype=np.float32))
    assert system.queries == SUBSTEPS
    assert len(substeps) == SUBSTEPS
    assert len(updates) == 1
    assert [len(camera) for camera in drawn] == [1] * CAMERAS


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
def test_pipes_carry_commands_only(multi_vec, monkeypatch):
    multi_vec.reset(seed=0)
    pipes = [CountingPipe(pipe) for pipe in multi_vec._pipes]
    monkeypatch.setattr(multi_vec, "_pipes", pipes)
    multi_vec.step(torch.zeros(multi_vec.num_envs, 26))
    assert max(pipe.bytes for pipe in pipes) <= PIPE_BYTES


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


def test_unlit_promises_colors_only():
    assert list(table_scene.UNLIT.texture_names) == ["Color"]
