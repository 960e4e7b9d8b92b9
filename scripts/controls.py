"""What a policy goes by: its figures when a sense or the sentence is taken from it.

A policy that looks must fail with black pictures, and one that reads with a sentence
that is not the one the episode is judged by. Every control plays the same scenes.

    python scripts/controls.py                 # all shipped policies
    python scripts/controls.py runs/NAME/best.safetensors
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ir_maniskill.environment.senses import State, tokens_of
from ir_maniskill.environment.vector import make_vec
from ir_maniskill.evaluation.evaluate import EVALUATION_SEED, evaluate_policy
from ir_maniskill.experiment import Experiment
from ir_maniskill.policy import load_policy

ROOT = Path(__file__).parent.parent
OUT = ROOT / "docs" / "results" / "controls.json"
SHIPPED = ROOT / "assets" / "policies"

Change = Callable[[State], State]
"""Takes something from the state s_t that the policy gets."""


def without(*keys: str) -> Change:
    """Return the control that replaces these parts of the state, if there, by zeros."""

    def change(state: State) -> State:
        blank = {key: torch.zeros_like(state[key]) for key in keys if key in state}
        return {**state, **blank}

    return change


def retold(tokens: Tensor, instead: list[int]) -> Change:
    """Return the control that swaps sentences.

    Args:
        tokens: All sentences of the task [I, L].
        instead: For each sentence, the index of the one to give instead.
    """

    def change(state: State) -> State:
        told = state["instruction"]  # [N, L]
        index = (told[:, None] == tokens.to(told)).all(dim=2).int().argmax(dim=1)
        other = tokens.to(told)[torch.tensor(instead)[index]]
        return {**state, "instruction": other}

    return change


def controls(experiment: Experiment) -> dict[str, Change]:
    """Return the controls by name; those of the sentence need several sentences."""
    changes = {
        "nothing taken away": without(),
        "black pictures": without("images"),
        "without touch": without("touch"),
        "without joint positions and targets": without("proprioception", "target"),
    }
    count = len(experiment.sentences)
    if count > 1:
        tokens = tokens_of(experiment.sentences, experiment.vocabulary)
        shifted = [(index + 1) % count for index in range(count)]
        changes["the sentence of another object"] = retold(tokens, shifted)
        changes["always the first sentence"] = retold(tokens, [0] * count)
    return changes


def measure(path: Path, episodes: int) -> tuple[str, dict[str, Any]]:
    """Return a policy's task, and its figures under each control.

    Args:
        path: Policy or checkpoint file.
        episodes: Episodes of each control, spread evenly over the sentences.
    """
    policy, figures = load_policy(path), {}
    with closing(make_vec(policy.env_id, 8, **policy.env_kwargs)) as envs:
        for name, change in controls(envs.experiment).items():
            report = evaluate_policy(
                lambda state, change=change: policy.agent.policy(change(state)),
                envs,
                episodes=episodes,
                seed=EVALUATION_SEED,
                frames=policy.config.frames,
                progress=True,
            )
            figures[name] = report.overall.as_dict()
    return policy.env_id, {"steps": policy.metadata.get("steps"), "controls": figures}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("policies", nargs="*", type=Path, help="default: all shipped")
    parser.add_argument("--episodes", type=int, default=120, help="of each control")
    given = parser.parse_args()
    data = json.loads(OUT.read_text())
    for path in given.policies or sorted(SHIPPED.glob("*.safetensors")):
        task, data[task] = measure(path, given.episodes)
        OUT.write_text(json.dumps(data, indent=1) + "\n")
