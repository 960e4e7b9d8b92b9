"""Train an agent: what a run is made of, and where it goes on."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from ir_maniskill import experiment as catalog
from ir_maniskill.agent.agent import Agent
from ir_maniskill.agent.language_system import encoder_of
from ir_maniskill.checks import require, require_choice
from ir_maniskill.environment.robots.robot import robot_class
from ir_maniskill.environment.vector import VectorEnv, make_vec
from ir_maniskill.experiment import Experiment, Spoken
from ir_maniskill.policy import load_policy
from ir_maniskill.training import distributed
from ir_maniskill.training.algorithm import Algorithm
from ir_maniskill.training.config import (
    CONFIGS,
    WITH_WEIGHTS,
    TrainConfig,
    from_data,
    require_same,
)
from ir_maniskill.training.ppo import PPO
from ir_maniskill.training.run_folder import RunFolder, interruptible, stored_config
from ir_maniskill.training.runner import Runner
from ir_maniskill.training.sac import SAC

log = logging.getLogger(__name__)

ALGORITHMS: dict[str, type[Algorithm]] = {"ppo": PPO, "sac": SAC}
"""What `TrainConfig.algorithm` names."""


def train(
    task: str,
    resume: bool = False,
    envs: VectorEnv | None = None,
    eval_envs: VectorEnv | None = None,
    algorithm: type[Algorithm] | str | None = None,
    *,
    preset: str = "default",
    **changes: Any,
) -> Path:
    """Train an agent and return the file of its best policy.

    Whatever stops it (Ctrl-C, a worker that fails) leaves a checkpoint of the last
    complete update; a full disk and numbers that are not finite leave the one before.
    Where torchrun started several processes, each trains on its share of the envs.

    Args:
        task: [MODULE:]ID of the task.
        resume: Go on from the folder's last checkpoint, if there is one, with the
            folder's own config; of what is given only `MAY_CHANGE` may differ from it.
        envs: Vector of this rank's envs to use (and leave open) instead of making one.
        eval_envs: The same for evaluations, which only the first rank makes.
        algorithm: What learns, a class or "ppo" or "sac"; None: what the preset names.
        preset: Which of `CONFIGS` to train a task with; a run that is resumed keeps
            its own.
        **changes: Fields that shall be other than in the preset; a dict changes some
            of a part, e.g. `ppo={"gamma": 0.95}`. With `init_from`, the
            policy decides instead of the preset what its weights need.

    Raises:
        CheckpointError: If the folder or its checkpoint cannot be used, or there is no
            policy to begin with.
        ConfigError: If the run was begun with another config, or the envs, their number
            or that of the episodes do not fit.
        MismatchError: If the weights to begin with do not fit the agent.
        OSError: If the folder cannot be written to.
        RankError: If another rank failed.
        TrainingDivergedError: If a number stopped being finite.
        WorkerError: If a simulator process died or hangs.
    """
    changes = {k: str(v) if isinstance(v, Path) else v for k, v in changes.items()}
    if isinstance(algorithm, str):
        changes["algorithm"], algorithm = algorithm, None
    require(isinstance(task, str), "task", task, "an id")
    require_choice("preset", preset, CONFIGS)
    known = [name for name in vars(CONFIGS[preset]) if name != "env_id"]
    for name in changes:
        require_choice("argument of train", name, known)
    if envs is None:
        task = catalog.get(task).id  # without its module
    changes = {"env_id": task, "out": f"runs/{task}", **changes}
    stored = stored_config(Path(changes["out"])) if resume else None
    usual = stored or beginning_with(changes.get("init_from"), CONFIGS[preset])
    return run(_changed(usual, changes), resume, envs, eval_envs, algorithm)


def _changed(config: TrainConfig, changes: Mapping[str, Any]) -> TrainConfig:
    """Return the config with other fields; a dict changes some of a part's."""
    values = dict(changes)
    for name, value in changes.items():
        part: Any = vars(config).get(name)
        if isinstance(value, Mapping) and hasattr(part, "__dataclass_fields__"):
            for field in value:
                require_choice(f"argument {name} of train", field, vars(part))
            values[name] = dataclasses.replace(part, **value)
    return dataclasses.replace(config, **values)


