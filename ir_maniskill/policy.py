"""Policy: a trained agent, ready to act on what envs observe."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from pathlib import Path
from textwrap import shorten
from typing import Any

import torch
from torch import Tensor

from ir_maniskill import experiment as catalog
from ir_maniskill.agent.agent import Agent
from ir_maniskill.agent.language_system import encoder_of
from ir_maniskill.assets import FOLDER
from ir_maniskill.checks import require
from ir_maniskill.environment.robots.robot import Robot, short_name
from ir_maniskill.environment.senses import (
    Observation,
    State,
    StateStack,
    text_of,
    tokens_of,
)
from ir_maniskill.experiment import Experiment
from ir_maniskill.language.tokens import split_words, warn_of_unknown
from ir_maniskill.training.checkpoint import (
    CheckpointError,
    MismatchError,
    acting,
    load_agent,
    task_facts,
)
from ir_maniskill.training.config import WITH_WEIGHTS, TrainConfig


class Policy:
    """A trained agent that acts without noise and remembers what it saw.

    Example:
        >>> import ir_maniskill
        >>> policy = ir_maniskill.load_policy("NaoTouchCubeTriangle-v1")
        >>> envs = ir_maniskill.make_vec(policy.env_id, 4, **policy.env_kwargs)
        >>> obs, _ = envs.reset(seed=0)
        >>> for _ in range(64):
        ...     obs, reward, terminated, truncated, info = envs.step(policy.act(obs))
        ...     policy.reset(terminated | truncated)

    `agent` is the network, `config` how it was trained, `metadata` what its file says:
    `steps`, `evaluation`, `task`, ...
    """

    def __init__(
        self, agent: Agent, config: TrainConfig, metadata: dict[str, Any]
    ) -> None:
        """Take what `training.checkpoint.load_agent` returns."""
        self.agent, self.config, self.metadata = agent, config, metadata
        self.reset()

    @property
    def env_id(self) -> str:
        """The task that it was trained for."""
        return self.config.env_id

    @property
    def vocabulary(self) -> tuple[str, ...]:
        """The words that it knows."""
        return self.config.agent.vocabulary

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """What an env must be made with for it to see what it was trained with."""
        return self.config.env_kwargs(training=False)

    def reset(self, done: Tensor | None = None) -> None:
        """Forget what was seen, before an observation that begins an episode.

        `done` [N] bool are the envs where it does; None: all.
        """
        if done is None:
            self._stack: StateStack | None = None
        self._done = done

    @torch.no_grad()
    def act(
        self, obs: Observation, sentences: str | Sequence[str] | None = None
    ) -> Tensor:
        """Return the actions [N, A] in [-1, 1] for the next observation of N envs.

        `sentences` are said in place of the envs' own, one for all or N.

        Raises:
            ValueError: The observation lacks something, a sentence is too long, there
                are neither one nor N, or N is not that of the last observation:
                `reset()` comes before that. The history stays as it was.
        """
        stack, state = self._see(obs)
        rows = state["instruction"]
        if sentences is not None:
            said = [sentences] * len(rows) if isinstance(sentences, str) else sentences
            expected = f"one for all, or {len(rows)}, one for each env"
            require(len(said) == len(rows), "sentences", said, expected)
            state |= self.read(said)
        actions = self.agent.policy(state).to(rows.device)
        self._stack, self._count, self._done = stack, len(rows), None
        return actions

    def read(self, sentences: Sequence[str]) -> State:
        """Return the entries of the state that tell it these sentences."""
        if "instruction" in self.agent.encoder.language.reads:
            for sentence in sentences:
                warn_of_unknown(sentence, self.vocabulary)
        longest = max(len(split_words(sentence)) or 1 for sentence in sentences)
        tokens = tokens_of(sentences, self.vocabulary, longest)
        return {"instruction": tokens, "text": text_of(sentences)}

    def require_match(
        self,
        experiment: Experiment,
        robot: str | type[Robot] | None = None,
        *,
        any_task: bool = False,
    ) -> None:
        """Raise MismatchError unless it was trained for this task and robot.

        `robot` is what `robot_uids` takes, None its own; `any_task` accepts another
        task. The words must be the same, but for a policy that reads any.
        """
        pairs: dict[str, tuple[Any, Any]] = {}
        reads_any = "instruction" not in encoder_of(self.config.agent).reads
        if self.vocabulary != experiment.vocabulary and not reads_any:
            pairs["vocabulary"] = self.vocabulary, experiment.vocabulary
        uid: Any = getattr(robot, "uid", robot)
        if uid is not None and short_name(uid) != short_name(self.config.robot):
            pairs["robot"] = self.config.robot, uid
        if not any_task and self.env_id != experiment.id:
            pairs["task"] = self.env_id, experiment.id
        elif not any_task:
            then, now = self.metadata.get("task", {}), task_facts(experiment)
            pairs |= {k: (then[k], now.get(k)) for k in then if then[k] != now.get(k)}
        if pairs:
            told = [_difference(name, *pair) for name, pair in pairs.items()]
            if not pairs.keys() & {"vocabulary", "robot"}:  # else that would not do
                told.append("say any_task (--any-task) to try it")
            raise MismatchError(
                f"policy trained for {self.env_id} does not fit {experiment.id}: "
                + "; ".join(told)
            )

    def give_weights(self, agent: Agent) -> int:
        """Give another agent the weights that this one acts by; return how many.

        Raises:
            MismatchError: They have not the names, shapes or words of its own.
        """
        weights, words = acting(self.agent), agent.config.vocabulary
        given = {name: tuple(weight.shape) for name, weight in weights.items()}
        own = {name: tuple(weight.shape) for name, weight in acting(agent).items()}
        told = [
            f"{name}: got {given.get(name)}, expected {own.get(name)}"
            for name in given | own
            if given.get(name) != own.get(name)
        ]
        if not told and self.vocabulary != words:
            told = [_difference("vocabulary", self.vocabulary, words)]
        if told:
            raise MismatchError(
                f"weights of the policy for {self.env_id} do not fit this agent: "
                f"{shorten('; '.join(told), 300)}; expected a config with the policy's "
                f"{', '.join(WITH_WEIGHTS)} (`train ID --init-from` has them, if they "
                "are not told), and a task with its words"
            )
        agent.load_state_dict(weights, strict=False)
        return len(weights)

    def _see(self, obs: Observation) -> tuple[StateStack, State]:
        """Return the history with an observation added, and the state."""
        told = isinstance(obs, Mapping) and obs.get("extra", {}).get("instruction")
        expected = "a dict of tensors, with what is said: make the env with the "
        expected += "policy's `env_kwargs`"
        require(isinstance(told, Tensor), "observation", type(obs).__name__, expected)
        if self._stack is None:
            stack = StateStack(self.config.frames)
            return stack, stack.reset(obs)
        count = len(obs["extra"]["instruction"])
        if count != self._count:
            raise ValueError(
                f"observation: got one of {count} envs, expected {self._count} as "
                "before; call reset() before other envs are played"
            )
        stack = copy(self._stack)
        return stack, stack.push(obs, self._done)


def load_policy(
    id_or_path: str | Path, device: str | torch.device | None = None
) -> Policy:
    """Load a trained policy, to `act` on what envs observe; see `Policy`.

    Args:
        id_or_path: Id of a task, for the policy that ships with the package, or the
            path of a policy or checkpoint file such as `runs/ID/best.safetensors`, or
            the folder of a run, for its best policy.
        device: Where it computes; None: the GPU if there is one.

    Raises:
        CheckpointError: There is no such file, or it cannot be used.
    """
    path, name = Path(id_or_path), str(id_or_path)
    if name in ships():
        if path.exists():
            raise CheckpointError(
                f"policy: got {name!r}, which ships and lies in this folder, too; "
                f"expected {name}/best.safetensors, or another working folder"
            )
        path = shipped(name)
    if path.is_dir():
        path = path / "best.safetensors"
    if not path.exists():
        raise CheckpointError(
            f"policy: got {name!r}, expected an existing file, a run's "
            "folder with a best policy, or a task whose policy ships with the package: "
            + ", ".join(ships())
        )
    agent, config, metadata = load_agent(path)
    chosen = device or ("cuda" if torch.cuda.is_available() else "cpu")
    return Policy(agent.to(chosen), config, metadata)


def shipped(task_id: str) -> Path:
    """Return where the policy of a task is, if it ships with the package."""
    return FOLDER / "policies" / f"{task_id}.safetensors"


def ships() -> list[str]:
    """Return the tasks whose policy ships."""
    return [i for i in catalog.available() if shipped(i).is_file()]


def _difference(name: str, got: Any, expected: Any) -> str:
    """Return what differs; of long lists only the first place that does."""
    lists = isinstance(got, list | tuple) and isinstance(expected, list | tuple)
    if lists and len(got) == len(expected):
        place = next(i for i, item in enumerate(got) if item != expected[i])
        name, got, expected = f"{name}[{place}]", got[place], expected[place]
    return f"{name}: got {got!r}, expected {expected!r}"
