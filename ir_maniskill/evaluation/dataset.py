"""Datasets: episodes of a policy, for others to learn from.

"maniskill" is what ManiSkill's `RecordEpisode` writes and its replay reads, "lerobot" a
LeRobotDataset.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

import gymnasium as gym
import torch
from mani_skill.utils.wrappers import RecordEpisode
from torch import Tensor
from tqdm import tqdm

from ir_maniskill.checks import ConfigError, require
from ir_maniskill.environment.senses import Observation
from ir_maniskill.evaluation.evaluate import threads
from ir_maniskill.files import require_writable, write_json
from ir_maniskill.goals import Instruction
from ir_maniskill.policy import Policy

Format = Literal["maniskill", "lerobot"]

DATASET_SEED = 3_000_000
"""Seed of the first episode, apart from those of training and evaluation."""


class Writer(Protocol):
    """Keeps episodes of one env, one after the other."""

    env: gym.Env
    """The env."""

    def step(self, obs: Observation, action: Tensor) -> tuple:
        """Step the env from what was observed; return what it does."""

    def end(self, sentence: str, kept: bool) -> None:
        """End the episode; without `kept` it is dropped."""

    def close(self) -> None:
        """Complete the dataset of the episodes so far, and close the env."""


def open_writer(
    form: Format, folder: Path, env_id: str, height: int, env_kwargs: dict[str, Any]
) -> Writer:
    """Return what keeps episodes of a task in a folder.

    Raises:
        ConfigError: The folder is not empty, or a package is missing.
        OSError: It cannot be written.
    """
    new = not folder.exists() or (folder.is_dir() and not any(folder.iterdir()))
    require(new, "folder of the dataset", str(folder), "a new one, or an empty one")
    if form == "maniskill":
        require_writable(folder / env_id)
        return ManiSkillWriter(folder, env_id, env_kwargs)
    try:
        from ir_maniskill.evaluation.lerobot import LeRobotWriter  # pyarrow is an extra
    except ModuleNotFoundError as error:
        if error.name != "pyarrow":
            raise
        raise ConfigError(
            "format 'lerobot': got no module 'pyarrow', expected it installed: "
            "pip install 'ir-maniskill[lerobot]'"
        ) from None
    require_writable(folder / env_id)
    return LeRobotWriter(folder, env_id, height, env_kwargs)


@threads(1)
@torch.no_grad()
def play(
    policy: Policy,
    writer: Writer,
    told: Sequence[Instruction | None],
    seeds: Sequence[int],
    *,
    failures: bool,
    progress: bool,
) -> int:
    """Play an episode from each seed, and return how many were kept.

    They are those with success and no foul, or all of them with `failures`. What is
    `told` takes turns; None: each episode draws its own.
    """
    kept = 0
    base: Any = writer.env.unwrapped
    for index, seed in enumerate(tqdm(seeds, "record", disable=not progress)):
        said = told[index % len(told)]
        options = {} if said is None else {"instruction": said.text}
        obs, _ = writer.env.reset(seed=seed, options=options)
        policy.reset()
        done = False
        while not done:
            obs, _, _, truncated, info = writer.step(obs, policy.act(obs))
            done = bool(truncated)
        good = failures or bool(info["exclusive_success"])
        writer.end(base.get_language_instruction()[0], good)
        kept += good
    return kept


class ManiSkillWriter:
    """Has ManiSkill's own wrapper write; adds the sentences to its JSON file."""

    def __init__(self, folder: Path, env_id: str, env_kwargs: dict[str, Any]) -> None:
        self.env = RecordEpisode(
            gym.make(env_id, **env_kwargs),
            str(folder),
            trajectory_name=env_id,
            save_video=False,
            save_on_reset=False,
            source_type="reinforcement learning",
        )
        self._facts = folder / f"{env_id}.json"
        self._sentences: list[str] = []

    def step(self, obs: Observation, action: Tensor) -> tuple:
        """Step the env, which keeps all of it."""
        return self.env.step(action)

    def end(self, sentence: str, kept: bool) -> None:
        """Write the episode, or drop it."""
        self.env.flush_trajectory(save=kept)
        self._sentences += [sentence] * kept

    def close(self) -> None:
        """Complete the JSON file."""
        self.env.close()
        facts = json.loads(self._facts.read_text())
        for episode, sentence in zip(facts["episodes"], self._sentences, strict=True):
            episode["instruction"] = sentence
        write_json(self._facts, facts)
