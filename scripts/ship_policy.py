"""Ships the best policy of a run with the package: `ship_policy.py runs/NAME`.

Rounds the weights to 16 bits, evaluates the rounded policy on pinned scenes, tells it
all sentences of the task in the same ones, and writes it with its config, figures and
the commit to `assets/policies/ID.safetensors`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import subprocess
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

from ir_maniskill import experiment as catalog
from ir_maniskill.training import checkpoint
from ir_maniskill.training.evaluate import (
    EVALUATION_SEED,
    EvaluationReport,
    evaluate_policy,
    evaluate_scenes,
)

FOLDER = Path(__file__).parent.parent / "assets" / "policies"


def ship(run: Path, episodes: int, scenes: int) -> EvaluationReport:
    """Round, evaluate and write the best policy of a run.

    Args:
        run: Folder of the run.
        episodes: Episodes for each instruction.
        scenes: Scenes in which to tell it every instruction, if there are several.
    """
    agent, config, facts = checkpoint.load_policy(run / "best.safetensors")
    config = dataclasses.replace(config, out=f"runs/{config.env_id}")
    origin = {"steps": facts["steps"], "half": True}
    save = partial(checkpoint.save_policy, agent=agent, config=config, **origin)
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / "rounded.safetensors"
        save(draft, evaluation={})
        rounded, *_ = checkpoint.load_policy(draft)
    sentences = len(catalog.get(config.env_id).sentences)
    play: dict[str, Any] = {
        "seed": EVALUATION_SEED,
        "frames": config.frames,
        "env_kwargs": config.env_kwargs(training=False),
        "progress": True,
    }
    report = evaluate_policy(
        rounded.policy, config.env_id, episodes=episodes * sentences, **play
    )
    figures = {**report.as_dict(), "commit": _commit()}
    if sentences > 1:
        same = evaluate_scenes(rounded.policy, config.env_id, scenes=scenes, **play)
        figures["same_scene"] = same.as_dict()
    path = FOLDER / f"{config.env_id}.safetensors"
    path.parent.mkdir(exist_ok=True)
    save(path, evaluation=figures)
    about = {"run": run.resolve().name, "steps": facts["steps"]}
    about["training_seed"] = config.seed
    path.with_suffix(".json").write_text(
        json.dumps({**about, **figures}, indent=2) + "\n"
    )
    return report


def _commit() -> str:
    command = ["git", "rev-parse", "HEAD"]
    return subprocess.run(
        command, cwd=FOLDER.parent, capture_output=True, text=True, check=True
    ).stdout.strip()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="folder of the run")
    parser.add_argument("--episodes", type=int, default=200, help="per instruction")
    parser.add_argument("--scenes", type=int, default=200, help="for all instructions")
    given = parser.parse_args()
    print(ship(given.run, given.episodes, given.scenes))
