"""Makes an `Experiment` known to `gym.make`."""

from __future__ import annotations

import gymnasium as gym
from mani_skill.utils.registration import register_env

from ir_maniskill import experiment as catalog
from ir_maniskill.environment.touch_env import TouchEnv
from ir_maniskill.experiment import Experiment, ExperimentError


def register(experiment: Experiment) -> Experiment:
    """Register an experiment as a task: afterwards `gym.make(experiment.id)` works.

    Registering the same experiment again does nothing.

    Returns:
        The experiment itself, so that a task file reads `TASK = register(...)`.

    Raises:
        ExperimentError: Another experiment, or a task of another package, has that id
            already.
    """
    taken = experiment.id in gym.registry
    if taken and catalog.CATALOG.get(experiment.id) != experiment:
        raise ExperimentError(
            f"experiment id: got {experiment.id!r}, which is taken; "
            "register yours under another id"
        )
    catalog.CATALOG[experiment.id] = experiment
    if not taken:
        register_env(
            experiment.id,
            max_episode_steps=experiment.episode_steps,
            experiment=experiment.id,
        )(TouchEnv)
    return experiment
