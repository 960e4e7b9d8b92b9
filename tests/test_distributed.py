import dataclasses
import multiprocessing as mp
import os
import socket
import subprocess
import sys
from datetime import timedelta
from pathlib import Path

import pytest
import torch
from torch.nn.utils import parameters_to_vector
from toy_envs import (
    LENGTH,
    SPEC,
    ToyVectorEnv,
    records,
    steps_of,
    toy_config,
    toy_state,
)

from ir_maniskill.agent import Agent
from ir_maniskill.training import checkpoint, distributed, ppo, runner
from ir_maniskill.training import train as training
from ir_maniskill.training.config import ConfigError
from ir_maniskill.training.distributed import RankError
from ir_maniskill.training.rollout import RewardScale, Rollout
from ir_maniskill.training.run_folder import RunFolder
from ir_maniskill.training.runner import Runner, StepCounts

ENVS = 8  # of all ranks together
UPDATE = 32 * LENGTH  # steps of an update of the toy task


# -- Running ranks ---------------------------------------------------------------------


def in_ranks(work, out, ranks=2):
    """Let processes do work(out), and return their exit codes."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    context = mp.get_context("spawn")
    ready = context.Barrier(ranks)
    arguments = (ranks, port, ready, work, out)
    processes = [
        context.Process(target=as_rank, args=(rank, *arguments), daemon=True)
        for rank in range(ranks)
    ]
    for process in processes:
        process.start()
    processes[0].join(900)
    for process in processes[1:]:
        process.join(30)
    codes = [process.exitcode for process in processes]
    for process in processes:
        process.kill()
    return codes


def as_rank(rank, ranks, port, ready, work, out):
    """Do the work in the environment that torchrun gives to a process."""
    numbers = {"RANK": rank, "LOCAL_RANK": rank}
    numbers |= {"WORLD_SIZE": ranks, "LOCAL_WORLD_SIZE": ranks, "MASTER_PORT": port}
    os.environ.update({name: str(number) for name, number in numbers.items()})
    os.environ["MASTER_ADDR"] = "127.0.0.1"
    torch.set_num_threads(1)
    runner.FINAL_EPISODES = 16
    ready.wait()  # loading may take one of them longer than the patience under test
    work(out)


def load(out, ranks=2):
    return [torch.load(out / f"{rank}.pt") for rank in range(ranks)]


# -- The joined batch ------------------------------------------------------------------


def fixed_rollout():
    """Return an agent with all its parts, and what it lived through in all envs."""
    agent_config = dataclasses.replace(toy_config("x").agent, auxiliary_weight=0.5)
    torch.manual_seed(0)
    agent, rollout = Agent(agent_config, SPEC), Rollout(16, toy_state(ENVS), 2)
    never = torch.zeros(ENVS, dtype=torch.bool)
    for t in range(16):
        state = toy_state(ENVS)
        with torch.no_grad():
            rollout.add(t, state, agent.act(state))
        # What the ranks see shall differ, else per-rank statistics would do as well.
        reward = 0.1 * torch.rand(ENVS) + 0.05 * torch.arange(ENVS)
        rollout.add_outcome(t, reward, never, torch.zeros(ENVS))
    rollout.state["privileged"] *= 1 + torch.arange(ENVS)[:, None]
    rollout.finish(torch.zeros(ENVS), 0.9, 0.95)
    return agent, rollout


def share_of(rollout):
    """Return this rank's part of the roll-out: its envs."""
    count = ENVS // distributed.size()
    mine = slice(distributed.rank() * count, (distributed.rank() + 1) * count)
    rollout.num_envs = count
    rollout.state = {key: kept[:, mine] for key, kept in rollout.state.items()}
    for name, kept in vars(rollout).items():
        if isinstance(kept, torch.Tensor):
            setattr(rollout, name, kept[:, mine])
    return rollout


