import dataclasses
import json
import math
import os
import random
import re
import resource
from pathlib import Path
from types import SimpleNamespace

import pytest
import safetensors.torch
import torch
from toy_envs import SPEC, ToyVectorEnv, toy_config, toy_state

from ir_maniskill import experiment as catalog
from ir_maniskill.agent import Agent
from ir_maniskill.policy import Policy, load_policy
from ir_maniskill.training import checkpoint
from ir_maniskill.training.algorithm import averages, copied
from ir_maniskill.training.checkpoint import CheckpointError, MismatchError, Stored
from ir_maniskill.training.config import AgentConfig, TrainConfig
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


def test_random_generators_go_on_where_they_were():
    def draw():
        return torch.rand(3).tolist()

    state = checkpoint.random_state()
    first = draw()
    checkpoint.set_random_state(state)
    assert draw() == first


def test_a_policy_acts_after_loading_as_before(trained, tmp_path):
    agent, _, config = trained
    path = tmp_path / "policy.safetensors"
    facts = {"steps": 7, "evaluation": (figures := {"success": 1.0})}
    checkpoint.save_policy(path, agent, config, **facts)
    loaded, stored_config, metadata = checkpoint.load_agent(path)
    state = toy_state()
    assert torch.allclose(loaded.policy(state), agent.policy(state), atol=1e-3)
    assert stored_config == config
    assert (metadata["steps"], metadata["evaluation"]) == (7, figures)
    with pytest.raises(RuntimeError, match="without its critic"):
        loaded.act(state)
    again = tmp_path / "again.safetensors"  # what was rounded once stays as it is
    checkpoint.save_policy(again, loaded, config, **facts)
    once, twice = checkpoint.read(path).tensors, checkpoint.read(again).tensors
    assert once.keys() == twice.keys()
    assert all(torch.equal(once[name], twice[name]) for name in once)


def test_what_is_counted_keeps_all_its_bits(tmp_path):
    config = toy_config(tmp_path)
    shape = dataclasses.replace(config.agent, senses=("state",))
    agent = Agent(shape, SPEC)
    agent.encoder.standardize.count.fill_(10**6)  # 16 bits end at 65504
    agent.encoder.standardize.variance.fill_(1e-6)
    checkpoint.save_policy(tmp_path / "p", agent, config, steps=1, evaluation={})
    loaded, *_ = checkpoint.load_agent(tmp_path / "p")
    assert torch.equal(loaded.encoder.standardize.variance, torch.full((7,), 1e-6))


def test_a_crash_while_writing_leaves_the_old_file(trained, tmp_path, monkeypatch):
    agent, _, config = trained
    path = tmp_path / "policy"
    checkpoint.save_policy(path, agent, config, steps=1, evaluation={})

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"cannot write .*: No space left"):
        checkpoint.save_policy(path, agent, config, steps=2, evaluation={})
    assert checkpoint.read(path).metadata["steps"] == 1
    assert [file.name for file in tmp_path.iterdir()] == ["policy"]


def write_both(folder, agent, optimizer, config):
    """Write a policy and a checkpoint of the same agent; return their paths."""
    paths = folder / "policy", folder / "checkpoint"
    checkpoint.save_policy(paths[0], agent, config, steps=1, evaluation={})
    facts = checkpoint.describe(agent, config, steps=1)
    packed = copied("agent", agent.state_dict())
    packed |= copied("optimizer", averages(optimizer))
    checkpoint.write(paths[1], Stored(checkpoint.CHECKPOINT, packed, facts))
    return paths


