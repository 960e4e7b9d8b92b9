"""Record trajectories, and play them again with ManiSkill's own replay.

    python examples/record_and_replay.py [--task NaoTouchCubeShuffled-v1]
    python examples/record_and_replay.py --use-states
    python examples/record_and_replay.py --obs-mode rgb

On the CPU the actions of an episode that began with `reset(seed=...)` lead to the same
states, bit for bit. The last line records without pictures, which is quick, and adds
them in the replay.
"""

from pathlib import Path

import gymnasium as gym
import h5py
import numpy as np
import tyro
from mani_skill.trajectory import replay_trajectory
from mani_skill.utils.wrappers import RecordEpisode

import ir_maniskill  # noqa: F401 - registers the tasks, for the replay as well


def record(task: str, episodes: int, folder: Path) -> Path:
    """Play random actions; return the file of what happened (beside it, a .json)."""
    env = gym.make(
        task,
        obs_mode="none",
        control_mode="pd_joint_target_delta_pos",
        # For replays with pictures: these shaders are quick, and draw without light.
        sensor_configs={"width": 64, "height": 128, "shader_pack": "trivial"},
    )
    env = RecordEpisode(env, str(folder), trajectory_name="recorded", save_video=False)
    for episode in range(episodes):
        env.reset(seed=episode)
        env.action_space.seed(episode)
        done = False
        while not done:
            done = bool(env.step(env.action_space.sample())[3])
    env.close()
    return folder / "recorded.h5"


def replay(recorded: Path, use_states: bool, obs_mode: str | None = None) -> Path:
    """Play a file again, by its actions or its states; return the new file."""
    arguments = replay_trajectory.Args(
        str(recorded),
        obs_mode=obs_mode,
        use_env_states=use_states,
        save_traj=True,
        record_rewards=True,
        allow_failure=True,  # else only episodes that end in success are kept
    )
    replay_trajectory.main(arguments)
    replays = recorded.parent.glob(f"{recorded.stem}.*.h5")
    return max(replays, key=lambda path: path.stat().st_mtime)


def compare(first: h5py.Group, second: h5py.Group) -> str:
    """Say by how much two episodes are apart at most, after each of their actions."""
    reward = np.abs(first["rewards"][:] - second["rewards"][:]).max()
    actors = [episode["env_states/actors"] for episode in (first, second)]
    moved = [actors[0][name][1:, :3] - actors[1][name][1:, :3] for name in actors[0]]
    return f"rewards {reward:g}, places of objects {1000 * np.abs(moved).max():g} mm"


def main(
    task: str = "NaoTouchCubeShuffled-v1",
    episodes: int = 3,
    use_states: bool = False,
    obs_mode: str | None = None,
    out: Path = Path("runs/trajectories"),
) -> None:
    """Record, replay and compare."""
    recorded = record(task, episodes, out)
    replayed = replay(recorded, use_states, obs_mode)
    print(f"{recorded} and {replayed} differ by at most:")
    with h5py.File(recorded) as first, h5py.File(replayed) as second:
        for name in first:
            print(f"{name}: {compare(first[name], second[name])}")


if __name__ == "__main__":
    tyro.cli(main)