def run(
    config: TrainConfig,
    resume: bool = False,
    envs: VectorEnv | None = None,
    eval_envs: VectorEnv | None = None,
    algorithm: type[Algorithm] | None = None,
) -> Path:
    """Train as `train` does, but take `config` as it is, also to resume."""
    with contextlib.ExitStack() as leaving:
        leaving.enter_context(interruptible())
        leaving.enter_context(distributed.group())
        _require_shares(config)
        folder = distributed.from_first(
            lambda: RunFolder(Path(config.out), resume=resume)
        )
        leaving.callback(folder.close)
        leaving.callback(torch.set_num_threads, torch.get_num_threads())
        task = envs.experiment if envs is not None else catalog.get(config.env_id)
        config = for_experiment(config, task)
        # Read while the folder is ours: another run may have ended there meanwhile.
        stored = distributed.from_first(folder.read_last)
        if stored is not None:
            require_same(from_data(stored.metadata["config"]), config)
        if envs is None:
            envs = make_envs(config, config.num_envs // distributed.size())
            leaving.callback(envs.close)
        _require_fit(config, envs)
        _require_made_for(config, envs, "robot_uids", "control_mode", "reward_mode")

        @functools.cache
        def evaluated_in() -> VectorEnv:
            """Return the envs to evaluate in, made when they are first asked for."""
            if eval_envs is not None:
                _require_made_for(config, eval_envs, "robot_uids", "control_mode")
                return eval_envs
            count = min(config.num_envs, config.eval_episodes)
            made = make_envs(config, count, training=False)
            leaving.callback(made.close)
            return made

        chosen = algorithm or ALGORITHMS[config.algorithm]
        runner = Runner(config, folder, envs, evaluated_in, chosen)
        if stored is not None:
            runner.restore(stored)
        else:
            if resume:
                log.info("no checkpoint in %s: a new run begins", config.out)
            if config.init_from is not None:
                _give_weights(config.init_from, runner.algorithm.agent)
        runner.learn()
    return folder.best


def beginning_with(policy: str | None, config: TrainConfig) -> TrainConfig:
    """Return the config with what a policy's weights need, if there is a policy."""
    if policy is None:
        return config
    trained = load_policy(policy, device="cpu").config
    needed = {name: getattr(trained, name) for name in WITH_WEIGHTS}
    return dataclasses.replace(config, init_from=policy, **needed)


def _give_weights(name: str, agent: Agent) -> None:
    """Let an agent begin with the weights of a policy."""
    policy = load_policy(name, device="cpu")
    given, steps = policy.give_weights(agent), policy.metadata.get("steps")
    origin, new = f"{policy.env_id}, {steps} steps", len(agent.state_dict()) - given
    log.info("begin with %d weights of %s (%s); %d are new", given, name, origin, new)


def for_experiment(config: TrainConfig, experiment: Experiment) -> TrainConfig:
    """Return the config with what the experiment decides: senses, words and kinds.

    An agent that reads any text keeps the words of the weights it begins with.
    """
    senses, words = config.agent.senses or experiment.senses, experiment.vocabulary
    if config.init_from and "instruction" not in encoder_of(config.agent).reads:
        words = config.agent.vocabulary
    agent = dataclasses.replace(config.agent, senses=senses, vocabulary=words)
    said = experiment.instructions
    spoken = said.kinds if isinstance(said, Spoken) else ()
    kinds = tuple(kind for kind in config.kinds or () if kind in spoken) or None
    return dataclasses.replace(config, agent=agent, kinds=kinds)


def _require_shares(config: TrainConfig) -> None:
    """Raise unless every rank gets equal parts of the envs and of each minibatch."""
    ranks, envs, batch = distributed.size(), config.num_envs, config.ppo.minibatch
    shared = f"a multiple of {ranks}: the ranks share them"
    require(envs % ranks == 0, "num_envs", envs, shared)
    fits = batch is None or batch >= ranks
    require(fits, "minibatch", batch, f"at least {ranks}: the ranks share it")


def _require_fit(config: TrainConfig, envs: VectorEnv) -> None:
    """Raise unless the envs are those of the config, and it evaluates them wholly."""
    task, share = envs.experiment.id, config.num_envs // distributed.size()
    expected = f"{task!r}, the task of the envs given"
    require(config.env_id == task, "env_id", config.env_id, expected)
    expected = f"{share}, this rank's share of {config.num_envs}"
    require(envs.num_envs == share, "num_envs of those given", envs.num_envs, expected)
    episodes, sentences = config.eval_episodes, len(envs.experiment.sentences)
    expected = f"at least {sentences}, one for each sentence"
    require(episodes >= sentences, "eval_episodes", episodes, expected)


def _require_made_for(config: TrainConfig, envs: VectorEnv, *names: str) -> None:
    """Raise unless envs that were given were made as the config says."""
    usual = {"robot_uids": "nao", "control_mode": "pd_joint_pos"}
    made = {**usual, "reward_mode": "sparse", **envs.env_kwargs}
    expected = config.env_kwargs(training=True)
    for name in names:
        got, wanted = made[name], expected[name]
        if name == "robot_uids":
            got, wanted = robot_class(got).uid, robot_class(wanted).uid
        require(got == wanted, f"{name} of the envs given", got, f"{wanted!r}")


def make_envs(config: TrainConfig, count: int, *, training: bool = True) -> VectorEnv:
    """Make envs to learn or to be evaluated in, on this rank's device."""
    device, kwargs = distributed.device(), config.env_kwargs(training=training)
    sim_backend, render_backend = str(config.sim_backend), str(config.render_backend)
    if device.index is not None:  # of several GPUs, this rank's
        sim_backend = sim_backend.replace("cuda", str(device))
        render_backend = render_backend.replace("auto", f"sapien_{device}")
    return make_vec(
        config.env_id,
        count,
        num_workers=config.num_workers or distributed.cores(),
        sim_backend=sim_backend,
        render_backend=render_backend,
        **kwargs,
    )
