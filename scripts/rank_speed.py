"""Measures what sharing the updates of a training among ranks brings.

    python scripts/rank_speed.py
    torchrun --nproc-per-node 2 scripts/rank_speed.py

Each rank has one simulator process and one thread, which work in turns: with a core for
each rank, the wall time of an update is the CPU time of the two, and waiting for the
others. On a machine that is busy otherwise only the CPU time can be compared.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import tempfile
import time
from pathlib import Path

import psutil
import torch

from ir_maniskill.environment.vector import make_vec
from ir_maniskill.training import distributed
from ir_maniskill.training.config import CONFIGS
from ir_maniskill.training.run_folder import RunFolder
from ir_maniskill.training.train import Trainer


def cpu_time() -> float:
    """Return the CPU time of this rank and of its simulator so far [s]."""
    me = psutil.Process()
    times = [process.cpu_times() for process in (me, *me.children(recursive=True))]
    return sum(spent.user + spent.system for spent in times)


def measure(trainer: Trainer, updates: int) -> tuple[float, float]:
    """Return the medians of the CPU time of the busiest rank and of the wall time [s].

    Args:
        trainer: What this rank trains with.
        updates: How many updates to measure, after one to warm up.
    """
    trainer.update()
    samples = []
    for _ in range(updates):
        cpu, wall = cpu_time(), time.perf_counter()
        trainer.update()
        sample = torch.tensor([cpu_time() - cpu, time.perf_counter() - wall])
        samples.append(distributed.gather(sample[None]).amax(dim=0).tolist())
    cpu, wall = (statistics.median(column) for column in zip(*samples, strict=True))
    return cpu, wall


def main() -> None:
    """Measure the updates of the default config, and let the first rank say it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="NaoTouchCubeTriangle-v1")
    parser.add_argument("--updates", type=int, default=5)
    options = parser.parse_args()
    with distributed.group(), tempfile.TemporaryDirectory() as out:
        numbers = {"env_id": options.task, "out": out, "num_workers": 1, "threads": 1}
        config = dataclasses.replace(CONFIGS["default"], **numbers)
        share = config.num_envs // distributed.size()
        kwargs = config.env_kwargs(training=True)
        envs = make_vec(config.env_id, share, num_workers=1, **kwargs)
        folder = RunFolder(Path(out), resume=False)
        folder.begin(config, 0)
        cpu, wall = measure(Trainer(config, envs, folder), options.updates)
        if distributed.rank() == 0:
            print(
                f"{distributed.size()} rank(s), {config.steps_per_update} steps an "
                f"update: {cpu:.2f} s of CPU in the busiest rank, {wall:.2f} s of wall"
            )
        folder.close()
        envs.close()


if __name__ == "__main__":
    main()
