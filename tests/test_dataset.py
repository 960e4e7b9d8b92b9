"""Datasets: whole episodes, in the form that their readers expect."""

import io
import json
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest
from mani_skill.trajectory import replay_trajectory
from PIL import Image
from pyarrow import parquet

import ir_maniskill
from ir_maniskill import Policy, load_policy
from ir_maniskill.checks import ConfigError
from ir_maniskill.evaluation import dataset
from ir_maniskill.evaluation import lerobot as lerobot_format

CUBE = "NaoTouchCubeSingle-v1"
SEED, STEPS = dataset.DATASET_SEED, 32


@pytest.fixture(scope="module")
def policy() -> Policy:
    return load_policy(CUBE)


@pytest.fixture(scope="module")
def lerobot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes of the language, two in each file; all are kept."""
    folder = tmp_path_factory.mktemp("data") / "lerobot"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lerobot_format, "CHUNK", 2)
        options: dict[str, Any] = {"form": "lerobot", "height": 32, "failures": True}
        count = ir_maniskill.collect("NaoInstruct-v1", folder, episodes=3, **options)
    assert count == 3
    return folder


def test_maniskill_replays_what_was_recorded(policy: Policy, tmp_path: Path) -> None:
    assert ir_maniskill.collect(policy, tmp_path, episodes=2) == 2
    recorded = tmp_path / f"{CUBE}.h5"
    episodes = json.loads(recorded.with_suffix(".json").read_text())["episodes"]
    assert [e["instruction"] for e in episodes] == ["Touch the blue cube."] * 2
    assert [e["episode_seed"] for e in episodes] == [SEED, SEED + 1]
    again = replay_trajectory.Args(str(recorded), save_traj=True, record_rewards=True)
    again.obs_mode = "rgb"
    replay_trajectory.main(again)
    (replayed,) = tmp_path.glob(f"{CUBE}.rgb.*.h5")
    with h5py.File(recorded) as first, h5py.File(replayed) as second:
        for name in ("traj_0", "traj_1"):
            rewards = first[name]["rewards"][:]
            assert rewards.sum() > 0
            np.testing.assert_array_equal(rewards, second[name]["rewards"][:])
            pictures = second[name]["obs/sensor_data/front_camera/rgb"]
            assert pictures.shape[0] == len(rewards) + 1 and pictures[:].std() > 10


def test_episodes_that_fail_are_left_out(policy: Policy, tmp_path: Path) -> None:
    class Still(Policy):
        def act(self, obs: Any, sentences: Any = None) -> Any:
            return 0 * super().act(obs, sentences)

    still = Still(policy.agent, policy.config, policy.metadata)
    assert ir_maniskill.collect(still, tmp_path, episodes=1) == 0
    with h5py.File(tmp_path / f"{CUBE}.h5") as recorded:
        assert not recorded.keys()


def test_lerobot_has_every_frame_once(lerobot: Path) -> None:
    info = json.loads((lerobot / "meta/info.json").read_text())
    tables = [parquet.read_table(path) for path in sorted(lerobot.glob("data/*/*"))]
    assert [len(table) for table in tables] == [2 * STEPS, STEPS]
    assert info["total_frames"] == 3 * STEPS and info["total_episodes"] == 3
    rows = [row for table in tables for row in table.to_pylist()]
    assert rows[0].keys() == info["features"].keys()
    assert [row["index"] for row in rows] == [*range(3 * STEPS)]
    assert [row["frame_index"] for row in rows] == 3 * [*range(STEPS)]
    assert [row["next.done"] for row in rows] == 3 * [*[False] * (STEPS - 1), True]
    assert rows[1]["timestamp"] == pytest.approx(0.05)
    episodes = parquet.read_table(lerobot / "meta/episodes").to_pylist()
    for place, episode in enumerate(episodes):
        span = range(episode["dataset_from_index"], episode["dataset_to_index"])
        assert {rows[index]["episode_index"] for index in span} == {place}
        assert episode["data/file_index"] == place // 2


def test_lerobot_frames_are_what_was_seen_and_done(lerobot: Path) -> None:
    policy = load_policy("NaoInstruct-v1")
    rows = parquet.read_table(lerobot / "data").to_pylist()
    tasks = parquet.read_table(lerobot / "meta/tasks.parquet").to_pylist()
    named = {task["task_index"]: task["task"] for task in tasks}
    size = {"height": 32, "width": 16}
    env = gym.make(policy.env_id, **policy.env_kwargs)
    larger = gym.make(policy.env_id, **{**policy.env_kwargs, "sensor_configs": size})
    try:
        obs, _ = env.reset(seed=SEED)
        base: Any = env.unwrapped
        assert named[rows[0]["task_index"]] == base.get_language_instruction()[0]
        seen, _ = larger.reset(seed=SEED)
        for view, camera in seen["sensor_data"].items():
            drawn = rows[0][f"observation.images.{view}"]["bytes"]
            picture = np.array(Image.open(io.BytesIO(drawn)), dtype=int)
            assert picture.shape == (32, 16, 3)
            assert np.abs(picture - camera["rgb"][0].numpy()).max() <= 2
        for row in rows[:3]:
            state = obs["agent"]["proprioception"][0]
            np.testing.assert_array_equal(row["observation.state"], state)
            action = policy.act(obs)
            np.testing.assert_allclose(row["action"], action[0], atol=1e-6)
            obs, reward, *_ = env.step(action)
            assert row["next.reward"] == pytest.approx(float(reward[0]))
    finally:
        env.close()
        larger.close()


def test_lerobot_statistics_are_those_of_all_frames(lerobot: Path) -> None:
    found = json.loads((lerobot / "meta/stats.json").read_text())
    table = parquet.read_table(lerobot / "data")
    actions = np.array(table["action"].to_pylist())
    views = table["observation.images.top_camera"].to_pylist()
    views = [np.array(Image.open(io.BytesIO(view["bytes"]))) / 255 for view in views]
    for name, measure in {"mean": np.mean, "std": np.std, "max": np.max}.items():
        expected = measure(actions, axis=0)
        np.testing.assert_allclose(found["action"][name], expected, atol=1e-6)
        expected = measure(np.stack(views), axis=(0, 1, 2))[:, None, None]
        camera = found["observation.images.top_camera"]
        np.testing.assert_allclose(camera[name], expected, atol=1e-6)
    assert found["action"]["count"] == [3 * STEPS]


def test_a_folder_that_is_in_use_is_refused(policy: Policy, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(ConfigError, match="folder of the dataset: got .*empty one"):
        ir_maniskill.collect(policy, tmp_path, episodes=1)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_lerobot_tells_what_to_install(
    policy: Policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.delitem(sys.modules, lerobot_format.__name__)
    with pytest.raises(ConfigError, match=r"pip install 'ir-maniskill\[lerobot\]'"):
        ir_maniskill.collect(policy, tmp_path / "new", form="lerobot", episodes=1)
    assert not (tmp_path / "new").exists()
