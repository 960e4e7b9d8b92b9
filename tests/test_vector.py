"""Vector envs: same numbers as single envs, ends of episodes, failures, leftovers."""

import dataclasses
import itertools
import os
import signal
import subprocess
import sys
import textwrap
import time
import types
from collections.abc import Iterator
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import ir_maniskill
from ir_maniskill import experiment as catalog
from ir_maniskill.environment import process_vector, vector
from ir_maniskill.environment.process_vector import ProcessVectorEnv, WorkerError
from ir_maniskill.environment.reward_generator import DenseWeights
from ir_maniskill.environment.vector import make_vec

TASK = "NaoTouchCubeTriangle-v1"
KWARGS = {
    "obs_mode": "state_dict",
    "reward_mode": "dense",
    "render_backend": "none",
}


@pytest.fixture(scope="module")
def envs() -> Iterator[ProcessVectorEnv]:
    """Three envs in two processes, without pictures."""
    envs = make_vec(TASK, 3, num_workers=2, sim_backend="physx_cpu", **KWARGS)
    yield envs
    envs.close()


@pytest.fixture(scope="module")
def flat() -> Iterator[ProcessVectorEnv]:
    """Three envs in two processes, each observation one tensor."""
    kwargs = {**KWARGS, "obs_mode": "state"}
    envs = make_vec(TASK, 3, num_workers=2, sim_backend="physx_cpu", **kwargs)
    yield envs
    envs.close()


def arrays(tree: Any) -> Any:
    """Return a tree of tensors as arrays."""
    if isinstance(tree, torch.Tensor):
        return tree.numpy()
    return {name: arrays(branch) for name, branch in tree.items()}


def actions(steps: int, num_envs: int) -> torch.Tensor:
    """Return fixed random actions [T, N, 26]."""
    generator = torch.Generator().manual_seed(0)
    return 2 * torch.rand(steps, num_envs, 26, generator=generator) - 1


def test_env_i_is_a_single_env_seeded_with_seed_plus_i(envs: ProcessVectorEnv) -> None:
    many, _ = envs.reset(seed=11)
    single = gym.make(TASK, num_envs=1, **KWARGS)
    one, _ = single.reset(seed=12)
    for action in actions(6, 3):
        for part in ("agent", "extra"):
            for name, value in one[part].items():
                assert torch.equal(many[part][name][1], value[0])
                assert many[part][name].dtype == value.dtype
        many, rewards, *_, infos = envs.step(action)
        one, reward, *_, info = single.step(action[1])
        assert rewards[1] == reward[0]
        assert torch.equal(infos["contact"][1], info["contact"][0])
    single.close()


def test_observations_are_in_the_declared_space(envs: ProcessVectorEnv) -> None:
    obs, _ = envs.reset(seed=0)
    assert obs["extra"]["object_position"].shape == (3, 3, 3)
    assert envs.observation_space.contains(arrays(obs))


def test_without_a_seed_every_env_has_a_stream_of_its_own(
    flat: ProcessVectorEnv,
) -> None:
    first, second = flat.reset()[0], flat.reset()[0]
    starts = torch.cat([first, second])
    assert len(starts.unique(dim=0)) == 6
    assert torch.equal(flat.reset(seed=2022)[0], first)
    assert torch.equal(flat.reset()[0], second)


def test_flat_observations_are_one_tensor(flat: ProcessVectorEnv) -> None:
    assert flat.observation_space.contains(flat.reset(seed=0)[0].numpy())
    for action in actions(32, 3):
        obs, *_, info = flat.step(action)
    final = info["final_observation"]
    assert final.shape == obs.shape == flat.observation_space.shape
    assert not torch.equal(final, obs)


def test_an_episode_ends_in_the_same_step_it_is_reset(envs: ProcessVectorEnv) -> None:
    first, _ = envs.reset(seed=5)
    for step, action in enumerate(actions(32, 3)):
        obs, _, terminated, truncated, info = envs.step(action)
        assert not terminated.any()
        assert truncated.all() == (step == 31)
        assert ("final_observation" in info) == (step == 31)
    assert info["_final_info"].all()
    assert info["_final_observation"].all()
    assert info["final_info"]["elapsed_steps"].tolist() == [32, 32, 32]
    assert info["elapsed_steps"].tolist() == [0, 0, 0]
    start = first["extra"]["object_position"]
    assert not torch.equal(obs["extra"]["object_position"], start)
    final = info["final_observation"]["agent"]["proprioception"]
    assert not torch.equal(final, obs["agent"]["proprioception"])


