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
from torch.nn.utils.rnn import pad_sequence

from ir_maniskill import experiment as catalog
from ir_maniskill.environment.senses import State
from ir_maniskill.environment.vector import make_vec
from ir_maniskill.evaluation.evaluate import EVALUATION_SEED, evaluate_policy
from ir_maniskill.experiment import Experiment, tokenize
from ir_maniskill.training.checkpoint import load_agent

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


def tokens_of(experiment: Experiment) -> Tensor:
    """Return all sentences of a task as the env gives them [I, L]."""
    words = experiment.vocabulary
    rows = [torch.tensor(tokenize(s, words)) for s in experiment.sentences]
    return pad_sequence(rows, batch_first=True)


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
        tokens = tokens_of(experiment)
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
    agent, config, facts = load_agent(path)
    play: dict[str, Any] = {"seed": EVALUATION_SEED, "frames": config.frames}
    figures = {}
    with closing(
        make_vec(config.env_id, 8, **config.env_kwargs(training=False))
    ) as envs:
        for name, change in controls(catalog.get(config.env_id)).items():
            report = evaluate_policy(
                lambda state, change=change: agent.policy(change(state)),
                config.env_id,
                episodes=episodes,
                envs=envs,
                progress=True,
                **play,
            )
            figures[name] = report.overall.as_dict()
    return config.env_id, {"steps": facts.get("steps"), "controls": figures}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("policies", nargs="*", type=Path, help="default: all shipped")
    parser.add_argument("--episodes", type=int, default=120, help="of each control")
    given = parser.parse_args()
    data = json.loads(OUT.read_text())
    for path in given.policies or sorted(SHIPPED.glob("*.safetensors")):
        task, data[task] = measure(path, given.episodes)
        OUT.write_text(json.dumps(data, indent=1) + "\n")
