import contextlib
import dataclasses
import itertools
import json
import math
import re
import shutil

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from toy_envs import (
    LENGTH,
    SENTENCES,
    TASK,
    ToyVectorEnv,
    records,
    steps_of,
    toy_config,
)

from ir_maniskill.environment.vector import info_of_step
from ir_maniskill.evaluation.evaluate import EvaluationReport, Rate, Score
from ir_maniskill.language.tokens import VOCABULARY
from ir_maniskill.training import checkpoint, distributed, run_folder, runner
from ir_maniskill.training import train as training
from ir_maniskill.training.algorithm import under
from ir_maniskill.training.checkpoint import CheckpointError, MismatchError
from ir_maniskill.training.config import (
    CONFIGS,
    AgentConfig,
    ConfigError,
    TrainConfig,
    from_data,
)
from ir_maniskill.training.finite import TrainingDivergedError
from ir_maniskill.training.run_folder import RunFolder
from ir_maniskill.training.train import beginning_with, train

UPDATE = 32 * LENGTH  # steps of an update of the toy task


@pytest.fixture(autouse=True)
def few_final_episodes(monkeypatch):
    monkeypatch.setattr(runner, "FINAL_EPISODES", 16)


def run(config, **kwargs):
    envs = ToyVectorEnv(config.num_envs, env_id=config.env_id)
    given = {"envs": envs, "eval_envs": ToyVectorEnv(4)}
    return training.run(config, **(given | kwargs))


def tensors(folder):
    return checkpoint.read(folder / "last.safetensors").tensors


def assert_same(first, second):
    assert first.keys() == second.keys()
    different = [name for name in first if not torch.equal(first[name], second[name])]
    assert not different


@pytest.fixture
def interrupt(before_update):
    """Make the training stop in its n-th update, as if by Ctrl-C."""

    def stop(error):
        raise error

    return lambda at, error=KeyboardInterrupt: before_update(at, lambda: stop(error))


def test_training_learns_the_toy_task_and_keeps_the_best_policy(tmp_path):
    learner = dataclasses.replace(toy_config(tmp_path).ppo, learning_rate=3e-3)
    steps = {"total_steps": 16 * UPDATE, "eval_interval": 8 * UPDATE}
    config = toy_config(tmp_path, ppo=learner, **steps)
    best = run(config)
    assert best == tmp_path / "best.safetensors"
    assert float(records(tmp_path, "evaluations")[-1]["eval/worst"]) == 1.0
    report = json.loads((tmp_path / "evaluation.json").read_text())
    assert (report["episodes"], report["overall"]["success"]) == (16, 1.0)
    _, stored, metadata = checkpoint.load_agent(best)
    assert stored == config
    assert metadata["evaluation"] == report
    names = {path.name for path in tmp_path.iterdir()}
    assert {"config.json", "metrics.csv", "last.safetensors"} <= names
    assert any("tfevents" in name for name in names)


def test_the_best_policy_reaches_the_goal_and_holds_it_with_many_fingers():
    def score(success, holding, fingers):
        rates = {"success": Rate(success, 4), "exclusive": Rate(4, 4)}
        means = {"holding": holding, "right_fingers": fingers}
        each = Score(**rates, **means, wrong_fingers=0, mean_return=0)
        report = EvaluationReport("T-v1", 0, 4, dict.fromkeys(SENTENCES, each), each)
        return runner.score_of(report, fingers=2)

    assert score(3, 0.5, 1.0) == 0.75 + 1 + 0.5 + 0.5
    assert score(4, 0.5, 1.0) > score(3, 0.6, 1.2)
    assert score(4, 0.5, 1.5) > score(4, 0.5, 1.0)


