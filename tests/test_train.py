import contextlib
import csv
import dataclasses
import itertools
import json

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from toy_envs import LENGTH, SENTENCES, ToyVectorEnv, toy_config

import ir_maniskill
from ir_maniskill import experiment as catalog
from ir_maniskill.agent.actor import Actor
from ir_maniskill.environment.reward_generator import DenseWeights
from ir_maniskill.evaluation.evaluate import EvaluationReport, Rate, Score
from ir_maniskill.training import checkpoint, distributed
from ir_maniskill.training import train as training
from ir_maniskill.training.checkpoint import CheckpointError
from ir_maniskill.training.config import AgentConfig, ConfigError, TrainConfig
from ir_maniskill.training.finite import TrainingDivergedError
from ir_maniskill.training.run_folder import RunFolder
from ir_maniskill.training.train import train

UPDATE = 32 * LENGTH  # steps of an update of the toy task


@pytest.fixture(autouse=True)
def few_final_episodes(monkeypatch):
    monkeypatch.setattr(training, "FINAL_EPISODES", 16)


def run(config, **kwargs):
    envs = ToyVectorEnv(config.num_envs, env_id=config.env_id)
    return train(config, envs=envs, **kwargs)


def rows(folder, table):
    with (folder / f"{table}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def tensors(folder):
    return checkpoint.read(folder / "last.safetensors").tensors


def assert_same(first, second):
    assert first.keys() == second.keys()
    different = [name for name in first if not torch.equal(first[name], second[name])]
    assert not different


@pytest.fixture
def interrupt(monkeypatch):
    """Make the training stop in its n-th update, as if by Ctrl-C."""

    def at(count, error=KeyboardInterrupt):
        update, calls = training.ppo.update, []

        def interrupted(*arguments):
            calls.append(None)
            if len(calls) == count:
                raise error
            return update(*arguments)

        monkeypatch.setattr(training.ppo, "update", interrupted)

    return at


def test_training_learns_the_toy_task_and_stops_when_told(tmp_path):
    ppo = dataclasses.replace(toy_config(tmp_path).ppo, learning_rate=3e-3)
    config = toy_config(
        tmp_path,
        ppo=ppo,
        total_steps=60 * UPDATE,
        eval_interval=3 * UPDATE,
        stop_at_success=1.0,
    )
    best = run(config)
    assert best == tmp_path / "best.safetensors"
    steps = [int(row["steps"]) for row in rows(tmp_path, "metrics")]
    assert steps[-1] < 60 * UPDATE
    assert float(rows(tmp_path, "evaluations")[-1]["eval/worst"]) == 1.0
    report = json.loads((tmp_path / "evaluation.json").read_text())
    assert (report["episodes"], report["overall"]["success"]) == (16, 1.0)
    _, stored, metadata = checkpoint.load_policy(best)
    assert stored == config
    assert metadata["evaluation"] == report


@pytest.mark.parametrize(
    ("reward", "each_finger", "best"),
    [("binary", False, 1), ("binary", True, 2), ("per_finger", False, 2)],
)
def test_the_best_policy_holds_longest_or_with_the_most_fingers(
    tmp_path, monkeypatch, reward, each_finger, best
):
    rates = {"success": Rate(4, 4), "exclusive": Rate(4, 4)}
    scores = [
        Score(**rates, touching=t, right_fingers=f, wrong_fingers=0, mean_return=0)
        for t, f in ((0.9, 0.9), (0.8, 1.6), (0.7, 0.7))
    ]
    reports = iter(
        EvaluationReport("Toy-v1", 0, 4, dict.fromkeys(SENTENCES, score), score)
        for score in (*scores, scores[0])
    )
    monkeypatch.setattr(training, "evaluate_policy", lambda *_, **__: next(reports))
    envs = ToyVectorEnv()
    envs.experiment.reward = reward
    config = toy_config(tmp_path, total_steps=3 * UPDATE, eval_interval=UPDATE)
    weights = DenseWeights(each_finger=each_finger)
    path = train(dataclasses.replace(config, dense_weights=weights), envs=envs)
    _, _, metadata = checkpoint.load_policy(path)
    assert metadata["steps"] == best * UPDATE


def test_training_leaves_its_records(tmp_path):
    run(toy_config(tmp_path))
    names = {path.name for path in tmp_path.iterdir()}
    expected = {"config.json", "metrics.csv", "evaluations.csv", "evaluation.json"}
    assert expected | {"best.safetensors", "last.safetensors"} <= names
    assert any("tfevents" in name for name in names)
    assert [int(row["steps"]) for row in rows(tmp_path, "metrics")] == [
        UPDATE * i for i in (1, 2, 3, 4)
    ]


@pytest.mark.parametrize("images", [False, True])
def test_a_run_resumed_at_a_checkpoint_equals_one_never_interrupted(
    tmp_path, interrupt, images
):
    senses = ("vision", "proprioception") if images else ("proprioception",)
    changes = {} if not images else {"camera_height": 16, "camera_width": 8}
    agent = AgentConfig(senses=senses, hidden=(32, 32), language_layers=1)

    def config(name):
        return toy_config(tmp_path / name, agent=agent, **changes)

    def go(config, **kwargs):
        train(config, envs=ToyVectorEnv(8, images=images), **kwargs)

    go(config("whole"))
    interrupt(3)  # after the checkpoint that follows the second update
    with pytest.raises(KeyboardInterrupt):
        go(config("halves"))
    torch.manual_seed(123)  # whatever happens in between
    go(config("halves"), resume=True)
    assert_same(tensors(tmp_path / "whole"), tensors(tmp_path / "halves"))
    times = ("time/collect", "time/update")
    first, second = (
        [{k: v for k, v in row.items() if k not in times} for row in records]
        for records in (rows(tmp_path / n, "metrics") for n in ("whole", "halves"))
    )
    assert first == second


def test_evaluating_changes_nothing_in_the_weights_to_come(tmp_path):
    each = {"checkpoint_interval": UPDATE}
    run(toy_config(tmp_path / "never", **each))
    run(toy_config(tmp_path / "often", eval_interval=UPDATE, **each))
    assert_same(tensors(tmp_path / "never"), tensors(tmp_path / "often"))


def test_the_same_seed_gives_the_same_weights_and_another_one_others(tmp_path):
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        run(toy_config(tmp_path / name, seed=seed, total_steps=UPDATE))
    a, b, c = (tensors(tmp_path / name) for name in "abc")
    assert_same(a, b)
    assert not torch.equal(
        a["agent.actor.mean.0.weight"], c["agent.actor.mean.0.weight"]
    )


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_whatever_stops_it_the_last_complete_update_is_kept(tmp_path, interrupt, error):
    interrupt(2, error)
    with pytest.raises(error):
        run(toy_config(tmp_path))
    stored = checkpoint.read(tmp_path / "last.safetensors")
    assert stored.metadata["steps"] == UPDATE


@pytest.mark.parametrize(
    ("owner", "name", "late"),
    [
        (training, "evaluate_policy", False),
        (checkpoint, "save_policy", True),
        (RunFolder, "log", True),
    ],
)
def test_an_evaluation_that_is_interrupted_is_made_on_resuming(
    tmp_path, monkeypatch, owner, name, late
):
    changes = {"total_steps": 2 * UPDATE, "eval_interval": UPDATE}
    run(toy_config(tmp_path / "whole", **changes))
    work, calls = getattr(owner, name), itertools.count()

    def interrupted(*arguments, **keywords):
        stop = next(calls) % 2 == 0
        result = work(*arguments, **keywords) if late or not stop else None
        if stop:
            raise KeyboardInterrupt
        return result

    monkeypatch.setattr(owner, name, interrupted)
    finished = False
    while not finished:
        with contextlib.suppress(KeyboardInterrupt):
            run(toy_config(tmp_path / "parts", **changes), resume=True)
            finished = True
    assert next(calls) > 2
    whole, parts = (
        (
            rows(folder, "evaluations"),
            checkpoint.read(folder / "last.safetensors").metadata["best_score"],
            (folder / "evaluation.json").read_text(),
        )
        for folder in (tmp_path / "whole", tmp_path / "parts")
    )
    assert parts == whole
    assert_same(tensors(tmp_path / "whole"), tensors(tmp_path / "parts"))


def test_records_of_steps_made_again_are_dropped(tmp_path, interrupt):
    interrupt(4)
    with pytest.raises(KeyboardInterrupt):
        run(toy_config(tmp_path))
    run(toy_config(tmp_path), resume=True)
    steps = [int(row["steps"]) for row in rows(tmp_path, "metrics")]
    assert steps == [UPDATE * i for i in (1, 2, 3, 4)]


def test_curves_have_no_points_of_steps_made_again(tmp_path, interrupt):
    interrupt(4, TrainingDivergedError)  # leaves the checkpoint of the second update
    with pytest.raises(TrainingDivergedError):
        run(toy_config(tmp_path))
    assert [int(row["steps"]) for row in rows(tmp_path, "metrics")][-1] == 3 * UPDATE
    run(toy_config(tmp_path), resume=True)
    events = EventAccumulator(str(tmp_path)).Reload()
    steps = [point.step for point in events.Scalars("train/reward")]
    assert steps == [UPDATE * i for i in (1, 2, 3, 4)]


def test_a_finished_run_can_be_prolonged(tmp_path):
    run(toy_config(tmp_path, total_steps=UPDATE))
    run(toy_config(tmp_path, total_steps=2 * UPDATE), resume=True)
    assert (
        checkpoint.read(tmp_path / "last.safetensors").metadata["steps"] == 2 * UPDATE
    )


def test_a_folder_with_a_run_is_not_overwritten(tmp_path):
    config = toy_config(tmp_path, total_steps=UPDATE)
    run(config)
    with pytest.raises(CheckpointError, match="already holds a run: resume"):
        run(config)


@pytest.mark.parametrize(
    ("envs", "message"),
    [
        (ToyVectorEnv(4), "num_envs: got a vector of 4 envs, expected 8"),
        (ToyVectorEnv(8, env_id="B-v1"), "env_id: got 'Toy-v1', expected 'B-v1'"),
    ],
)
def test_envs_that_are_not_the_configs_are_refused(tmp_path, envs, message):
    with pytest.raises(ConfigError, match=message):
        train(toy_config(tmp_path), envs=envs)


def test_senses_left_to_the_experiment_decide_what_the_envs_give(tmp_path, monkeypatch):
    blind = dataclasses.replace(
        catalog.get("NaoTouchCubeSingle-v1"), id="Blind-v1", senses=("touch",)
    )
    ir_maniskill.register(blind)
    made = []
    monkeypatch.setattr(training, "make_vec", lambda *_, **kwargs: made.append(kwargs))
    config = toy_config(tmp_path, env_id="Blind-v1")
    senseless = dataclasses.replace(config.agent, senses=None)
    with pytest.raises(AttributeError):  # there are no envs
        train(dataclasses.replace(config, agent=senseless))
    assert made[0]["obs_mode"] == "state_dict"


@pytest.mark.parametrize(
    ("device", "asked", "expected"),
    [
        ("cpu", ("physx_cpu", "auto"), ("physx_cpu", "auto")),
        ("cuda", ("physx_cpu", "cpu"), ("physx_cpu", "cpu")),
        ("cuda", ("physx_cuda", "auto"), ("physx_cuda", "auto")),
        ("cuda:1", ("physx_cpu", "cpu"), ("physx_cpu", "cpu")),
        ("cuda:1", ("physx_cuda", "auto"), ("physx_cuda:1", "sapien_cuda:1")),
    ],
)
def test_physics_and_drawing_are_where_the_config_says(
    tmp_path, monkeypatch, device, asked, expected
):
    made = []
    monkeypatch.setattr(training, "make_vec", lambda *_, **kwargs: made.append(kwargs))
    monkeypatch.setattr(distributed, "device", lambda: torch.device(device))
    sim, render = asked
    config = TrainConfig(out=str(tmp_path), sim_backend=sim, render_backend=render)
    with pytest.raises(AttributeError):  # there are no envs
        train(config)
    assert (made[0]["sim_backend"], made[0]["render_backend"]) == expected


def test_too_few_episodes_for_the_sentences_are_refused_before_training(tmp_path):
    with pytest.raises(ConfigError, match="eval_episodes: got 1, expected at least 2"):
        run(toy_config(tmp_path, eval_episodes=1))
    assert not (tmp_path / "metrics.csv").exists()


def test_the_last_evaluation_has_an_episode_for_every_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "FINAL_EPISODES", 1)
    run(toy_config(tmp_path, total_steps=UPDATE))
    report = json.loads((tmp_path / "evaluation.json").read_text())
    assert (report["episodes"], report["reward_mode"]) == (2, "dense")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"env_id": "Other-v1"}, "env_id .checkpoint: 'Toy-v1', now: 'Other-v1'"),
        ({"seed": 5}, "seed .checkpoint: 0, now: 5"),
    ],
)
def test_another_task_or_config_cannot_be_resumed(tmp_path, change, message):
    config = toy_config(tmp_path, total_steps=UPDATE)
    run(config)
    with pytest.raises(CheckpointError, match=message):
        run(dataclasses.replace(config, **change), resume=True)


