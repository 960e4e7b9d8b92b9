"""A worker process of `ProcessVectorEnv`: several envs that step one after another."""

from __future__ import annotations

import contextlib
import gc
import os
import pickle
import signal
import traceback
from multiprocessing import reduction
from multiprocessing.connection import Connection
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from ir_maniskill.environment import senses
from ir_maniskill.environment.robots.robot import Robot
from ir_maniskill.environment.senses import Term
from ir_maniskill.environment.shared_rows import SharedRows, record_of
from ir_maniskill.experiment import Experiment

ENDS = ("terminated", "truncated")
"""How an episode can end, each a field of what is shared."""


IMPORTABLE = (
    "worker processes import goals, senses and robots of your own: define them at the "
    "top level of a .py file"
)
"""What to do where one cannot be pickled."""


def work(pipe: Connection, environ: dict[str, str]) -> None:
    """Run a worker: answer commands until the parent closes the pipe or is gone."""
    # The fork server still has the environment variables of when it was started.
    os.environ.clear()
    os.environ.update(environ)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    torch.set_num_threads(1)
    # Mesa reads it at the first picture. Workers keep all cores busy, so more threads
    # for drawing would cost more than they gain.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    worker = _Worker(pipe)
    with contextlib.suppress(EOFError, OSError):
        while True:
            pipe.send_bytes(worker.answer(pipe.recv_bytes()))


class _Worker:
    """The envs of one process; its methods are the commands that it takes."""

    _rows: list[int]
    _envs: list[Any]
    _shared: SharedRows

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe

    def make(
        self,
        argument: tuple[
            Experiment, type[Robot], tuple[Term, ...], list[int], dict[str, Any]
        ],
    ) -> Any:
        """Make the envs; the first worker describes them for all."""
        from ir_maniskill.registration import register

        experiment, _, terms, self._rows, kwargs = argument
        for term in terms:
            senses.register(term)
        register(experiment)
        self._envs = [gym.make(experiment.id, **kwargs) for _ in self._rows]
        # ManiSkill collects garbage whenever it rebuilds a scene, as seeded resets do.
        # What is alive now stays alive: leave it out of the search.
        gc.freeze()
        return self._description() if self._rows[0] == 0 else None

    def _description(self) -> tuple[np.dtype, gym.Space, gym.Space]:
        """Return the layout of an env's row in shared memory, and its spaces."""
        env = self._envs[0]
        obs, info = env.reset(seed=0)
        sample = {"obs": obs, "info": info, "final_obs": obs, "final_info": info}
        sample |= {name: np.zeros(1, bool) for name in ENDS}
        sample["reward"] = np.zeros(1, np.float32)
        sample["action"] = env.action_space.sample()[None]
        space = env.unwrapped.single_observation_space
        return record_of(sample), space, env.unwrapped.single_action_space

    def attach(self, argument: tuple[np.dtype, int]) -> None:
        """Map the shared memory."""
        descriptor = reduction.recv_handle(self._pipe)
        self._shared = SharedRows(descriptor, *argument)
        os.close(descriptor)

    def reset(self, argument: list[tuple[int | None, dict]]) -> None:
        """Reset every env with its seed and options."""
        for index, (seed, options) in enumerate(argument):
            self._reset(index, seed, options)

    def _reset(self, index: int, seed: int | None, options: dict | None) -> None:
        obs, info = self._envs[index].reset(seed=seed, options=options)
        self._shared.write(self._rows[index], {"obs": obs, "info": info})

    def step(self, _: None) -> None:
        """Step every env, and reset it if its episode is over."""
        actions = self._shared.views["action"]
        for index, (row, env) in enumerate(zip(self._rows, self._envs, strict=True)):
            obs, reward, terminated, truncated, info = env.step(actions[row])
            ends = {"reward": reward, "terminated": terminated, "truncated": truncated}
            if terminated or truncated:
                self._shared.write(row, ends | {"final_obs": obs, "final_info": info})
                self._reset(index, None, None)
            else:
                self._shared.write(row, ends | {"obs": obs, "info": info})

    def call(self, argument: tuple[str, tuple, dict]) -> list:
        """Call a method of every env, or get an attribute."""
        name, args, kwargs = argument
        found = [env.get_wrapper_attr(name) for env in self._envs]
        return [each(*args, **kwargs) if callable(each) else each for each in found]

    def answer(self, message: bytes) -> bytes:
        """Return whether the command could be done, and its result or what failed."""
        try:
            name, argument = pickle.loads(message)
        except (AttributeError, ImportError) as error:
            return pickle.dumps((False, f"{error}; {IMPORTABLE}"))
        try:
            return pickle.dumps((True, getattr(self, name)(argument)))
        except Exception:
            return pickle.dumps((False, traceback.format_exc()))