def test_a_run_resumed_at_a_checkpoint_equals_one_never_interrupted(
    tmp_path, interrupt
):
    agent = AgentConfig(senses=("vision", "proprioception"), hidden=(32, 32))
    changes = {"agent": agent, "camera_height": 16, "camera_width": 8}

    def go(name, **kwargs):
        envs, evaluated_in = (ToyVectorEnv(8, images=True) for _ in range(2))
        config = toy_config(tmp_path / name, **changes)
        training.run(config, envs=envs, eval_envs=evaluated_in, **kwargs)

    go("whole")
    interrupt(3)  # after the checkpoint that follows the second update
    with pytest.raises(KeyboardInterrupt):
        go("halves")
    torch.manual_seed(123)  # whatever happens in between
    go("halves", resume=True)
    assert_same(tensors(tmp_path / "whole"), tensors(tmp_path / "halves"))
    assert records(tmp_path / "whole") == records(tmp_path / "halves")


def test_an_evaluation_alone_changes_nothing(tmp_path):
    never = {"checkpoint_interval": 10**6}
    run(toy_config(tmp_path / "never", **never))
    run(toy_config(tmp_path / "often", eval_interval=UPDATE, **never))
    assert len(records(tmp_path / "often", "evaluations")) == 4
    assert_same(tensors(tmp_path / "never"), tensors(tmp_path / "often"))


def test_another_seed_gives_other_weights(tmp_path):
    for name, seed in (("a", 0), ("b", 1)):
        run(toy_config(tmp_path / name, seed=seed, total_steps=UPDATE))
    a, b = (tensors(tmp_path / name)["agent.actor.mean.0.weight"] for name in "ab")
    assert not torch.equal(a, b)


def test_whatever_stops_it_the_last_complete_update_is_kept(tmp_path, interrupt):
    interrupt(2, MemoryError)
    with pytest.raises(MemoryError):
        run(toy_config(tmp_path))
    stored = checkpoint.read(tmp_path / "last.safetensors")
    assert stored.metadata["steps"] == UPDATE


@pytest.mark.parametrize(
    ("owner", "name", "late"),
    [
        (runner, "evaluate_policy", False),
        (checkpoint, "save_policy", True),
        (RunFolder, "log", True),
    ],
)
def test_an_evaluation_that_is_interrupted_is_made_on_resuming(
    tmp_path, monkeypatch, owner, name, late
):
    changes = {"total_steps": 2 * UPDATE, "eval_interval": UPDATE}
    changes["checkpoint_interval"] = UPDATE
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
            records(folder, "evaluations"),
            checkpoint.read(folder / "last.safetensors").metadata["best_score"],
            (folder / "evaluation.json").read_text(),
        )
        for folder in (tmp_path / "whole", tmp_path / "parts")
    )
    assert parts == whole
    assert_same(tensors(tmp_path / "whole"), tensors(tmp_path / "parts"))


def test_a_run_that_began_with_a_policys_words_keeps_them(tmp_path, monkeypatch):
    begun = toy_config(tmp_path, init_from="NaoInstruct-v1")
    words = {"language": "lexicon", "vocabulary": (*VOCABULARY, "grape")}
    agent = dataclasses.replace(begun.agent, **words)
    begun = dataclasses.replace(begun, agent=agent)
    monkeypatch.setattr(training, "stored_config", lambda out: begun)
    monkeypatch.setattr(training, "run", lambda config, *_: config)
    assert train("Toy-v1", True, ToyVectorEnv(), out=tmp_path) == begun


def test_a_folder_may_be_a_path(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "run", lambda config, *_: config)
    assert training.train("NaoTouchCubeSingle-v1", out=tmp_path).out == str(tmp_path)


def test_records_have_no_steps_made_again(tmp_path, interrupt):
    interrupt(4, TrainingDivergedError)  # leaves the checkpoint of the second update
    with pytest.raises(TrainingDivergedError):
        run(toy_config(tmp_path))
    assert steps_of(tmp_path)[-1] == 3 * UPDATE
    run(toy_config(tmp_path), resume=True)
    events = EventAccumulator(str(tmp_path)).Reload()
    curve = [point.step for point in events.Scalars("train/reward")]
    assert curve == steps_of(tmp_path) == [UPDATE * i for i in (1, 2, 3, 4)]


