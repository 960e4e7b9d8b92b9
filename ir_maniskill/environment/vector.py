"""Vectorized envs: one factory for GPU-batched and CPU multi-process envs.

Both give torch tensors with the same keys, shapes, dtypes and the same end of an
episode: an env that is done is reset in the same step, and `info` holds what
`final_infos` says of the ended episode.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import torch
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv
from torch import Tensor

from ir_maniskill import experiment as catalog
from ir_maniskill.checks import require, require_whole
from ir_maniskill.environment.arguments import (
    RESET_OPTIONS,
    require_names,
    seeds_of,
    simulator_of,
)
from ir_maniskill.environment.process_vector import ProcessVectorEnv, Step, final_infos


def make_vec(
    task_id: str,
    num_envs: int,
    *,
    num_workers: int | None = None,
    timeout: float = 180.0,
    sim_backend: str = "physx_cpu",
    **env_kwargs: Any,
) -> VectorEnv:
    """Make `num_envs` envs that step together.

    Args:
        task_id: A registered task id.
        num_envs: Number of envs N.
        num_workers: Worker processes on the CPU; None is one per core.
        timeout: How long a worker process may take for one command [s].
        sim_backend: "physx_cpu" (processes), "physx_cuda" (one process, batched; ":0"
            behind it names a device), ManiSkill's other names of these, or "auto":
            CUDA where torch sees a device, else processes.
        **env_kwargs: As for `gym.make(task_id)`.

    Raises:
        ExperimentError: There is no task of that id, or it has no such split.
        ValueError: A number is out of range, or there is no such backend here.
        WorkerError: Worker processes cannot be started, or one failed to make its envs.
        OSError: There is too little shared memory.
    """
    experiment = catalog.get(task_id)
    require_whole("num_envs", num_envs, 1)
    if num_workers is not None:
        require_whole("num_workers", num_workers, 1)
    waits = isinstance(timeout, float | int) and timeout > 0
    require(waits, "timeout", timeout, "more than 0 [s]")
    if (simulator := simulator_of(sim_backend)) == "physx_cuda":
        # ManiSkill takes "auto" for the cores where there is one env.
        named = simulator if sim_backend == "auto" else sim_backend
        return GpuVectorEnv(task_id, num_envs, sim_backend=named, **env_kwargs)
    return ProcessVectorEnv(experiment, num_envs, num_workers, env_kwargs, timeout)


class GpuVectorEnv(ManiSkillVectorEnv):
    """ManiSkill's GPU-batched vector env with our seeding: env i gets seed + i.

    Not yet run on a GPU.
    """

    def __init__(self, task_id: str, num_envs: int, **env_kwargs: Any) -> None:
        """Make the batched env; the arguments are those of `make_vec`."""
        self.env_kwargs = env_kwargs
        env = gym.make(task_id, num_envs=num_envs, **env_kwargs)
        super().__init__(env, ignore_terminations=True)
        self.experiment = self.base_env.experiment

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict | None = None
    ) -> tuple[dict, dict]:
        """Start a new episode in all envs, or in those of the option "env_idx" [b].

        Raises:
            ValueError: An option or a seed cannot be used, or a seed comes with
                "env_idx": ManiSkill would start the other envs' random streams anew.
        """
        options = {} if options is None else options
        require_names(options, (*RESET_OPTIONS, "env_idx"))
        options = dict(options)
        if "env_idx" in options:
            if seed is not None:
                raise ValueError(
                    f"seed: got {seed} for some of the envs, expected None with the "
                    "option 'env_idx'; leave 'env_idx' out to seed all envs"
                )
            options["env_idx"] = torch.as_tensor(options["env_idx"], device=self.device)
        seeds = None if seed is None else seeds_of(seed, self.num_envs)
        return super().reset(seed=seeds, options=options)

    def step(self, actions: Any) -> Step:
        """Step all envs and reset those that are done, as `ProcessVectorEnv` does."""
        obs, reward, terminated, truncated, info = super().step(actions)
        if "final_info" in info:
            obs_then, info_then = info["final_observation"], info["final_info"]
            info |= final_infos(obs_then, info_then, info["_final_info"])
        return obs, reward, terminated, truncated, info

    def get_attr(self, name: str) -> Any:
        """Return the attribute, which all envs of the batch share."""
        return self._env.get_wrapper_attr(name)


def info_of_step(info: dict[str, Any], done: Tensor) -> dict[str, Tensor]:
    """Return what was measured after the step, also where a new episode has begun.

    Rows of `final_info` whose episode goes on are stale: those of `info` count.
    """
    if "final_info" not in info:
        return info
    final, merged = info["final_info"], {}
    for name, value in final.items():
        if isinstance(value, Tensor) and isinstance(info.get(name), Tensor):
            rows = done.view(-1, *[1] * (value.ndim - 1))
            merged[name] = torch.where(rows, value, info[name])
    return merged


VectorEnv = GpuVectorEnv | ProcessVectorEnv
"""What `make_vec` makes."""
