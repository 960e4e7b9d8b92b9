"""Nothing is lost: trainings that are killed, stopped, starved or run out of disk."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time

import killed_training
import psutil
import pytest
import torch
from mounts import disk
from toy_envs import LENGTH, ToyVectorEnv, steps_of, toy_config

from ir_maniskill.environment.process_vector import WorkerError
from ir_maniskill.environment.vector import make_vec
from ir_maniskill.training import checkpoint, run_folder, runner
from ir_maniskill.training.checkpoint import CheckpointError
from ir_maniskill.training.config import AgentConfig, PPOConfig, TrainConfig
from ir_maniskill.training.run_folder import RunFolder
from ir_maniskill.training.train import run

UPDATE = 32 * LENGTH  # steps of an update of the toy task


def saved(folder):
    return checkpoint.read(folder / "last.safetensors")


# -- Killed ----------------------------------------------------------------------------


@pytest.mark.slow
def test_a_training_killed_25_times_ends_as_one_never_interrupted(
    tmp_path, monkeypatch
):
    (tmp_path / "killed").mkdir()
    done = subprocess.run(
        [sys.executable, killed_training.__file__, str(tmp_path / "killed"), "25"],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        check=True,
        text=True,
    )
    lines = done.stdout.splitlines()  # among them those of its evaluations
    lives = [json.loads(line) for line in lines if line[:1] in ("{", "[")]
    assert len(lives) == 25
    assert sum(death == signal.SIGKILL for death, _ in lives) >= 20
    steps = [steps for _, steps in lives]
    assert steps == sorted(steps), "a checkpoint was lost"
    assert len(set(steps)) > 5, "the lives were too short to show anything"

    monkeypatch.setattr(runner, "FINAL_EPISODES", 16)
    killed_training.train(tmp_path / "whole")
    ends = [saved(tmp_path / name).tensors for name in ("killed", "whole")]
    assert ends[0].keys() == ends[1].keys()
    for name in ends[0]:
        assert torch.equal(ends[0][name], ends[1][name]), name
    for table in ("metrics", "evaluations"):
        killed, whole = (steps_of(tmp_path / n, table) for n in ("killed", "whole"))
        assert killed == whole
    assert not list((tmp_path / "killed").glob(".*"))


def test_rows_cut_short_by_a_kill_are_dropped(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "FINAL_EPISODES", 16)
    config = toy_config(tmp_path, total_steps=2 * UPDATE)
    run(config, envs=ToyVectorEnv(8), eval_envs=ToyVectorEnv(8))
    table = tmp_path / "metrics.csv"
    for torn in ("2", "25,0.5", "25,0.5\r\n", "\0\xff"):
        with table.open("a", newline="", encoding="latin1") as file:
            file.write(torn)
        toys = {"envs": ToyVectorEnv(8), "eval_envs": ToyVectorEnv(8)}
        run(config, resume=True, **toys)
        assert steps_of(tmp_path) == [UPDATE, 2 * UPDATE]


def test_two_trainings_cannot_share_a_folder(tmp_path):
    first = RunFolder(tmp_path, resume=False)
    with pytest.raises(CheckpointError, match="in use by another training"):
        RunFolder(tmp_path, resume=True)
    first.close()
    RunFolder(tmp_path, resume=True).close()


def test_a_figure_that_begins_later_gets_a_column_of_its_own(tmp_path):
    folder = RunFolder(tmp_path, resume=False)
    folder.begin(toy_config(tmp_path), 0)
    for steps, figures in ((1, {"a": 1.0, "b": 2.0}), (2, {"b": 3.0, "c": 4.0})):
        folder.log("metrics", steps, figures)
    folder.close()
    lines = (tmp_path / "metrics.csv").read_text().split()
    assert lines == ["steps,a,b,c", "1,1.0,2.0,nan", "2,nan,3.0,4.0"]


# -- Workers ---------------------------------------------------------------------------


def small(out, **changes):
    """Return a config of the real task that needs no pictures."""
    senses = ("proprioception", "touch")
    agent = AgentConfig(senses=senses, critic="separate", auxiliary_weight=0.0)
    ppo = PPOConfig(128, epochs=1, minibatch=None)
    never = {"checkpoint_interval": 10**8, "eval_interval": 10**8}
    values = {"out": str(out), "num_envs": 2, "total_steps": 10**7, **never}
    return TrainConfig(agent=agent, ppo=ppo, **(values | changes))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("blow", "message"),
    [
        (signal.SIGKILL, r"worker-1 \(envs 1 to 1\) died with exit code -9"),
        (signal.SIGSTOP, r"no answer within 1 s from .*worker-1 \(envs 1 to 1\)"),
    ],
)
def test_a_worker_that_dies_or_hangs_is_named_and_no_update_is_lost(
    tmp_path, before_update, blow, message
):
    config = small(tmp_path)
    kwargs = config.env_kwargs(training=True) | {"render_backend": "none"}
    envs = make_vec(config.env_id, 2, num_workers=2, sim_backend="physx_cpu", **kwargs)

    def strike():
        envs._timeout = 1
        os.kill(envs._processes[1].pid, blow)

    before_update(2, strike)
    workers = [psutil.Process(process.pid) for process in envs._processes]
    with contextlib.closing(envs), pytest.raises(WorkerError, match=message):
        run(config, envs=envs)
    assert saved(tmp_path).metadata["steps"] == 2 * 128
    assert not any(worker.is_running() for worker in workers)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_script_that_is_asked_to_end_leaves_a_checkpoint(
    tmp_path, before_update, number
):
    before = signal.getsignal(number)
    before_update(3, lambda: signal.raise_signal(number))
    with pytest.raises(KeyboardInterrupt):
        run(toy_config(tmp_path), envs=ToyVectorEnv(8))
    assert saved(tmp_path).metadata["steps"] == 2 * UPDATE
    assert signal.getsignal(number) is before


def test_a_run_that_fails_at_its_first_step_leaves_none(tmp_path):
    envs, config = ToyVectorEnv(8), toy_config(tmp_path)
    envs.step = lambda _: 1 / 0
    with pytest.raises(ZeroDivisionError):
        run(config, envs=envs)
    run(config, envs=ToyVectorEnv(8), eval_envs=ToyVectorEnv(8))


# -- Ctrl-C ----------------------------------------------------------------------------


def leave(process, blow):
    """Stop a training from outside; return its exit code and what it left running."""
    family = psutil.Process(process.pid).children(recursive=True)
    assert len(family) >= 2
    blow(process.pid)
    code = process.wait(timeout=120)
    _, alive = psutil.wait_procs(family, timeout=300)  # long only where all are busy
    return code, alive


@pytest.mark.slow
def test_ctrl_c_and_sigterm_save_and_leave_nothing_running(tmp_path):
    task, steps = "NaoTouchCubeSingle-v1", 128
    command = [sys.executable, "-m", "ir_maniskill_cli", "train", task]
    options = "--num-envs 2 --num-workers 2 --agent.senses proprioception touch "
    options += "--agent.critic separate --agent.auxiliary-weight 0 --ppo.epochs 1 "
    options += "--ppo.steps-per-update 128 --ppo.minibatch None --resume --out"
    command += [*options.split(), str(tmp_path)]
    table, done = tmp_path / "metrics.csv", 0
    blows = (
        lambda pid: os.killpg(pid, signal.SIGINT),  # as a terminal does
        lambda pid: os.kill(pid, signal.SIGTERM),
    )
    for blow in blows:
        process = subprocess.Popen(
            command,
            start_new_session=True,
            stderr=subprocess.DEVNULL,
            # A shell's background jobs ignore Ctrl-C, and hand that on.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        deadline = time.monotonic() + 400
        # Two updates: the last one may be logged, and not yet be complete.
        goal = done + 2 * steps
        while not table.exists() or max(steps_of(tmp_path), default=0) < goal:
            assert process.poll() is None, "the training ended by itself"
            assert time.monotonic() < deadline, "the training did not begin"
            time.sleep(0.2)
        assert leave(process, blow) == (130, [])
        before, done = done, saved(tmp_path).metadata["steps"]
        assert done >= before + steps
        assert done in steps_of(tmp_path)[-2:]


def test_a_second_ctrl_c_does_not_cut_the_saving_short(
    tmp_path, monkeypatch, before_update
):
    write, numbers = checkpoint.write, run_folder.STOPPING
    # A shell's background jobs ignore Ctrl-C.
    before = [signal.signal(n, signal.default_int_handler) for n in numbers]

    def write_while_all_want_it_to_stop(*arguments):
        for number in numbers:
            signal.raise_signal(number)
        write(*arguments)

    def stop():
        monkeypatch.setattr(checkpoint, "write", write_while_all_want_it_to_stop)
        signal.raise_signal(signal.SIGINT)

    before_update(2, stop)
    with pytest.raises(KeyboardInterrupt):
        run(toy_config(tmp_path), envs=ToyVectorEnv(8))
    assert saved(tmp_path).metadata["steps"] == UPDATE
    after = [signal.signal(*pair) for pair in zip(numbers, before, strict=True)]
    assert after == [signal.default_int_handler] * len(numbers)


# -- Disk ------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_disk_that_fills_up_keeps_the_last_good_checkpoint(tmp_path, before_update):
    def fill():
        filler = (tmp_path / "filler").open("wb", buffering=0)
        with filler, contextlib.suppress(OSError):
            while True:
                filler.write(bytes(4096))

    before_update(4, fill)
    config = toy_config(tmp_path, checkpoint_interval=2 * UPDATE)
    with (
        disk(tmp_path, "size=8m"),
        pytest.raises(OSError, match="cannot write .*No space left on device"),
    ):
        try:
            run(config, envs=ToyVectorEnv(8))
        finally:
            assert saved(tmp_path).metadata["steps"] >= 2 * UPDATE


def test_a_read_only_folder_is_refused_before_training(tmp_path):
    config = toy_config(tmp_path / "run")
    with (
        disk(tmp_path, "ro"),
        pytest.raises(OSError, match="cannot write .*Read-only file system"),
    ):
        run(config, envs=ToyVectorEnv(8), eval_envs=ToyVectorEnv(8))
