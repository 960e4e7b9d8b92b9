"""Evaluation: how reliably a policy does what the sentence asks, and nothing else.

Every episode is pinned by a seed of its own, and the policy acts on each env alone, so
the figures depend on neither the number of envs nor the order of the episodes.

Legend: N envs, E episodes, I instructions.
"""

from __future__ import annotations

import contextlib
import math
import os
import platform
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from ir_maniskill.checks import require
from ir_maniskill.environment.arguments import instructions_of
from ir_maniskill.environment.senses import Observation, State, StateStack
from ir_maniskill.environment.vector import VectorEnv, info_of_step
from ir_maniskill.experiment import Experiment, Spoken
from ir_maniskill.files import write_json
from ir_maniskill.goals import Instruction
from ir_maniskill.language import KINDS, kind_of

Policy = Callable[[State], Tensor]
"""Maps the state s_t of N envs to their actions [N, 26] in [-1, 1]."""

Player = Callable[[Observation, Tensor | None], Tensor]
"""Maps observations of N envs to actions, and keeps its own history: `done` [N] bool
says in which envs an episode begins; None: in all."""

EVALUATION_SEED = 2_000_000
"""Seed of the first episode that figures are made of, apart from those of training and
of choosing the best policy."""

Z_95 = 1.959963984540054
"""Two-sided 95% quantile of the normal distribution."""


@dataclass(frozen=True)
class Rate:
    """Share of episodes, with how sure it is."""

    count: int
    """Episodes in which it happened."""
    total: int
    """Episodes played."""

    def __post_init__(self) -> None:
        assert 0 <= self.count <= self.total and self.total > 0, self

    @property
    def value(self) -> float:
        """The share itself."""
        return self.count / self.total

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95% confidence interval of the share."""
        n, p, z = self.total, self.value, Z_95
        center = (p + z * z / (2 * n)) / (1 + z * z / n)
        half = z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
        # At the ends the formula is exactly 0 or 1, were it not for rounding.
        low = center - half if self.count > 0 else 0.0
        return low, center + half if self.count < n else 1.0

    def as_dict(self, name: str) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {name: self.value, f"{name}_interval": list(self.interval)}

    def __str__(self) -> str:
        low, high = self.interval
        return f"{100 * self.value:5.1f}% [{100 * low:4.1f}, {100 * high:5.1f}]"


@dataclass(frozen=True)
class Score:
    """What the policy did over a set of episodes."""

    success: Rate
    """Episodes in which the goal was reached."""
    exclusive: Rate
    """Episodes in which it was, without a foul at any step."""
    holding: float
    """Share of steps in which the goal holds."""
    right_fingers: float
    """Fingers that touch as the goal asks, mean over steps."""
    wrong_fingers: float
    """Fingers that touch as it does not allow, mean over steps."""
    mean_return: float
    """Sum of the rewards of an episode, mean over episodes."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "episodes": self.success.total,
            **self.success.as_dict("success"),
            **self.exclusive.as_dict("exclusive"),
            "holding": self.holding,
            "right_fingers": self.right_fingers,
            "wrong_fingers": self.wrong_fingers,
            "return": self.mean_return,
        }

    def __str__(self) -> str:
        return (
            f"{self.success.total:>5}  {self.success!s:<20}  {self.exclusive!s:<20}  "
            f"{100 * self.holding:>7.1f}%  "
            f"{self.right_fingers:>11.2f} / {self.wrong_fingers:<5.2f}  "
            f"{self.mean_return:>6.2f}"
        )