def test_broken_files_get_the_one_clear_error(trained, tmp_path):
    generator = random.Random(0)
    for path in write_both(tmp_path, *trained):
        good = path.read_bytes()
        header = 8 + int.from_bytes(good[:8], "little")
        for case in range(30):
            data, place = bytearray(good), generator.randrange(header)
            if case % 3 == 0:
                data[place : place + 4] = b"\xff\xff\xff\xff"  # not UTF-8
            elif case % 3 == 1:
                del data[generator.randrange(len(data)) :]
            else:
                data[place:place] = generator.randbytes(generator.randrange(1, 64))
            path.write_bytes(data)
            with pytest.raises(CheckpointError, match="not ours"):
                checkpoint.load_agent(path)


WRONG = (None, True, -1, 0, 10**4, 2**40, 2**80, 0.5, 1e308, math.nan, "x", [], {})
"""Values that do not belong where they are put."""


def distort(stored, generator):
    """Return the contents with something in them that does not belong there."""
    tensors, metadata = dict(stored.tensors), json.loads(json.dumps(stored.metadata))
    if generator.random() < 0.3:
        name = generator.choice(sorted(tensors))
        tensor = tensors.pop(name)
        others = tensor.reshape(-1)[:-1], tensor[None], tensor.long(), tensor * 0
        tensors[generator.choice((name, "agent", "x.y"))] = generator.choice(others)
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


def test_files_of_wrong_values_work_or_get_the_error(trained, tmp_path):
    generator, refused = random.Random(0), 0
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for path in write_both(tmp_path, *trained):
        stored = checkpoint.read(path)
        for _ in range(50):
            checkpoint.write(path, distort(stored, generator))
            try:
                agent, *_ = checkpoint.load_agent(path)
                assert agent.policy(toy_state()).isfinite().all()
            except CheckpointError:
                refused += 1
            except ValueError as error:  # its weights fit, the state does not
                assert re.search("this agent|expected", str(error))
    assert refused > 20
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert after - before < 300_000, "sizes were believed before they were checked [KB]"


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x02" + b"\0" * 7,
        safetensors.torch.save({"weight": torch.zeros(2)}),
        safetensors.torch.save({"weight": torch.zeros(2)}, {"kind": "another"}),
    ],
)
def test_foreign_files_are_refused(tmp_path, data):
    path = tmp_path / "foreign"
    path.write_bytes(data)
    with pytest.raises(CheckpointError, match="not ours"):
        checkpoint.load_agent(path)


@pytest.mark.parametrize("version", [1, 3])
def test_a_file_of_another_version_says_so(trained, tmp_path, monkeypatch, version):
    agent, _, config = trained
    monkeypatch.setattr(checkpoint, "FORMAT", version)
    checkpoint.save_policy(tmp_path / "new", agent, config, steps=1, evaluation={})
    monkeypatch.undo()
    with pytest.raises(
        CheckpointError, match=rf"format {version}, written by ir_maniskill \d"
    ):
        checkpoint.load_agent(tmp_path / "new")


def test_what_is_no_file_is_refused_without_waiting(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, Path("/dev/zero")):
        with pytest.raises(CheckpointError, match="expected a file"):
            checkpoint.load_agent(path)
    with pytest.raises(CheckpointError, match=r"cannot read .*nothing: No such file"):
        checkpoint.load_agent(tmp_path / "nothing")


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
        checkpoint.load_agent(path)


def test_a_checkpoint_of_wrong_values_is_resumed_or_refused(tmp_path):
    config, generator = toy_config(tmp_path), random.Random(1)
    folder = RunFolder(tmp_path, resume=False)
    folder.begin(config, 0)
    runner = Runner(config, folder, ToyVectorEnv(8), lambda: ToyVectorEnv(8), PPO)
    runner.advance()
    stored, refused = runner.snapshot(), 0
    for _ in range(40):
        checkpoint.write(folder.last, distort(stored, generator))
        try:
            runner.restore(checkpoint.read(folder.last))
        except CheckpointError:
            refused += 1
        assert runner.steps >= 0
    assert 8 < refused < 40
    folder.close()


