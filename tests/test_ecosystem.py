"""At home with ManiSkill, Gymnasium and Stable-Baselines3: what others wrote works."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import imageio.v3 as iio
import numpy as np
import pytest
import torch
from gymnasium.wrappers import RecordVideo
from mani_skill.trajectory import replay_trajectory
from mani_skill.trajectory.utils import dict_to_list_of_dicts
from mani_skill.utils import common
from mani_skill.utils.wrappers import (
    CPUGymWrapper,
    FlattenRGBDObservationWrapper,
    RecordEpisode,
)
from mani_skill.utils.wrappers.cached_reset import CachedResetWrapper
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv

from ir_maniskill import Experiment, Instruction, Ref, Touch, TouchObject, register
from ir_maniskill.language.tokens import VOCABULARY

STEPS = 16
"""Actions of each recorded episode."""


def blind(task: str) -> Any:
    """Make a task without pictures."""
    return gym.make(
        task,
        obs_mode="state_dict",
        control_mode="pd_joint_target_delta_pos",
        render_backend="none",
    )


# -- ManiSkill's recordings and their replay -------------------------------------------


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes of a task with words of its own, recorded by ManiSkill.

    The first start is by seed, the second goes on with the env's random stream, and
    the third does so in a scene built anew.
    """
    lemon = TouchObject("yellow", (0.21, 0.06))
    plum = TouchObject("purple", (0.21, -0.06))
    sentences = (
        Instruction("Touch the lemon.", Touch(Ref("yellow"))),
        Instruction("Touch the plum, not the lemon.", Touch(Ref("purple"))),
    )
    words = (*VOCABULARY, "plum", "lemon", "not")
    register(Experiment("RecordFruit-v1", (lemon, plum), sentences, vocabulary=words))
    folder = tmp_path_factory.mktemp("recorded")
    env = RecordEpisode(
        blind("RecordFruit-v1"), str(folder), trajectory_name="fruit", save_video=False
    )
    rng = np.random.default_rng(5)  # touches the right object in two of the three
    starts = (3, {"instruction": 1}), (None, {}), (None, {"reconfigure": True})
    for seed, options in starts:
        env.reset(seed=seed, options=options)
        for action in rng.uniform(-1, 1, (STEPS, 26)).astype(np.float32):
            env.step(action)
    env.close()
    return folder / "fruit.h5"


def replay(recorded: Path, **arguments: Any) -> Path:
    """Return the file that ManiSkill's replay of `recorded` leaves."""
    replay_trajectory.main(
        replay_trajectory.Args(
            str(recorded),
            save_traj=True,
            record_rewards=True,
            allow_failure=True,
            **arguments,
        )
    )
    (replayed,) = recorded.parent.glob("fruit.*.h5")
    return replayed


def datasets(group: h5py.Group) -> dict[str, np.ndarray]:
    """Return all arrays of an episode by path."""
    found: dict[str, np.ndarray] = {}

    def visit(path: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset):
            found[path] = item[:]

    group.visititems(visit)
    return found


@pytest.mark.slow
def test_replayed_actions_lead_to_the_same_states(recorded: Path) -> None:
    replayed = replay(recorded)
    with h5py.File(recorded) as first, h5py.File(replayed) as second:
        for name in ("traj_0", "traj_2"):  # the random stream has no seed to record
            before, after = datasets(first[name]), datasets(second[name])
            assert before.keys() == after.keys()
            assert "env_states/task/instruction_index" in before
            for path, array in before.items():
                np.testing.assert_array_equal(array, after[path], path)
            assert before["success"].any()


@pytest.mark.slow
def test_replayed_states_are_those_recorded(recorded: Path) -> None:
    replayed = replay(recorded, use_env_states=True)
    with h5py.File(recorded) as first, h5py.File(replayed) as second:
        assert len(first) == 3
        for name in first:
            before, after = datasets(first[name]), datasets(second[name])
            np.testing.assert_array_equal(before["rewards"], after["rewards"])
            np.testing.assert_array_equal(before["success"], after["success"])
            for path in before:
                # ManiSkill stores the second state in the first one's place. Each of
                # the others is a step away from a state that was set: places agree.
                a, b = before[path][1:], after[path][1:]
                if path.startswith("env_states/actors"):
                    np.testing.assert_allclose(a[:, :3], b[:, :3], atol=3e-3)
                elif path.startswith(("env_states/task", "env_states/controller")):
                    np.testing.assert_array_equal(a, b, path)


@pytest.mark.slow
def test_a_row_of_a_recording_restores_the_whole_state(recorded: Path) -> None:
    env = blind("RecordFruit-v1").unwrapped
    env.reset(seed=0, options={"instruction": 0})
    with h5py.File(recorded) as file:
        rows = dict_to_list_of_dicts(file["traj_0/env_states"])
    for row in (rows[0], rows[-1]):
        env.set_state_dict(row)
        assert env.get_language_instruction() == ["Touch the plum, not the lemon."]
        state = common.to_tensor(common.batch(row))
        state = common.flatten_state_dict(state, use_torch=True)
        torch.testing.assert_close(env.get_state(), state)
    env.close()


