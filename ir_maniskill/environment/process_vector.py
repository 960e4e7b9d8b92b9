"""CPU vector env: worker processes that each step several envs.

Observations, rewards and infos cross process borders in one block of shared memory;
pipes carry only commands. Legend: N envs.
"""

from __future__ import annotations

import contextlib
import gc
import multiprocessing as mp
import os
import signal
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.shared_memory import SharedMemory
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from ir_maniskill.experiment import Experiment

Tree = dict[str, Any]
"""Nested dicts with tensors or arrays as leaves."""

Observation = Any
"""A tree, or in obs_mode "state" one tensor: what a single env gives."""

Step = tuple[Observation, Tensor, Tensor, Tensor, Tree]
"""Observation, reward [N], terminated [N], truncated [N], info."""

FIRST_SEED = 2022
"""Seed of the first reset if it has none, as of ManiSkill's own envs."""


class WorkerError(RuntimeError):
    """A worker process failed, died or hangs; the message names it."""


@dataclass(frozen=True)
class _Leaf:
    """One array in the shared block."""

    path: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: str
    offset: int


class _SharedTree:
    """Named arrays [N, ...] in one block of shared memory."""

    ALIGNMENT = 64

    def __init__(self, leaves: list[_Leaf], memory: SharedMemory) -> None:
        self.leaves, self._memory = leaves, memory
        self.arrays = {
            leaf.path: np.ndarray(
                leaf.shape, leaf.dtype, buffer=memory.buf, offset=leaf.offset
            )
            for leaf in leaves
        }

    @classmethod
    def create(cls, sample: Tree, num_envs: int) -> _SharedTree:
        """Make room for N rows of every leaf of `sample`, whose leaves have one."""
        leaves, offset = [], 0
        for path, value in _walk(sample):
            shape = (num_envs, *value.shape[1:])
            leaves.append(_Leaf(path, shape, value.dtype.str, offset))
            size = int(np.prod(shape)) * value.dtype.itemsize
            offset += -(-size // cls.ALIGNMENT) * cls.ALIGNMENT
        return cls(leaves, SharedMemory(create=True, size=max(offset, 1)))

    @property
    def address(self) -> tuple[list[_Leaf], str]:
        """What another process needs to `attach`."""
        return self.leaves, self._memory.name

    @classmethod
    def attach(cls, address: tuple[list[_Leaf], str]) -> _SharedTree:
        leaves, name = address
        return cls(leaves, SharedMemory(name=name))

    def write(self, row: int, tree: Tree) -> None:
        """Copy the one row of `tree` to `row`."""
        for path, value in _walk(tree):
            self.arrays[path][row] = value[0]

    def read(self, *prefix: str) -> Any:
        """Return copies of the leaf at `prefix`, or, nested, of all below it."""
        if prefix in self.arrays:
            return torch.from_numpy(self.arrays[prefix].copy())
        tree: Tree = {}
        for path, array in self.arrays.items():
            if path[: len(prefix)] == prefix:
                *parents, name = path[len(prefix) :]
                node = tree
                for parent in parents:
                    node = node.setdefault(parent, {})
                node[name] = torch.from_numpy(array.copy())
        return tree

    def close(self, unlink: bool) -> None:
        self.arrays.clear()
        self._memory.close()
        if unlink:
            self._memory.unlink()


def _walk(tree: Tree, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple, np.ndarray]]:
    """Yield (path, array) of every tensor or array leaf."""
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from _walk(value, (*path, name))
        elif isinstance(value, Tensor):
            yield (*path, name), value.numpy()
        elif isinstance(value, np.ndarray):
            yield (*path, name), value