def test_returned_tensors_are_not_overwritten_later(envs: ProcessVectorEnv) -> None:
    obs, _ = envs.reset(seed=1)
    before = obs["agent"]["proprioception"].clone()
    envs.step(actions(1, 3)[0])
    assert torch.equal(obs["agent"]["proprioception"], before)


@pytest.mark.parametrize("form", [torch.tensor, np.array, list, tuple])
def test_options_are_dealt_out_one_each(envs: ProcessVectorEnv, form: Any) -> None:
    options = {"instruction": form([2, 0, 1]), "reconfigure": False}
    obs, _ = envs.reset(seed=0, options=options)
    assert obs["extra"]["target_object"].argmax(1).tolist() == [2, 0, 1]
    obs, _ = envs.reset(options={"instruction": form([1, 1, 1])[0]})
    assert obs["extra"]["target_object"].argmax(1).tolist() == [1, 1, 1]


def test_each_env_is_reset_to_its_own_state(envs: ProcessVectorEnv) -> None:
    env = gym.make(TASK, **KWARGS).unwrapped
    sources = []
    for row in range(3):
        obs = env.reset(seed=40 + row, options={"instruction": row})[0]
        sources.append((obs["extra"], env.get_state_dict(), env.get_state()))
    env.close()
    told, trees, flat = zip(*sources, strict=True)

    def reset(states: Any) -> dict[str, torch.Tensor]:
        envs.reset(seed=0)
        options = {"reset_to_env_states": {"env_states": states}}
        return envs.reset(options=options)[0]["extra"]

    tree = {
        kind: {key: torch.cat([t[kind][key] for t in trees]) for key in trees[0][kind]}
        for kind in trees[0]
    }
    for states in (tree, arrays(tree), torch.cat(flat)):
        obs = reset(states)
        for row in range(3):
            for name, value in told[row].items():
                torch.testing.assert_close(obs[name][row], value[0])
    for states in (trees[1], flat[1]):  # a single row is for all
        assert reset(states)["target_object"].argmax(1).tolist() == [1, 1, 1]
    with pytest.raises(ValueError, match=r"\['env_states'\]: got 2 values, expected 3"):
        reset(torch.cat(flat[:2]))


def test_seeds_may_be_those_of_numpy(flat: ProcessVectorEnv) -> None:
    expected, _ = flat.reset(seed=[4, 5, 6])
    for seed in (4, np.int64(4), np.arange(4, 7), torch.arange(4, 7)):
        assert torch.equal(flat.reset(seed=seed)[0], expected)


def test_attributes_are_set_for_all_or_one_each(envs: ProcessVectorEnv) -> None:
    def rewards() -> list[float]:
        envs.reset(seed=[7, 7, 7])
        return envs.step(torch.zeros(3, 26))[1].tolist()

    usual = DenseWeights()
    none = DenseWeights(reach=0, gather=0)
    envs.set_attr("dense_weights", [usual, none, usual])
    one, other, third = rewards()
    assert one == third > other == 0
    envs.set_attr("dense_weights", usual)
    assert rewards() == [one] * 3
    with pytest.raises(ValueError, match="dense_weights: got 2 values, expected 3"):
        envs.set_attr("dense_weights", [usual, usual])


def test_wrong_shapes_are_refused(envs: ProcessVectorEnv) -> None:
    with pytest.raises(ValueError, match=r"got shape \(2, 26\), expected \(3, 26\)"):
        envs.step(torch.zeros(2, 26))
    with pytest.raises(ValueError, match="actions: got NaN or infinity"):
        envs.step(torch.full((3, 26), torch.nan))
    with pytest.raises(ValueError, match="seeds: got 2, expected 3"):
        envs.reset(seed=[1, 2])
    for wrong in (2, 4):
        with pytest.raises(ValueError, match=f"'instruction': got {wrong} values, exp"):
            envs.reset(options={"instruction": torch.zeros(wrong, dtype=int)})
    with pytest.raises(ValueError, match="options: got 'env_idx'"):
        envs.reset(options={"env_idx": torch.tensor([0])})
    with pytest.raises(ValueError, match="num_envs: got 0"):
        make_vec(TASK, 0)
    for wrong in (0, -1):
        with pytest.raises(ValueError, match=f"num_workers: got {wrong}, expected at "):
            make_vec(TASK, 2, num_workers=wrong)
    with pytest.raises(ValueError, match="sim_backend: got 'gpus', expected 'auto' or"):
        make_vec(TASK, 2, sim_backend="gpus")
    with pytest.raises(catalog.UnknownExperimentError, match="available"):
        make_vec("NoSuchTask-v1", 1)


