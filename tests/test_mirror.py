"""What an episode looks like in a mirror: a symmetric robot could have lived it."""

import dataclasses
from contextlib import closing

import pytest
import torch

from ir_maniskill import experiment as catalog
from ir_maniskill.environment.robots.nao import Nao
from ir_maniskill.environment.senses import StateStack, flatten
from ir_maniskill.environment.vector import GpuVectorEnv
from ir_maniskill.training.algorithm import Outcome
from ir_maniskill.training.config import CONFIGS
from ir_maniskill.training.mirror import TURNED, Mirror
from ir_maniskill.training.sac import SAC
from ir_maniskill.training.train import for_experiment

MIRROR = Mirror(Nao)
SPUN = torch.cat([TURNED, torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])])
"""Signs of an actor's state: place, quaternion, velocity, angular velocity."""


@pytest.fixture(scope="module")
def envs():
    made = GpuVectorEnv(
        "NaoInstruct-v1",
        1,
        sim_backend="physx_cpu",
        render_backend="cpu",
        obs_mode="rgb",
        control_mode="pd_joint_target_delta_pos",
        sensor_configs={"width": 32, "height": 64, "shader_pack": "unlit"},
    )
    with closing(made):
        yield made


def mirrored(state, order):
    """Return the mirror image of an env's state; `order` is that of its joints."""
    robot, joints = state["articulations"]["nao"].clone(), len(order)
    for first in (13, 13 + joints):  # positions, then velocities
        values = robot[:, first : first + joints]
        values[:, order] = MIRROR.joints(values[:, order])
    start = state["task"]["start"].unflatten(1, (-1, 7)) * TURNED
    return state | {
        "actors": {name: value * SPUN for name, value in state["actors"].items()},
        "articulations": {"nao": robot},
        "controller": {
            "target_qpos": MIRROR.joints(state["controller"]["target_qpos"])
        },
        "task": state["task"] | {"start": start.flatten(1)},
    }


def played(envs, state, actions):
    """Return what is sensed, and the scene, after each of the actions."""
    envs.base_env.set_state_dict(state)
    found = []
    for action in actions:
        obs, *_ = envs.step(action)
        found.append((flatten(obs), envs.base_env.snapshot()))
    return found


def test_mirrored_actions_do_in_a_mirrored_scene_what_the_mirror_shows(envs) -> None:
    torch.manual_seed(0)
    envs.reset(seed=[3])
    base = envs.base_env
    state, order = base.get_state_dict(), base.agent.controller.active_joint_indices
    actions = 0.7 * (torch.rand(10, 1, 26) * 2 - 1)
    actions[..., [0, 13]] = 0.5  # both shoulders: the arms go down
    one = played(envs, state, actions)
    two = played(envs, mirrored(state, order), MIRROR.joints(actions))
    names = ("proprioception", "target", "touch", "images")
    for (sensed, scene), (other, seen) in zip(one, two, strict=True):
        shown, image = (
            MIRROR({name: sensed[name] for name in names}),
            MIRROR.scene(scene),
        )
        off = (shown.pop("images").int() - other["images"].int()).abs()
        assert off.float().mean() < 1, "the pictures differ"
        for name, value in shown.items():
            torch.testing.assert_close(value, other[name], atol=0.02, rtol=0)
        torch.testing.assert_close(image.fingertip, seen.fingertip, atol=2e-3, rtol=0)
        torch.testing.assert_close(image.position, seen.position, atol=2e-3, rtol=0)
        torch.testing.assert_close(image.contact, seen.contact)
        if scene.contact.any():
            return  # what follows amplifies the smallest difference
    raise AssertionError("nothing was touched")


def test_a_mirror_in_a_mirror_shows_what_is_there() -> None:
    rows = torch.rand(3, 26)
    torch.testing.assert_close(MIRROR.joints(MIRROR.joints(rows)), rows)
    torch.testing.assert_close(
        MIRROR({"touch": MIRROR({"touch": rows[:, :6]})["touch"]})["touch"], rows[:, :6]
    )


def test_a_sense_of_ones_own_has_no_mirror_image() -> None:
    assert MIRROR.knows({"images", "touch", "proprioception", "target"})
    assert not MIRROR.knows({"images", "warmth"})


@pytest.mark.parametrize(
    ("task", "share", "kept"),
    [
        ("NaoInstructPush-v1", 0.0, 1),
        ("NaoInstructPush-v1", 1.0, 2),
        ("NaoTouchCubeTriangle-v1", 1.0, 1),
    ],
)
def test_a_policy_learns_also_from_the_mirror_images_of_what_is_drawn_freely(
    task, share, kept
) -> None:
    listen = CONFIGS["listen"]
    small = dataclasses.replace(listen.sac, capacity=64)
    config = dataclasses.replace(listen, env_id=task, num_envs=1, sac=small)
    config = for_experiment(config, catalog.get(task))
    kwargs = config.env_kwargs(training=True)
    backends = {"sim_backend": "physx_cpu", "render_backend": "cpu"}
    with closing(GpuVectorEnv(task, 1, **backends, **kwargs)) as envs:
        state = StateStack(1).reset(envs.reset(seed=[0])[0])
    sac = SAC(config, state, 26)
    sac.share = share
    for step in range(3):
        sac.act(state)
        done = torch.tensor([step == 2])
        sac.observe(Outcome(torch.zeros(1), torch.zeros_like(done), done, state, state))
    assert sac.replay.episodes == kept
    snapshots = sac.replay.read("snapshot", torch.arange(4 * kept))
    mirrored = MIRROR({"snapshot": snapshots[:4]})["snapshot"]
    torch.testing.assert_close(snapshots[-4:], mirrored if kept == 2 else snapshots[:4])