@dataclass(frozen=True)
class EvaluationReport:
    """The scores of a policy on one task."""

    env_id: str
    """The task."""
    seed: int
    """Seed of the first episode; episode e has seed + e."""
    episodes: int
    """Episodes played."""
    instructions: dict[str, Score]
    """Score of each sentence; where they are spoken, of each kind of sentence."""
    overall: Score
    """Score over all episodes."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        each = {name: score.as_dict() for name, score in self.instructions.items()}
        return {**vars(self), "instructions": each, "overall": self.overall.as_dict()}

    def __str__(self) -> str:
        rows = [*self.instructions.items(), ("all", self.overall)]
        rows = rows if len(self.instructions) > 1 else rows[:1]
        width = max(len(name) for name in ("instruction", *dict(rows)))
        head = (
            f"{'instruction':<{width}}     N  success [95%]         "
            "exclusive [95%]        holding  fingers right/wrong  return"
        )
        return "\n".join([head, *(f"{name:<{width}} {score}" for name, score in rows)])


def evaluate_policy(
    policy: Policy,
    envs: VectorEnv,
    *,
    episodes: int,
    seed: int,
    frames: int = 3,
    instructions: Sequence[Any] | None = None,
    progress: bool = False,
) -> EvaluationReport:
    """Play episodes with a policy and count what it does.

    Episode e starts from seed + e. The instructions take turns; where they are spoken,
    each episode has a sentence of its own.

    Args:
        policy: Acts without noise on the state s_t.
        envs: The task, in as many envs as play at a time. They are left open.
        episodes: How many episodes; at least one for each instruction.
        seed: Seed of the first episode.
        frames: S, observations stacked into a state.
        instructions: What to say, as a reset takes it; None: all that the experiment
            has.
        progress: Whether to show a progress bar.

    Raises:
        ValueError: Too few episodes, or an instruction that nobody understands.
    """
    chosen = choose_instructions(envs.experiment, instructions)
    if episodes < len(chosen):
        raise ValueError(
            f"episodes: got {episodes}, expected at least {len(chosen)}, "
            "one for each instruction"
        )
    told = [chosen[e % len(chosen)] for e in range(episodes)]
    seeds = range(seed, seed + episodes)
    player = player_of(policy, frames)
    figures, names = play(player, envs, told, seeds, progress)
    return EvaluationReport(
        env_id=envs.experiment.id,
        seed=seed,
        episodes=episodes,
        instructions=score_by_name(figures, names),
        overall=score(figures),
    )


def player_of(policy: Policy, frames: int) -> Player:
    """Return a policy as one that gets observations, of which it stacks S.

    On the CPU it acts on one env after another: how a matrix product is rounded depends
    on the number of rows, and contacts amplify such differences. So an episode does not
    depend on how many envs there are.
    """
    stack = StateStack(frames)

    def player(obs: Observation, done: Tensor | None) -> Tensor:
        state = stack.reset(obs) if done is None else stack.push(obs, done)
        count, device = len(state["instruction"]), state["instruction"].device
        if device.type != "cpu":
            return policy(state).to(device)
        rows = [{k: v[i : i + 1] for k, v in state.items()} for i in range(count)]
        return torch.cat([policy(row) for row in rows]).to(device)

    return player


def score_by_name(figures: Tensor, names: Sequence[str]) -> dict[str, Score]:
    """Return the score of each name's episodes: kinds in their order, else as met."""
    order = sorted(set(names), key=lambda n: [*KINDS, *names].index(n))
    groups = {name: torch.tensor([n == name for n in names]) for name in order}
    return {name: score(figures[rows]) for name, rows in groups.items()}


def write_report(path: Path, report: Any, **facts: Any) -> None:
    """Write the report as JSON, with the versions and the machine it was made on.

    Args:
        path: The file.
        report: What was measured: its `as_dict()` is plain data.
        **facts: More to write down: the checkpoint, the configuration, ...
    """
    made = {"versions": versions(), "machine": machine()}
    write_json(path, {**report.as_dict(), **facts, **made})


def versions() -> dict[str, str]:
    """Return the versions of what the figures depend on."""
    names = ("ir-maniskill", "mani-skill", "sapien", "torch", "gymnasium", "numpy")
    found = {name: metadata.version(name) for name in names}
    return {"python": platform.python_version(), **found}


def machine() -> dict[str, Any]:
    """Return what the figures were made on."""
    cuda = torch.cuda.get_device_name(0) if torch.cuda.is_available() else None
    system = f"{platform.system()} {platform.machine()}"
    return {"platform": system, "cpus": os.cpu_count(), "cuda": cuda}