def test_answers_of_different_commands_cannot_get_mixed(envs: ProcessVectorEnv) -> None:
    envs.reset(seed=0)
    with pytest.raises(WorkerError, match="step_async. comes first"):
        envs.step_wait()
    envs.step_async(torch.zeros(3, 26))
    for command in (lambda: envs.step_async(torch.zeros(3, 26)), envs.reset):
        with pytest.raises(WorkerError, match="last command has not been answered"):
            command()
    assert envs.step_wait()[4]["elapsed_steps"].tolist() == [1, 1, 1]


def test_users_own_experiments_reach_the_workers() -> None:
    triangle = catalog.get(TASK)
    mine = dataclasses.replace(triangle, id="Mine-v1", episode_steps=4)
    ir_maniskill.register(mine)
    envs = make_vec("Mine-v1", 1, sim_backend="physx_cpu", **KWARGS)
    envs.reset(seed=0)
    ends = [envs.step(action)[3].item() for action in actions(4, 1)]
    assert ends == [False, False, False, True]
    envs.close()


def test_workers_know_what_the_environment_says_now(
    envs: ProcessVectorEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("IR_MANISKILL_NAO_URDF", "/no/such.urdf")
    with pytest.raises(WorkerError, match=r"/no/such\.urdf: no such file"):
        make_vec(TASK, 1, sim_backend="physx_cpu", **KWARGS)


def test_a_failing_worker_says_why() -> None:
    with pytest.raises(WorkerError, match=r"worker-0 \(envs 0 to 0\)(.|\n)*smell"):
        make_vec(TASK, 1, sim_backend="physx_cpu", **KWARGS | {"reward_mode": "smell"})


def test_a_dead_worker_is_named_and_close_leaves_nothing() -> None:
    envs = make_vec(TASK, 2, num_workers=2, sim_backend="physx_cpu", **KWARGS)
    envs.reset(seed=0)
    victims = [process.pid for process in envs._processes]
    os.kill(victims[1], signal.SIGKILL)
    with pytest.raises(WorkerError, match=r"worker-1 \(envs 1 to 1\) died.*code -9"):
        envs.step(torch.zeros(2, 26))
    envs.close()
    assert not any(alive(pid) for pid in victims)
    with pytest.raises(WorkerError, match="closed"):
        envs.reset()


def test_a_script_without_a_guard_is_told_to_have_one(tmp_path: Path) -> None:
    script = tmp_path / "unguarded.py"
    options = "sim_backend='physx_cpu', obs_mode='state', render_backend='none'"
    script.write_text(f"import ir_maniskill as ir\nir.make_vec({TASK!r}, 1, {options})")
    done = subprocess.run([sys.executable, script], capture_output=True, text=True)
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert "code 1;" in last and "guard the script's entry with `if __name__" in last


def test_a_hanging_worker_is_named_instead_of_waited_for() -> None:
    envs = make_vec(TASK, 1, sim_backend="physx_cpu", timeout=600, **KWARGS)
    envs.reset(seed=0)
    assert envs._timeout == 600
    envs._timeout = 0.5
    os.kill(envs._processes[0].pid, signal.SIGSTOP)
    with pytest.raises(WorkerError, match="no answer within 0.5 s from .*worker-0"):
        envs.step(torch.zeros(1, 26))
    pid = envs._processes[0].pid
    os.kill(pid, signal.SIGCONT)
    with pytest.raises(WorkerError, match="not been answered"):  # not the late answer
        envs.reset()
    os.kill(pid, signal.SIGSTOP)
    envs.close()
    assert not alive(pid)


def test_an_hour_in_which_all_were_stopped_is_no_waiting(
    envs: ProcessVectorEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    envs.reset(seed=0)
    clock, looks = itertools.count(0, 3600), []

    def look(pipes: list, left: float) -> list:
        looks.append(left)
        return wait(pipes, 60) if len(looks) > 1 else []

    ticking = types.SimpleNamespace(monotonic=lambda: next(clock))
    monkeypatch.setattr(process_vector, "time", ticking)
    monkeypatch.setattr(process_vector, "wait", look)
    assert envs.step(torch.zeros(3, 26))[4]["elapsed_steps"].tolist() == [1, 1, 1]
    assert len(looks) > 1


def alive(pid: int) -> bool:
    """Return whether a process of that id runs (a zombie does not)."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().split(") ")[1][0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.slow
def test_workers_end_when_the_parent_is_killed() -> None:
    script = """
        import time
        from ir_maniskill import make_vec
        if __name__ == "__main__":
            envs = make_vec("NaoTouchCubeSingle-v1", 2, num_workers=2,
                            sim_backend="physx_cpu", obs_mode="state_dict",
                            render_backend="none")
            print(*(p.pid for p in envs._processes), flush=True)
            time.sleep(60)
    """
    parent = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    workers = [int(pid) for pid in parent.stdout.readline().split()]
    assert len(workers) == 2
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 20
    while any(map(alive, workers)) and time.monotonic() < deadline:
        time.sleep(0.2)
    assert not any(map(alive, workers))


@pytest.fixture
def cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_batch_on_a_gpu_needs_one() -> None:
    message = "got 'physx_cuda', expected 'physx_cpu': torch sees no CUDA device"
    with pytest.raises(ValueError, match=message):
        make_vec(TASK, 3, sim_backend="physx_cuda")


@pytest.mark.usefixtures("cuda")
@pytest.mark.parametrize("backend", ["gpu", "cuda", "cuda:0", "physx_cuda:0"])
def test_every_name_of_the_gpu_means_the_gpu(
    backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(vector, "GpuVectorEnv", lambda *_, sim_backend: sim_backend)
    assert make_vec(TASK, 3, sim_backend=backend) == backend


@pytest.mark.usefixtures("cuda")
def test_a_batch_on_a_gpu_is_seeded_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    resets: list[tuple] = []

    def reset(seed: list[int] | None, options: dict | None) -> tuple[dict, dict]:
        resets.append((seed, options))
        return {}, {}

    class Batch(types.SimpleNamespace):
        """Stands in for ManiSkill's env: it needs a GPU."""

        get_wrapper_attr = types.SimpleNamespace.__getattribute__

    base = types.SimpleNamespace(num_envs=3, experiment=None, device="cpu")
    spaces = ("observation_space", "action_space")
    made = dict.fromkeys([*spaces, *(f"single_{name}" for name in spaces)])
    batch = Batch(unwrapped=base, spec=None, metadata={}, reset=reset, **made)
    monkeypatch.setattr(vector.gym, "make", lambda *_, **__: batch)
    envs = make_vec(TASK, 3, sim_backend="physx_cuda")
    some = {"env_idx": torch.tensor([1])}
    envs.reset(seed=np.int64(7))
    envs.reset(seed=[5, 3, 4])
    envs.reset(options=some)
    assert resets == [([7, 8, 9], None), ([5, 3, 4], None), (None, some)]
    with pytest.raises(ValueError, match="seed: got 7 for some of the envs"):
        envs.reset(seed=7, options=some)
    with pytest.raises(ValueError, match="seeds: got 2, expected 3"):
        envs.reset(seed=[1, 2])
    envs.set_attr("dense_weights", "new")
    assert base.dense_weights == "new"
    with pytest.raises(ValueError, match="dense_weights: got 3 values, expected one"):
        envs.set_attr("dense_weights", ["new"] * 3)


def test_pictures_cross_the_process_border(multi_vec: ProcessVectorEnv) -> None:
    obs, _ = multi_vec.reset(seed=0)
    obs = multi_vec.step(np.zeros((2, 26), np.float32))[0]
    for camera in ("top_camera", "front_camera"):
        picture = obs["sensor_data"][camera]["rgb"]
        assert picture.shape == (2, 64, 32, 3)
        assert picture.dtype == torch.uint8
        assert picture.float().std() > 10
    assert "sensor_param" in obs
    assert multi_vec.observation_space.contains(arrays(obs))
