"""What ManiSkill's own tests check of its tasks, checked of all of ours."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import imageio.v3 as iio
import numpy as np
import pytest
import torch
from mani_skill.utils.wrappers import (
    ActionRepeatWrapper,
    CPUGymWrapper,
    FrameStack,
    RecordEpisode,
)
from trees import leaves

from ir_maniskill import available
from ir_maniskill.goals import GoalError

IDS = [task for task in available() if task.startswith("Nao")]
QUICK = ("NaoTouchCubeShuffled-v1", "NaoInstruct-v1")
"""Tasks that stand for all where time is short."""
EACH = [t if t in QUICK else pytest.param(t, marks=pytest.mark.slow) for t in IDS]
SMALL = {"width": 16, "height": 32, "shader_pack": "trivial"}
MODES = ("none", "state", "rgbd", "depth+segmentation")
RECORDED = (("state", "rgb_array"), ("rgb", "sensors"), ("pointcloud", "all"))
"""Modes of observations and what the film shows."""
UNSTORED = ("extra/touch", "extra/gap")
"""What no state holds, as it depends on the contacts of the last step."""


def make(task: str, **more: Any) -> gym.Env:
    """Make a task, without a renderer unless it needs one."""
    usual = {"obs_mode": "state_dict", "render_backend": "none"}
    return gym.make(task, **usual | more)


def seeing(task: str, **more: Any) -> gym.Env:
    """Make a task with small cameras of both kinds."""
    cameras = {"sensor_configs": SMALL, "human_render_camera_configs": SMALL}
    return make(task, render_backend="auto", **cameras | more)


def same(one: Any, other: Any, within: float = 0.0) -> bool:
    """Whether two observations are equal, but for contacts."""
    first, second = leaves(one), leaves(other)
    assert first.keys() == second.keys()
    return all(
        torch.allclose(first[name].float(), second[name].float(), 0, within)
        for name in first
        if name not in UNSTORED
    )


def walk(env: gym.Env, steps: int) -> Any:
    """Take random actions; return the last observation."""
    for _ in range(steps):
        obs = env.step(env.action_space.sample())[0]
    return obs


@pytest.fixture(scope="module", params=EACH)
def env(request: pytest.FixtureRequest) -> Iterator[gym.Env]:
    """Each task in turn, without pictures."""
    env = make(request.param)
    yield env
    env.close()


# -- Seeds and states ------------------------------------------------------------------


def test_a_seed_gives_the_same_sequence_of_episodes(env: gym.Env) -> None:
    short = gym.wrappers.TimeLimit(env.unwrapped, 3)
    actions, ends = [env.action_space.sample() for _ in range(7)], []
    for _ in range(2):
        short.reset(seed=np.int64(2000))
        for action in actions:
            obs, _, _, truncated, _ = short.step(action)
            if truncated:
                obs, _ = short.reset()
        ends.append({name: leaf.clone() for name, leaf in leaves(obs).items()})
    assert same(*ends)


def test_a_state_that_is_set_gives_its_observation(env: gym.Env) -> None:
    base: Any = env.unwrapped
    env.reset(seed=1000)
    walk(env, 5)
    row, tree = base.get_state().clone(), base.get_state_dict()
    obs = {name: leaf.clone() for name, leaf in leaves(base.get_obs()).items()}
    for restore in (lambda: base.set_state(row), lambda: base.set_state_dict(tree)):
        walk(env, 5)
        restore()
        assert same(base.get_obs(), obs, within=1e-6)
        torch.testing.assert_close(base.get_state(), row)


def test_observations_and_rewards_are_what_the_spaces_say(env: gym.Env) -> None:
    cpu = CPUGymWrapper(env)
    obs, _ = cpu.reset(seed=3)
    for _ in range(3):
        assert cpu.observation_space.contains(obs)
        obs, reward, terminated, truncated, _ = cpu.step(cpu.action_space.sample())
        assert isinstance(reward, float) and not (terminated or truncated)


# -- Modes, robots, wrappers -----------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["panda", "g1"])
@pytest.mark.parametrize("task", IDS)
def test_other_robots_do_every_task_that_fits_their_hands(
    task: str, robot: str
) -> None:
    made = {"robot_uids": robot, "control_mode": "pd_joint_target_delta_pos"}
    if (task, robot) == ("NaoInstructHand-v1", "panda"):
        with pytest.raises(GoalError, match="hand"):  # it has but one
            make(task, **made)
        return
    env = make(task, **made)
    env.reset(seed=0)
    walk(env, 2)
    env.close()


@pytest.mark.render
@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("task", IDS)
def test_every_mode_of_observations_works(task: str, mode: str) -> None:
    env = CPUGymWrapper(seeing(task, obs_mode=mode))
    obs, _ = env.reset(seed=0)
    assert env.observation_space.contains(obs) or mode == "none"
    env.step(env.action_space.sample())
    env.close()


@pytest.mark.render
@pytest.mark.parametrize(("mode", "shown"), RECORDED)
@pytest.mark.parametrize("task", EACH)
def test_recordings_hold_every_episode(
    task: str, mode: str, shown: str, tmp_path: Path
) -> None:
    env = seeing(task, obs_mode=mode, render_mode=shown, max_episode_steps=3)
    env = RecordEpisode(env, str(tmp_path), trajectory_name="t", info_on_video=True)
    for seed in (1, 2):
        env.reset(seed=seed)
        walk(env, 3)
    env.close()
    films = sorted(tmp_path.glob("*.mp4"))
    assert [len(iio.imread(film)) for film in films] == [4, 4]
    with h5py.File(tmp_path / "t.h5") as file:
        assert [len(file[f"traj_{i}/actions"]) for i in range(2)] == [3, 3]
        state = file["traj_1/env_states/task/instruction_index"]
        assert len(state) == 4


@pytest.mark.parametrize("task", QUICK)
def test_wrappers_of_others_wrap(task: str) -> None:
    stacked = FrameStack(make(task, obs_mode="state"), num_stack=2)
    obs, _ = stacked.reset(seed=0)
    assert torch.equal(obs[:, 0], obs[:, 1])
    slow = ActionRepeatWrapper(make(task), repeat=4)
    slow.reset(seed=0)
    info = slow.step(np.zeros(26, np.float32))[4]
    assert info["elapsed_steps"].item() == 4
    for env in (stacked, slow):
        env.close()
