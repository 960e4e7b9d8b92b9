import dataclasses
import json
import os
import shlex
import signal
import sys

import pytest
import torch

from ir_maniskill import api, cli, experiment, files
from ir_maniskill.agent.agent import Agent, StateSpec
from ir_maniskill.policy import load_policy
from ir_maniskill.training.checkpoint import save_policy
from ir_maniskill.training.config import (
    CONFIGS,
    TrainConfig,
    to_data,
)
from ir_maniskill.training.train import beginning_with, for_experiment

IDS = [
    f"NaoTouch{shape}{kind}-v1"
    for shape in ("Cube", "Button")
    for kind in ("Single", "Multi", "Triangle", "Shuffled")
]


def fails(capsys, *arguments):
    """Run a command that must fail with one line, and return that line."""
    assert cli.run(arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("ir-maniskill: error: ")
    return lines[0]


@pytest.fixture
def policy_file(tmp_path):
    """An untrained policy for small pictures."""
    config = TrainConfig(camera_width=32, camera_height=64)
    felt = {"proprioception": (3, 26), "target": (3, 26), "touch": (3, 6)}
    spec = StateSpec({"images": (3, 2, 64, 32, 3), **felt}, 26)
    torch.manual_seed(0)
    agent = Agent(config.agent, spec, policy_only=True)
    path = tmp_path / "policy.safetensors"
    save_policy(path, agent, config, steps=7, evaluation={})
    return path


def test_tasks_lists_all_eight_ids_and_three_robots(capsys):
    assert cli.run(["tasks"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    assert {*IDS, "nao", "g1", "panda"} <= {row[0] for row in rows}
    assert ["g1", "ir_g1", "24"] in [row[:3] for row in rows]


@pytest.mark.parametrize("command", ["train", "evaluate", "video", "record"])
def test_an_unknown_id_lists_those_there_are(command, capsys):
    line = fails(capsys, command, "NaoTouchMoon-v1")
    assert "got 'NaoTouchMoon-v1'" in line and all(name in line for name in IDS)


@pytest.mark.parametrize("command", ["evaluate", "video", "record"])
def test_a_policy_of_another_task_is_refused(command, policy_file, capsys):
    line = fails(capsys, command, IDS[5], "--checkpoint", str(policy_file))
    assert f"task: got '{IDS[0]}', expected '{IDS[5]}'" in line
    assert "any_task" in line


def test_what_is_printed_to_type_next_is_quoted(monkeypatch, tmp_path, capsys):
    best = tmp_path / "my run's" / "best.safetensors"
    monkeypatch.setattr(cli, "train", lambda *_, **__: best)
    assert cli.run(["train", IDS[0], "--out", str(best.parent)]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    typed = shlex.split(last.removeprefix("Next: "))
    assert typed == ["ir-maniskill", "evaluate", IDS[0], "--checkpoint", str(best)]


def test_without_a_policy_the_error_tells_how_to_train(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    task = "from ir_maniskill import experiment, register; import dataclasses\n"
    task += f"task = experiment.get({IDS[0]!r})\n"
    task += "register(dataclasses.replace(task, id='Quoted-v1'))\n"
    (tmp_path / "quoted.py").write_text(task)
    line = fails(capsys, "evaluate", "quoted:Quoted-v1")
    assert "ir-maniskill train quoted:Quoted-v1" in line


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["evaluate", IDS[0], "--num-envs", "0"], "num_envs: got 0"),
        (["evaluate", IDS[0], "--episodes", "0"], "episodes: got 0"),
        (["evaluate", IDS[0], "--split", "pairs"], "got 'pairs', expected 'train'"),
        (["evaluate", IDS[0], "--instruction", "Hop."], "'Touch the blue cube.'"),
        (["evaluate", IDS[0], "--instruction", "Touch the can."], "exactly one of: "),
        (["video", IDS[0], "--episodes", "-1"], "episodes: got -1"),
        (["video", IDS[0], "--speed", "0"], "speed: got 0"),
        (["video", IDS[0], "--out", "film.avi"], "film.avi"),
        (["record", IDS[0], "--out", "/dev"], "got '/dev', expected a new one"),
        (["record", IDS[0], "--out", "/dev/null/x"], "cannot write /dev/null/x/"),
        (["record", IDS[0], "--height", "1"], "height: got 1"),
        (["audit", IDS[0], "--picture", "bars"], "got bars, expected a name ending"),
        (["audit", IDS[0], "--policy", "a:b", "--checkpoint", "c"], "got 'a:b and c'"),
        (["video", IDS[0], "--seed", str(2**32 - 2)], "seed: got 4294967294"),
        (["evaluate", IDS[0], "--seed", str(2**32 - 100)], "seed: got 4294967196"),
        (["train", IDS[0], "--num-envs", "0"], "num_envs: got 0"),
        (["train", IDS[0], "--preset", "fast"], "default, listen, vision, paper"),
        (["curve", "/nowhere"], "/nowhere"),
        (["audit", IDS[0], "--checkpoint", "/nowhere/best"], "/nowhere/best"),
        (["video", IDS[0], "--out", "/dev/null/film.mp4"], "cannot write /dev/null/f"),
        (["evaluate", IDS[0], "--json", "/dev"], "cannot write /dev: Is a directory"),
        (["bench", "--json", "/dev/null/x"], "cannot write /dev/null/x: "),
        (["bench", "--seconds", "0"], "seconds: got 0"),
    ],
)
def test_values_out_of_range_are_refused(arguments, message, capsys, policy_file):
    if arguments[0] in ("evaluate", "video", "record"):
        arguments = [*arguments, "--checkpoint", str(policy_file)]
    assert message in fails(capsys, *arguments)


def test_what_is_no_file_is_not_replaced_and_a_link_stays(tmp_path):
    pipe, link, file = (tmp_path / name for name in ("pipe", "link", "file"))
    os.mkfifo(pipe)
    link.symlink_to(file)
    for write in (files.require_writable, lambda path: files.write_json(path, {})):
        with pytest.raises(OSError, match="cannot write .*pipe: it is no file"):
            write(pipe)
        write(link)
    assert pipe.is_fifo() and link.is_symlink() and file.read_text() == "{}\n"


@pytest.mark.parametrize("name", ["file/inside", 99 * "long"])
def test_where_no_file_can_be_the_path_is_named(name, tmp_path):
    (tmp_path / "file").touch()
    for write in (files.require_writable, lambda path: files.write_json(path, {})):
        with pytest.raises(OSError, match=f"cannot write {tmp_path / name}: "):
            write(tmp_path / name)


@pytest.mark.parametrize("arguments", [[], ["dance"], ["train"], ["evaluate"]])
def test_incomplete_commands_exit_with_2(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.run(arguments)
    assert stop.value.code == 2


def trained_with(monkeypatch, *arguments):
    """Return the config and the resume flag that a train command leads to."""
    calls = []
    monkeypatch.setattr(
        cli, "train", lambda config, resume: calls.append((config, resume))
    )
    assert cli.run(["train", *arguments]) == 0
    return calls[0]


@pytest.mark.parametrize("preset", CONFIGS)
def test_a_preset_gives_every_number_but_id_and_folder(preset, monkeypatch):
    config, resume = trained_with(monkeypatch, IDS[2], "--preset", preset)
    out = f"runs/{IDS[2]}"
    assert config == dataclasses.replace(CONFIGS[preset], env_id=IDS[2], out=out)
    assert type(config) is TrainConfig and resume is False


def test_options_override_the_preset(monkeypatch):
    config, resume = trained_with(
        monkeypatch, IDS[0], "--preset", "paper", "--ppo.learning-rate", "0.001",
        "--agent.senses", "vision", "touch", "--out", "runs/mine", "--resume",
    )  # fmt: skip
    assert config.ppo.learning_rate == 0.001
    assert config.agent.senses == ("vision", "touch")
    assert config.out == "runs/mine" and resume is True
    assert config.ppo.clip == CONFIGS["paper"].ppo.clip


def test_a_run_that_is_resumed_gives_the_numbers_itself(monkeypatch, tmp_path, capsys):
    folder = tmp_path / "run"
    folder.mkdir()
    stored = dataclasses.replace(
        CONFIGS["vision"], env_id=IDS[0], out=str(folder), seed=3, total_steps=9000
    )
    stored = for_experiment(stored, experiment.get(IDS[0]))
    (folder / "config.json").write_text(json.dumps(to_data(stored)))
    go_on = (IDS[0], "--out", str(folder), "--resume")
    config, resume = trained_with(monkeypatch, *go_on, "--threads", "1")
    assert (config, resume) == (dataclasses.replace(stored, threads=1), True)
    again = (*go_on, "--preset", "vision", "--seed", "3")
    assert trained_with(monkeypatch, *again)[0] == stored
    line = fails(capsys, "train", *go_on, "--preset", "default", "--seed", "3")
    assert "ppo.gamma (run: 0.95, now: 0.9)" in line


def test_a_policy_to_begin_with_gives_what_its_weights_need(monkeypatch, tmp_path):
    policy, task = load_policy("NaoInstruct-v1").config, "NaoTouchCubeShuffled-v1"
    out = ("--out", str(tmp_path))
    begin = (task, *out, "--init-from", "NaoInstruct-v1")
    config, _ = trained_with(monkeypatch, *begin)
    assert config == beginning_with(
        "NaoInstruct-v1",
        dataclasses.replace(CONFIGS["default"], env_id=task, out=str(tmp_path)),
    )
    assert (config.agent, config.frames) == (policy.agent, 1)
    told = (*begin, "--preset", "listen", "--frames", "2")
    config, _ = trained_with(monkeypatch, *told)
    assert (config.agent, config.frames) == (policy.agent, 2)
    assert config.sac == CONFIGS["listen"].sac
    stored = for_experiment(config, experiment.get(task))
    assert stored.agent.vocabulary == policy.agent.vocabulary  # it reads any text
    (tmp_path / "config.json").write_text(json.dumps(to_data(stored)))
    for again in (told, (task, *out)):
        assert trained_with(monkeypatch, *again, "--resume")[0] == stored


def test_errors_of_many_lines_are_told_in_one(monkeypatch, capsys):
    def fail(*_, **__):
        trace = "Traceback ...\n  File\n    raise\nRuntimeError: no Vulkan\nTo install:"
        raise RuntimeError(f"worker 1 failed:\n{trace}\napt-get install mesa\n")

    monkeypatch.setattr(cli, "train", fail)
    assert cli.run(["train", IDS[0]]) == 2
    told = "worker 1 failed: RuntimeError: no Vulkan\nTo install:\napt-get install mesa"
    assert told in capsys.readouterr().err


def test_ctrl_c_exits_with_130(monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "train", interrupt)
    assert cli.run(["train", IDS[0]]) == 130


def test_a_reader_who_has_seen_enough_is_no_error(monkeypatch, capsys):
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as closed:
        monkeypatch.setattr(sys, "stdout", closed)
        assert cli.run(["tasks"]) == 0
    assert capsys.readouterr().err == ""


@pytest.fixture
def signals():
    """Put the handlers of signals back."""
    numbers = (signal.SIGTERM, signal.SIGHUP)
    handlers = [signal.signal(number, signal.SIG_DFL) for number in numbers]
    yield numbers
    for number, handler in zip(numbers, handlers, strict=True):
        signal.signal(number, handler)


def code_of_a_training(monkeypatch, number):
    """Return the exit code of a training that gets a signal."""
    monkeypatch.setattr(cli, "train", lambda *_, **__: signal.raise_signal(number))
    with pytest.raises(SystemExit) as stop:
        cli.main(["train", IDS[0]])
    return stop.value.code


def test_sigterm_and_a_closed_terminal_stop_like_ctrl_c(monkeypatch, signals):
    for number in signals:
        assert code_of_a_training(monkeypatch, number) == 130


def test_nohup_holds(monkeypatch, signals):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    assert code_of_a_training(monkeypatch, signal.SIGHUP) == 0


@pytest.mark.render
def test_evaluate_prints_a_table_and_writes_json(
    policy_file, multi_vec, monkeypatch, tmp_path, capsys
):
    monkeypatch.setattr(api, "make_vec", lambda *_, **__: multi_vec)
    monkeypatch.setattr(multi_vec, "close", lambda: None)
    out, task = tmp_path / "report.json", "NaoTouchCubeMulti-v1"
    options = ["--episodes", "3", "--seed", "5", "--json", str(out)]
    policy = ["--checkpoint", str(policy_file), "--any-task"]
    assert cli.run(["evaluate", task, *policy, *options]) == 0
    assert "Touch the blue cube." in capsys.readouterr().out
    data = json.loads(out.read_text())
    assert data["episodes"] == 3 and data["seed"] == 5 and data["trained_steps"] == 7
    assert (data["config"]["camera_height"], data["reward_mode"]) == (64, "sparse")
    assert list(data["instructions"]) == list(experiment.get(task).sentences)
