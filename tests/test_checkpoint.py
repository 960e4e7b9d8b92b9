import dataclasses
import io
import json
import math
import os
import pickle
import random
import resource
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from toy_envs import SPEC, ToyVectorEnv, toy_config, toy_state

from ir_maniskill.agent import Agent
from ir_maniskill.environment.reward_generator import DenseWeights
from ir_maniskill.training import checkpoint, quantize
from ir_maniskill.training.checkpoint import CheckpointError, Stored
from ir_maniskill.training.config import (
    CONFIGS,
    LATER,
    AgentConfig,
    ConfigError,
    PPOConfig,
    TrainConfig,
    decode,
    to_json,
)
from ir_maniskill.training.finite import TrainingDivergedError
from ir_maniskill.training.run_folder import RunFolder
from ir_maniskill.training.train import Trainer


@pytest.fixture
def trained(tmp_path):
    """An agent and an optimizer that have made one step."""
    config = toy_config(tmp_path)
    agent = Agent(config.agent, SPEC)
    optimizer = torch.optim.Adam(agent.parameters(), 1e-3)
    state = toy_state()
    judgement = agent.evaluate_actions(state, torch.zeros(3, 2))
    (judgement.log_prob.sum() + judgement.value.sum()).backward()
    optimizer.step()
    return agent, optimizer, config


def from_json(text):
    return decode(TrainConfig, json.loads(text))


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
        (
            {"stop_at_success": 0.0},
            "stop_at_success: got 0.0, expected more than 0, at most 1, or None",
        ),
        ({"reward_mode": "none"}, "reward_mode: got 'none'.*'dense'"),
        ({"control_mode": "pd_ee"}, "control_mode: got 'pd_ee'.*'pd_joint_pos'"),
        ({"eval_seed": 2**29}, "eval_seed: got 536870912, expected 0 to"),
        (
            {"dense_weights": dataclasses.asdict(DenseWeights()) | {"spoiled": 1.5}},
            "dense_weights: got spoiled=1.5",
        ),
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


def test_files_from_before_a_field_was_added_keep_their_meaning():
    data = json.loads(to_json(TrainConfig()))
    for field in LATER["TrainConfig"]:
        del data[field]
    for part, owner in (("agent", "AgentConfig"), ("dense_weights", "DenseWeights")):
        for field in LATER[owner]:
            del data[part][field]
    assert from_json(json.dumps(data)) == TrainConfig()


def replace_leaf(data, path, value):
    """Return JSON data with another value at a path of keys."""
    if not path:
        return value
    return data | {path[0]: replace_leaf(data[path[0]], path[1:], value)}


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=4,
)
FIELDS = [
    *((f.name,) for f in dataclasses.fields(TrainConfig)),
    *(("agent", f.name) for f in dataclasses.fields(AgentConfig)),
    *(("ppo", f.name) for f in dataclasses.fields(PPOConfig)),
    *(("dense_weights", f.name) for f in dataclasses.fields(DenseWeights)),
]


@given(st.sampled_from(FIELDS), JSON)
def test_whatever_a_config_says_it_is_a_config_or_refused(path, value):
    data = replace_leaf(json.loads(to_json(TrainConfig())), path, value)
    try:
        config = from_json(json.dumps(data))
    except ConfigError as error:
        assert "got" in str(error)
        return
    assert from_json(to_json(config)) == config
    assert config.steps_per_update > 0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: AgentConfig(senses=("smell",)),
            "senses: got 'smell'",
        ),
        (lambda: AgentConfig(vision="resnet"), "'patches', 'paper'"),
        (lambda: AgentConfig(language_heads=3), "language_width: got 50.*3 heads"),
        (lambda: AgentConfig(body_width=0), "body_width: got 0, expected at least 1"),
        (lambda: TrainConfig(reward_mode="none"), "reward_mode: got 'none', expected"),
        (lambda: AgentConfig(std=0.0), "std: got 0.0, expected more than 0"),
        (
            lambda: AgentConfig(posture_gain=-1.0),
            "posture_gain: got -1.0, expected a finite number of at least 0",
        ),
        (
            lambda: AgentConfig(posture_gain=1.0, senses=("vision", "touch")),
            "posture_gain: got 1.0, expected 0 where the actor does not feel",
        ),
        (
            lambda: AgentConfig(posture_gain=1.0, sees_target=False),
            "posture_gain: got 1.0, expected 0 where the actor does not feel",
        ),
        (
            lambda: TrainConfig(
                control_mode="pd_joint_pos", agent=AgentConfig(posture_gain=1.0)
            ),
            "posture_gain: got 1.0, expected 0 where actions do not change",
        ),
        (
            lambda: AgentConfig(posture_gain_final=2.0),
            "posture_gain_final: got 2.0, expected .* beside a posture_gain above 0",
        ),
        (lambda: PPOConfig(gamma=1.1), "gamma: got 1.1, expected 0 to 1"),
        (lambda: PPOConfig(minibatch=1), "minibatch: got 1, expected 2 to 2048"),
        (lambda: TrainConfig(total_steps=0), "total_steps: got 0"),
        (
            lambda: dataclasses.replace(CONFIGS["posture"], total_steps=60_000),
            "lenient_steps: got 80000, expected 0 to 60000, the total_steps",
        ),
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


