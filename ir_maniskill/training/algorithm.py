"""The seam between the runner and what it trains: one protocol for any algorithm.

Legend: N envs, A numbers of an action, K reward terms.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor
from torch.optim import Optimizer

from ir_maniskill.agent.agent import Agent
from ir_maniskill.environment.senses import State
from ir_maniskill.training import distributed
from ir_maniskill.training.config import TrainConfig


@dataclass(frozen=True)
class Outcome:
    """What a step of all envs led to, on the learner's device."""

    reward: Tensor
    """r_t as the env gives it [N]."""
    terminated: Tensor
    """Whether the episode ended for good [N] bool: nothing more would have come."""
    truncated: Tensor
    """Whether time ran out [N] bool: more would have come."""
    state: State
    """s_{t+1}; where an episode ended, the first state of the next one."""
    final: State | None = None
    """s_{t+1} of the episodes that ended; other rows mean nothing. None: none ended."""
    terms: Tensor | None = None
    """`reward_generator.TERMS` as measured [N, K]; None where the reward is sparse."""

    @property
    def done(self) -> Tensor:
        """Whether the episode ended [N] bool."""
        return self.terminated | self.truncated


class Algorithm(ABC):
    """Learns from what the envs give; knows nothing of files or progress bars.

    For each step of all envs the runner calls `act`, `observe` and `update`.
    """

    agent: Agent
    """Whose `policy` is evaluated and kept."""
    share: float = 0.0
    """Share of the training that is done, set by the runner; schedules follow it."""
    learns_while_stepping: ClassVar[bool] = False
    """Whether `update` may come while the envs step, before `observe`."""

    @property
    def has_policy(self) -> bool:
        """Whether `agent` has begun to learn; before that it is not evaluated."""
        return True

    @staticmethod
    def device() -> torch.device:
        """Return where states are given to it, and where it learns."""
        return distributed.device()

    @abstractmethod
    def __init__(self, config: TrainConfig, state: State, actions: int) -> None:
        """Make what is still untrained, for states like the first one and A actions."""

    @abstractmethod
    def act(self, state: State) -> Tensor:
        """Return the actions to try in this state [N, A], in [-1, 1]."""

    @abstractmethod
    def observe(self, outcome: Outcome) -> None:
        """Take in what the last actions led to."""

    @abstractmethod
    def update(self) -> dict[str, float]:
        """Learn, if it is time to; return figures for the log, none if it is not."""

    @abstractmethod
    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of all that a resumed run needs; its weights: `agent.NAME`."""

    @abstractmethod
    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Go on from what `state_dict` returned."""

    def restart(self) -> None:  # noqa: B027 - most have nothing to forget
        """Learn that all envs begin new episodes, though none was seen to end."""


def under(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors named `prefix.` something, without that prefix."""
    start = prefix + "."
    return {k.removeprefix(start): v for k, v in tensors.items() if k.startswith(start)}


def copied(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return copies of the tensors, named `prefix.` and their name."""
    return {f"{prefix}.{k}": v.detach().clone() for k, v in tensors.items()}


def averages(optimizer: Optimizer) -> dict[str, Tensor]:
    """Return an optimizer's averages by weight and name, e.g. `0.exp_avg`."""
    state = optimizer.state_dict()["state"]
    return {f"{i}.{name}": v for i, kept in state.items() for name, v in kept.items()}


def load_averages(optimizer: Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Load what `averages` returned; ValueError: one has not its weight's shape."""
    weights = [w for group in optimizer.param_groups for w in group["params"]]
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        index, key = name.split(".", 1)
        shape = weights[int(index)].shape
        if tensor.ndim and tensor.shape != shape:
            raise ValueError(f"{name}: got {tuple(tensor.shape)}, expected {shape}")
        state.setdefault(int(index), {})[key] = tensor
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": state, "param_groups": groups})
