import dataclasses
import json
import random

import numpy as np
import pytest
import torch
from toy_envs import toy_config

from ir_maniskill.agent import Agent, StateSpec
from ir_maniskill.training import checkpoint
from ir_maniskill.training.checkpoint import CheckpointError, Stored
from ir_maniskill.training.config import (
    CONFIGS,
    AgentConfig,
    ConfigError,
    PPOConfig,
    TrainConfig,
    from_json,
    to_json,
)

SPEC = StateSpec(2, 3, 0, 0, 0, 2, 2, 7, 2)


def make_state(n=3):
    return {
        "instruction": torch.ones(n, 2, dtype=torch.long),
        "proprioception": torch.rand(n, 3, 2),
        "target": torch.rand(n, 3, 2),
        "touch": torch.zeros(n, 3, 2),
        "privileged": torch.rand(n, 7),
    }


@pytest.fixture
def trained(tmp_path):
    """An agent and an optimizer that have made one step."""
    config = toy_config(tmp_path)
    agent = Agent(config.agent, SPEC)
    optimizer = torch.optim.Adam(agent.parameters(), 1e-3)
    state = make_state()
    judgement = agent.evaluate_actions(state, torch.zeros(3, 2))
    (judgement.log_prob.sum() + judgement.value.sum()).backward()
    optimizer.step()
    return agent, optimizer, config


@pytest.mark.parametrize("name", CONFIGS)
def test_configs_survive_json(name):
    assert from_json(to_json(CONFIGS[name])) == CONFIGS[name]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sede": 1}, "unknown: \\['sede'\\]"),
        ({"seed": "1"}, "seed: got '1', expected a value of type int"),
        ({"seed": True}, "seed: got True"),
        ({"agent": 3}, "AgentConfig: got 3, expected an object"),
        ({"num_envs": 7}, "num_envs: got 7, expected a divisor of 64"),
        ({"stop_at_success": 1.5}, "stop_at_success: got 1.5, expected 0 to 1"),
    ],
)
def test_wrong_configs_say_what_was_got_and_expected(change, message):
    with pytest.raises(ConfigError, match=message):
        from_json(json.dumps(json.loads(to_json(TrainConfig())) | change))


def test_a_missing_field_is_named():
    data = json.loads(to_json(TrainConfig()))
    del data["ppo"]["clip"]
    with pytest.raises(ConfigError, match=r"PPOConfig.*missing: \['clip'\]"):
        from_json(json.dumps(data))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: AgentConfig(senses=("smell",)),
            "senses: got 'smell'",
        ),
        (lambda: AgentConfig(vision="resnet"), "'strided', 'paper'"),
        (lambda: AgentConfig(language_heads=3), "language_width: got 50.*3 heads"),
        (lambda: AgentConfig(std=0.0), "std: got 0.0, expected more than 0"),
        (lambda: PPOConfig(gamma=1.1), "gamma: got 1.1, expected 0 to 1"),
        (lambda: PPOConfig(minibatch=1), "minibatch: got 1, expected 2 to 2048"),
        (lambda: TrainConfig(total_steps=0), "total_steps: got 0"),
    ],
)
def test_values_that_cannot_work_are_refused(make, message):
    with pytest.raises(ConfigError, match=message):
        make()


def test_the_papers_numbers():
    paper = CONFIGS["paper"]
    assert paper.steps_per_update == 24 * 32
    assert (paper.ppo.learning_rate, paper.ppo.epochs) == (1e-5, 60)
    assert (paper.ppo.gae_lambda, paper.ppo.minibatch) == (1.0, None)
    assert (paper.agent.std_mode, paper.agent.std) == ("fixed", 0.36)
    assert paper.env_kwargs(training=True)["obs_mode"] == "rgb"


def test_only_training_asks_for_the_simulators_state():
    config = TrainConfig()
    assert config.env_kwargs(training=True)["obs_mode"] == "rgb+state_dict"
    assert config.env_kwargs(training=False)["obs_mode"] == "rgb"
    blind = dataclasses.replace(config, agent=AgentConfig(senses=("touch",)))
    assert blind.env_kwargs(training=False)["obs_mode"] == "state_dict"


def test_weights_and_optimizer_come_back_bit_for_bit(trained, tmp_path):
    agent, optimizer, config = trained
    packed = checkpoint.pack(agent, optimizer)
    path = tmp_path / "last.safetensors"
    facts = checkpoint.describe(agent, config)
    checkpoint.write(path, Stored(checkpoint.CHECKPOINT, packed, facts))
    other = Agent(config.agent, SPEC)
    other_optimizer = torch.optim.Adam(other.parameters(), 1e-3)
    checkpoint.unpack(checkpoint.read(path).tensors, other, other_optimizer)
    again = checkpoint.pack(other, other_optimizer)
    assert again.keys() == packed.keys()
    assert all(torch.equal(again[name], packed[name]) for name in packed)
    assert any(name.startswith("optimizer.") for name in packed)