@pytest.mark.parametrize("updates", [2, 4])  # of 4: in the middle, and at the end
def test_a_run_whose_best_policy_is_lost_gets_another(tmp_path, updates):
    config = toy_config(tmp_path, eval_interval=2 * UPDATE)
    run(dataclasses.replace(config, total_steps=updates * UPDATE))
    (tmp_path / "best.safetensors").unlink()
    run(config, resume=True)
    best = checkpoint.read(tmp_path / "best.safetensors").metadata
    assert best["steps"] in (2 * UPDATE, 4 * UPDATE)
    assert steps_of(tmp_path, "evaluations") == [2 * UPDATE, 4 * UPDATE]


def test_a_best_policy_that_is_broken_is_refused_before_training(tmp_path, interrupt):
    interrupt(3)
    with pytest.raises(KeyboardInterrupt):
        run(toy_config(tmp_path, eval_interval=UPDATE))
    (tmp_path / "best.safetensors").write_bytes(b"cut short")
    with pytest.raises(CheckpointError, match="best.safetensors: .*or move it away"):
        run(toy_config(tmp_path), resume=True)


@pytest.mark.parametrize("text", ["step,return\n1,2\n", "steps,return\nmany,2\n"])
def test_a_table_that_is_none_is_named(tmp_path, text):
    run(toy_config(tmp_path, total_steps=UPDATE))
    (tmp_path / "metrics.csv").write_text(text)
    with pytest.raises(CheckpointError, match=r"metrics.csv: got .*a column `steps`"):
        run(toy_config(tmp_path), resume=True)


def test_a_run_goes_on_with_its_own_config_but_for_what_is_given(tmp_path):
    config = toy_config(tmp_path, total_steps=UPDATE, seed=3)
    run(config)
    with pytest.raises(ConfigError, match=r"\(run: 3, now: 5\)"):
        train("Toy-v1", True, ToyVectorEnv(), out=tmp_path, seed=5)
    toys = ToyVectorEnv(), ToyVectorEnv()
    train("Toy-v1", True, *toys, out=tmp_path, total_steps=2 * UPDATE)
    stored = checkpoint.read(tmp_path / "last.safetensors")
    assert stored.metadata["steps"] == 2 * UPDATE
    longer = dataclasses.replace(config, total_steps=2 * UPDATE)
    written = json.loads((tmp_path / "config.json").read_text())
    assert from_data(written) == longer


def test_a_run_that_ends_while_another_waits_for_its_folder_is_not_overwritten(
    tmp_path, monkeypatch
):
    ended = toy_config(tmp_path / "ended", total_steps=2 * UPDATE)
    run(dataclasses.replace(ended, total_steps=UPDATE))
    folder = tmp_path / "waiting"
    shutil.copytree(tmp_path / "ended", folder)
    run(ended, resume=True)
    lock, steps = run_folder.fcntl.flock, []

    def lock_late(*arguments):
        shutil.copytree(tmp_path / "ended", folder, dirs_exist_ok=True)
        lock(*arguments)

    monkeypatch.setattr(run_folder.fcntl, "flock", lock_late)
    restore = runner.Runner.restore
    monkeypatch.setattr(
        runner.Runner,
        "restore",
        lambda self, stored: (
            restore(self, stored),
            steps.append(stored.metadata["steps"]),
        ),
    )
    run(toy_config(folder, total_steps=3 * UPDATE), resume=True)
    assert steps == [2 * UPDATE]


# -- Beginning with another policy's weights -------------------------------------------


@pytest.fixture
def before(tmp_path):
    """Return the folder of a run to begin with."""
    run(toy_config(tmp_path / "before", total_steps=UPDATE))
    return tmp_path / "before"


def begun(folder):
    """Return the weights in a run's last checkpoint, by which its agent acts or not."""
    weights = under("agent", tensors(folder)).items()
    acting = {k: v for k, v in weights if not k.startswith(checkpoint.TRAINING_ONLY)}
    return acting, {k: v for k, v in weights if k not in acting}


