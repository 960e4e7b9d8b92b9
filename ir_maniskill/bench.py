"""How fast the project is: steps/s beside something that does the same work.

Absolute speed says more about the machine than about the code. So whatever is compared
takes turns in short blocks, medians are taken, and the ratio is what counts.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from tqdm import tqdm

from ir_maniskill.checks import require
from ir_maniskill.environment.vector import make_vec
from ir_maniskill.evaluation.evaluate import machine, versions
from ir_maniskill.training.config import CONFIGS
from ir_maniskill.training.run_folder import whole_rows
from ir_maniskill.training.train import train

OURS = "NaoTouchCubeTriangle-v1"
PEER = "mani_skill.envs:UnitreeG1PlaceAppleInBowl-v1"
"""A humanoid task of ManiSkill's; it too looks through two cameras at 128 x 128."""
BARE = "physics and drawing alone"
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


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    what: str
    """What was measured."""
    speed: float
    """Its speed [steps/s]."""
    beside: str
    """What took turns with it."""
    speed_beside: float
    """The speed of that [steps/s]."""

    @property
    def ratio(self) -> float:
        """How many times as fast it is."""
        return self.speed / self.speed_beside

    def __str__(self) -> str:
        return (
            f"{self.what:42} {self.speed:8.1f}   {self.beside:32} "
            f"{self.speed_beside:8.1f} {self.ratio:7.2f}"
        )