def choose_instructions(
    experiment: Experiment, wanted: Sequence[Any] | None
) -> tuple[Instruction | None, ...]:
    """Return what to say: what is wanted, else all; None: each episode draws its own.

    Raises:
        ValueError: Nothing is wanted, or something that nobody understands.
    """
    own = experiment.instructions
    if wanted is None:
        return (None,) if isinstance(own, Spoken) else own
    require(len(wanted) > 0, "instructions", wanted, "at least one")
    return tuple(instructions_of(list(wanted), experiment, len(wanted)))


FIGURES = (
    *("success", "exclusive"),  # of the whole episode, 0 or 1
    *("steps", "holding", "right_fingers", "wrong_fingers", "return"),  # summed over it
)
"""What is counted of an episode."""


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """Let torch compute with that many threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@threads(1)  # the cores are the simulator's: one row of a policy is too little to share
@torch.no_grad()  # envs may keep what they get, and write to it later
def play(
    player: Player,
    envs: VectorEnv,
    told: Sequence[Instruction | None],
    seeds: Sequence[int],
    progress: bool = False,
) -> tuple[Tensor, list[str]]:
    """Play all E episodes, N at a time.

    Args:
        player: Acts.
        envs: The task.
        told: What each episode is told; None: what is drawn [E].
        seeds: Where each starts from [E].
        progress: Whether to show a progress bar.

    Returns:
        `FIGURES` of each episode [E, 7] float64, and the sentence or its kind [E].
    """
    episodes, n = len(told), envs.num_envs
    names: list[str] = []
    figures = torch.zeros(episodes, len(FIGURES), dtype=torch.float64)
    firsts = range(0, episodes, n)
    for first in tqdm(firsts, "evaluate", disable=not progress, leave=False):
        episode = torch.arange(first, first + n)  # [N]
        rows = [e % episodes for e in episode.tolist()]  # the last may be to spare
        say = [told[row] for row in rows]
        options = {} if say[0] is None else {"instruction": say}
        obs, _ = envs.reset(seed=[seeds[row] for row in rows], options=options)
        names += _names(envs, say)
        playing, done = episode < episodes, None
        while playing.any():
            action = player(obs, done)
            obs, reward, terminated, truncated, info = envs.step(action)
            done = terminated | truncated
            step = _measured(reward, info_of_step(info, done))[playing]
            figures[episode[playing], :2] = step[:, :2]
            figures[episode[playing], 2:] += step[:, 2:]
            playing &= ~done.cpu()
    return figures, names[:episodes]


def _names(envs: VectorEnv, told: Sequence[Any]) -> list[str]:
    """Return the sentence of each env; where they are spoken, its kind."""
    if not isinstance(envs.experiment.instructions, Spoken):
        return [instruction.text for instruction in told]
    each = envs.get_attr("instructions")  # of N envs, or of N vectors of one
    said = [i for one in each for i in (one if isinstance(one, list) else [one])]
    return [kind_of(instruction.goal) for instruction in said]


def _measured(reward: Tensor, info: dict[str, Tensor]) -> Tensor:
    """Return the `FIGURES` of one step [N, 7]."""
    so_far = info["success_once"], info["exclusive_success"]
    now = info["success"], info["right_fingers"], info["wrong_fingers"], reward
    columns = (*so_far, torch.ones_like(reward), *now)
    return torch.stack([column.cpu().double() for column in columns], dim=1)


def score(figures: Tensor) -> Score:
    """Return the score of episodes, of which `FIGURES` are given [E, 7]."""
    total = len(figures)
    success, exclusive, steps, *sums, returns = figures.sum(dim=0).tolist()
    holding, right, wrong = (value / steps for value in sums)
    return Score(
        success=Rate(int(success), total),
        exclusive=Rate(int(exclusive), total),
        holding=holding,
        right_fingers=right,
        wrong_fingers=wrong,
        mean_return=returns / total,
    )