def test_a_new_run_begins_with_the_weights_that_act(
    tmp_path, before, interrupt, caplog
):
    interrupt(1)
    new = toy_config(tmp_path / "new", seed=1, init_from=str(before))
    with caplog.at_level("INFO"), pytest.raises(KeyboardInterrupt):
        run(new)
    acting, learning = begun(tmp_path / "new")
    stored = checkpoint.read(before / "best.safetensors").tensors
    assert_same(acting, {k: v.float() for k, v in stored.items()})
    critic = begun(before)[1]["critic.value.0.weight"]
    assert not torch.equal(learning["critic.value.0.weight"], critic)
    told = f"begin with {len(acting)} weights of {before} (Toy-v1, {UPDATE} steps); "
    assert told + f"{len(learning)} are new" in caplog.messages
    assert (tmp_path / "new/evaluations.csv").read_text().splitlines()[1][:2] == "0,"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"hidden": (16, 32)},
            r"actor.mean.0.weight: got \(32, 928\), expected \(16, 928\);.*agent, alg",
        ),
        (
            {"senses": ("proprioception", "touch")},
            r"policy for Toy-v1 do not fit .*got \(128, 6\), expected \(128, 12\)",
        ),
        (
            {"vision": "paper"},
            r"encoder.body.embedding.1.bias: got \(128,\), expected None",
        ),
    ],
)
def test_weights_that_do_not_fit_are_refused(tmp_path, before, change, message):
    config = toy_config(tmp_path / "new", init_from=str(before))
    agent = dataclasses.replace(config.agent, **change)
    with pytest.raises(MismatchError, match=message):
        run(dataclasses.replace(config, agent=agent))
    assert not (tmp_path / "new" / "config.json").exists()


def test_words_in_other_places_are_refused(tmp_path, before):
    envs, words = ToyVectorEnv(), VOCABULARY
    envs.experiment.vocabulary = (*words[:5], words[6], words[5], *words[7:])
    with pytest.raises(MismatchError, match=r"vocabulary\[5\]: got 'blue', .*'red'"):
        run(toy_config(tmp_path / "new", init_from=str(before)), envs=envs)


@pytest.mark.parametrize("update", [1, 3])
def test_a_resumed_run_does_not_begin_again(tmp_path, before, interrupt, update):
    config = toy_config(tmp_path / "whole", init_from=str(before))
    run(config)
    halves = dataclasses.replace(config, out=str(tmp_path / "halves"))
    interrupt(update)
    with pytest.raises(KeyboardInterrupt):
        run(halves)
    shutil.rmtree(before)
    run(halves, resume=True)
    assert_same(tensors(tmp_path / "whole"), tensors(tmp_path / "halves"))
    whole, made = (records(tmp_path / n, "evaluations") for n in ("whole", "halves"))
    assert made == whole


def test_what_the_weights_need_comes_with_them_unless_it_is_told(before):
    preset = toy_config("x", agent=AgentConfig(), frames=1, camera_width=8)
    config = beginning_with(str(before), preset)
    own = toy_config("x")
    assert (config.frames, config.camera_width) == (3, 32)
    assert config.init_from == str(before)
    assert config.agent == dataclasses.replace(own.agent, vocabulary=VOCABULARY)
    assert beginning_with(None, preset) is preset


def test_a_task_is_named_with_its_module_as_elsewhere(monkeypatch):
    monkeypatch.setattr(training, "run", lambda config, *_: config)
    name = "ir_maniskill.tasks.single:NaoTouchCubeSingle-v1"
    config = train(name)
    assert config.env_id == "NaoTouchCubeSingle-v1"
    assert config.out == "runs/NaoTouchCubeSingle-v1"


def test_a_dict_changes_some_numbers_of_a_part(monkeypatch):
    monkeypatch.setattr(training, "run", lambda config, *_: config)
    config = train("NaoTouchCubeSingle-v1", preset="paper", ppo={"gamma": 0.5})
    paper = CONFIGS["paper"].ppo
    assert config.ppo == dataclasses.replace(paper, gamma=0.5)
    with pytest.raises(ConfigError, match="argument ppo of train: got 'gama', avail"):
        train("NaoTouchCubeSingle-v1", ppo={"gama": 0.5})


# -- Refusals --------------------------------------------------------------------------


