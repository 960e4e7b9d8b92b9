"""The shipped policies load, say how good they are, and are."""

from importlib.resources import files
from pathlib import Path

import pytest
import torch
from torch import Tensor

from ir_maniskill.training.checkpoint import load_policy
from ir_maniskill.training.evaluate import evaluate_policy

SHIPPED = sorted(Path(str(files("ir_maniskill.assets"))).glob("policies/*.safetensors"))


def test_there_are_shipped_policies() -> None:
    assert SHIPPED


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_policy_says_where_it_comes_from(path: Path) -> None:
    _, config, facts = load_policy(path)
    assert config.env_id == path.stem
    assert facts["steps"] >= 2048
    figures = facts["evaluation"]
    assert figures["env_id"] == path.stem
    assert figures["overall"]["episodes"] >= 200
    assert len(figures["commit"]) == 40
    assert path.stat().st_size < 4e6


@pytest.mark.render
@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_policy_does_what_it_is_told(path: Path) -> None:
    agent, config, _ = load_policy(path)
    report = evaluate_policy(
        agent.policy,
        config.env_id,
        episodes=6,
        seed=3_000_000,
        num_envs=2,
        frames=config.frames,
        env_kwargs=config.env_kwargs(training=False),
    )
    assert report.overall.success.value >= 5 / 6
    assert report.overall.touching > 0.6


@pytest.mark.render
@pytest.mark.parametrize("path", [p for p in SHIPPED if "Shuffled" in p.stem])
def test_where_colors_are_shuffled_a_policy_is_lost_without_its_eyes(
    path: Path,
) -> None:
    agent, config, _ = load_policy(path)

    def blindfolded(state: dict[str, Tensor]) -> Tensor:
        return agent.policy(state | {"images": torch.zeros_like(state["images"])})

    report = evaluate_policy(
        blindfolded,
        config.env_id,
        episodes=12,
        seed=3_000_000,
        num_envs=2,
        frames=config.frames,
        env_kwargs=config.env_kwargs(training=False),
    )
    assert report.overall.exclusive.value <= 0.5