def test_a_broken_checkpoint_is_refused(tmp_path):
    config = toy_config(tmp_path, total_steps=UPDATE)
    run(config)
    last = tmp_path / "last.safetensors"
    last.write_bytes(last.read_bytes()[:1000])
    with pytest.raises(CheckpointError, match="cut short"):
        run(config, resume=True)


@pytest.mark.parametrize("rate", [0.0, float("nan"), "fast"])
def test_a_step_size_that_cannot_be_is_refused(tmp_path, rate):
    config = toy_config(tmp_path, total_steps=UPDATE)
    run(config)
    last = tmp_path / "last.safetensors"
    stored = checkpoint.read(last)
    stored.metadata["learning_rate"] = rate
    checkpoint.write(last, stored)
    with pytest.raises(CheckpointError, match="learning_rate: got"):
        run(config, resume=True)


def test_a_folder_that_cannot_be_written_is_refused_before_training(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(CheckpointError, match=r"cannot write to .*choose another"):
        run(toy_config(tmp_path / "file" / "run"))


def test_a_full_disk_is_refused_before_training(tmp_path, monkeypatch):
    usage = training.RunFolder.__init__.__globals__["shutil"].disk_usage(tmp_path)
    full = usage._replace(free=1_000_000)
    monkeypatch.setattr("shutil.disk_usage", lambda _: full)
    with pytest.raises(CheckpointError, match="got 1 MB of free space"):
        run(toy_config(tmp_path))


def test_divergence_keeps_the_last_good_checkpoint(tmp_path, monkeypatch):
    envs = ToyVectorEnv(8)
    step, calls = envs.step, []

    def explode(action):
        calls.append(None)
        obs, *rest = step(action)
        if len(calls) > 3 * UPDATE // 8:
            obs["agent"]["proprioception"][0, 0] = torch.nan
        return obs, *rest

    envs.step = explode
    with pytest.raises(TrainingDivergedError, match=r"observation.*: proprioception"):
        train(toy_config(tmp_path), envs=envs)
    stored = checkpoint.read(tmp_path / "last.safetensors")
    assert stored.metadata["steps"] == 2 * UPDATE
    assert all(v.isfinite().all() for v in stored.tensors.values())


def test_a_reward_that_is_no_number_is_named(tmp_path):
    envs = ToyVectorEnv(8)
    step = envs.step

    def explode(action):
        obs, reward, *rest = step(action)
        return obs, reward / 0, *rest

    envs.step = explode
    with pytest.raises(TrainingDivergedError, match=r"outcome .*: reward; .*unstable"):
        train(toy_config(tmp_path), envs=envs)
    assert checkpoint.read(tmp_path / "last.safetensors").metadata["steps"] == 0


@pytest.mark.parametrize(
    ("mode", "expected"),
    [("annealed", [0.5, 0.4, 0.3, 0.2]), ("decayed", [0.8, 0.4, 0.2, 0.1])],
)
def test_the_noise_shrinks_as_steps_are_made(tmp_path, mode, expected):
    config = toy_config(tmp_path)
    final = {"annealed": 0.1, "decayed": 0.05}[mode]
    noise = {"std_mode": mode, "std": expected[0], "std_final": final}
    run(dataclasses.replace(config, agent=dataclasses.replace(config.agent, **noise)))
    got = [float(row["std"]) for row in rows(tmp_path, "metrics")]
    assert got == pytest.approx(expected, abs=1e-4)


def test_the_posture_gain_changes_as_steps_are_made_and_is_kept(tmp_path, monkeypatch):
    gains, set_gain = [], Actor.set_gain
    monkeypatch.setattr(
        Actor,
        "set_gain",
        lambda actor, gain: (gains.append(gain), set_gain(actor, gain)),
    )
    config = toy_config(tmp_path)
    changes = {"posture_gain": 1.0, "posture_gain_final": 2.0}
    run(dataclasses.replace(config, agent=dataclasses.replace(config.agent, **changes)))
    assert gains == pytest.approx([1, 1.25, 1.5, 1.75])
    agent, _, _ = checkpoint.load_policy(tmp_path / "best.safetensors")
    assert float(agent.actor.posture_gain) == 1.75


def test_other_objects_get_their_price_as_steps_are_made(tmp_path):
    prices = []
    envs = ToyVectorEnv()
    envs.set_attr = lambda name, value: prices.append((name, value.wrong))
    train(toy_config(tmp_path, lenient_steps=2 * UPDATE), envs=envs)
    usual = DenseWeights().wrong
    expected = [0, usual / 2, usual, usual]
    assert prices == [("dense_weights", price) for price in expected]


@pytest.mark.slow
@pytest.mark.render
def test_the_real_task_resumes_bit_for_bit(tmp_path, interrupt):
    def config(name):
        update = {"rollouts": 4, "epochs": 2, "minibatch": 64}
        ppo = dataclasses.replace(TrainConfig().ppo, **update)
        intervals = {"checkpoint_interval": 128, "eval_interval": 10**6}
        return TrainConfig(
            out=str(tmp_path / name),
            total_steps=4 * 128,
            num_envs=4,
            num_workers=2,
            threads=1,
            eval_episodes=4,
            ppo=ppo,
            **intervals,
        )

    train(config("whole"))
    interrupt(3)
    with pytest.raises(KeyboardInterrupt):
        train(config("halves"))
    train(config("halves"), resume=True)
    assert_same(tensors(tmp_path / "whole"), tensors(tmp_path / "halves"))