@pytest.mark.parametrize("few_bits", [False, True])
def test_a_policy_acts_after_loading_as_before(trained, tmp_path, few_bits):
    agent, _, config = trained
    path = tmp_path / "policy.safetensors"
    facts = {"steps": 7, "evaluation": (figures := {"success": 1.0})}
    states = toy_state(64) if few_bits else None
    checkpoint.save_policy(path, agent, config, **facts, states=states)
    loaded, stored_config, metadata = checkpoint.load_policy(path)
    state = toy_state()
    tolerance = 1e-3 if few_bits else 0
    assert torch.allclose(loaded.policy(state), agent.policy(state), atol=tolerance)
    assert stored_config == config
    assert (metadata["steps"], metadata["evaluation"]) == (7, figures)
    with pytest.raises(RuntimeError, match="without its critic"):
        loaded.act(state)


def test_a_policy_file_is_smaller_than_a_checkpoint(trained, tmp_path):
    agent, optimizer, config = trained
    small, large = tmp_path / "policy", tmp_path / "checkpoint"
    policy = {"steps": 0, "evaluation": {}, "states": toy_state()}
    checkpoint.save_policy(small, agent, config, **policy)
    facts = checkpoint.describe(agent, config)
    packed = checkpoint.pack(agent, optimizer)
    checkpoint.write(large, Stored(checkpoint.CHECKPOINT, packed, facts))
    assert small.stat().st_size < large.stat().st_size / 6
    agent_of_checkpoint, _, _ = checkpoint.load_policy(large)
    assert agent_of_checkpoint.act(toy_state()).value.shape == (3,)


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


def write_both(folder, monkeypatch, agent, optimizer, config):
    """Write a policy and a checkpoint of the same agent; return their paths."""
    monkeypatch.setattr(quantize, "LARGE", 2000)  # some weights have 4 bits, some 8
    paths = folder / "policy", folder / "checkpoint"
    policy = {"steps": 1, "evaluation": {}, "states": toy_state()}
    checkpoint.save_policy(paths[0], agent, config, **policy)
    facts = checkpoint.describe(agent, config, steps=1)
    packed = checkpoint.pack(agent, optimizer)
    checkpoint.write(paths[1], Stored(checkpoint.CHECKPOINT, packed, facts))
    return paths


def test_500_mutated_files_each_get_the_one_clear_error(trained, tmp_path, monkeypatch):
    generator = random.Random(0)
    for path in write_both(tmp_path, monkeypatch, *trained):
        good = path.read_bytes()
        header = 8 + int.from_bytes(good[:8], "little")
        for case in range(250):
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


WRONG = (None, True, -1, 0, 10**4, 2**40, 2**80, 0.5, 1e308, math.nan, "x", [], {})
"""Values that do not belong where they are put."""