@dataclass(frozen=True)
class Report:
    """All that one run of the benchmark found."""

    machine: dict[str, Any]
    """Where it was measured, and with which versions."""
    rows: tuple[Row, ...]
    """The table."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        rows = [asdict(row) | {"ratio": row.ratio} for row in self.rows]
        return {"machine": self.machine, "rows": rows}

    def __str__(self) -> str:
        facts = ", ".join(f"{name} {fact}" for name, fact in self.machine.items())
        head = f"{'':42} {'steps/s':>8}   {'beside':32} {'steps/s':>8} {'ratio':>7}"
        return "\n".join([facts, "", head, *map(str, self.rows)])


# -- The table -------------------------------------------------------------------------


def run(seconds: float = 10.0, quick: bool = False) -> Report:
    """Measure everything.

    Args:
        seconds: How long each comparison goes on [s].
        quick: Whether to measure as briefly as possible, without the peer, which takes
            long to load.
    """
    require(0 < seconds <= 600, "seconds", seconds, "more than 0, at most 600")
    seconds = 1.0 if quick else seconds
    jobs = (
        one_env("state", seconds, peer=not quick),
        one_env("rgb", seconds, peer=not quick),
        many_envs(seconds),
        learning(updates=1 if quick else 3),
    )
    rows = tuple(chain.from_iterable(tqdm(jobs, desc="bench")))
    load = {"load": round(os.getloadavg()[0], 1)}
    return Report(machine() | load | versions(), rows)


def one_env(obs_mode: str, seconds: float, peer: bool) -> Iterator[Row]:
    """Compare one env with the peer and, with pictures, with SAPIEN alone."""
    with ExitStack() as stack:
        env = stack.enter_context(closing(make(OURS, obs_mode)))
        blocks: dict[str, Block] = {OURS: Stepping(env, EPISODE)}
        if peer:
            other = stack.enter_context(closing(make(PEER, obs_mode)))
            # A block of the peer's pictures takes as long as one of ours: few steps.
            blocks[PEER] = Stepping(other, 2 if obs_mode == "rgb" else EPISODE)
        if obs_mode == "rgb":
            blocks[BARE] = BareLoop(env)
        speed = in_turn(blocks, seconds)
    kind = f"two {SIDE} x {SIDE} pictures" if obs_mode == "rgb" else "state"
    for name in list(blocks)[1:]:
        beside = name.split(":")[-1].removesuffix("-v1")
        yield Row(f"one env, {kind}", speed[OURS], beside, speed[name])


def many_envs(seconds: float) -> Iterator[Row]:
    """Compare a worker process on every core with one."""
    cores = len(os.sched_getaffinity(0))
    total = ENVS_EACH * cores
    cameras = {"width": 32, "height": 64, "shader_pack": SHADER}
    kwargs: dict[str, Any] = {"obs_mode": "rgb", "sensor_configs": cameras}
    with (
        closing(make_vec(OURS, total, num_workers=cores, **kwargs)) as envs,
        closing(make_vec(OURS, ENVS_EACH, num_workers=1, **kwargs)) as few,
    ):
        blocks = {"all": stepping_many(envs), "one": stepping_many(few)}
        speed = in_turn(blocks, seconds)
    what = f"{total} envs, {cores} processes, pictures 64 x 32"
    yield Row(what, speed["all"], f"{ENVS_EACH} envs, one process", speed["one"])


def learning(updates: int) -> Iterator[Row]:
    """Compare training with collecting alone, by the times that a run logs."""
    steps = CONFIGS["default"].ppo.steps_per_update
    with tempfile.TemporaryDirectory() as folder:
        train(OURS, out=folder, total_steps=updates * steps, eval_episodes=3)
        rows = whole_rows(Path(folder) / "metrics.csv")
    collect = [float(row["time/collect"]) for row in rows]  # [s] for each update
    both = [float(row["time/update"]) + t for row, t in zip(rows, collect, strict=True)]
    alone, speed = (steps / statistics.median(times) for times in (collect, both))
    yield Row("training, preset `default`", speed, "its envs and actions alone", alone)


# -- Timing ----------------------------------------------------------------------------


def in_turn(blocks: Mapping[str, Block], seconds: float) -> dict[str, float]:
    """Run the blocks in turn and return the median speed of each [steps/s].

    Whatever else runs on the machine slows all of them alike, so that ratios stay.

    Args:
        blocks: What to compare, by name; each runs three times at least.
        seconds: How long to go on.
    """
    samples: dict[str, list[float]] = {name: [] for name in blocks}
    end = time.perf_counter() + seconds
    while min(map(len, samples.values())) < 3 or time.perf_counter() < end:
        for name, block in blocks.items():
            samples[name].append(block())
    return {name: 1 / statistics.median(times) for name, times in samples.items()}


def timed(work: Callable[[], Any], steps: int) -> float:
    """Return how long a step of this work takes [s]."""
    start = time.perf_counter()
    work()
    return (time.perf_counter() - start) / steps


# -- Blocks ----------------------------------------------------------------------------


def make(task: str, obs_mode: str) -> Any:
    """Make one env on the CPU and step it once, which compiles its shaders."""
    cameras = {"width": SIDE, "height": SIDE, "shader_pack": SHADER}
    kwargs: dict[str, Any] = {"sim_backend": "physx_cpu", "render_backend": "cpu"}
    kwargs["sensor_configs"] = cameras if obs_mode == "rgb" else {}
    env = gym.make(task, obs_mode=obs_mode, **kwargs)
    env.reset(seed=0)
    env.step(actions(env, 1)[0])
    return env


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


class BareLoop:
    """A block that drives an env's SAPIEN objects as a program without ManiSkill would.

    The joints get the targets that the env gives them for the actions of `Stepping`,
    so that the physics is the same; the same two pictures are drawn and fetched.
    """

    def __init__(self, env: Any) -> None:
        """Record the targets of one episode."""
        base, self._env = env.unwrapped, env
        self._substeps = base.sim_freq // base.control_freq
        self._physics, (self._scene,) = base.scene.px, base.scene.sub_scenes
        sensors = base.scene.sensors.values()
        self._cameras = [sensor.camera._render_cameras[0] for sensor in sensors]
        self._joints = [joint._objs[0] for joint in base.agent.controller.joints]
        self._targets: list[list[float]] = []
        env.reset()
        for action in actions(env, EPISODE):
            env.step(action)
            self._targets.append(base.agent.controller.target[0].tolist())

    def __call__(self) -> float:
        """Return the time of a step [s]."""
        self._env.reset()
        return timed(self._episode, EPISODE)

    def _episode(self) -> None:
        for targets in self._targets:
            for joint, target in zip(self._joints, targets, strict=True):
                joint.set_drive_target(target)
            for _ in range(self._substeps):
                self._physics.step()
            self._scene.update_render()
            for camera in self._cameras:
                camera.take_picture()
            for camera in self._cameras:
                camera.get_picture("Color")