def learn_from_the_fixed_rollout(out):
    with distributed.group(timedelta(minutes=2)):
        agent, rollout = fixed_rollout()
        rollout = share_of(rollout)
        everything = torch.arange(16 * rollout.num_envs)
        batch, config = rollout.batch(everything), toy_config("x").ppo
        ppo.ppo_loss(agent, batch, config)[0].backward()
        distributed.average_gradients(agent)
        got = {"gradient": parameters_to_vector(w.grad for w in agent.parameters())}
        got["norm"] = ppo.clip_gradient(agent, 0.01)
        got["clipped"] = parameters_to_vector(w.grad for w in agent.parameters())
        scale = RewardScale(rollout.num_envs, 0.9)
        got["reward"] = scale(rollout.reward, rollout.done)
        agent.observe(distributed.gather(rollout.state["privileged"].flatten(0, 1)))
        got["buffers"] = torch.cat([b.flatten() for b in agent.buffers()])
        # Without minibatches no shuffling tells the joined batch from the shares.
        epochs = {"epochs": 20, "target_kl": 3e-5}
        whole = dataclasses.replace(config, minibatch=None, **epochs)
        optimizer = torch.optim.SGD(agent.parameters(), 0.05)
        got["figures"] = ppo.improve(agent, optimizer, rollout, whole)
        got["weights"] = parameters_to_vector(agent.parameters()).detach()
        ppo.improve(
            agent, optimizer, rollout, dataclasses.replace(config, minibatch=48)
        )
        got["minibatches"] = parameters_to_vector(agent.parameters()).detach()
        number = distributed.rank() + 1
        counts = StepCounts()
        counts.sums += torch.tensor([10.0 * number, 0.5, 0, 0, number, 1, 0])
        got["means"] = counts.means()
        torch.save(got, out / f"{distributed.rank()}.pt")


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """Return what each of two ranks has got, and what one has with the joined batch."""
    two, one = tmp_path_factory.mktemp("two"), tmp_path_factory.mktemp("one")
    assert in_ranks(learn_from_the_fixed_rollout, two) == [0, 0]
    learn_from_the_fixed_rollout(one)
    return *load(two), *load(one, 1)


@pytest.mark.parametrize("what", ["gradient", "norm", "clipped", "buffers", "weights"])
def test_two_ranks_get_what_one_gets_from_the_joined_batch(learned, what):
    first, second, joined = (got[what] for got in learned)
    assert torch.equal(first, second)
    assert (first - joined).abs().max() <= 3e-6 * max(1, float(joined.abs().max()))
    assert joined.abs().max() > 1e-4


def test_rewards_are_scaled_by_the_returns_of_all_ranks(learned):
    first, second, joined = (got["reward"] for got in learned)
    assert torch.allclose(torch.cat([first, second], dim=1), joined, rtol=1e-6)


def test_the_ranks_stop_their_epochs_together(learned):
    first, second, joined = (got["figures"] for got in learned)
    assert first == second
    assert first == pytest.approx(joined, rel=1e-4, abs=1e-6)
    assert 1 < first["epochs"] < 20


def test_episodes_are_counted_over_all_ranks(learned):
    first, second, _ = (got["means"] for got in learned)
    assert first == second
    got = [first[name] for name in ("reward", "return", "success")]
    assert got == [1 / 30, 1 / 3, 2 / 3]


def test_minibatches_leave_the_ranks_with_the_same_weights(learned):
    first, second, _ = (got["minibatches"] for got in learned)
    assert torch.equal(first, second)
    assert not torch.equal(first, learned[0]["weights"])


# -- Training --------------------------------------------------------------------------


