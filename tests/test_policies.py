"""The shipped policies load, say how good they are, and are."""

import json
import runpy
from contextlib import closing
from importlib.resources import files
from pathlib import Path

import pytest
import torch
from torch import Tensor

from ir_maniskill import make_vec
from ir_maniskill.evaluation.evaluate import Policy, Score, evaluate_policy
from ir_maniskill.training.checkpoint import load_agent
from ir_maniskill.training.config import TrainConfig

DOCS = Path(__file__).parents[1] / "docs"
SHIPPED = sorted(Path(str(files("ir_maniskill.assets"))).glob("policies/*.safetensors"))


def play(policy: Policy, config: TrainConfig, episodes: int) -> Score:
    """Return how the policy does on scenes that nothing was chosen by."""
    with closing(
        make_vec(config.env_id, 2, **config.env_kwargs(training=False))
    ) as envs:
        return evaluate_policy(
            policy, envs, episodes=episodes, seed=3_000_000, frames=config.frames
        ).overall


def test_there_are_shipped_policies() -> None:
    assert SHIPPED


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_policy_says_where_it_comes_from(path: Path) -> None:
    _, config, facts = load_agent(path)
    assert config.env_id == path.stem
    assert facts["steps"] >= 2048
    figures = facts["evaluation"]
    assert figures["env_id"] == path.stem
    assert figures["overall"]["episodes"] >= 200
    assert len(figures["commit"]) == 40
    assert path.stat().st_size < 4e6


@pytest.mark.parametrize("path", [p for p in SHIPPED if "Touch" in p.stem])
def test_the_results_page_has_the_figures_of_a_shipped_policy(path: Path) -> None:
    page = (DOCS / "results.md").read_text()
    figures = json.loads(path.with_suffix(".json").read_text())
    for sentence, score in figures["instructions"].items():
        cells = [f"`{path.stem}`", sentence.split()[-2]]
        for name in ("success", "exclusive"):
            low, high = score[f"{name}_interval"]
            cells += [f"{100 * score[name]:.1f}% [{100 * low:.1f}, {100 * high:.1f}]"]
        cells += [f"{score['holding']:.0%}", f"{score['right_fingers']:.1f}"]
        assert "| " + " | ".join(cells) + " |" in page


@pytest.mark.render
@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_policy_does_what_it_is_told(path: Path) -> None:
    agent, config, facts = load_agent(path)
    told = facts["evaluation"]["overall"]
    score = play(agent.policy, config, episodes=6)
    # None sweeps up whatever there is; in six episodes, two may fail that need not.
    assert score.exclusive.value >= told["exclusive"] - 0.35
    assert score.holding > told["exclusive"] - 0.4


@pytest.mark.render
def test_the_film_of_a_failure_shows_one() -> None:
    film = runpy.run_path(str(DOCS / "make_images.py"))
    *_, last = film["episode"](film["SHUFFLED"], film["FAILURE"][1], film["FAILURE"][0])
    assert any(foul for _, foul in last.history)


@pytest.mark.render
@pytest.mark.parametrize("path", [p for p in SHIPPED if "Shuffled" in p.stem])
def test_where_colors_are_shuffled_a_policy_is_lost_without_its_eyes(
    path: Path,
) -> None:
    agent, config, _ = load_agent(path)

    def blindfolded(state: dict[str, Tensor]) -> Tensor:
        return agent.policy(state | {"images": torch.zeros_like(state["images"])})

    assert play(blindfolded, config, episodes=12).exclusive.value <= 0.5
