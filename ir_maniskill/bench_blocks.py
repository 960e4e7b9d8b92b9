"""What the benchmark steps: blocks of work that return how long a step took [s].

Run as a program it makes the blocks it is asked for, one name a line. `bench.against`
runs it with another revision of the project, so it uses what all revisions have.
"""

from __future__ import annotations

import csv
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from ir_maniskill import make_vec

OURS = "NaoTouchCubeTriangle-v1"
SHADER = "unlit"
"""Shader pack of all pictures: the cheapest."""
SIDE = 128
"""Height and width of the pictures that are compared [pixel]."""
EPISODE = 32
"""Steps of an episode of ours."""
ENVS_EACH = 8
"""Envs of each worker process, as in a training with default settings on two cores."""
Block = Callable[[], float]
"""Makes some steps and returns how long one of them took [s]."""
BLOCKS: dict[str, Callable[[], Block]] = {
    f"one env, two {SIDE} x {SIDE} pictures": lambda: Stepping(make(OURS), EPISODE),
    f"{2 * ENVS_EACH} envs, 2 processes, pictures 64 x 32": lambda: stepping_many(
        make_many(2 * ENVS_EACH, 2)
    ),
    "training, preset `default`": lambda: (
        lambda: statistics.mean(sum(times) for times in training(1))
    ),
}
"""What is compared with another revision."""


def timed(work: Callable[[], Any], steps: int) -> float:
    """Return how long a step of this work takes [s]."""
    start = time.perf_counter()
    work()
    return (time.perf_counter() - start) / steps


def make(task: str, obs_mode: str = "rgb") -> Any:
    """Make one env on the CPU and step it once, which compiles its shaders."""
    cameras = {"width": SIDE, "height": SIDE, "shader_pack": SHADER}
    kwargs: dict[str, Any] = {"sim_backend": "physx_cpu", "render_backend": "cpu"}
    kwargs["sensor_configs"] = cameras if obs_mode == "rgb" else {}
    env = gym.make(task, obs_mode=obs_mode, **kwargs)
    env.reset(seed=0)
    env.step(actions(env, 1)[0])
    return env


def make_many(num_envs: int, workers: int) -> Any:
    """Make a vector of envs with small pictures."""
    kwargs: dict[str, Any] = {"obs_mode": "rgb", "sim_backend": "physx_cpu"}
    kwargs["sensor_configs"] = {"width": 32, "height": 64, "shader_pack": SHADER}
    return make_vec(OURS, num_envs, num_workers=workers, **kwargs)


def actions(env: Any, steps: int) -> np.ndarray:
    """Return pinned random actions [T, J]."""
    env.action_space.seed(0)
    return np.stack([env.action_space.sample() for _ in range(steps)])


class Stepping:
    """A block that steps one env, episode after episode; resets are not timed."""

    def __init__(self, env: Any, steps: int) -> None:
        """Plan the actions of an episode, of which a block makes some steps."""
        length = env.spec.max_episode_steps or EPISODE
        self._env, self._steps, self._done = env, steps, length
        self._plan = actions(env, length)

    def __call__(self) -> float:
        """Return the time of a step [s]."""
        if self._done + self._steps > len(self._plan):
            self._env.reset()
            self._done = 0
        part = self._plan[self._done : self._done + self._steps]
        self._done += self._steps
        return timed(lambda: [self._env.step(action) for action in part], self._steps)


def stepping_many(envs: Any) -> Block:
    """Return a block that steps all envs of a vector for an episode."""
    plan = torch.rand(EPISODE, *envs.action_space.shape) * 2 - 1
    envs.reset(seed=0)
    return lambda: timed(
        lambda: [envs.step(action) for action in plan], EPISODE * envs.num_envs
    )


def training(updates: int) -> Iterator[tuple[float, float]]:
    """Train with the default preset; return what its log says of each update.

    Returns:
        Time of collecting and of learning, of each step [s].
    """
    from ir_maniskill.training.config import CONFIGS
    from ir_maniskill.training.train import train

    config = CONFIGS["default"]
    steps = config.steps_per_update
    brief = {"total_steps": updates * steps, "eval_episodes": 3, "lenient_steps": 0}
    known = {field.name for field in fields(config)}  # 0.1 has `lenient_steps`
    changes: dict[str, Any] = {k: v for k, v in brief.items() if k in known}
    with tempfile.TemporaryDirectory() as folder:
        train(replace(config, env_id=OURS, out=folder, **changes))
        with (Path(folder) / "metrics.csv").open() as file:
            rows = list(csv.DictReader(file))
    for row in rows:
        yield float(row["time/collect"]) / steps, float(row["time/update"]) / steps


def serve() -> None:
    """Answer each name of a block with the time of a step [s]."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what trainings print is no answer
    made: dict[str, Block] = {}
    for line in sys.stdin:
        name = line.rstrip("\n")
        try:
            block = made[name] = made.get(name) or BLOCKS[name]()
            print(block(), file=answers, flush=True)
        except Exception as error:  # the other side says what went wrong
            print(repr(error), file=answers, flush=True)


if __name__ == "__main__":
    serve()
