"""Ships the best policy of a run with the package: `ship_policy.py runs/NAME`.

Rounds the weights to few bits, evaluates the rounded policy on pinned scenes, tells it
all sentences of the task in the same ones, and writes it with its config, figures and
the commit to `assets/policies/ID.safetensors`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ir_maniskill import experiment as catalog
from ir_maniskill.environment.state import State
from ir_maniskill.evaluation.evaluate import (
    EVALUATION_SEED,
    EvaluationReport,
    Policy,
    evaluate_policy,
    evaluate_scenes,
)
from ir_maniskill.training import checkpoint

FOLDER = Path(__file__).parent.parent / "assets" / "policies"

SEEN_EPISODES = 120
"""Episodes whose states the rounded policy shall act alike in."""


def ship(run: Path, episodes: int, scenes: int) -> EvaluationReport:
    """Round, evaluate and write the best policy of a run.

    Args:
        run: Folder of the run.
        episodes: Episodes for each instruction.
        scenes: Scenes in which to tell it every instruction, if there are several.
    """
    agent, config, facts = checkpoint.load_policy(run / "best.safetensors")
    config = dataclasses.replace(config, out=f"runs/{config.env_id}")
    env_id, steps = config.env_id, facts["steps"]
    play: dict[str, Any] = {
        "frames": config.frames,
        "env_kwargs": config.env_kwargs(training=False),
        "progress": True,
    }
    states = seen(agent.policy, env_id, seed=config.eval_seed, **play)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rounded.safetensors"
        checkpoint.save_policy(
            path, agent, config, steps=steps, evaluation={}, states=states
        )
        stored = checkpoint.read(path)
        rounded, *_ = checkpoint.load_policy(path)
    play["seed"] = EVALUATION_SEED
    sentences = len(catalog.get(env_id).sentences)
    report = evaluate_policy(
        rounded.policy, env_id, episodes=episodes * sentences, **play
    )
    figures = {**report.as_dict(), "commit": _commit()}
    if sentences > 1:
        same = evaluate_scenes(rounded.policy, env_id, scenes=scenes, **play)
        figures["same_scene"] = same.as_dict()
    path = FOLDER / f"{env_id}.safetensors"
    path.parent.mkdir(exist_ok=True)
    metadata = {**stored.metadata, "evaluation": figures}
    checkpoint.write(path, dataclasses.replace(stored, metadata=metadata))
    about = {"run": run.resolve().name, "steps": steps}
    about["training_seed"] = config.seed
    path.with_suffix(".json").write_text(
        json.dumps({**about, **figures}, indent=2) + "\n"
    )
    return report


def seen(policy: Policy, env_id: str, **play: Any) -> State:
    """Return the states [N, ...] that a policy comes to in the scenes it is chosen by.

    Args:
        policy: Acts without noise.
        env_id: The task.
        **play: Whatever else `evaluate_policy` needs.
    """
    states: list[State] = []

    def watched(state: State) -> Tensor:
        states.append({key: value.clone() for key, value in state.items()})
        return policy(state)

    evaluate_policy(watched, env_id, episodes=SEEN_EPISODES, **play)
    return {key: torch.cat([state[key] for state in states]) for key in states[0]}


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
