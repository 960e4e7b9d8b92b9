"""A loaded policy acts on what envs observe, and remembers what it saw."""

import logging
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import ir_maniskill
from ir_maniskill import experiment as catalog
from ir_maniskill.checks import ConfigError
from ir_maniskill.environment.robots import Nao
from ir_maniskill.environment.senses import StateStack, read_text
from ir_maniskill.policy import shipped
from ir_maniskill.training.checkpoint import CheckpointError, MismatchError

TASK = "NaoTouchCubeMulti-v1"


@pytest.fixture(scope="module")
def policy():
    return ir_maniskill.load_policy(TASK, device="cpu")


def observed(count=2):
    """Return a random observation of `count` envs."""
    color = torch.randint(256, (count, 64, 32, 3), dtype=torch.uint8)
    return {
        "agent": {
            "proprioception": torch.rand(count, 26),
            "target": torch.rand(count, 26),
        },
        "extra": {
            "touch": torch.zeros(count, 6),
            "instruction": torch.tensor([[3, 4, 5, 8, 2]] * count),
        },
        "sensor_data": {
            "front_camera": {"rgb": color},
            "top_camera": {"rgb": color.flip(0)},
        },
    }


def test_it_acts_on_its_own_history(policy):
    seen, stack = [observed() for _ in range(4)], StateStack(3)
    policy.reset()
    assert torch.equal(policy.act(seen[0]), policy.agent.policy(stack.reset(seen[0])))
    assert torch.equal(policy.act(seen[1]), policy.agent.policy(stack.push(seen[1])))
    done = torch.tensor([True, False])
    policy.reset(done)
    expected = policy.agent.policy(stack.push(seen[2], done))
    assert torch.equal(policy.act(seen[2]), expected)
    assert torch.equal(policy.act(seen[3]), policy.agent.policy(stack.push(seen[3])))
    policy.reset()
    assert torch.equal(policy.act(seen[0]), policy.agent.policy(stack.reset(seen[0])))


def test_what_it_cannot_act_on_it_has_not_seen(policy):
    seen, stack = [observed() for _ in range(3)], StateStack(3)
    policy.reset()
    with pytest.raises(ValueError, match="images of the state: got nothing"):
        policy.act({name: seen[0][name] for name in ("agent", "extra")})
    assert torch.equal(policy.act(seen[0]), policy.agent.policy(stack.reset(seen[0])))
    done = torch.tensor([True, False])
    policy.reset(done)
    with pytest.raises(ValueError, match="got one of 3 envs"):
        policy.act(observed(3))
    with pytest.raises(ValueError, match="sentence of 17 tokens"):
        policy.act(seen[1], "the " * 17)
    expected = policy.agent.policy(stack.push(seen[2], done))
    assert torch.equal(policy.act(seen[2]), expected)
    policy.reset()
    assert policy.act(observed(3)).shape == (3, 26)


def test_it_can_be_told_any_sentence(policy, caplog):
    obs = observed()

    def told(sentences):
        policy.reset()
        return policy.act(obs, sentences)

    obs["extra"]["instruction"] = torch.tensor([[3, 4, 6, 8, 2]] * 2)
    red = told(None)
    assert torch.equal(red, told("touch the RED cube."))
    both = told(["Touch the red cube.", "Touch the blue cube."])
    assert torch.allclose(both[0], red[0], atol=1e-5)
    assert not torch.allclose(both[1], red[1], atol=1e-2)
    assert read_text(policy.read(["à gauche"])["text"]) == ["à gauche"]
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            told("Touch the pink cube.")
    assert caplog.text.count("not in the vocabulary: pink") == 1
    with pytest.raises(ValueError, match="sentence of 17 tokens, expected at most 16"):
        told("Touch the " + 12 * "very " + "blue cube.")
    with pytest.raises(
        ValueError, match=r"sentences: got \['Stop'\], expected one for"
    ):
        told(["Stop"])
    assert told("").shape == (2, 26)


@pytest.mark.parametrize(
    "obs",
    [
        torch.zeros(1, 78),
        {"agent": {"qpos": torch.zeros(1, 9)}, "extra": {}},
        {"agent": {}, "extra": {"instruction": np.zeros((1, 5))}},
    ],
)
def test_observations_of_other_envs_are_refused(obs):
    policy = ir_maniskill.load_policy("NaoInstruct-v1", device="cpu")
    with pytest.raises(ValueError, match="observation: got .* a dict of t.*env_kwargs"):
        policy.act(obs)


def test_it_says_what_it_was_trained_for(policy):
    assert policy.env_id == TASK
    assert policy.vocabulary == catalog.VOCABULARY
    assert policy.env_kwargs["sensor_configs"]["width"] == 32
    for robot in ("nao", Nao):
        policy.require_match(catalog.get(TASK), robot)
    with pytest.raises(MismatchError, match="expected 'NaoTouchButtonMulti-v1'"):
        policy.require_match(catalog.get("NaoTouchButtonMulti-v1"))


def test_a_path_is_a_path(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run.safetensors").touch()
    shutil.copy(shipped("NaoInstruct-v1"), tmp_path / "run" / "best.safetensors")
    for known in (tmp_path / "run", Path("NaoInstruct-v1")):
        assert ir_maniskill.load_policy(known).env_id == "NaoInstruct-v1"


def test_what_cannot_be_loaded_says_what_can(tmp_path, monkeypatch):
    with pytest.raises(CheckpointError, match=r"got 'Nao-v1', .*: .*CubeTriangle-v1"):
        ir_maniskill.load_policy("Nao-v1")
    with pytest.raises(CheckpointError, match="expected .* a run's folder with a best"):
        ir_maniskill.load_policy(tmp_path)
    (tmp_path / TASK).mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CheckpointError, match=f"{TASK}', which ships and lies in this"):
        ir_maniskill.load_policy(TASK)
    with pytest.raises(ConfigError, match="policy: got .*`audit` takes any function"):
        ir_maniskill.evaluate(lambda obs: obs, TASK)


@pytest.mark.render
def test_a_vector_of_envs_is_played(policy, multi_vec):
    torch.manual_seed(0)
    obs, _ = multi_vec.reset(seed=3_000_000, options={"instruction": 1})
    policy.reset()
    for _ in range(32):
        obs, _, terminated, truncated, info = multi_vec.step(policy.act(obs))
        policy.reset(terminated | truncated)
    assert info["final_info"]["success_once"].all()
