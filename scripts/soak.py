"""Steps envs for long and checks that they hold on to nothing.

    python scripts/soak.py --steps 100000 --envs 1 4

One env is stepped in this process, more in worker processes. Every tenth episode starts
from a seed, which rebuilds the scene. Memory has to stay flat, and the number of open
files and of processes has to stay what it was.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import psutil

import ir_maniskill

SEEDED = 10
"""Every how many episodes one starts from a seed."""
SAMPLES = 50
"""How often usage is looked at."""
GROWTH = 0.05
"""How much memory may grow from the first to the last quarter, after warming up."""


@dataclass(frozen=True)
class Usage:
    """What this process and all that it started hold."""

    memory: int
    """Resident memory [byte]."""
    files: int
    """Open file descriptors."""
    processes: int
    """Processes."""

    @classmethod
    def now(cls) -> Usage:
        """Return the usage of this moment."""
        me = psutil.Process()
        family = [me, *me.children(recursive=True)]
        memory = sum(process.memory_info().rss for process in family)
        return cls(memory, sum(p.num_fds() for p in family), len(family))


def soak(envs: Any, steps: int) -> Iterator[Usage]:
    """Step `envs` with random actions; yield the usage `SAMPLES` times.

    Args:
        envs: One env, or a vector of envs that reset themselves.
        steps: How many steps.
    """
    envs.action_space.seed(0)
    envs.reset(seed=0)
    episodes = 0
    for step in range(1, steps + 1):
        truncated = envs.step(envs.action_space.sample())[3]
        if truncated.all():
            episodes += 1
            envs.reset(seed=step if episodes % SEEDED == 0 else None)
        if step % max(1, steps // SAMPLES) == 0:
            yield Usage.now()


def leaks(usages: list[Usage]) -> list[str]:
    """Return what grew, after a first third of warming up, in words."""
    kept = usages[len(usages) // 3 :]
    part = len(kept) // 4
    before, after = (
        statistics.median(usage.memory for usage in some)
        for some in (kept[:part], kept[-part:])
    )
    found = []
    if after > before * (1 + GROWTH):
        found.append(f"memory: {before / 1e6:.1f} MB grew to {after / 1e6:.1f} MB")
    for name in ("files", "processes"):
        first, last = (getattr(usage, name) for usage in (kept[0], kept[-1]))
        if last > first:
            found.append(f"{name}: {first} grew to {last}")
    return found


def make(task: str, num_envs: int, obs_mode: str) -> Any:
    """Make one env, or a vector of envs in worker processes."""
    kwargs: dict[str, Any] = {"obs_mode": obs_mode}
    if obs_mode == "state_dict":
        kwargs["render_backend"] = "none"
    else:
        kwargs["sensor_configs"] = {"width": 32, "height": 64, "shader_pack": "unlit"}
    if num_envs == 1:
        return gym.make(task, **kwargs)
    return ir_maniskill.make_vec(task, num_envs, sim_backend="physx_cpu", **kwargs)


def main() -> int:
    """Soak every number of envs asked for; return 1 if anything leaked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="NaoTouchCubeShuffled-v1")
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--envs", type=int, nargs="+", default=[1, 4])
    parser.add_argument("--obs-mode", default="state_dict", help="or rgb")
    options = parser.parse_args()
    leaked = False
    for num_envs in options.envs:
        envs = make(options.task, num_envs, options.obs_mode)
        usages = []
        for usage in soak(envs, options.steps):
            usages.append(usage)
            print(f"{num_envs} envs: {usage}", flush=True)
        envs.close()
        found = leaks(usages)
        leaked |= bool(found)
        print(f"{num_envs} envs: {'; '.join(found) or 'flat'}", flush=True)
    return int(leaked)


if __name__ == "__main__":
    sys.exit(main())
