"""Evaluation: how reliably a policy does what the sentence asks, and nothing else.

Every episode is pinned by a seed of its own, and the policy acts on each env alone, so
the figures depend on neither the number of envs nor the order of the episodes.

Legend: N envs, E episodes, I instructions.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import os
import platform
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from ir_maniskill.environment.senses import State, StateStack
from ir_maniskill.environment.vector import VectorEnv, info_of_step, make_vec
from ir_maniskill.files import replacing

Policy = Callable[[State], Tensor]
"""Maps the state s_t of N envs to their actions [N, 26] in [-1, 1]."""

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
        if not 0 <= self.count <= self.total or self.total < 1:
            raise ValueError(
                f"rate: got {self.count} of {self.total}, expected 0 <= count <= total "
                "and at least one episode"
            )

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
    """Score of each sentence."""
    overall: Score
    """Score over all episodes."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "env_id": self.env_id,
            "seed": self.seed,
            "episodes": self.episodes,
            "instructions": {k: v.as_dict() for k, v in self.instructions.items()},
            "overall": self.overall.as_dict(),
        }

    def __str__(self) -> str:
        rows = [*self.instructions.items()]
        if len(rows) > 1:
            rows.append(("all", self.overall))
        width = max(len(name) for name, _ in rows)
        head = (
            f"{'instruction':<{width}}     N  success [95%]         "
            "exclusive [95%]        holding  fingers right/wrong  return"
        )
        return "\n".join([head, *(_row(name, score, width) for name, score in rows)])