class ProcessVectorEnv(VectorEnv):
    """N envs on the CPU, spread evenly over worker processes.

    Scripts that make one must guard their entry with `if __name__ == "__main__":`,
    as always with processes that are not forked.
    """

    device = torch.device("cpu")
    _shared: _SharedTree

    def __init__(
        self,
        experiment: Experiment,
        num_envs: int,
        *,
        num_workers: int | None = None,
        env_kwargs: dict[str, Any] | None = None,
        timeout: float = 180.0,
    ) -> None:
        """Start the workers and make their envs.

        Args:
            experiment: What to make; sent to the workers, so that one registered by
                a user's script is known to them too.
            num_envs: Number of envs N.
            num_workers: Number of processes; None is one per core.
            env_kwargs: Passed to `gym.make`.
            timeout: How long a worker may take for one command [s].

        Raises:
            WorkerError: A worker could not make its envs.
        """
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        cores = len(os.sched_getaffinity(0))
        workers = min(num_envs, num_workers or cores)
        self.experiment, self.num_envs, self._timeout = experiment, num_envs, timeout
        self._rows = [r.tolist() for r in np.array_split(np.arange(num_envs), workers)]
        self._pipes: list[Connection] = []
        self._processes: list[mp.process.BaseProcess] = []
        self._seeded = False
        """Whether the envs' random streams have been told apart."""
        self._busy = False
        """Whether answers to a command are still to come."""
        try:
            self._start(env_kwargs or {})
            self._connect()
        except BaseException:
            self.close()
            raise

    def _start(self, env_kwargs: dict[str, Any]) -> None:
        """Start the workers, which make their envs and describe them."""
        context = mp.get_context("forkserver")
        context.set_forkserver_preload(["ir_maniskill"])
        for index, rows in enumerate(self._rows):
            ours, theirs = context.Pipe()
            process = context.Process(
                target=_work,
                args=(theirs, self.experiment, rows, env_kwargs, dict(os.environ)),
                name=f"ir-maniskill-worker-{index}",
                daemon=True,
            )
            process.start()
            theirs.close()
            self._pipes.append(ours)
            self._processes.append(process)

    def _connect(self) -> None:
        """Learn the spaces from the workers and lay out the shared memory."""
        samples = self._gather()
        sample, self.single_observation_space, self.single_action_space = samples[0]
        self.observation_space = batch_space(
            self.single_observation_space, self.num_envs
        )
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._shared = _SharedTree.create(sample, self.num_envs)
        self._command("attach", [self._shared.address] * len(self._pipes))

    # -- VectorEnv -------------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, Tree]:
        """Start a new episode in every env.

        Args:
            seed: Env i gets seed + i, or the i-th of a list; None goes on with each
                env's own random stream, which begins with 2022 + i.
            options: Passed to the envs; a list, array or tensor of N values is dealt
                out, one each, and so are states of N rows ("reset_to_env_states").

        Raises:
            ValueError: There are not N seeds, values of an option or rows of a state,
                or the options name some of the envs.
            WorkerError: A worker refused an option, failed, died or hangs; or it has
                not answered the last command.
        """
        if "env_idx" in (options or {}):
            raise ValueError(
                "options: got 'env_idx', expected none: worker processes reset all "
                "envs at once, and each by itself when its episode ends"
            )
        if seed is None and not self._seeded:
            seed = FIRST_SEED
        count = self.num_envs
        seeds = [None] * count if seed is None else seeds_of(seed, count)
        each = list(zip(seeds, _deal(options or {}, count), strict=True))
        self._command("reset", [[each[row] for row in rows] for rows in self._rows])
        self._seeded = True
        return self._shared.read("obs"), self._shared.read("info")

    def step(self, actions: Tensor | np.ndarray) -> Step:
        """Step every env and reset those that are done.

        Args:
            actions: One row per env [N, J] in [-1, 1].

        Returns:
            Observation, reward [N], terminated [N], truncated [N] and info.

        Raises:
            ValueError: The actions have another shape or are not finite.
            WorkerError: A worker failed, died or hangs, or has not answered the last
                command.
        """
        self.step_async(actions)
        return self.step_wait()

    def step_async(self, actions: Tensor | np.ndarray) -> None:
        """Send the actions and return at once; `step_wait` must follow.

        Args:
            actions: One row per env [N, J] in [-1, 1].

        Raises:
            ValueError: The actions have another shape or are not finite.
            WorkerError: A worker died, or has not answered the last command.
        """
        actions = np.asarray(actions, dtype=np.float32)
        expected = self.action_space.shape
        if actions.shape != expected:
            raise ValueError(f"actions: got shape {actions.shape}, expected {expected}")
        if not np.isfinite(actions).all():
            raise ValueError("actions: got NaN or infinity, expected finite numbers")
        self._require_idle()
        self._shared.arrays["action",][:] = actions
        self._send("step", [None] * len(self._pipes))

    def step_wait(self) -> Step:
        """Wait for all workers and return what `step` returns.

        Raises:
            WorkerError: `step_async` was not called, or a worker failed, died or hangs.
        """
        if not self._busy:
            raise WorkerError("there is nothing to wait for: `step_async` comes first")
        self._gather()
        shared = self._shared
        now = shared.read("now")
        info = shared.read("info")
        done = now["terminated"] | now["truncated"]
        if done.any():
            info["final_observation"] = shared.read("final", "obs")
            info["final_info"] = shared.read("final", "info")
            info["_final_observation"] = info["_final_info"] = done
        obs = shared.read("obs")
        return obs, now["reward"], now["terminated"], now["truncated"], info

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of every env, such as "dense_weights".

        Args:
            name: Of the attribute.
            values: A list, array or tensor of N values, one each, or one for all.

        Raises:
            ValueError: The list has not N values.
            WorkerError: A worker died or hangs, or has not answered the last command.
        """
        each = _values(name, values, self.num_envs)
        self._command(
            "set_attr", [(name, [each[row] for row in rows]) for rows in self._rows]
        )

    def close_extras(self, **kwargs: Any) -> None:
        """End all workers; none is left behind, whatever state it is in."""
        for pipe in self._pipes:
            with contextlib.suppress(OSError):
                pipe.send(("close", None))
            pipe.close()
        deadline = time.monotonic() + 5.0
        for process in self._processes:
            process.join(max(0.0, deadline - time.monotonic()))
            if process.is_alive():
                process.kill()
                process.join()
        self._pipes, self._processes = [], []
        shared = self.__dict__.pop("_shared", None)
        if shared is not None:
            shared.close(unlink=True)

    # -- Talking to the workers ------------------------------------------------------

    def _command(self, name: str, arguments: list) -> list:
        self._require_idle()
        self._send(name, arguments)
        return self._gather()

    def _require_idle(self) -> None:
        """Raise unless the workers wait for a command: answers must not get mixed."""
        if self.closed:
            raise WorkerError("these envs are closed: make new ones")
        if self._busy:
            raise WorkerError(
                "the last command has not been answered: `step_wait` must follow "
                "`step_async`; after an interrupt or an error close these envs and "
                "make new ones"
            )

    def _send(self, name: str, arguments: list) -> None:
        self._busy = True
        for index, (pipe, argument) in enumerate(
            zip(self._pipes, arguments, strict=True)
        ):
            try:
                pipe.send((name, argument))
            except OSError:
                raise self._died(index) from None

    def _gather(self) -> list:
        """Collect one answer from every worker."""
        answers: list = [None] * len(self._pipes)
        pending = set(range(len(self._pipes)))
        left = self._timeout
        while pending:
            # In short waits, for none to count an hour that all were stopped (Ctrl-Z).
            brief, start = min(left, 1.0), time.monotonic()
            ready = wait([self._pipes[index] for index in pending], brief)
            left -= min(time.monotonic() - start, brief)
            if not ready and left <= 0:
                names = ", ".join(self._describe(index) for index in sorted(pending))
                raise WorkerError(f"no answer within {self._timeout:g} s from {names}")
            for index in [i for i in pending if self._pipes[i] in ready]:
                pending.remove(index)
                try:
                    ok, answers[index] = self._pipes[index].recv()
                except (EOFError, OSError):
                    raise self._died(index) from None
                if not ok:
                    raise WorkerError(
                        f"{self._describe(index)} failed:\n{answers[index]}"
                    )
        self._busy = False
        return answers

    def _describe(self, index: int) -> str:
        rows = self._rows[index]
        return f"{self._processes[index].name} (envs {rows[0]} to {rows[-1]})"

    def _died(self, index: int) -> WorkerError:
        process = self._processes[index]
        process.join(1.0)
        return WorkerError(
            f"{self._describe(index)} died with exit code {process.exitcode}; "
            "a negative one is the signal that killed it (-9: often out of memory); "
            "with 1 its error stands above, and if that speaks of bootstrapping, guard "
            'the script\'s entry with `if __name__ == "__main__":`'
        )


def seeds_of(seed: int | Sequence[int], num_envs: int) -> list[int]:
    """Return the seeds of N envs: seed + i, or those of a sequence.

    Raises:
        ValueError: The sequence has not N of them.
    """
    if isinstance(seed, int | np.integer):
        return list(range(int(seed), int(seed) + num_envs))
    if len(seed) != num_envs:
        raise ValueError(f"seeds: got {len(seed)}, expected {num_envs}")
    return [int(each) for each in seed]


def _deal(options: dict[str, Any], num_envs: int) -> Iterator[dict[str, Any]]:
    """Yield the options of each env: its own of N values, else what all get."""
    values = {
        name: _values(f"reset option {name!r}", given, num_envs)
        for name, given in options.items()
    }
    for row in range(num_envs):
        yield {name: value[row] for name, value in values.items()}


def _values(what: str, given: Any, num_envs: int) -> list:
    """Return each env's value of what is given for all or one each.

    Of arrays of more dimensions, also in nested dicts, each gets its row [1, ...].
    """
    if isinstance(given, dict):
        dealt = {
            name: _values(f"{what}[{name!r}]", value, num_envs)
            for name, value in given.items()
        }
        return [{name: dealt[name][row] for name in dealt} for row in range(num_envs)]
    if isinstance(given, Tensor | np.ndarray):
        given = np.asarray(given)
        if given.ndim < 2:
            given = given.tolist()
        elif len(given) > 1:
            given = list(given[:, None])
    if not isinstance(given, list | tuple):
        return [given] * num_envs
    if len(given) != num_envs:
        raise ValueError(
            f"{what}: got {len(given)} values, expected {num_envs}, "
            "one for each env, or a single one for all"
        )
    return list(given)


class _Worker:
    """The envs of one process."""

    _shared: _SharedTree

    def __init__(
        self, experiment: Experiment, rows: list[int], env_kwargs: dict[str, Any]
    ) -> None:
        from ir_maniskill.registration import register

        register(experiment)
        self._rows = rows
        self._envs: list[Any] = [gym.make(experiment.id, **env_kwargs) for _ in rows]
        # ManiSkill collects garbage whenever it rebuilds a scene, which seeded resets
        # do; what is alive now stays alive, so there is no point in looking at it.
        gc.freeze()

    def describe(self) -> tuple[Tree, gym.Space, gym.Space]:
        """Return a one-row sample of all that is shared, and the spaces."""
        env = self._envs[0]
        obs, info = env.reset(seed=0)
        ends = {"terminated": np.zeros(1, bool), "truncated": np.zeros(1, bool)}
        record = {"obs": obs, "info": info}
        sample = {
            **record,
            "now": {"reward": np.zeros(1, np.float32), **ends},
            "final": record,
            "action": env.action_space.sample()[None],
        }
        space = env.unwrapped.single_observation_space
        return sample, space, env.unwrapped.single_action_space

    def attach(self, address: tuple) -> None:
        """Open the shared memory."""
        self._shared = _SharedTree.attach(address)

    def reset(self, arguments: list[tuple]) -> None:
        """Reset every env with its seed and options."""
        for index, (seed, options) in enumerate(arguments):
            self._reset(index, seed, options)

    def _reset(self, index: int, seed: int | None, options: dict | None) -> None:
        obs, info = self._envs[index].reset(seed=seed, options=options)
        self._shared.write(self._rows[index], {"obs": obs, "info": info})

    def set_attr(self, argument: tuple[str, list]) -> None:
        """Set an attribute of every env."""
        name, values = argument
        for env, value in zip(self._envs, values, strict=True):
            setattr(env.unwrapped, name, value)

    def step(self, _: None) -> None:
        """Step every env, and reset it if its episode is over."""
        actions = self._shared.arrays["action",]
        for index, (row, env) in enumerate(zip(self._rows, self._envs, strict=True)):
            obs, reward, terminated, truncated, info = env.step(actions[row])
            now = {"reward": reward, "terminated": terminated, "truncated": truncated}
            record = {"obs": obs, "info": info}
            self._shared.write(row, {"now": now})
            if terminated or truncated:
                self._shared.write(row, {"final": record})
                self._reset(index, None, None)
            else:
                self._shared.write(row, record)


def _work(
    pipe: Connection,
    experiment: Experiment,
    rows: list[int],
    env_kwargs: dict[str, Any],
    environ: dict[str, str],
) -> None:
    """Run a worker: answer commands until told to close or the parent is gone."""
    # The server that forks workers has those of the time when it was started.
    os.environ.clear()
    os.environ.update(environ)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    torch.set_num_threads(1)
    # Mesa reads it when the first picture is asked for: workers keep all cores busy, so
    # that drawing on further threads costs more than it gains.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    try:
        worker = _Worker(experiment, rows, env_kwargs)
        pipe.send((True, worker.describe()))
        while True:
            name, argument = pipe.recv()
            if name == "close":
                return
            pipe.send((True, getattr(worker, name)(argument)))
    except (EOFError, BrokenPipeError):
        return
    except Exception:
        pipe.send((False, traceback.format_exc()))
