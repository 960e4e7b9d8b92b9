"""CPU vector env: worker processes that each step several envs.

Observations, rewards and infos cross process borders in one block of shared memory;
pipes carry only commands. Legend: N envs, J joints.
"""

from __future__ import annotations

import contextlib
import multiprocessing as mp
import os
import pickle
import sys
from collections.abc import Sequence
from multiprocessing import reduction
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from ir_maniskill.environment import senses
from ir_maniskill.environment.arguments import action_of, options_of, seeds_of
from ir_maniskill.environment.host_tensor import HostTensor
from ir_maniskill.environment.robots import Nao
from ir_maniskill.environment.robots.robot import robot_class
from ir_maniskill.environment.shared_rows import SharedRows, Tree, map_leaves, reserve
from ir_maniskill.environment.worker import ENDS, IMPORTABLE, work
from ir_maniskill.experiment import Experiment

Observation = Any
"""A tree, or in obs_mode "state" one tensor: what a single env gives."""

Step = tuple[Observation, Tensor, Tensor, Tensor, Tree]
"""Observation, reward [N], terminated [N], truncated [N], info."""

FIRST_SEED = 2022
"""Seed of the first reset if it has none, as of ManiSkill's own envs."""

GRACE = 5.0
"""How long workers that wait for a command may take to end [s]."""


class WorkerError(RuntimeError):
    """Worker processes cannot be started, or one failed, died or hangs."""


class ProcessVectorEnv(VectorEnv):
    """N envs on the CPU, spread evenly over worker processes; `make_vec` makes one.

    Scripts that do so must guard their entry with `if __name__ == "__main__":`, as
    always with processes that are not forked.
    """

    device = torch.device("cpu")
    _shared: SharedRows

    def __init__(
        self,
        experiment: Experiment,
        num_envs: int,
        num_workers: int | None = None,
        env_kwargs: dict[str, Any] | None = None,
        timeout: float = 180.0,
    ) -> None:
        """Start the workers and make their envs; the arguments are `make_vec`'s."""
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        cores = len(os.sched_getaffinity(0))
        workers = min(num_envs, num_workers or cores)
        self.num_envs, self._timeout = num_envs, timeout
        self.env_kwargs = env_kwargs or {}
        """What the envs were made with."""
        self.experiment = experiment.in_split(
            *map(self.env_kwargs.get, ("split", "kinds"))
        )
        self._rows = [r.tolist() for r in np.array_split(np.arange(num_envs), workers)]
        self._pipes: list[Connection] = []
        self._processes: list[mp.process.BaseProcess] = []
        self._seeded = False
        """Whether the envs' random streams have been told apart."""
        self._busy = False
        """Whether answers to a command are still to come."""
        try:
            _require_main()
            self._start()
            self._make(experiment)
        except BaseException:
            self.close()
            raise

    def _start(self) -> None:
        context = mp.get_context("forkserver")
        context.set_forkserver_preload(["ir_maniskill"])
        for index in range(len(self._rows)):
            name = f"ir-maniskill-worker-{index}"
            try:
                ours, theirs = context.Pipe()
                process = context.Process(
                    target=work, args=(theirs, dict(os.environ)), name=name, daemon=True
                )
                process.start()
            except OSError as error:
                short = "AF_UNIX" in str(error)  # the name of a socket has 107 letters
                hint = "; set TMPDIR, where sockets are, to a shorter path"
                raise WorkerError(
                    f"cannot start {name} of {len(self._rows)} workers: {error}"
                    + short * hint
                ) from error
            theirs.close()
            self._pipes.append(ours)
            self._processes.append(process)

    def _make(self, experiment: Experiment) -> None:
        """Have the envs made, learn their spaces and hand out the shared memory."""
        # Reading the robot's class, a worker imports the module that registers it.
        robot = robot_class(self.env_kwargs.get("robot_uids", Nao.uid))
        known = experiment, robot, senses.registered()
        makes = [(*known, rows, self.env_kwargs) for rows in self._rows]
        record, *spaces = self._command("make", makes)[0]
        self.single_observation_space, self.single_action_space = spaces
        self.observation_space, self.action_space = (
            batch_space(space, self.num_envs) for space in spaces
        )
        with reserve(self.num_envs * record.itemsize) as file:
            self._shared = SharedRows(file.fileno(), record, self.num_envs)
            self._send("attach", [(record, self.num_envs)] * len(self._pipes))
            for pipe, process in zip(self._pipes, self._processes, strict=True):
                with contextlib.suppress(OSError):  # `_gather` tells who died
                    reduction.send_handle(pipe, file.fileno(), process.pid)
            self._gather()

    # -- VectorEnv -------------------------------------------------------------------

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict | None = None
    ) -> tuple[Observation, Tree]:
        """Start a new episode in every env.

        Args:
            seed: Env i gets seed + i, or the i-th of a list; None goes on with each
                env's own random stream, which begins with 2022 + i.
            options: "instruction": an index or a sentence for all envs, or a list,
                array or tensor of N; "reconfigure": a bool; "reset_to_env_states":
                states of N rows, or of one for all.

        Raises:
            ValueError: A seed or an option cannot be used; no env has been reset.
            WorkerError: A worker failed (another reset may do), died or hangs.
        """
        options = {} if options is None else options
        if seed is None and not self._seeded:
            seed = FIRST_SEED
        count = self.num_envs
        seeds = [None] * count if seed is None else seeds_of(seed, count)
        dealt = options_of(options, self.experiment, count)
        each = list(zip(seeds, dealt, strict=True))
        self._command("reset", [[each[row] for row in rows] for rows in self._rows])
        self._seeded = True
        return self._shared.read("obs"), self._shared.read("info")

    def step(self, actions: Tensor | np.ndarray) -> Step:
        """Step every env by its row of actions [N, J], and reset those that are done.

        Where an episode ends, info has what `final_infos` says of it.

        Raises:
            ValueError: The actions have another shape or are not finite.
            WorkerError: A worker failed, died or hangs.
        """
        self.step_async(actions)
        return self.step_wait()

    def step_async(self, actions: Tensor | np.ndarray) -> None:
        """Send the actions and return at once; `step_wait` must follow."""
        given = action_of(actions, self.action_space.shape or ()).cpu()
        if not given.isfinite().all():
            raise ValueError("action: got NaN or infinity, expected finite numbers")
        self._require_idle()
        self._shared.views["action"][:] = given.numpy()
        self._send("step", [None] * len(self._pipes))

    def step_wait(self) -> Step:
        """Wait for all workers and return what `step` returns."""
        if not self._busy:
            raise WorkerError("there is nothing to wait for: `step_async` comes first")
        self._gather()
        read = self._shared.read
        obs, info, *ends = map(read, ("obs", "info", "reward", *ENDS))
        done = ends[1] | ends[2]
        if done.any():
            info |= final_infos(read("final_obs"), read("final_info"), done)
        reward, terminated, truncated = (end.as_subclass(HostTensor) for end in ends)
        return obs, reward, terminated, truncated, info

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple:
        """Call the method of every env, or get the attribute: N results, copied.

        Raises:
            ValueError: All envs have one method of that name, which is to be used.
            WorkerError: There is none, it failed, or its result cannot be copied; or
                a worker died or hangs.
        """
        if name in ("reset", "step", "close"):
            raise ValueError(f"call: got {name!r}; use {name}() of all envs")
        answers = self._command("call", [(name, args, kwargs)] * len(self._pipes))
        return tuple(result for answer in answers for result in answer)

    def get_attr(self, name: str) -> tuple:
        """Return the attribute of each env (N values), as `call` does."""
        return self.call(name)

    def close_extras(self, **kwargs: Any) -> None:
        """End all workers; none is left behind, whatever state it is in."""
        for pipe in self._pipes:
            pipe.close()  # which ends a worker that waits for a command
        for process in self._processes:
            process.join(0.0 if self._busy else GRACE)
            if process.is_alive():
                process.kill()
                process.join()
        self._pipes, self._processes, self._busy = [], [], False
        self.__dict__.pop("_shared", None)

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
        # Pickled here: `send` would pass each tensor as a file descriptor.
        try:
            messages = [pickle.dumps((name, argument)) for argument in arguments]
        except (AttributeError, pickle.PicklingError) as error:
            raise WorkerError(f"{name}: {error}; {IMPORTABLE}") from error
        self._busy = True
        for index, message in enumerate(messages):
            try:
                self._pipes[index].send_bytes(message)
            except OSError:
                raise self._died(index) from None

    def _gather(self) -> list:
        """Collect one answer from every worker."""
        answers: list[bytes] = [b""] * len(self._pipes)
        asked: dict[Any, int] = {pipe: i for i, pipe in enumerate(self._pipes)}
        left = self._timeout
        while asked:
            ready = wait(list(asked), min(left, 1.0))
            # No clock: an hour in which all were stopped (Ctrl-Z) counts as a second.
            left -= 0.0 if ready else 1.0
            if left <= 0:
                names = ", ".join(map(self._describe, asked.values()))
                raise WorkerError(f"no answer within {self._timeout:g} s from {names}")
            for pipe in ready:
                index = asked.pop(pipe)
                try:
                    answers[index] = self._pipes[index].recv_bytes()
                except (EOFError, OSError):
                    raise self._died(index) from None
        self._busy = False
        results = [pickle.loads(answer) for answer in answers]
        for index, (done, result) in enumerate(results):
            if not done:
                raise WorkerError(f"{self._describe(index)} failed:\n{result}")
        return [result for _, result in results]

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


