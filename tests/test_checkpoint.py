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
from PIL import Image
from toy_envs import SPEC, ToyVectorEnv, toy_config, toy_state

from ir_maniskill.agent import Agent
from ir_maniskill.training import checkpoint, quantize
from ir_maniskill.training.algorithm import averages, copied
from ir_maniskill.training.checkpoint import CheckpointError, Stored
from ir_maniskill.training.finite import TrainingDivergedError
from ir_maniskill.training.ppo import PPO
from ir_maniskill.training.run_folder import RunFolder
from ir_maniskill.training.runner import Runner


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


def packed_of(agent, optimizer):
    """Return the tensors of a checkpoint."""
    weights = copied("agent", agent.state_dict())
    return weights | copied("optimizer", averages(optimizer))


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
    packed = packed_of(agent, optimizer)
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
    packed = packed_of(agent, optimizer)
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
    runner = Runner(config, folder, ToyVectorEnv(8), lambda: ToyVectorEnv(8), PPO)
    runner.advance()
    stored, refused = runner.snapshot(), 0
    for _ in range(100):
        checkpoint.write(folder.last, distort(stored, generator))
        try:
            runner.restore(checkpoint.read(folder.last))
        except CheckpointError:
            refused += 1
        assert runner.steps >= 0
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
