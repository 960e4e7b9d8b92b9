"""How cost grows: `python -m ir_maniskill.bench.scaling` draws it for the docs."""

from __future__ import annotations

import argparse
import json
import os
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from ir_maniskill import experiment as catalog
from ir_maniskill.bench.run import SHADER
from ir_maniskill.bench.simulation import OURS
from ir_maniskill.bench.timing import timed
from ir_maniskill.environment.process_vector import ProcessVectorEnv
from ir_maniskill.experiment import Experiment, Instruction, Jitter, TouchObject
from ir_maniskill.goals import COLORS, Ref, Touch

ENVS = (1, 2, 4, 8, 16)
SIZES = ((64, 32), (128, 64), (128, 128), (256, 128), (512, 256))
"""Height and width of the pictures [pixel]."""
OBJECTS = (1, 2, 3, 4, 5, 6)

Point = dict[str, float | str]


def main() -> None:
    """Measure, write the figures and draw them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/images/throughput.png"))
    parser.add_argument("--redraw", action="store_true", help="measure nothing anew")
    given = parser.parse_args()
    table = given.out.with_suffix(".json")
    if not given.redraw:
        table.parent.mkdir(parents=True, exist_ok=True)
        table.write_text(json.dumps(measure(), indent=2) + "\n")
    draw(json.loads(table.read_text()), given.out)


def measure() -> dict[str, list[Point]]:
    """Measure with more and more envs, pixels and objects."""
    return {
        "envs": [point(str(n), n) for n in tqdm(ENVS, desc="envs")],
        "pictures": [
            point(f"{h} x {w}", 4, height=h, width=w)
            for h, w in tqdm(SIZES, desc="pictures")
        ],
        "objects": [
            point(str(count), 4, experiment=with_objects(count))
            for count in tqdm(OBJECTS, desc="objects")
        ],
    }


def point(
    label: str,
    num_envs: int,
    height: int = 64,
    width: int = 32,
    experiment: Experiment | None = None,
    steps: int = 24,
) -> Point:
    """Measure steps/s of all envs together, and the memory of their processes.

    Args:
        label: What stands at the axis.
        num_envs: Number of envs.
        height: Of each picture [pixel].
        width: Of each picture [pixel].
        experiment: What lies on the table; None: three cubes.
        steps: Steps in each of the three blocks.
    """
    cameras = {"width": width, "height": height, "shader_pack": SHADER}
    kwargs: dict[str, Any] = {"obs_mode": "rgb", "sensor_configs": cameras}
    task = experiment or catalog.get(OURS)
    with closing(ProcessVectorEnv(task, num_envs, env_kwargs=kwargs)) as envs:
        envs.reset(seed=0)
        plan = torch.rand(steps, num_envs, 26) * 2 - 1
        block = (lambda: [envs.step(action) for action in plan], steps * num_envs)
        timed(*block)
        fastest = min(timed(*block) for _ in range(3))
        memory = sum(map(_memory, [p.pid for p in envs._processes if p.pid]))
    return {"label": label, "steps_per_second": 1 / fastest, "memory_mb": memory}


def with_objects(count: int) -> Experiment:
    """Return an experiment with this many cubes in one or two lines."""
    colors = list(COLORS)[:count]
    places = [(x, y) for x in (0.17, 0.23) for y in (-0.08, 0.0, 0.08)]
    cubes = tuple(map(TouchObject, colors, places))
    sentence = Instruction("Touch the blue cube.", Touch(Ref("blue")))
    base = catalog.get(OURS)
    name = f"Cubes{count}-v1"
    return replace(
        base,
        id=name,
        objects=cubes,
        instructions=(sentence,),
        jitter=Jitter(position=0.0, yaw=0.0),  # so that six fit into reach
    )


def draw(curves: dict[str, list[Point]], out: Path) -> None:
    """Draw one panel for each curve, relative to its first point."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, len(curves), figsize=(11, 3.2))
    for panel, (name, points) in zip(panels, curves.items(), strict=True):
        labels = [str(p["label"]) for p in points]
        speed = np.array([float(p["steps_per_second"]) for p in points])
        memory = np.array([float(p["memory_mb"]) for p in points])
        lines = speed / speed[0], memory / memory[0]
        panel.plot(labels, lines[0], "o-", label="steps/s")
        panel.plot(labels, lines[1], "s--", label="memory")
        panel.set(xlabel=name, ylim=(0, 1.1 * np.max(lines)))
        panel.set_title(f"1 = {speed[0]:.0f} steps/s, {memory[0]:.0f} MB", fontsize=9)
        panel.tick_params(axis="x", labelsize=8)
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("relative to the first point")
    panels[0].legend()
    figure.tight_layout()
    figure.savefig(out, dpi=110)


def _memory(process: int) -> float:
    """Return the memory of a process, its share of what is shared included [MB]."""
    text = Path(f"/proc/{process}/smaps_rollup").read_text()
    line = next(row for row in text.splitlines() if row.startswith("Pss:"))
    return int(line.split()[1]) / 1024


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