@dataclass(frozen=True)
class SceneReport:
    """How often a policy obeys in one and the same scene, whatever it is told.

    A policy that neither looks nor reads may have every single score by chance or by
    habit; only one that does both obeys all sentences in a shuffled scene.
    """

    env_id: str
    """The task."""
    seed: int
    """Seed of the first scene; scene e has seed + e."""
    exclusive: Rate
    """Scenes in which it did what was asked without a foul, for every sentence."""
    pairs: dict[tuple[str, str], Rate]
    """The same for every two sentences."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "env_id": self.env_id,
            "seed": self.seed,
            "scenes": self.exclusive.total,
            **self.exclusive.as_dict("exclusive"),
            "pairs": [
                {"sentences": list(pair), **rate.as_dict("exclusive")}
                for pair, rate in self.pairs.items()
            ],
        }


def _row(name: str, score: Score, width: int) -> str:
    return (
        f"{name:<{width}} {score.success.total:>5}  {score.success!s:<20}  "
        f"{score.exclusive!s:<20}  {100 * score.holding:>7.1f}%  "
        f"{score.right_fingers:>11.2f} / {score.wrong_fingers:<5.2f}  "
        f"{score.mean_return:>6.2f}"
    )


@dataclass
class _Record:
    """Per-episode sums over the steps, E episodes."""

    episodes: int
    success: Tensor = field(init=False)  # [E]
    exclusive: Tensor = field(init=False)  # [E]
    sums: Tensor = field(init=False)  # [E, 5]: see SUMS

    SUMS = ("steps", "holding", "right_fingers", "wrong_fingers", "return")

    def __post_init__(self) -> None:
        self.success = torch.zeros(self.episodes, dtype=torch.bool)
        self.exclusive = torch.zeros(self.episodes, dtype=torch.bool)
        self.sums = torch.zeros(self.episodes, len(self.SUMS), dtype=torch.float64)

    def add(
        self, episode: Tensor, env: Tensor, reward: Tensor, info: dict[str, Tensor]
    ) -> None:
        """Count one step of the episodes that the chosen envs play."""
        names = ("success", "right_fingers", "wrong_fingers")
        holds, right, wrong = (info[name][env].cpu() for name in names)
        step = (torch.ones_like(right), holds, right, wrong, reward[env].cpu())
        self.sums[episode] += torch.stack([x.double() for x in step], dim=1)
        self.success[episode] = info["success_once"][env].cpu()
        self.exclusive[episode] = info["exclusive_success"][env].cpu()

    def score(self, chosen: Tensor) -> Score:
        """Return the score of the chosen episodes [E] bool."""
        total = int(chosen.sum())
        sums = dict(zip(self.SUMS, self.sums[chosen].sum(dim=0).tolist(), strict=True))
        return Score(
            success=Rate(int(self.success[chosen].sum()), total),
            exclusive=Rate(int(self.exclusive[chosen].sum()), total),
            holding=sums["holding"] / sums["steps"],
            right_fingers=sums["right_fingers"] / sums["steps"],
            wrong_fingers=sums["wrong_fingers"] / sums["steps"],
            mean_return=sums["return"] / total,
        )


def evaluate_policy(
    policy: Policy,
    env_id: str,
    *,
    episodes: int,
    seed: int,
    num_envs: int = 8,
    frames: int = 3,
    env_kwargs: dict[str, Any] | None = None,
    envs: VectorEnv | None = None,
    instructions: Sequence[int] | None = None,
    progress: bool = False,
) -> EvaluationReport:
    """Play episodes with a policy and count what it does.

    Episodes are spread evenly over the instructions: episode e is told instruction
    e modulo their number, and starts from seed + e.

    Args:
        policy: Acts without noise on the state s_t.
        env_id: The task of the envs to make.
        episodes: How many episodes; at least one for each instruction.
        seed: Seed of the first episode.
        num_envs: Envs to make, unless `envs` are given.
        frames: S, observations stacked into a state.
        env_kwargs: Keyword arguments for the envs (obs_mode, control_mode, ...).
        envs: Envs to use, and to leave open, instead of making some.
        instructions: Which of the experiment's instructions; None: all.
        progress: Whether to show a progress bar.

    Raises:
        ValueError: Too few episodes, or an instruction that the task does not have.
    """
    _check_episodes(episodes)
    with _opened(envs, env_id, min(num_envs, episodes), env_kwargs) as envs:
        sentences = tuple(envs.experiment.sentences)
        chosen = choose_instructions(sentences, instructions)
        _check_episodes(episodes, len(chosen))
        told = torch.tensor([chosen[e % len(chosen)] for e in range(episodes)])  # [E]
        record = _play(policy, envs, told, seed, StateStack(frames), progress)
    return EvaluationReport(
        env_id=envs.experiment.id,
        seed=seed,
        episodes=episodes,
        instructions={sentences[i]: record.score(told == i) for i in chosen},
        overall=record.score(torch.ones(episodes, dtype=torch.bool)),
    )


def evaluate_scenes(
    policy: Policy,
    env_id: str,
    *,
    scenes: int,
    seed: int,
    num_envs: int = 8,
    frames: int = 3,
    env_kwargs: dict[str, Any] | None = None,
    envs: VectorEnv | None = None,
    progress: bool = False,
) -> SceneReport:
    """Play every scene once for each sentence and count where all are obeyed.

    Args:
        policy: Acts without noise on the state s_t.
        env_id: The task of the envs to make.
        scenes: How many; as many episodes are played for every sentence.
        seed: Seed of the first scene.
        num_envs: Envs to make, unless `envs` are given.
        frames: S, observations stacked into a state.
        env_kwargs: Keyword arguments for the envs (obs_mode, control_mode, ...).
        envs: Envs to use, and to leave open, instead of making some.
        progress: Whether to show a progress bar.

    Raises:
        ValueError: No scenes.
    """
    if scenes < 1:
        raise ValueError(f"scenes: got {scenes}, expected at least 1")
    with _opened(envs, env_id, min(num_envs, scenes), env_kwargs) as envs:
        sentences = tuple(envs.experiment.sentences)
        obeyed = {}  # [E] bool each
        for index, sentence in enumerate(sentences):
            told = torch.full((scenes,), index)
            record = _play(policy, envs, told, seed, StateStack(frames), progress)
            obeyed[sentence] = record.exclusive
    return SceneReport(
        env_id=envs.experiment.id,
        seed=seed,
        exclusive=_all_of(obeyed.values()),
        pairs={
            pair: _all_of(obeyed[sentence] for sentence in pair)
            for pair in itertools.combinations(sentences, 2)
        },
    )


def _all_of(obeyed: Iterable[Tensor]) -> Rate:
    """Return the share of scenes in which all hold, each [E] bool."""
    every = torch.stack(list(obeyed)).all(dim=0)
    return Rate(int(every.sum()), len(every))


def write_report(path: Path, report: EvaluationReport, **facts: Any) -> None:
    """Write the report as JSON, with the versions and the machine it was made on.

    Args:
        path: The file.
        report: What was measured.
        **facts: More to write down: the checkpoint, the configuration, ...
    """
    data = {**report.as_dict(), **facts, "versions": versions(), "machine": machine()}
    with replacing(path) as aside:
        aside.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")


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


@contextlib.contextmanager
def _opened(
    envs: VectorEnv | None, env_id: str, num_envs: int, kwargs: dict[str, Any] | None
) -> Iterator[VectorEnv]:
    """Lend the envs given, or else some that are closed at the end.

    Callers never make more envs than episodes: those would play what nobody counts.
    """
    with contextlib.ExitStack() as stack:
        if envs is None:
            envs = make_vec(env_id, num_envs, **(kwargs or {}))
            stack.enter_context(contextlib.closing(envs))
        # One row of a policy is too little to share: the cores are the simulator's.
        stack.enter_context(threads(1))
        yield envs


def _check_episodes(episodes: int, least: int = 1) -> None:
    if episodes < least:
        raise ValueError(
            f"episodes: got {episodes}, expected at least {least}, "
            "one for each instruction"
        )


def choose_instructions(
    sentences: Sequence[str], wanted: Sequence[int] | None
) -> tuple[int, ...]:
    """Return the indices of the instructions to play.

    Args:
        sentences: The I sentences of the experiment.
        wanted: Which of them; None: all.

    Raises:
        ValueError: None is wanted, or one that there is not.
    """
    everything = range(len(sentences))
    chosen = tuple(everything if wanted is None else wanted)
    if not chosen or any(index not in everything for index in chosen):
        listed = ", ".join(f"{i}: {s!r}" for i, s in enumerate(sentences))
        raise ValueError(f"instructions: got {chosen}, available: {listed}")
    return chosen


@torch.no_grad()  # envs may keep what they get, and write to it later
def _play(
    policy: Policy,
    envs: VectorEnv,
    told: Tensor,  # [E]
    seed: int,
    stack: StateStack,
    progress: bool,
) -> _Record:
    """Play all episodes, N at a time; episode e is told instruction told[e]."""
    episodes, n = len(told), envs.num_envs
    record = _Record(episodes)
    for first in tqdm(
        range(0, episodes, n), "evaluate", disable=not progress, leave=False
    ):
        episode = torch.arange(first, first + n)  # [N]
        options = {"instruction": told[episode % episodes].to(envs.device)}
        obs, _ = envs.reset(seed=seed + first, options=options)
        state = stack.reset(obs)
        playing = episode < episodes  # the last round may have envs to spare
        while playing.any():
            action = _act(policy, state, envs.device)
            obs, reward, terminated, truncated, info = envs.step(action)
            done = terminated | truncated
            env = playing.nonzero()[:, 0]
            record.add(episode[env], env, reward, info_of_step(info, done))
            playing &= ~done.cpu()
            state = stack.push(obs, done)
    return record


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """Let torch compute with that many threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _act(policy: Policy, state: State, device: torch.device) -> Tensor:
    """Return the actions [N, 26], on the CPU computed for one env after another.

    How a matrix product is rounded depends on the number of rows, and contacts make
    much of little: alone, an env is acted on alike whatever others are beside it.
    """
    n = len(state["instruction"])
    if device.type != "cpu":
        return policy(state)
    rows = [policy({k: v[i : i + 1] for k, v in state.items()}) for i in range(n)]
    return torch.cat(rows).to(device)
