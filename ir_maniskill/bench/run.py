"""The whole benchmark: the table of ratios and the split of a step."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from tqdm import tqdm

from ir_maniskill.bench import learning, simulation
from ir_maniskill.bench.report import Machine, Measure, Report

SHADER = "unlit"
"""Shader pack of the pictures that are compared: the cheapest."""


def run(seconds: float = 10.0, quick: bool = False, shader: str = SHADER) -> Report:
    """Measure everything.

    Args:
        seconds: How long each comparison goes on [s].
        quick: Whether to leave out the peer, which takes long to load, and to measure
            as briefly as possible.
        shader: Shader pack of all cameras.
    """
    seconds = 1.0 if quick else seconds
    jobs: dict[str, Callable[[], list[Measure]]] = {
        "bare loop": lambda: [simulation.beside_bare_loop(shader, seconds)],
        "processes": lambda: [simulation.processes(shader, seconds)],
        "reset": lambda: [simulation.resets(shader, seconds)],
        "training": lambda: _training(shader, seconds, rollouts=16 if quick else 32),
    }
    if not quick:
        peers = {
            "peer, pictures": lambda: [
                simulation.beside_peer("rgb", pack, seconds, goal=30)
                for pack in ("minimal", shader)
            ],
            "peer, state": lambda: [
                simulation.beside_peer("state", shader, seconds, goal=12)
            ],
        }
        jobs = peers | jobs
    measures: list[Measure] = []
    with tqdm(total=len(jobs) + 1) as bar:
        for name, job in jobs.items():
            bar.set_description(name)
            measures += job()
            bar.update()
        bar.set_description("profile")
        profile = simulation.profile(shader, seconds / 2)
        bar.update()
    return Report(Machine.here(), tuple(measures), profile)


def _training(shader: str, seconds: float, rollouts: int) -> list[Measure]:
    with learning.trainer(shader, rollouts) as made:
        return [learning.overhead(made), learning.arithmetic(made, seconds)]


def save(report: Report, path: Path) -> None:
    """Write the report as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(report.as_dict(), indent=2) + "\n")