def test_random_generators_go_on_where_they_were():
    def draw():
        return torch.rand(3).tolist(), np.random.rand(3).tolist(), random.random()

    random.gauss(0, 1)  # leaves a second number waiting
    np.random.randn()
    tensors, plain = checkpoint.random_state()
    plain = json.loads(json.dumps(plain))
    first = draw()
    checkpoint.set_random_state(tensors, plain)
    assert draw() == first


@pytest.mark.parametrize("half", [False, True])
def test_a_policy_acts_after_loading_as_before(trained, tmp_path, half):
    agent, _, config = trained
    path = tmp_path / "policy.safetensors"
    figures = {"success": 1.0}
    checkpoint.save_policy(path, agent, config, steps=7, evaluation=figures, half=half)
    loaded, stored_config, metadata = checkpoint.load_policy(path)
    state = make_state()
    tolerance = 1e-3 if half else 0
    assert torch.allclose(loaded.policy(state), agent.policy(state), atol=tolerance)
    assert stored_config == config
    assert (metadata["steps"], metadata["evaluation"]) == (7, figures)
    with pytest.raises(RuntimeError, match="without its critic"):
        loaded.act(state)


def test_a_policy_file_is_smaller_than_a_checkpoint(trained, tmp_path):
    agent, optimizer, config = trained
    small, large = tmp_path / "policy", tmp_path / "checkpoint"
    checkpoint.save_policy(small, agent, config, steps=0, evaluation={}, half=True)
    facts = checkpoint.describe(agent, config)
    packed = checkpoint.pack(agent, optimizer)
    checkpoint.write(large, Stored(checkpoint.CHECKPOINT, packed, facts))
    assert small.stat().st_size < large.stat().st_size / 4
    agent_of_checkpoint, _, _ = checkpoint.load_policy(large)
    assert agent_of_checkpoint.act(make_state()).value.shape == (3,)


def test_a_crash_while_writing_leaves_the_old_file(trained, tmp_path, monkeypatch):
    agent, _, config = trained
    path = tmp_path / "policy"
    checkpoint.save_policy(path, agent, config, steps=1, evaluation={})

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint.os, "fsync", full)
    with pytest.raises(CheckpointError, match=r"cannot write .*: No space left"):
        checkpoint.save_policy(path, agent, config, steps=2, evaluation={})
    assert checkpoint.read(path).metadata["steps"] == 1
    assert [file.name for file in tmp_path.iterdir()] == ["policy"]


def test_500_mutated_files_each_get_the_one_clear_error(trained, tmp_path):
    agent, _, config = trained
    path = tmp_path / "policy"
    checkpoint.save_policy(path, agent, config, steps=1, evaluation={}, half=True)
    good, generator = path.read_bytes(), random.Random(0)
    header = 8 + int.from_bytes(good[:8], "little")
    for case in range(500):
        data, kind = bytearray(good), case % 5
        place = generator.randrange(header if kind < 2 else len(data))
        if kind == 0:  # one bit, in the header
            data[place] ^= 1 << generator.randrange(8)
        elif kind == 1:  # some bytes, in the header
            data[place : place + 4] = generator.randbytes(4)
        elif kind == 2:  # cut short
            del data[place:]
        elif kind == 3:  # one bit, anywhere
            data[place] ^= 1 << generator.randrange(8)
        else:  # something in between
            data[place:place] = generator.randbytes(generator.randrange(1, 64))
        if data == good:
            continue
        path.write_bytes(data)
        with pytest.raises(CheckpointError):
            checkpoint.load_policy(path)


@pytest.mark.parametrize(
    "data", [b"", b"PK\x03\x04 a zip", b"\xff" * 64, b"\x02" + b"\0" * 7]
)
def test_foreign_files_are_refused(tmp_path, data):
    path = tmp_path / "foreign"
    path.write_bytes(data)
    with pytest.raises(CheckpointError, match="not ours"):
        checkpoint.load_policy(path)


def test_a_pickle_is_never_executed(tmp_path):
    path, witness = tmp_path / "evil", tmp_path / "witness"

    class Evil:
        def __reduce__(self):
            return (open, (str(witness), "w"))

    torch.save(Evil(), path)
    with pytest.raises(CheckpointError):
        checkpoint.load_policy(path)
    assert not witness.exists()


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(CheckpointError, match=r"cannot read .*nothing: No such file"):
        checkpoint.load_policy(tmp_path / "nothing")


def test_weights_of_another_size_than_their_config_are_refused(trained, tmp_path):
    agent, _, config = trained
    path = tmp_path / "policy"
    facts = checkpoint.describe(agent, config)
    facts["spec"]["actions"] = 26
    weights = {k: v for k, v in agent.state_dict().items() if "critic" not in k}
    checkpoint.write(path, Stored(checkpoint.POLICY, weights, facts))
    with pytest.raises(CheckpointError, match=r"do not belong together.*size mismatch"):
        checkpoint.load_policy(path)