def distort(stored, generator):
    """Return the contents with something in them that does not belong there."""
    tensors, metadata = dict(stored.tensors), json.loads(json.dumps(stored.metadata))
    if generator.random() < 0.3:
        name = generator.choice(sorted(tensors))
        tensor = tensors.pop(name)
        replacements = (
            tensor.reshape(-1)[:-1],
            tensor[None],
            tensor.long(),
            tensor * 0,
        )
        replacement = generator.choice((None, *replacements))
        if replacement is not None:
            tensors[generator.choice((name, "agent", "x.y"))] = replacement
        return Stored(stored.kind, tensors, metadata)
    node = metadata
    while True:
        key = generator.choice(
            sorted(node) if isinstance(node, dict) else range(len(node))
        )
        inner = node[key]
        if not isinstance(inner, dict | list) or not inner or generator.random() < 0.2:
            break
        node = inner
    node[key] = generator.choice(WRONG)
    return Stored(stored.kind, tensors, metadata)


def test_500_files_of_wrong_values_but_right_checksums_work_or_get_the_error(
    trained, tmp_path, monkeypatch
):
    generator, refused = random.Random(0), 0
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for path in write_both(tmp_path, monkeypatch, *trained):
        stored = checkpoint.read(path)
        for _ in range(250):
            checkpoint.write(path, distort(stored, generator))
            try:
                agent, *_ = checkpoint.load_policy(path)
                assert agent.policy(toy_state()).isfinite().all()
            except CheckpointError:
                refused += 1
            except ValueError as error:  # its weights fit, the state does not
                assert "this agent was made for" in str(error)
    assert refused > 100
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert after - before < 300_000, "sizes were believed before they were checked [KB]"


def png():
    buffer = io.BytesIO()
    Image.new("RGB", (8, 8)).save(buffer, "png")
    return buffer.getvalue()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"PK\x03\x04 a zip",
        b"\xff" * 64,
        b"\x02" + b"\0" * 7,
        pickle.dumps({"agent": 1}),
        png(),
        safetensors.torch.save({"weight": torch.zeros(2)}),
        safetensors.torch.save({"weight": torch.zeros(2)}, {"kind": "another"}),
    ],
)
def test_foreign_files_are_refused(tmp_path, data):
    path = tmp_path / "foreign"
    path.write_bytes(data)
    with pytest.raises(CheckpointError, match="not ours"):
        checkpoint.load_policy(path)


def test_little_is_read_of_a_large_foreign_file(tmp_path, monkeypatch):
    path = tmp_path / "large.safetensors"
    path.write_bytes(safetensors.torch.save({"weight": torch.zeros(1000)}))
    monkeypatch.setattr(Path, "read_bytes", lambda _: pytest.fail("read it all"))
    with pytest.raises(CheckpointError, match="not ours"):
        checkpoint.load_policy(path)


def test_what_is_no_file_is_refused_without_waiting(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, Path("/dev/zero")):
        with pytest.raises(CheckpointError, match="expected a file"):
            checkpoint.load_policy(path)


def test_numbers_that_are_not_finite_are_neither_written_nor_read(
    trained, tmp_path, monkeypatch
):
    agent, _, config = trained
    path = tmp_path / "policy"
    checkpoint.save_policy(path, agent, config, steps=1, evaluation={})
    with torch.no_grad():
        agent.actor.mean[0].bias[0] = torch.nan
    with pytest.raises(TrainingDivergedError, match="checkpoint .*actor.mean.0.bias"):
        checkpoint.save_policy(path, agent, config, steps=2, evaluation={})
    assert checkpoint.read(path).metadata["steps"] == 1
    monkeypatch.setattr(checkpoint, "check_finite", lambda *_: None)
    checkpoint.save_policy(path, agent, config, steps=2, evaluation={})
    with pytest.raises(CheckpointError, match=r"actor.mean.0.bias is not finite"):
        checkpoint.load_policy(path)


def test_a_checkpoint_of_wrong_values_is_resumed_or_refused(tmp_path):
    config, generator = toy_config(tmp_path), random.Random(1)
    folder = RunFolder(tmp_path, resume=False)
    folder.begin(config, 0)
    trainer = Trainer(config, ToyVectorEnv(8), folder)
    trainer.update()
    stored, refused = trainer.snapshot(), 0
    for _ in range(100):
        checkpoint.write(folder.last, distort(stored, generator))
        try:
            trainer.restore()
        except CheckpointError:
            refused += 1
        assert trainer.steps >= 0
    assert 20 < refused < 100
    folder.close()


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
