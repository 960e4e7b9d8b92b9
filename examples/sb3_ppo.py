"""Stable-Baselines3's PPO on one of our tasks.

    pip install -e '.[sb3]'
    python examples/sb3_ppo.py [--task NaoTouchCubeSingle-v1] [--steps 20000]

ManiSkill's `CPUGymWrapper` makes a plain Gymnasium env of numpy arrays of it; `make`
lays its nested observation out flat, which is what `MultiInputPolicy` reads. It makes
the tokens of the sentence one-hot, since their space is `MultiDiscrete`. Afterwards:

    ir-maniskill audit NaoTouchCubeSingle-v1 --policy examples.sb3_ppo:policy
"""

from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import tyro
from gymnasium.spaces import Box, Dict, MultiDiscrete
from gymnasium.wrappers import TransformObservation
from mani_skill.utils.wrappers import CPUGymWrapper
from stable_baselines3 import PPO

import ir_maniskill  # noqa: F401 - registers the tasks

OUT = Path("runs/sb3_ppo.zip")
KWARGS: dict[str, Any] = {
    "obs_mode": "rgb",
    "reward_mode": "dense",
    "control_mode": "pd_joint_target_delta_pos",
    "sensor_configs": {"width": 36, "height": 72, "shader_pack": "unlit"},
}
"""Its vision net takes no pictures that are less than 36 wide."""


def flatten(obs: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return the observation as one dict of arrays."""
    felt = [*obs["agent"].values(), obs["extra"]["touch"]]
    pictures = {name: data["rgb"] for name, data in obs["sensor_data"].items()}
    words = obs["extra"]["instruction"]
    return {**pictures, "body": np.concatenate(felt, axis=-1), "instruction": words}


def make(task: str, **env_kwargs: Any) -> gym.Env:
    """Make one env of a task as Stable-Baselines3 takes it."""
    env = CPUGymWrapper(gym.make(task, **KWARGS | env_kwargs))
    obs, _ = env.reset(seed=0)
    spaces: dict[str, gym.Space] = {
        name: Box(0, 255, leaf.shape, np.uint8)
        if leaf.dtype == np.uint8
        else Box(-np.inf, np.inf, leaf.shape, np.float32)
        for name, leaf in flatten(obs).items()
    }
    words = len(env.unwrapped.experiment.vocabulary)
    spaces["instruction"] = MultiDiscrete([words] * len(obs["extra"]["instruction"]))
    return TransformObservation(env, flatten, Dict(spaces))


def policy(obs: dict[str, Any]) -> np.ndarray:
    """Return the actions of the trained model for what a vector env observes."""
    rows = {name: np.asarray(leaf) for name, leaf in flatten(obs).items()}
    return trained().predict(rows, deterministic=True)[0]


policy.env_kwargs = KWARGS  # type: ignore[attr-defined]


@cache
def trained() -> PPO:
    """Return the trained model."""
    return PPO.load(OUT)


def main(
    task: str = "NaoTouchCubeSingle-v1",
    steps: int = 20_000,
    rollout: int = 1024,
    episodes: int = 20,
    out: Path = OUT,
) -> None:
    """Train, save the policy, and count what it touches."""
    env = make(task)
    model = PPO("MultiInputPolicy", env, n_steps=rollout, gamma=0.95, seed=0, verbose=1)
    model.learn(steps)
    model.save(out)
    touched = 0
    for seed in range(episodes):
        obs, info = env.reset(seed=seed)
        done = False
        while not done:
            action, _ = model.predict(obs, deterministic=True)
            obs, _, _, done, info = env.step(action)
        touched += bool(info["success_once"])
    print(f"{touched} of {episodes} episodes touched the right object; it is in {out}.")
    env.close()


if __name__ == "__main__":
    tyro.cli(main)
