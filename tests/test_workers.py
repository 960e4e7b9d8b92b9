"""Worker processes that cannot start, fail, die, hang, or are left behind."""

import dataclasses
import multiprocessing as mp
import os
import resource
import signal
import subprocess
import sys
import textwrap
import time
import types
from pathlib import Path

import pytest
import torch
from mani_skill.agents.registration import register_agent
from mounts import disk

from ir_maniskill import experiment as catalog
from ir_maniskill import register
from ir_maniskill.environment import shared_rows
from ir_maniskill.environment.process_vector import ProcessVectorEnv, WorkerError
from ir_maniskill.environment.robots import Nao
from ir_maniskill.environment.vector import make_vec

TASK = "NaoTouchCubeSingle-v1"


def make(num_envs: int, **kwargs) -> ProcessVectorEnv:
    """Make envs without pictures, each in a process of its own."""
    usual = {"obs_mode": "state", "render_backend": "none", "sim_backend": "physx_cpu"}
    usual |= {"task_id": TASK, "num_workers": num_envs}
    return make_vec(num_envs=num_envs, **usual | kwargs)


def alive(pid: int) -> bool:
    """Return whether a process of that id runs (a zombie does not)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().split(") ")[1][0] != "Z"
    except FileNotFoundError:
        return False


def run(path: Path, script: str, **kwargs) -> subprocess.CompletedProcess:
    """Run a script that may use `make()` in a process of its own."""
    names = f"""
        from ir_maniskill import make_vec
        def make():
            return make_vec({TASK!r}, 1, obs_mode="state", render_backend="none",
                            sim_backend="physx_cpu")
    """
    path.write_text(textwrap.dedent(names) + textwrap.dedent(script))
    return subprocess.run(
        [sys.executable, path], capture_output=True, text=True, **kwargs
    )


# -- Cannot start ----------------------------------------------------------------------


@pytest.mark.parametrize("script", ["<stdin>", "/dev/null"])
def test_a_script_that_is_no_file_cannot_be_read_by_workers(
    script: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    main = types.ModuleType("__main__")
    main.__file__ = script
    monkeypatch.setitem(sys.modules, "__main__", main)
    with pytest.raises(WorkerError, match=f"read the script, but {script} is no file"):
        make(1)


def test_a_daemonic_process_may_have_no_workers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(mp.current_process()._config, "daemon", True)
    with pytest.raises(WorkerError, match="daemonic .*use concurrent.futures.Process"):
        make(1)


@pytest.mark.slow
def test_reasons_not_to_start_are_told_apart(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    done = run(script, "make()")
    last = done.stderr.splitlines()[-1]
    assert "code 1;" in last and "guard the script's entry with `if __name__" in last
    deep = tmp_path / ("x" * 110)
    deep.mkdir()
    guarded = """
        if __name__ == "__main__":
            import multiprocessing
            with multiprocessing.Pool(1) as pool:
                try:
                    pool.apply(make)
                except Exception as error:
                    print(error)
            make()
    """
    done = run(script, guarded, env=os.environ | {"TMPDIR": str(deep)})
    assert "this is a daemonic process" in done.stdout
    assert "WorkerError" in done.stderr and "set TMPDIR" in done.stderr


def test_many_workers_need_few_descriptors() -> None:
    make(1).close()  # the server that forks workers is not counted
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    used = max(map(int, os.listdir("/proc/self/fd")))
    resource.setrlimit(resource.RLIMIT_NOFILE, (used + 4 * 4 + 8, hard))
    try:
        envs = make(4)
        envs.reset(seed=0)
        envs.close()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.parametrize("size", ["4k", "64k"])
def test_memory_that_does_not_suffice_is_told_at_once(
    size: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared_rows, "FOLDER", tmp_path)
    message = r"No space left.* need 0\.1 MiB of shared memory in .*--shm-size"
    with disk(tmp_path, f"size={size}"):
        with pytest.raises(OSError, match=message):
            shared_rows.reserve(100_000)
        if size == "4k":
            with pytest.raises(OSError, match="--shm-size"):
                make(4, num_workers=1)
        assert not os.listdir(tmp_path)


# -- Fail, die or hang -----------------------------------------------------------------


def test_workers_know_what_the_environment_says_now(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    make(1).close()
    monkeypatch.setenv("IR_MANISKILL_NAO_URDF", "/no/such.urdf")
    with pytest.raises(WorkerError, match=r"/no/such\.urdf: no such file"):
        make(1)


@register_agent()
class Twin(Nao):
    """A robot that workers know only if they import this module."""

    uid = "twin"


def test_a_task_and_a_robot_of_ones_own_reach_workers() -> None:
    mine = dataclasses.replace(catalog.get(TASK), id="Mine-v1", episode_steps=2)
    register(mine)
    envs = make(1, task_id="Mine-v1", robot_uids="twin")
    envs.reset(seed=0)
    assert [envs.step(torch.zeros(1, 26))[3].item() for _ in range(2)] == [False, True]
    assert envs.get_attr("robot_uids") == ("twin",)
    envs.close()


def test_a_failing_worker_says_why() -> None:
    with pytest.raises(WorkerError, match=r"worker-0 \(envs 0 to 0\)(.|\n)*smell"):
        make(1, reward_mode="smell")


def test_a_dead_worker_is_named_and_close_leaves_nothing() -> None:
    files = set(os.listdir("/dev/shm"))
    envs = make(2)
    envs.reset(seed=0)
    maps = Path("/proc/self/maps").read_text()
    mapped = [line for line in maps.splitlines() if "/dev/shm/" in line]
    assert [line for line in mapped if line.endswith("(deleted)")], "nothing is shared"
    ours = {Path(line.split()[5]).name for line in mapped}
    assert not ours & (set(os.listdir("/dev/shm")) - files), "a file has a name"
    victims = [process.pid for process in envs._processes]
    os.kill(victims[1], signal.SIGKILL)
    with pytest.raises(WorkerError, match=r"worker-1 \(envs 1 to 1\) died.*code -9"):
        envs.step(torch.zeros(2, 26))
    envs.close()
    assert not any(map(alive, victims))
    with pytest.raises(WorkerError, match="closed"):
        envs.reset()


def test_a_hanging_worker_is_named_instead_of_waited_for() -> None:
    envs = make(1, timeout=600)
    envs.reset(seed=0)
    assert envs._timeout == 600
    envs._timeout = 0.5
    pid = envs._processes[0].pid
    os.kill(pid, signal.SIGSTOP)
    with pytest.raises(WorkerError, match="no answer within 0.5 s from .*worker-0"):
        envs.step(torch.zeros(1, 26))
    os.kill(pid, signal.SIGCONT)
    with pytest.raises(WorkerError, match="not been answered"):  # not the late answer
        envs.reset()
    os.kill(pid, signal.SIGSTOP)
    envs.close()
    assert not alive(pid)
    with pytest.raises(WorkerError, match="nothing to wait for"):
        envs.step_wait()


@pytest.mark.slow
def test_workers_end_when_the_parent_is_killed(tmp_path: Path) -> None:
    kill = """
        import os, signal
        if __name__ == "__main__":
            envs = make()
            print(*(p.pid for p in envs._processes), flush=True)
            os.kill(os.getpid(), signal.SIGKILL)
    """
    done = run(tmp_path / "script.py", kill)
    assert done.returncode == -signal.SIGKILL
    (worker,) = map(int, done.stdout.split())
    deadline = time.monotonic() + 20
    while alive(worker) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not alive(worker)