def test_a_number_that_there_is_not_is_refused_by_what_there_is():
    with pytest.raises(ConfigError, match="got 'gamma', available: out, .* ppo,"):
        train("NaoTouchCubeSingle-v1", gamma=0.9)
    with pytest.raises(ConfigError, match="preset: got 'fast', available: default, "):
        train("NaoTouchCubeSingle-v1", preset="fast")
    with pytest.raises(ConfigError, match="got 'env_id', available: out, "):
        train("NaoTouchCubeSingle-v1", env_id="NaoTouchCubeMulti-v1")
    with pytest.raises(ConfigError, match="task: got Exp.*expected an id"):
        train(TASK)


def test_a_folder_with_a_run_is_not_overwritten(tmp_path):
    config = toy_config(tmp_path, total_steps=UPDATE)
    run(config)
    with pytest.raises(CheckpointError, match="already holds a run: resume"):
        run(config)


@pytest.mark.parametrize(
    ("envs", "message"),
    [
        (ToyVectorEnv(4), "num_envs of those given: got 4, expected 8"),
        (ToyVectorEnv(8, env_id="B-v1"), "env_id: got 'Toy-v1', expected 'B-v1'"),
        ({"robot_uids": "panda"}, "robot_uids of the envs given: got 'ir_panda', exp"),
        ({"control_mode": "pd_joint_pos"}, "control_mode .*: got 'pd_joint_pos', exp"),
        ({"reward_mode": "sparse"}, "reward_mode .*: got 'sparse', expected 'dense'"),
    ],
)
def test_envs_that_are_not_the_configs_are_refused(tmp_path, envs, message):
    if isinstance(envs, dict):
        kwargs, envs = envs, ToyVectorEnv(8)
        envs.env_kwargs = {**envs.env_kwargs, **kwargs}
    with pytest.raises(ConfigError, match=message):
        training.run(toy_config(tmp_path), envs=envs)


def test_the_algorithm_may_be_named(monkeypatch):
    given = []
    monkeypatch.setattr(training, "run", lambda *args: given.append(args))
    training.train("NaoTouchCubeSingle-v1", preset="listen", algorithm="sac")
    ((config, *_, algorithm),) = given
    assert (config.algorithm, algorithm) == ("sac", None)
    with pytest.raises(
        ConfigError, match="algorithm: got 'dqn', expected one of 'ppo'"
    ):
        training.train("NaoTouchCubeSingle-v1", algorithm="dqn")


@pytest.mark.parametrize(
    ("device", "asked", "expected"),
    [
        ("cpu", ("physx_cpu", "auto"), ("physx_cpu", "auto")),
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
        training.run(config)
    assert (made[0]["sim_backend"], made[0]["render_backend"]) == expected


def test_too_few_episodes_for_the_sentences_are_refused_before_training(tmp_path):
    with pytest.raises(ConfigError, match="eval_episodes: got 1, expected at least 2"):
        run(toy_config(tmp_path, eval_episodes=1))
    assert not (tmp_path / "metrics.csv").exists()


def test_the_last_evaluation_has_an_episode_for_every_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "FINAL_EPISODES", 1)
    run(toy_config(tmp_path, total_steps=UPDATE))
    report = json.loads((tmp_path / "evaluation.json").read_text())
    assert report["episodes"] == 2


def test_a_broken_checkpoint_is_refused(tmp_path):
    config = toy_config(tmp_path, total_steps=UPDATE)
    run(config)
    last = tmp_path / "last.safetensors"
    last.write_bytes(last.read_bytes()[:1000])
    with pytest.raises(CheckpointError, match="cut short"):
        run(config, resume=True)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda obs, reward: obs["agent"]["proprioception"].fill_(torch.nan),
            "observation.*: proprioception",
        ),
        (lambda obs, reward: reward.div_(0), "outcome .*: reward; .*unstable"),
    ],
)
def test_divergence_keeps_the_last_good_checkpoint(tmp_path, spoil, message):
    envs = ToyVectorEnv(8)
    step, calls = envs.step, []

    def explode(action):
        calls.append(None)
        obs, reward, *rest = step(action)
        if len(calls) > 3 * UPDATE // 8:
            spoil(obs, reward)
        return obs, reward, *rest

    envs.step = explode
    with pytest.raises(TrainingDivergedError, match=message):
        run(toy_config(tmp_path), envs=envs)
    stored = checkpoint.read(tmp_path / "last.safetensors")
    assert stored.metadata["steps"] == 2 * UPDATE
    assert all(v.isfinite().all() for v in stored.tensors.values())


