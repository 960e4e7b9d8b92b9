"""What to do with a trained policy, in one call each: evaluate it, film it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ir_maniskill import experiment as catalog
from ir_maniskill.evaluation import video
from ir_maniskill.evaluation.evaluate import (
    EVALUATION_SEED,
    EvaluationReport,
    evaluate_policy,
)
from ir_maniskill.experiment import Experiment
from ir_maniskill.policy import Policy, load_policy
from ir_maniskill.training.checkpoint import MismatchError

PolicyLike = Policy | str | Path
"""A policy, the file of one, or the id of a task whose policy ships."""


def evaluate(
    policy: PolicyLike,
    task: str | None = None,
    *,
    episodes: int = 100,
    seed: int = EVALUATION_SEED,
    num_envs: int = 8,
    instruction: str | None = None,
    any_task: bool = False,
    progress: bool = True,
    **env_kwargs: Any,
) -> EvaluationReport:
    """Play seeded episodes and report success, exclusive success and more.

    Args:
        policy: The policy, its file, or the id of a task whose policy ships.
        task: Id of the task to play; None: the one that it was trained for.
        episodes: How many, spread evenly over the sentences.
        seed: Seed of the first episode; episode e starts from seed + e.
        num_envs: Envs side by side; on a CPU the result is the same for any number.
        instruction: Play this sentence alone; None: all of the task's.
        any_task: Accept a policy that was trained for another task.
        progress: Whether to show a bar.
        **env_kwargs: As for `make_vec`, other than the policy was trained with.

    Returns:
        The figures, with intervals; `print` shows them as a table.

    Raises:
        CheckpointError: There is no such policy.
        MismatchError: It was trained for another task, robot or vocabulary.
        ValueError: There is no such sentence, or too few episodes.
    """
    robot = env_kwargs.get("robot_uids")
    policy, experiment = _matched(policy, task, any_task, robot)
    return evaluate_policy(
        policy.agent.policy,
        experiment.id,
        episodes=episodes,
        seed=seed,
        num_envs=num_envs,
        frames=policy.config.frames,
        env_kwargs={**policy.env_kwargs, **env_kwargs},
        instructions=_chosen(experiment, instruction),
        progress=progress,
    )


def record(
    policy: PolicyLike,
    path: Path | str,
    task: str | None = None,
    *,
    episodes: int = 3,
    seed: int = EVALUATION_SEED,
    speed: float = 0.5,
    instruction: str | None = None,
    any_task: bool = False,
) -> Path:
    """Film a policy, what it sees and what it feels (.mp4 or .gif); return the file.

    Args:
        policy: The policy, its file, or the id of a task whose policy ships.
        path: The file to write.
        task: Id of the task to play; None: the one that it was trained for.
        episodes: How many; the sentences take turns.
        seed: Seed of the first episode; episode e starts from seed + e.
        speed: How fast to play, 0.05 to 4; 1 is real time.
        instruction: Show this sentence alone; None: all of the task's.
        any_task: Accept a policy that was trained for another task.

    Raises:
        CheckpointError: There is no such policy.
        MismatchError: It was trained for another task, robot or vocabulary.
        OSError: The film cannot be written.
        ValueError: There is no such sentence, or another argument cannot be used.
    """
    path = Path(path)
    video.check_name(path)
    if episodes < 1 or not 0.05 <= speed <= 4:
        raise ValueError(
            f"episodes, speed: got {episodes}, {speed:g}, expected at least 1, "
            "and 0.05 to 4"
        )
    policy, experiment = _matched(policy, task, any_task)
    steps = video.record(
        policy.agent.policy,
        experiment.id,
        episodes=episodes,
        seed=seed,
        frames=policy.config.frames,
        env_kwargs=policy.env_kwargs,
        instructions=_chosen(experiment, instruction),
    )
    video.write_video(path, steps, speed=speed)
    return path


def _matched(
    policy: PolicyLike, task: str | None, any_task: bool, robot: str | None = None
) -> tuple[Policy, Experiment]:
    """Return the policy, and the task that it shall play."""
    if not isinstance(policy, Policy):
        policy = load_policy(policy)
    experiment = catalog.get(task or policy.env_id)
    try:
        policy.require_match(experiment, robot, any_task=any_task)
    except MismatchError as error:
        hint = "" if any_task else "; name its task, or use any_task to try it here"
        raise MismatchError(f"{error}{hint}") from error
    return policy, experiment


def _chosen(experiment: Experiment, text: str | None) -> tuple[int, ...] | None:
    """Return the index of a sentence of the task; None: all of them."""
    if text is None:
        return None
    known = [sentence.lower().rstrip(".") for sentence in experiment.sentences]
    wanted = text.lower().strip().rstrip(".")
    if wanted not in known:
        listed = ", ".join(map(repr, experiment.sentences))
        raise ValueError(f"instruction: got {text!r}, available: {listed}")
    return (known.index(wanted),)
