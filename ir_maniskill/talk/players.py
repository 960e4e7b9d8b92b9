"""What can move the robot: policies that fit a task, and random motion."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ir_maniskill import experiment as catalog
from ir_maniskill.agent.language_system import LexiconTransformer, TokenTransformer
from ir_maniskill.experiment import Experiment
from ir_maniskill.language.lexicon import lexicon
from ir_maniskill.language.tokens import split_words
from ir_maniskill.policy import Policy, load_policy, ships
from ir_maniskill.talk.reading import Reading
from ir_maniskill.training.checkpoint import MismatchError

RANDOM = "random motion"
"""Name of what needs no policy."""


class RandomMotion:
    """Wanders about, deaf: for a task or a robot without a policy."""

    vocabulary = None
    env_kwargs: dict[str, Any] = {  # noqa: RUF012 - read only
        "obs_mode": "rgb",
        "control_mode": "pd_joint_target_delta_pos",
        "reward_mode": "sparse",
        "sensor_configs": {"width": 64, "height": 128, "shader_pack": "unlit"},
    }
    """What an env is made with for it."""
    STRENGTH, MEMORY = 0.25, 0.9
    """Share of the largest action, and of the last action that is kept."""

    def __init__(self, joints: int, seed: int = 0) -> None:
        """Take how many joints there are."""
        self._generator = torch.Generator().manual_seed(seed)
        self._action = torch.zeros(1, joints)

    def reset(self) -> None:
        """Begin from rest."""
        self._action.zero_()

    def act(self, obs: Any, said: str) -> Tensor:
        """Return the next action [1, J]."""
        noise = torch.randn(self._action.shape, generator=self._generator)
        kick = (1 - self.MEMORY**2) ** 0.5 * self.STRENGTH
        self._action = self.MEMORY * self._action + kick * noise
        return self._action.clamp(-1, 1)


def fitting(task: str, robot: str, checkpoint: Path | None = None) -> list[str]:
    """Return what can play a task with a robot, the best first: names for `load`."""
    experiment = catalog.get(task)
    given = [str(checkpoint)] if checkpoint else []
    names = dict.fromkeys([*given, *sorted(ships(), key=lambda i: i != task)])
    return [*(n for n in names if _fits(load(n), experiment, robot)), RANDOM]


def _fits(policy: Policy, experiment: Experiment, robot: str) -> bool:
    try:
        policy.require_match(experiment, robot, any_task=True)
    except MismatchError:
        return False
    return True


@cache
def load(name: str) -> Policy:
    """Return a policy by its file, or by the task that it ships for; once each."""
    return load_policy(name, device="cpu")


def shortened(policy: Policy, said: str) -> str:
    """Return as many words of a sentence, from its start, as a policy can read."""
    encoder = policy.agent.encoder.language
    if isinstance(encoder, TokenTransformer):
        while len(split_words(said)) > encoder.length:
            said = said[:-1].rstrip()
    return said


def guesses(policy: Policy, reading: Reading) -> tuple[str, ...]:
    """Return what a policy with a lexicon takes words for that it never learned."""
    if not isinstance(policy.agent.encoder.language, LexiconTransformer):
        return ()
    known = lexicon(policy.vocabulary)
    nearest = ((word, next(iter(known.read(word)), "")) for word in reading.unknown)
    return tuple(f"{word} as {taken}" for word, taken in nearest if taken)