def test_noise_and_penalties_follow_the_share_of_the_steps(tmp_path):
    config = toy_config(tmp_path, penalty_warmup=0.5)
    learner = dataclasses.replace(config.ppo, std=0.5, std_final=0.1)
    run(dataclasses.replace(config, ppo=learner))
    got = records(tmp_path)
    noise = [float(row["std"]) for row in got]
    assert noise == pytest.approx([0.5, 0.4, 0.3, 0.2], abs=1e-4)
    assert [float(row["penalty"]) for row in got] == [0, 0.5, 1, 1]


def test_every_evaluation_has_its_line_and_the_last_one_a_table(tmp_path, capsys):
    run(toy_config(tmp_path, eval_interval=2 * UPDATE))
    lines = capsys.readouterr().out.splitlines()
    figures = r"success \d+%, worst sentence \d+%, exclusive .*fingers"
    steps = steps_of(tmp_path, "evaluations")
    for line, step in zip(lines, steps, strict=False):
        assert re.fullmatch(rf"step {step}: {figures}(, the best so far)?", line)
    best = checkpoint.read(tmp_path / "best.safetensors").metadata["steps"]
    title, head, *table = lines[len(steps) :]
    assert f"step {best}," in title and head.startswith("instruction ")
    assert all(map(str.startswith, table, SENTENCES)) and len(table) == 3
    assert lines[0].endswith(", the best so far")


def test_what_final_infos_say_of_episodes_that_go_on_does_not_count():
    def info(first, second):
        values = torch.tensor([first, second])
        fingers = {"right_fingers": values, "wrong_fingers": 0 * values}
        names = ("success", "success_once", "exclusive_success")
        once = {name: values > 0 for name in names}
        return {**fingers, **once, "reward_terms": values[:, None]}

    done, counts = torch.tensor([True, False]), runner.StepCounts()
    stale = {**info(0, 1), "final_info": info(1, 5)}  # the first episode has ended
    merged = info_of_step(stale, done)
    assert merged["right_fingers"].tolist() == [1, 1]
    assert merged["reward_terms"].tolist() == [[1], [1]]
    stale["success"][1] = stale["success_once"][1] = False
    counts.add(torch.zeros(2), done, info_of_step(stale, done))
    means = counts.means()
    assert (means["holding"], means["success"], means["return"]) == (0.5, 1, 0)


def test_where_no_episode_ended_there_are_no_figures_of_episodes():
    going = torch.zeros(4, dtype=torch.bool)
    names = ("success", "wrong_fingers", "success_once", "exclusive_success")
    info = dict.fromkeys(names, torch.tensor([1, 0, 0, 0]))
    counts = runner.StepCounts()
    counts.add(torch.full((4,), 0.5), going, info)
    means = counts.means()
    assert (means["reward"], means["holding"], means["wrong"]) == (0.5, 0.25, 0.25)
    assert all(math.isnan(means[name]) for name in ("return", "success", "exclusive"))


# -- The real task ---------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.render
def test_the_real_task_resumes_bit_for_bit(tmp_path, interrupt):
    def config(name):
        update = {"steps_per_update": 128, "epochs": 2, "minibatch": 64}
        learner = dataclasses.replace(TrainConfig().ppo, **update)
        intervals = {"checkpoint_interval": 128, "eval_interval": 10**6}
        return TrainConfig(
            out=str(tmp_path / name),
            total_steps=4 * 128,
            num_envs=4,
            num_workers=2,
            threads=1,
            eval_episodes=4,
            ppo=learner,
            **intervals,
        )

    training.run(config("whole"))
    interrupt(3)
    with pytest.raises(KeyboardInterrupt):
        training.run(config("halves"))
    training.run(config("halves"), resume=True)
    assert_same(tensors(tmp_path / "whole"), tensors(tmp_path / "halves"))
