"""Random actions: make a task, step it, film it.

    python examples/random_actions.py [--task NaoTouchCubeMulti-v1] [--episodes 1]

Prints what each episode asked for and what chance made of it. The videos are written
by ManiSkill's own `RecordEpisode`.
"""

from pathlib import Path

import gymnasium as gym
import tyro
from mani_skill.utils.wrappers import RecordEpisode

import ir_maniskill  # noqa: F401 - registers the tasks


def main(
    task: str = "NaoTouchCubeTriangle-v1",
    episodes: int = 2,
    out: Path = Path("runs/random_actions"),
) -> None:
    """Play episodes with random joint targets and film them."""
    env = gym.make(
        task,
        obs_mode="rgb",
        render_mode="rgb_array",
        sensor_configs={"width": 64, "height": 128},
        human_render_camera_configs={"width": 512, "height": 384},
    )
    env = RecordEpisode(env, str(out), save_trajectory=False, video_fps=20)
    for episode in range(episodes):
        env.reset(seed=episode)
        env.action_space.seed(episode)
        total, done = 0.0, False
        while not done:
            _, reward, _, truncated, info = env.step(env.action_space.sample())
            total, done = total + float(reward), bool(truncated)
        sentence = env.unwrapped.get_language_instruction()[0]
        touched = "touched" if info["success_once"] else "not touched"
        print(f"{sentence:<24} {touched:<12} return {total:.1f}")
    env.close()
    print(f"The videos are in {out}.")


if __name__ == "__main__":
    tyro.cli(main)