def toy(out):
    """Return the config of a run of four updates, and this rank's envs."""
    return toy_config(out), ToyVectorEnv(ENVS // distributed.size())


def runner_of(config, envs):
    """Return a runner of untrained agents."""
    folder = distributed.from_first(lambda: RunFolder(Path(config.out), resume=False))
    return Runner(config, folder, envs, lambda: ToyVectorEnv(4), ppo.PPO)


def interrupt(envs, error):
    """Let the envs fail in the third update."""
    step, calls = envs.step, []

    def fail(action):
        calls.append(None)
        if len(calls) > 2 * UPDATE // ENVS + 1:
            raise error
        return step(action)

    envs.step = fail
    return envs


def train(config, envs, **kwargs):
    return training.run(config, envs=envs, eval_envs=ToyVectorEnv(4), **kwargs)


def train_whole_and_in_halves(out):
    with distributed.group(timedelta(minutes=2)):
        config, envs = toy(out / "whole")
        made = runner_of(config, envs)
        got = {"scene": made.state["proprioception"]}
        made.learn()
        made.folder.close()
        learned = made.algorithm
        got |= {"action": learned.rollout.action, "weights": learned.agent.state_dict()}
        torch.save(got, out / f"{distributed.rank()}.pt")
        config, envs = toy(out / "halves")
        with pytest.raises(KeyboardInterrupt):
            train(config, interrupt(envs, KeyboardInterrupt))
        torch.manual_seed(123)  # whatever happens in between
        train(*toy(out / "halves"), resume=True)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    out = tmp_path_factory.mktemp("trained")
    assert in_ranks(train_whole_and_in_halves, out) == [0, 0]
    return out


@pytest.mark.slow
def test_ranks_end_with_the_same_weights_and_explore_apart(trained):
    first, second = load(trained)
    assert first["weights"].keys() == second["weights"].keys()
    for name, weight in first["weights"].items():
        assert torch.equal(weight, second["weights"][name]), name
    assert not torch.isclose(first["action"], second["action"]).any()


@pytest.mark.slow
def test_the_ranks_have_the_scenes_of_one_with_all_envs(trained, tmp_path):
    scene = runner_of(*toy(tmp_path)).state["proprioception"]
    assert torch.equal(torch.cat([got["scene"] for got in load(trained)]), scene)


@pytest.mark.slow
def test_a_run_of_two_ranks_resumes_bit_for_bit(trained):
    whole, halves = (
        checkpoint.read(trained / name / "last.safetensors").tensors
        for name in ("whole", "halves")
    )
    assert [name for name in whole if not torch.equal(whole[name], halves[name])] == []
    assert records(trained / "whole") == records(trained / "halves")


@pytest.mark.slow
def test_one_set_of_records_counts_all_ranks(trained):
    assert steps_of(trained / "whole") == [UPDATE * i for i in (1, 2, 3, 4)]
    assert (trained / "whole" / "evaluation.json").exists()


# -- Failures --------------------------------------------------------------------------


def lose_the_other(out):
    with distributed.group(timedelta(minutes=2)):
        config, envs = toy(out)
        if distributed.rank() == 1:
            train(config, interrupt(envs, RuntimeError("broken")))
        with pytest.raises(RankError, match=r"rank 0 lost the others: one .* failed"):
            train(config, envs)


@pytest.mark.slow
def test_a_rank_that_fails_stops_the_others_with_their_work_saved(tmp_path):
    assert in_ranks(lose_the_other, tmp_path) == [0, 1]
    stored = checkpoint.read(tmp_path / "last.safetensors")
    assert stored.metadata["steps"] == 2 * UPDATE


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_envs": 8}, "num_envs: got 8, expected a multiple of 3"),
        (
            {"num_envs": 12, "ppo": {"minibatch": 2}},
            "minibatch: got 2, expected at least 3",
        ),
    ],
)
def test_what_ranks_cannot_share_is_refused(tmp_path, monkeypatch, changes, message):
    monkeypatch.setattr(distributed, "size", lambda: 3)
    config = toy_config(tmp_path)
    learner = dataclasses.replace(config.ppo, **changes.pop("ppo", {}))
    with pytest.raises(ConfigError, match=message):
        training.run(dataclasses.replace(config, ppo=learner, **changes))


def test_the_ranks_of_a_machine_share_its_cores(monkeypatch):
    alone = distributed.cores()
    assert alone == len(os.sched_getaffinity(0))
    monkeypatch.setenv("LOCAL_WORLD_SIZE", str(alone))
    monkeypatch.setattr(distributed, "size", lambda: alone + 1)
    assert distributed.cores() == 1


# -- torchrun --------------------------------------------------------------------------


@pytest.mark.slow
def test_torchrun_trains_on_the_real_task(tmp_path):
    command = Path(sys.executable).with_name("ir-maniskill")
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    torchrun += ["--nproc-per-node", "2", "--no-python", str(command)]
    options = "--agent.senses state --agent.hidden 16 --num-envs 4 --ppo.epochs 1 "
    options += "--ppo.steps-per-update 128 --ppo.minibatch 64 --total-steps 256 "
    options += "--eval-episodes 1 --out"
    train = ["train", "NaoTouchCubeSingle-v1", *options.split(), str(tmp_path)]
    done = subprocess.run([*torchrun, *train], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("The best policy is in") == 1
    assert steps_of(tmp_path) == [128, 256]