def test_a_pickle_is_never_executed(tmp_path):
    path, witness = tmp_path / "evil", tmp_path / "witness"

    class Evil:
        def __reduce__(self):
            return (open, (str(witness), "w"))

    torch.save(Evil(), path)
    with pytest.raises(CheckpointError):
        checkpoint.load_agent(path)
    assert not witness.exists()


def test_weights_of_another_size_than_their_config_are_refused(trained, tmp_path):
    agent, _, config = trained
    path = tmp_path / "policy"
    facts = checkpoint.describe(agent, config)
    facts["spec"]["actions"] = 26
    weights = {k: v for k, v in agent.state_dict().items() if "critic" not in k}
    checkpoint.write(path, Stored(checkpoint.POLICY, weights, facts))
    with pytest.raises(CheckpointError, match=r"do not belong together.*size mismatch"):
        checkpoint.load_agent(path)


# -- What a policy was trained for -----------------------------------------------------


@pytest.fixture
def task():
    return catalog.get("NaoTouchCubeTriangle-v1")


def policy_for(task):
    """Return a policy trained for a task, with its metadata from JSON."""
    config = TrainConfig(env_id=task.id, agent=AgentConfig(vocabulary=task.vocabulary))
    agent = SimpleNamespace(config=config.agent, spec=SPEC)
    facts = json.loads(json.dumps(checkpoint.describe(agent, config)))
    return Policy(agent, config, facts)


def test_a_policy_file_tells_task_words_robot_and_longest_sentence(task):
    facts = policy_for(task).metadata
    told = facts["config"]["agent"]
    assert facts["config"]["env_id"] == "NaoTouchCubeTriangle-v1"
    assert told["vocabulary"] == list(task.vocabulary)
    assert (told["language_length"], facts["config"]["robot"]) == (16, "nao")
    assert facts["task"]["objects"][0]["is"] == "TouchObject"
    assert facts["version"].count(".") >= 2


def swapped(words):
    """Return a vocabulary with two words in each other's place."""
    return (*words[:5], words[6], words[5], *words[7:])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda task: {"vocabulary": swapped(task.vocabulary)},
            r"vocabulary\[5\]: got 'blue', expected 'red'$",
        ),
        (
            lambda task: {"shuffled": True},
            "Triangle-v1: shuffled: got False, expected True; say any_task",
        ),
        (
            lambda task: {"episode_steps": 64, "reward": "binary"},
            "reward: got .*'per_finger', expected 'binary'; episode_steps: got .*64; s",
        ),
        (
            lambda task: {"instructions": task.instructions[::-1]},
            r"instructions\[0\]: got .*blue.*, expected .*green",
        ),
    ],
)
def test_a_task_that_changed_is_refused(task, change, message):
    now = dataclasses.replace(task, **change(task))
    with pytest.raises(MismatchError, match=message):
        policy_for(task).require_match(now)


def test_another_task_or_robot_is_refused(task):
    other = catalog.get("NaoTouchCubeShuffled-v1")
    with pytest.raises(MismatchError, match="not fit .*Shuffled-v1: task.*any_task"):
        policy_for(task).require_match(other)
    policy_for(task).require_match(other, any_task=True)
    policy_for(task).require_match(task, "nao")
    words = dataclasses.replace(other, vocabulary=swapped(other.vocabulary))
    for any_task in (True, False):
        with pytest.raises(MismatchError, match=r"vocabulary\[5\]") as refused:
            policy_for(task).require_match(words, any_task=any_task)
        assert "any_task" not in str(refused.value)
    load_policy("NaoInstruct-v1").require_match(words, any_task=True)  # it reads text
    reader = policy_for(task)
    reader.config = dataclasses.replace(
        reader.config, agent=AgentConfig(language="lexicon")
    )
    reader.require_match(dataclasses.replace(task, vocabulary=words.vocabulary))
    with pytest.raises(MismatchError, match="robot: .*'nao', expected 'panda'"):
        policy_for(task).require_match(task, "panda")
