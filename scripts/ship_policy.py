"""Ships the best policy of a run with the package: `ship_policy.py runs/NAME`.

Rounds the weights to 16 bits, evaluates the rounded policy on pinned scenes, and writes
it with its config, figures and the commit to `assets/policies/ID.safetensors`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import subprocess
from pathlib import Path

from ir_maniskill.training import checkpoint
from ir_maniskill.training.evaluate import EvaluationReport, evaluate_policy

FOLDER = Path(__file__).parent.parent / "assets" / "policies"
SEED = 2_000_000
"""Seed of the first episode, apart from those of training and of choosing."""


def ship(run: Path, episodes: int) -> EvaluationReport:
    """Round, evaluate and write the best policy of a run.

    Args:
        run: Folder of the run.
        episodes: Episodes for each instruction.
    """
    agent, config, facts = checkpoint.load_policy(run / "best.safetensors")
    config = dataclasses.replace(config, out=f"runs/{config.env_id}")
    path = FOLDER / f"{config.env_id}.safetensors"
    path.parent.mkdir(exist_ok=True)
    steps = facts["steps"]
    checkpoint.save_policy(path, agent, config, steps=steps, evaluation={}, half=True)
    rounded, *_ = checkpoint.load_policy(path)
    sentences = len(facts["evaluation"]["instructions"])
    report = evaluate_policy(
        rounded.policy,
        config.env_id,
        episodes=episodes * sentences,
        seed=SEED,
        frames=config.frames,
        env_kwargs=config.env_kwargs(training=False),
        progress=True,
    )
    figures = {**report.as_dict(), "commit": _commit()}
    checkpoint.save_policy(
        path, agent, config, steps=steps, evaluation=figures, half=True
    )
    path.with_suffix(".json").write_text(
        json.dumps({"steps": steps, "seed": config.seed, **figures}, indent=2) + "\n"
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
    given = parser.parse_args()
    print(ship(given.run, given.episodes))
