"""`make demo` trains once; it evaluates, films and draws the curve each time."""

import subprocess
from pathlib import Path
from typing import Any

import pytest

from ir_maniskill import cli

ROOT = Path(__file__).parents[1]
TASK = "NaoTouchCubeSingle-v1"
PROGRAM = """\
#!/bin/sh
echo "$@" >> "$0.log"
[ "$1" != train ] || touch best.safetensors evaluation.json
"""
"""Stands in for `ir-maniskill`: writes down what it is told, and ends a training."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return an empty folder for the demonstration, beside the program."""
    program = tmp_path / "ir-maniskill"
    program.write_text(PROGRAM)
    program.chmod(0o755)
    run = tmp_path / "demo"
    run.mkdir()
    return run


def demonstrate(folder: Path) -> list[Any]:
    """Run the script and return the commands that it gave."""
    program = folder.parent / "ir-maniskill"
    script = [ROOT / "scripts" / "demo.sh", program, TASK, folder, "12"]
    subprocess.run(script, cwd=folder, check=True, capture_output=True, timeout=60)
    log = program.with_suffix(".log")
    lines = log.read_text().splitlines()
    log.unlink()
    return [cli.parse(line.split()) for line in lines]


def test_the_demonstration_trains_from_pictures_and_leaves_figures_and_a_film(
    folder: Path,
) -> None:
    (folder / "best.safetensors").touch()  # of a training that was interrupted
    training, *rest = demonstrate(folder)
    assert training.resume and training.config.out == str(folder)
    evaluation, video, curve = rest
    assert demonstrate(folder) == rest  # a finished training is not made again
    assert training.config.agent.senses == ("vision",)
    assert evaluation.episodes == 12
    best = folder / "best.safetensors"
    assert evaluation.checkpoint == video.checkpoint == best
    left = (evaluation.json, video.out, curve.out)
    names = ("report.json", "video.mp4", "learning_curve.png")
    assert left == tuple(folder / name for name in names)
    kinds = [cli.Train, cli.Evaluate, cli.Video, cli.Curve]
    assert [type(command) for command in (training, *rest)] == kinds