# -- Resets to a state -----------------------------------------------------------------


@pytest.fixture(scope="module", params=["NaoTouchCubeShuffled-v1", "NaoInstruct-v1"])
def to_states(request: pytest.FixtureRequest) -> Iterator[tuple[Any, dict]]:
    """An env of a task, and a state of another one: its tree, its row, its sentence."""
    other, env = blind(request.param), blind(request.param)
    other.reset(seed=1)
    for action in np.random.default_rng(0).uniform(-1, 1, (4, 26)):
        other.step(action)
    base = other.unwrapped
    states = {"tree": base.get_state_dict(), "row": base.get_state()}
    yield env, states | {"said": base.get_language_instruction()}
    other.close()
    env.close()


@pytest.mark.parametrize("more", [{}, {"reconfigure": True}, {"reconfigure": False}])
@pytest.mark.parametrize("kind", ["tree", "row"])
def test_a_reset_to_a_state_may_have_a_seed(
    to_states: tuple[Any, dict], kind: str, more: dict
) -> None:
    env, states = to_states
    for seed in (3, None):
        to = {"reset_to_env_states": {"env_states": states[kind]}}
        env.reset(seed=seed, options=to | more)
        torch.testing.assert_close(env.unwrapped.get_state(), states["row"])
        assert env.unwrapped.get_language_instruction() == states["said"]
        env.step(np.zeros(26))
    env.reset(seed=4)  # what follows is as ever
    begun = env.unwrapped.get_state()
    env.reset(seed=5)
    env.reset(seed=4)
    assert torch.equal(env.unwrapped.get_state(), begun)


@pytest.mark.parametrize("task", ["NaoTouchCubeShuffled-v1", "NaoInstruct-v1"])
def test_maniskills_cached_resets_work_with_and_without_a_seed(task: str) -> None:
    env = CachedResetWrapper(blind(task), config={"num_resets": 2, "seed": 0})
    cached = env._cached_resets_env_states["task"]["start"]
    for seed in (None, 5, None):
        seen, _ = env.reset(seed=seed)
        now = env.unwrapped.get_obs(env.unwrapped.get_info())
        torch.testing.assert_close(seen, now)
        start = env.unwrapped.get_state_dict()["task"]["start"]
        assert (start == cached).all(dim=1).sum() == 1
        env.step(env.action_space.sample())
    env.close()


# -- ManiSkill's PPO layout ------------------------------------------------------------


@pytest.mark.render
def test_flattening_keeps_the_tokens_last_as_plain_numbers() -> None:
    env: Any = gym.make(
        "NaoTouchCubeMulti-v1",
        obs_mode="rgb",
        reward_mode="normalized_dense",
        sensor_configs={"width": 32, "height": 64, "shader_pack": "trivial"},
    )
    env = FlattenRGBDObservationWrapper(env, rgb=True, depth=False, state=True)
    envs = ManiSkillVectorEnv(env, ignore_terminations=True, record_metrics=True)
    obs, _ = envs.reset(seed=0, options={"instruction": 0})
    assert set(obs) == {"rgb", "state"}
    assert tuple(obs["rgb"].shape) == (1, 64, 32, 6)  # two cameras
    assert obs["rgb"].dtype == torch.uint8
    assert tuple(obs["state"].shape) == (1, 26 + 26 + 6 + 5)
    words = [VOCABULARY[int(token)] for token in obs["state"][0, -5:]]
    assert words == ["touch", "the", "blue", "cube", "."]
    for _ in range(32):
        assert envs.observation_space.contains({k: v.numpy() for k, v in obs.items()})
        obs, _, terminated, truncated, info = envs.step(envs.action_space.sample())
    assert truncated.all()
    assert not terminated.any()
    assert info["final_info"]["episode"]["episode_len"].tolist() == [32]
    assert not torch.equal(info["final_observation"]["state"], obs["state"])
    envs.close()


# -- Gymnasium -------------------------------------------------------------------------


@pytest.mark.render
@pytest.mark.slow
def test_gymnasium_records_a_playable_video_in_real_time(tmp_path: Path) -> None:
    pytest.importorskip("moviepy", reason="needs the extra `video`")
    camera = {"width": 128, "height": 96, "shader_pack": "trivial"}
    env: Any = gym.make(
        "NaoTouchCubeMulti-v1",
        obs_mode="none",
        render_mode="rgb_array",
        human_render_camera_configs=camera,
    )
    env = RecordVideo(CPUGymWrapper(env), str(tmp_path))
    env.reset(seed=0)
    done = False
    while not done:
        _, reward, terminated, done, _ = env.step(env.action_space.sample())
        assert (type(reward), terminated) == (float, False)
    env.close()
    (video,) = tmp_path.glob("*.mp4")
    frames = iio.imread(video)
    assert frames.shape[1:] == (96, 128, 3)
    assert 33 <= len(frames) <= 34  # the writer may repeat the last one
    assert frames.astype(float).std() > 10
    assert np.abs(frames[0].astype(float) - frames[-1]).max() > 50  # the robot moved
    assert iio.immeta(video)["fps"] == 20
