"""What to do with a trained policy: evaluate, audit, film, or collect its episodes."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import torch

from ir_maniskill import experiment as catalog
from ir_maniskill.checks import ConfigError, require, require_choice, require_whole
from ir_maniskill.environment.arguments import SEEDS
from ir_maniskill.environment.vector import make_vec
from ir_maniskill.evaluation import audit as audits
from ir_maniskill.evaluation import dataset, video
from ir_maniskill.evaluation.evaluate import (
    EVALUATION_SEED,
    EvaluationReport,
    Player,
    choose_instructions,
    evaluate_policy,
    player_of,
)
from ir_maniskill.experiment import Experiment, Spoken
from ir_maniskill.goals import Instruction
from ir_maniskill.policy import Policy, load_policy

PolicyLike = Policy | str | Path
"""A policy, or what `load_policy` takes: a file, a run's folder, a task's id."""


def evaluate(
    policy: PolicyLike,
    task: str | None = None,
    *,
    episodes: int = 100,
    seed: int = EVALUATION_SEED,
    num_envs: int = 8,
    instruction: str | Instruction | None = None,
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
    require_whole("num_envs", num_envs, 1)
    policy, experiment, chosen = _prepare(
        policy, task, any_task, episodes, seed, instruction, env_kwargs
    )
    kwargs = {**policy.env_kwargs, **env_kwargs}
    # More envs than episodes would play what nobody counts.
    with closing(make_vec(experiment.id, min(num_envs, episodes), **kwargs)) as envs:
        return evaluate_policy(
            policy.agent.policy,
            envs,
            episodes=episodes,
            seed=seed,
            frames=policy.config.frames,
            instructions=chosen,
            progress=progress,
        )


def audit(
    policy: PolicyLike | Callable[[Any], Any],
    task: str | None = None,
    *,
    episodes: int = 200,
    seed: int = EVALUATION_SEED,
    num_envs: int = 8,
    any_task: bool = False,
    progress: bool = True,
    **env_kwargs: Any,
) -> audits.AuditReport:
    """Ask whether a policy looks, reads and copes with what is new to it.

    What it takes and raises is what `evaluate` does, and: `policy` may be any function
    from what a vector env observes to actions [N, J] in [-1, 1], or have such a method
    `act` and, if it remembers anything, `reset(done)`. What it has as `env_kwargs` goes
    to `make_vec`; without, it sees pictures and its actions change the joints' targets.
    `episodes` are those of each control and split, `num_envs` at least 2. All splits
    are played.

    Returns:
        The table: `print` shows it, `evaluation.plots.bars` draws it.
    """
    require_whole("num_envs", num_envs, 2)
    split = env_kwargs.get("split")
    require(split is None, "split", split, "none: an audit plays all there are")
    if isinstance(policy, Policy | str | Path):
        policy, experiment, _ = _prepare(
            policy, task, any_task, episodes, seed, None, env_kwargs
        )
        player = player_of(policy.agent.policy, policy.config.frames)
        kwargs = policy.env_kwargs
    else:
        if task is None:
            expected = "an id: a function does not say what it was trained for"
            raise ConfigError(f"task: got None, expected {expected}")
        experiment = catalog.get(task)
        player = _player(policy)
        kwargs = PICTURES | getattr(policy, "env_kwargs", {})
    return audits.audit(
        player,
        experiment,
        partial(make_vec, experiment.id, num_envs, **{**kwargs, **env_kwargs}),
        episodes=episodes,
        seed=seed,
        progress=progress,
    )


PICTURES = {"obs_mode": "rgb", "control_mode": "pd_joint_target_delta_pos"}
"""How envs are made for a policy that says nothing of it."""


def _player(policy: Any) -> Player:
    """Return somebody else's policy as one that is told where episodes begin."""
    act, reset = getattr(policy, "act", policy), getattr(policy, "reset", None)
    require(callable(act), "policy", policy, "a function, or what has a method `act`")

    def player(obs: Any, done: Any) -> Any:
        if reset is not None:
            reset(done)
        return torch.as_tensor(act(obs))

    return player


