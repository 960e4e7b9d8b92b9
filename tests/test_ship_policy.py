"""A policy ships with the figures of what ships, and with where it comes from."""

import dataclasses
import json
from types import SimpleNamespace

import pytest
import ship_policy
from toy_envs import SPEC, toy_config, toy_state

from ir_maniskill.agent import Agent
from ir_maniskill.evaluation.audit import Row
from ir_maniskill.evaluation.evaluate import Rate
from ir_maniskill.training import checkpoint

TASK = {1: "NaoTouchCubeSingle-v1", 3: "NaoTouchCubeShuffled-v1"}
STATE = toy_state(20)


def fake_report(policy, *, episodes):
    figures = {"episodes": episodes, "acts": policy.agent.policy(STATE).tolist()}
    return SimpleNamespace(as_dict=lambda: figures)


def fake_scenes(policy, envs, *, scenes, **_):
    rate = Rate(scenes - 1, scenes)
    return [Row("same scene", "every sentence", rate, rate)]


@pytest.fixture(autouse=True)
def no_envs(monkeypatch):
    """Nothing is simulated."""
    none = SimpleNamespace(close=lambda: None)
    monkeypatch.setattr(ship_policy, "make_vec", lambda *_, **__: none)


def make_run(folder, task):
    """Write the best policy of a run."""
    config = dataclasses.replace(toy_config(folder), env_id=task, seed=5)
    agent = Agent(config.agent, SPEC)
    folder.mkdir()
    path = folder / "best.safetensors"
    checkpoint.save_policy(path, agent, config, steps=4096, evaluation={})
    return folder


@pytest.mark.parametrize("sentences", [1, 3])
def test_a_shipped_policy_has_its_figures_and_origin(tmp_path, monkeypatch, sentences):
    monkeypatch.setattr(ship_policy, "FOLDER", tmp_path / "policies")
    monkeypatch.setattr(ship_policy, "_commit", lambda: "0" * 40)
    monkeypatch.setattr(ship_policy, "evaluate", fake_report)
    monkeypatch.setattr(ship_policy, "same_scene", fake_scenes)
    run = make_run(tmp_path / "run5", TASK[sentences])
    ship_policy.ship(run, episodes=20, scenes=10)
    stem = tmp_path / "policies" / TASK[sentences]
    data = json.loads(stem.with_suffix(".json").read_text())
    assert (data["run"], data["training_seed"], data["steps"]) == ("run5", 5, 4096)
    assert data["episodes"] == 20 * sentences
    assert ("same_scene" in data) == (sentences > 1)
    if sentences > 1:
        assert data["same_scene"]["scenes"] == 10
        assert data["same_scene"]["exclusive"] == 0.9
    agent, _, facts = checkpoint.load_agent(stem.with_suffix(".safetensors"))
    assert facts["evaluation"]["commit"] == "0" * 40 and facts["steps"] == 4096
    assert agent.policy(STATE).tolist() == data["acts"], "another one was evaluated"
