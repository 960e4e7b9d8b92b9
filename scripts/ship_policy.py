"""Ships the best policy of a run with the package: `ship_policy.py runs/NAME`.

Evaluates the policy and writes it to `assets/policies/ID.safetensors`, with its figures
beside it and inside.
"""

from __future__ import annotations

import dataclasses
import subprocess
from contextlib import closing
from pathlib import Path

import tyro

from ir_maniskill import evaluate, load_policy, make_vec
from ir_maniskill import experiment as catalog
from ir_maniskill.evaluation.audit import same_scene
from ir_maniskill.evaluation.evaluate import (
    EVALUATION_SEED,
    EvaluationReport,
    player_of,
)
from ir_maniskill.files import write_json
from ir_maniskill.training import checkpoint

FOLDER = Path(__file__).parent.parent / "assets" / "policies"


def ship(
    run: tyro.conf.Positional[Path], episodes: int = 200, scenes: int = 200
) -> EvaluationReport:
    """Evaluate and write the best policy of a run.

    Args:
        run: Folder of the run.
        episodes: Episodes for each sentence; in all, where sentences are drawn.
        scenes: Scenes in which to give it every sentence, if there are several.
    """
    best = run / "best.safetensors"
    stored, policy = checkpoint.read(best), load_policy(best, device="cpu")
    task, config = policy.env_id, policy.config
    sentences = len(catalog.get(task).sentences)  # 0: thousands are spoken
    report = evaluate(policy, episodes=episodes * max(1, sentences))
    figures = {**report.as_dict(), "commit": _commit()}
    if sentences != 1:
        with closing(make_vec(task, 8, **policy.env_kwargs)) as envs:
            player = player_of(policy.agent.policy, config.frames)
            same = same_scene(player, envs, scenes=scenes, seed=EVALUATION_SEED)[0]
        exclusive = same.exclusive.as_dict("exclusive")
        figures["same_scene"] = {"scenes": scenes, **exclusive}
    # Only now: what shipped before stays until the new figures are there.
    path = FOLDER / f"{task}.safetensors"
    metadata = {**stored.metadata, "evaluation": figures}
    checkpoint.write(path, dataclasses.replace(stored, metadata=metadata))
    origin = {"run": run.resolve().name, "steps": stored.metadata["steps"]}
    origin["training_seed"] = config.seed
    write_json(path.with_suffix(".json"), {**origin, **figures})
    return report


def _commit() -> str:
    command = ["git", "-C", str(FOLDER), "rev-parse", "HEAD"]
    return subprocess.check_output(command, text=True).strip()


if __name__ == "__main__":
    print(tyro.cli(ship))