def final_infos(obs: Observation, info: Tree, done: Tensor) -> Tree:
    """Return what info says of ended episodes, under Gymnasium's and ManiSkill's names.

    These are `final_obs` and `final_observation` (the same tensors) and `final_info`,
    and `done` [N] bool under each of them with "_" before it. Rows of envs whose
    episode goes on are set to zero.
    """
    going = (~done).nonzero()[:, 0]
    for tree in (obs, info):
        map_leaves(lambda leaf: leaf.index_fill_(0, going, 0), tree)
    final = {"final_obs": obs, "final_observation": obs, "final_info": info}
    return final | {f"_{name}": done for name in final}


def _require_main() -> None:
    """Raise unless this process may have workers, and they can read its script."""
    if mp.current_process().daemon:
        raise WorkerError(
            "cannot start workers: this is a daemonic process, such as one of "
            "multiprocessing.Pool, which may have no others; "
            "use concurrent.futures.ProcessPoolExecutor"
        )
    main = sys.modules["__main__"]
    script = getattr(main, "__file__", None)
    if script is None or getattr(main, "__spec__", None) is not None:
        return  # a prompt or a module: there is no script that workers need
    folder = getattr(mp.process, "ORIGINAL_DIR", None) or ""
    if not Path(folder, script).is_file():
        raise WorkerError(
            f"cannot start workers: they must read the script, but {script} is no "
            "file; save what comes from standard input as one"
        )