def record(
    policy: PolicyLike,
    path: Path | str,
    task: str | None = None,
    *,
    episodes: int = 3,
    seed: int = EVALUATION_SEED,
    speed: float = 0.5,
    instruction: str | Instruction | None = None,
    any_task: bool = False,
) -> Path:
    """Film a policy, what it sees and what it feels (.mp4 or .gif); return the file.

    What it takes and raises is what `evaluate` does, and: `path` is the file to write,
    the sentences take turns, and `speed` is 0.05 to 4, of which 1 is real time.

    Raises:
        OSError: The film cannot be written; this is found before anything is played.
    """
    path = Path(path)
    plays = isinstance(speed, float | int) and 0.05 <= speed <= 4
    require(plays, "speed", speed, "0.05 to 4")
    policy, experiment, chosen = _prepare(
        policy, task, any_task, episodes, seed, instruction, {}
    )
    steps = video.record(
        policy.agent.policy,
        experiment.id,
        episodes=episodes,
        seed=seed,
        frames=policy.config.frames,
        env_kwargs=policy.env_kwargs,
        instructions=chosen,
    )
    total = episodes * (experiment.episode_steps + 1)
    video.write_video(path, steps, speed=speed, total=total)
    return path


def collect(
    policy: PolicyLike,
    folder: Path | str,
    task: str | None = None,
    *,
    form: dataset.Format = "maniskill",
    episodes: int = 100,
    seed: int = dataset.DATASET_SEED,
    height: int = 256,
    failures: bool = False,
    instruction: str | None = None,
    any_task: bool = False,
    progress: bool = True,
    **env_kwargs: Any,
) -> int:
    """Play episodes and keep them for others to learn from; return how many were kept.

    What it takes and raises is what `evaluate` does, and: `folder` is where to write, a
    new folder or an empty one; `form` is "maniskill" for trajectories (.h5 and .json)
    or "lerobot" for a LeRobotDataset. Pictures of the former are those that the policy
    sees, those of the latter have `height` pixels, twice their width. `failures` keeps
    all episodes, not only those with success and no foul.

    Raises:
        ConfigError: The folder is not empty, or "lerobot" lacks a package.
    """
    require_choice("form", form, dataset.Format)
    text = isinstance(instruction, str | None)  # files do not hold goals of one's own
    require(text, "instruction", instruction, "a sentence")
    require_whole("height", height, 2)
    policy, experiment, chosen = _prepare(
        policy, task, any_task, episodes, seed, instruction, env_kwargs
    )
    kwargs = {**policy.env_kwargs, **env_kwargs}
    with closing(
        dataset.open_writer(form, Path(folder), experiment.id, height, kwargs)
    ) as writer:
        return dataset.play(
            policy,
            writer,
            choose_instructions(experiment, chosen),
            range(seed, seed + episodes),
            failures=failures,
            progress=progress,
        )


def _prepare(
    policy: PolicyLike,
    task: str | None,
    any_task: bool,
    episodes: int,
    seed: int,
    instruction: str | Instruction | None,
    env_kwargs: dict[str, Any],
) -> tuple[Policy, Experiment, list[str | Instruction] | None]:
    """Check what is asked for; return the policy, the task and what to say."""
    require_whole("episodes", episodes, 1)
    require_whole("seed", seed, 0, SEEDS[-1] - 2 * episodes)  # the last ones'
    expected = "a Policy, a task's id or a file; `audit` takes any function"
    require(isinstance(policy, Policy | str | Path), "policy", policy, expected)
    if not isinstance(policy, Policy):
        policy = load_policy(policy)
    experiment = catalog.get(task or policy.env_id)
    policy.require_match(experiment, env_kwargs.get("robot_uids"), any_task=any_task)
    wanted = None if instruction is None else [instruction]
    experiment = experiment.in_split(*map(env_kwargs.get, ("split", "kinds")))
    for said in choose_instructions(experiment, wanted):
        if said is not None and not isinstance(experiment.instructions, Spoken):
            experiment.check_refs(said)
    return policy, experiment, wanted
