"""Vector envs: same numbers as single envs, ends of episodes, what they are given."""

import copy
import pickle
import types
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.wrappers.vector import (
    NormalizeObservation,
    NormalizeReward,
    RecordEpisodeStatistics,
)
from trees import leaves

from ir_maniskill import experiment as catalog
from ir_maniskill.environment import vector
from ir_maniskill.environment.process_vector import (
    ProcessVectorEnv,
    WorkerError,
    final_infos,
)
from ir_maniskill.environment.shared_rows import SharedRows, record_of, reserve
from ir_maniskill.environment.vector import make_vec
from ir_maniskill.experiment import Experiment, TouchObject
from ir_maniskill.goals import Instruction, Ref, Touch

TASK = "NaoTouchCubeTriangle-v1"
SENTENCES = catalog.get(TASK).sentences
KWARGS = {
    "obs_mode": "state_dict",
    "reward_mode": "dense",
    "render_backend": "none",
}


class OnGpu(torch.Tensor):
    """Stands in for a tensor on a GPU: NumPy cannot read it, copies on the CPU can."""

    def numpy(self) -> np.ndarray:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")

    def to(self, *args: Any) -> torch.Tensor:
        return self.as_subclass(torch.Tensor).to(*args)

    def cpu(self) -> torch.Tensor:
        return self.to("cpu")


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


def told(envs: ProcessVectorEnv, **options: Any) -> list[int]:
    """Reset with options and return which sentence each env has."""
    envs.reset(options=options)
    return [index.item() for index in envs.get_attr("instruction_index")]


# -- The same numbers ------------------------------------------------------------------


def test_env_i_is_a_single_env_seeded_with_seed_plus_i(envs: ProcessVectorEnv) -> None:
    many, _ = envs.reset(seed=11)
    single = gym.make(TASK, num_envs=1, **KWARGS)
    one, _ = single.reset(seed=12)
    for action in actions(6, 3):
        row = leaves(many)
        for name, value in leaves(one).items():
            assert torch.equal(row[name][1], value[0])
            assert row[name].dtype == value.dtype
        many, rewards, *_, infos = envs.step(action)
        one, reward, *_, info = single.step(action[1])
        assert rewards[1] == reward[0]
        assert torch.equal(infos["contact"][1], info["contact"][0])
    single.close()


def test_observations_are_in_the_declared_space(
    envs: ProcessVectorEnv, flat: ProcessVectorEnv
) -> None:
    obs, _ = envs.reset(seed=0)
    assert obs["extra"]["object_position"].shape == (3, 3, 3)
    assert envs.observation_space.contains(arrays(obs))
    state, _ = flat.reset(seed=0)
    assert state.shape == (3, 26 * 3 + 6 + 5 + 9 + 18 + 3 + 6 + 1 + 1)
    assert flat.observation_space.contains(arrays(state))


def test_pictures_cross_the_process_border(multi_vec: ProcessVectorEnv) -> None:
    multi_vec.reset(seed=0)
    obs = multi_vec.step(np.zeros((2, 26), np.float32))[0]
    for camera in ("top_camera", "front_camera"):
        picture = obs["sensor_data"][camera]["rgb"]
        assert picture.shape == (2, 64, 32, 3)
        assert picture.dtype == torch.uint8
        assert picture.float().std() > 10
    assert "sensor_param" in obs
    assert multi_vec.observation_space.contains(arrays(obs))


def test_rows_are_copied_from_wherever_they_are() -> None:
    depth = torch.arange(4.0).reshape(1, 2, 2)
    row = {"depth": depth.as_subclass(OnGpu), "in": {"flag": np.ones(1, bool)}, "n": 3}
    record = record_of({"obs": row})
    with reserve(2 * record.itemsize) as file:
        ours, theirs = (SharedRows(file.fileno(), record, 2) for _ in range(2))
    theirs.write(1, {"obs": row})
    seen = ours.read("obs")
    theirs.write(1, {"obs": {"depth": 0 * depth}})
    assert torch.equal(seen["depth"], torch.cat([0 * depth, depth]))
    assert seen["in"]["flag"].tolist() == [False, True]
    assert "n" not in seen


def test_without_a_seed_every_env_has_a_stream_of_its_own(
    flat: ProcessVectorEnv,
) -> None:
    flat._seeded = False
    first, second = flat.reset()[0], flat.reset()[0]
    starts = torch.cat([first, second])
    assert len(starts.unique(dim=0)) == 6
    for seed in (2022, np.int64(2022), np.arange(2022, 2025), range(2022, 2025)):
        assert torch.equal(flat.reset(seed=seed)[0], first)
    assert torch.equal(flat.reset()[0], second)


# -- Ends of episodes ------------------------------------------------------------------


def test_an_episode_ends_in_the_same_step_it_is_reset(envs: ProcessVectorEnv) -> None:
    first, _ = envs.reset(seed=5)
    for step, action in enumerate(actions(32, 3)):
        obs, _, terminated, truncated, info = envs.step(action)
        assert not terminated.any()
        assert truncated.all() == (step == 31)
        assert ("final_observation" in info) == (step == 31)
    assert info["final_obs"] is info["final_observation"]
    for name in ("final_obs", "final_observation", "final_info"):
        assert info[f"_{name}"].tolist() == [True, True, True]
    assert info["final_info"]["elapsed_steps"].tolist() == [32, 32, 32]
    assert info["elapsed_steps"].tolist() == [0, 0, 0]
    start = first["extra"]["object_position"]
    assert not torch.equal(obs["extra"]["object_position"], start)
    final = info["final_obs"]["agent"]["proprioception"]
    assert not torch.equal(final, obs["agent"]["proprioception"])


@pytest.mark.parametrize(
    ("done", "expected"),
    [([True, False, True], [5, 0, 7]), ([False, True, False], [0, 6, 0])],
)
def test_final_rows_of_envs_that_go_on_are_zero(done: list, expected: list) -> None:
    info = {"steps": torch.tensor([5, 6, 7]), "deep": {"once": torch.ones(3, 2).bool()}}
    final = final_infos(torch.ones(3, 4), info, torch.tensor(done))
    assert final["final_info"]["steps"].tolist() == expected
    assert final["final_info"]["deep"]["once"][:, 1].tolist() == done
    assert final["final_obs"].sum(1).tolist() == [4.0 * end for end in done]
    assert final["_final_info"].tolist() == done


# -- What they are given ---------------------------------------------------------------


def test_instructions_are_dealt_out_one_each(envs: ProcessVectorEnv) -> None:
    red, blue = SENTENCES[0], SENTENCES[2]
    for form in (torch.tensor, np.array, list, tuple):
        assert told(envs, instruction=form([2, 0, 1]), reconfigure=False) == [2, 0, 1]
    for given in (2, np.int64(2), torch.tensor(2), blue):
        assert told(envs, instruction=given) == [2, 2, 2]
    assert told(envs, instruction=np.array([red, red, blue])) == [0, 0, 2]
    assert told(envs, instruction=(1, red, 2)) == [1, 0, 2]


WRONG_RESETS = [
    ({"seed": -1}, "seed: got -1, expected an integer"),
    ({"seed": 2**32 - 2}, "so that each env's is from 0 to 4294967295"),
    ({"seed": [1, 2]}, r"seed: got \[1, 2\], expected .* 3 of them"),
    ({"seed": np.array([0.5, 1, 2])}, r"seed: got \[0.5, 1.0, 2.0\]"),
    ({"seed": True}, "seed: got True"),
    ({"options": {"instructon": 0}}, r"got \['instructon'\], expected some of .*recon"),
    ({"options": 3}, "reset options: got 3, expected a dict"),
    ({"options": {"env_idx": [0]}}, r"got \['env_idx'\], expected some of"),
    ({"options": {"instruction": 3}}, "instruction: got 3, expected an index from 0"),
    ({"options": {"instruction": 1.5}}, "instruction: got 1.5"),
    ({"options": {"instruction": [0, 1]}}, r"got \[0, 1\], .* or a list of 3"),
    ({"options": {"instruction": "Touch."}}, "got 'Touch.'.*, one of .*red cube"),
    (
        {"options": {"instruction": "Touch the red cube with your left hand."}},
        "got 'Touch the red cube with your left hand.', expected at most 5 words",
    ),
    ({"options": {"reconfigure": 1}}, "'reconfigure': got 1, expected True or False"),
    ({"options": {"reset_to_env_states": torch.zeros(3, 9)}}, "expected {'env_states'"),
    (
        {"options": {"reset_to_env_states": {"env_states": {"actors": {}}}}},
        "got .*'actors'.*, expected .* what get_state or get_state_dict returned",
    ),
    (
        {"options": {"reset_to_env_states": {"env_states": torch.zeros(2, 9)}}},
        r"\['env_states'\]: got float32 of shape \(2, 9\), expected .* 3 rows",
    ),
    (
        {"options": {"reset_to_env_states": {"env_states": {}}, "instruction": 1}},
        "got 'reset_to_env_states' and instruction 1, expected one",
    ),
]


@pytest.mark.parametrize(("wrong", "message"), WRONG_RESETS)
def test_wrong_resets_are_refused_and_change_nothing(
    envs: ProcessVectorEnv, wrong: dict, message: str
) -> None:
    envs.reset(options={"instruction": [2, 0, 1]})
    with pytest.raises(ValueError, match=message):
        envs.reset(**wrong)
    assert envs.step(torch.zeros(3, 26))[4]["elapsed_steps"].tolist() == [1, 1, 1]
    assert [i.item() for i in envs.get_attr("instruction_index")] == [2, 0, 1]


def test_what_only_an_env_can_refuse_leaves_the_others_usable(
    envs: ProcessVectorEnv,
) -> None:
    nobody = {"actors": {"nobody": torch.zeros(3, 13)}, "task": {}}
    for states in (nobody, torch.zeros(3, 5)):
        with pytest.raises(WorkerError, match=r"worker-0 \(envs 0 to 1\) failed"):
            envs.reset(options={"reset_to_env_states": {"env_states": states}})
        envs.reset(seed=1)
        assert envs.step(torch.zeros(3, 26))[4]["elapsed_steps"].tolist() == [1, 1, 1]


def test_each_env_is_reset_to_its_own_state(envs: ProcessVectorEnv) -> None:
    env = gym.make(TASK, **KWARGS).unwrapped
    sources = []
    for row in range(3):
        obs = env.reset(seed=40 + row, options={"instruction": row})[0]
        sources.append((obs["extra"], env.get_state_dict(), env.get_state()))
    env.close()
    seen, trees, rows = zip(*sources, strict=True)

    def reset(states: Any, seed: int | None = None) -> dict[str, torch.Tensor]:
        envs.reset(seed=0)
        options = {"reset_to_env_states": {"env_states": states}}
        return envs.reset(seed=seed, options=options)[0]["extra"]

    tree = {
        kind: {key: torch.cat([t[kind][key] for t in trees]) for key in trees[0][kind]}
        for kind in trees[0]
    }
    every = (tree, None), (arrays(tree), None), (torch.cat(rows), None), (tree, 5)
    for states, seed in every:
        obs = reset(states, seed)
        for row in range(3):
            for name, value in seen[row].items():
                torch.testing.assert_close(obs[name][row], value[0])
    for states in (trees[1], rows[1]):  # a single row is for all
        assert reset(states)["target_object"].argmax(1).tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    "kind",
    [
        lambda a: a.clone().requires_grad_(),
        lambda a: a.as_subclass(OnGpu),
        lambda a: a.double().numpy(),
    ],
)
def test_actions_of_all_kinds_are_taken(envs: ProcessVectorEnv, kind: Any) -> None:
    plain = actions(1, 3)[0]
    after = []
    for given in (plain, kind(plain)):
        envs.reset(seed=2)
        after.append(envs.step(given)[0]["agent"]["target"])
    assert torch.equal(*after)
    assert not after[1].requires_grad


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (torch.zeros(2, 26), r"got shape \(2, 26\), expected \(3, 26\)"),
        (torch.full((3, 26), torch.nan), "got NaN or infinity"),
        (np.full((3, 26), 1e300), "got NaN or infinity"),
        (None, "action: got"),
    ],
)
def test_wrong_actions_are_refused_and_no_env_steps(
    envs: ProcessVectorEnv, wrong: Any, message: str
) -> None:
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        envs.step(wrong)
    assert envs.step(torch.zeros(3, 26))[4]["elapsed_steps"].tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"num_envs": 0}, "num_envs: got 0"),
        ({"num_envs": "2"}, "num_envs: got '2', expected a whole number, at least 1"),
        ({"num_workers": 0}, "num_workers: got 0, expected a whole number, at least 1"),
        ({"timeout": 0}, "timeout: got 0, expected more than 0"),
        ({"task_id": None}, "task id: got None, expected a str"),
        ({"sim_backend": None}, "sim_backend: got None, expected 'auto' or one of"),
        ({"sim_backend": "gpus"}, "sim_backend: got 'gpus', expected 'auto' or one of"),
        ({"task_id": "NoSuchTask-v1"}, "available"),
    ],
)
def test_envs_that_cannot_be_are_not_made(kwargs: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_vec(**{"task_id": TASK, "num_envs": 2} | kwargs)


def test_answers_of_different_commands_cannot_get_mixed(envs: ProcessVectorEnv) -> None:
    envs.reset(seed=0)
    with pytest.raises(WorkerError, match="step_async. comes first"):
        envs.step_wait()
    envs.step_async(torch.zeros(3, 26))
    for command in (lambda: envs.step_async(torch.zeros(3, 26)), envs.reset):
        with pytest.raises(WorkerError, match="last command has not been answered"):
            command()
    assert envs.step_wait()[4]["elapsed_steps"].tolist() == [1, 1, 1]


# -- What Gymnasium's have -------------------------------------------------------------


def test_methods_are_called_and_attributes_read_in_every_env(
    envs: ProcessVectorEnv,
) -> None:
    envs.reset(options={"instruction": [0, 1, 2]})
    said = envs.call("get_language_instruction")
    assert said == tuple([sentence] for sentence in SENTENCES)
    assert envs.get_attr("render_mode") == (None, None, None)
    qpos = envs.call("get_state_dict")[2]["controller"]["target_qpos"]
    assert qpos.shape == (1, 26)
    assert envs.call("get_obs", info=None)[0]["extra"]["touch"].shape == (1, 6)
    with pytest.raises(ValueError, match="call: got 'reset'"):
        envs.call("reset", seed=1)
    for name, reason in (("smell", "no attribute 'smell'"), ("scene", "cannot pickle")):
        with pytest.raises(WorkerError, match=f"(?s)worker-0.*{reason}"):
            envs.get_attr(name)
    assert envs.step(torch.zeros(3, 26))[4]["elapsed_steps"].tolist() == [1, 1, 1]


def test_gymnasiums_wrappers_record_and_scale_rewards(envs: ProcessVectorEnv) -> None:
    wrapped = NormalizeReward(RecordEpisodeStatistics(envs))
    for _ in range(2):
        wrapped.reset(seed=3)
        rewards, scaled = [], []
        for action in actions(32, 3):
            scaled.append(wrapped.step(action)[1])
        info = wrapped.step(actions(1, 3)[0])[4]
    assert "episode" not in info  # of the step after the end
    envs.reset(seed=3)
    rewards = torch.stack([envs.step(action)[1] for action in actions(32, 3)])
    returns = rewards.sum(0).tolist()
    assert np.allclose(wrapped.env.return_queue, [*returns, *returns])
    assert list(wrapped.env.length_queue) == [32] * 6
    ratio = torch.stack(scaled) / rewards
    assert ratio.std(dim=1).nan_to_num().max() < 1e-4  # one scale for all in a step
    assert not torch.allclose(ratio, torch.ones(()))
    with pytest.raises(ValueError, match="NEXT_STEP"):
        NormalizeObservation(envs)


def test_rewards_are_arrays_to_numpy_and_plain_tensors_to_torch(
    envs: ProcessVectorEnv,
) -> None:
    envs.reset(seed=0)
    _, reward, terminated, truncated, _ = envs.step(torch.zeros(3, 26))
    either = np.logical_or(terminated, truncated)
    for array in (
        *(either, np.where(either, 0, reward), np.zeros(3) + reward),
        *(np.stack([reward, reward]), np.add(reward, 1, out=reward)),
    ):
        assert type(array) is np.ndarray
    assert np.sum(np.ones(3), where=terminated) == 0
    assert np.sum(either) == 0
    assert (1 - terminated).tolist() == [1, 1, 1]
    assert torch.equal(1 - reward, -(reward - 1))
    for plain in (
        terminated | truncated,
        reward + 1,
        torch.stack([reward, reward]),
        copy.deepcopy(reward),
        pickle.loads(pickle.dumps(reward)),
    ):
        assert type(plain) is torch.Tensor


# -- Batches on a GPU ------------------------------------------------------------------


@pytest.fixture
def cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)


class Batch(types.SimpleNamespace):
    """Stands in for ManiSkill's batched env, which needs a GPU: env 1 of 3 ends."""

    get_wrapper_attr = types.SimpleNamespace.__getattribute__

    def __init__(self) -> None:
        base = types.SimpleNamespace(num_envs=3, experiment=None, device="cpu")
        spaces = ("observation_space", "action_space")
        made = dict.fromkeys([*spaces, *(f"single_{name}" for name in spaces)])
        super().__init__(unwrapped=base, spec=None, metadata={}, resets=[], **made)

    def reset(self, seed: list[int] | None, options: dict) -> tuple[dict, dict]:
        chosen = options.get("env_idx")
        self.resets.append((seed, None if chosen is None else chosen.tolist()))
        return {}, {}

    def step(self, action: Any) -> tuple:
        done = torch.tensor([False, True, False])
        info = {"elapsed_steps": torch.tensor([3, 32, 5])}
        return {"touch": torch.ones(3, 2)}, torch.zeros(3), ~done & done, done, info


@pytest.fixture
def batch(cuda: None, monkeypatch: pytest.MonkeyPatch) -> Batch:
    batch = Batch()
    monkeypatch.setattr(vector.gym, "make", lambda *_, **__: batch)
    return batch


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


def test_a_batch_on_a_gpu_is_seeded_alike(batch: Batch) -> None:
    envs = make_vec(TASK, 3, sim_backend="physx_cuda")
    envs.reset(seed=np.int64(7))
    envs.reset(seed=[5, 3, 4])
    for some in ([2, 0], torch.tensor([2, 0])):
        envs.reset(options={"env_idx": some})
    assert batch.resets == [([7, 8, 9], None), ([5, 3, 4], None)] + [(None, [2, 0])] * 2
    with pytest.raises(ValueError, match="seed: got 7 for some of the envs"):
        envs.reset(seed=7, options={"env_idx": [1]})
    with pytest.raises(ValueError, match=r"seed: got \[1, 2\], expected"):
        envs.reset(seed=[1, 2])
    with pytest.raises(ValueError, match=r"got \['env_id'\], expected some of"):
        envs.reset(options={"env_id": [1]})


def test_a_batch_on_a_gpu_ends_episodes_alike(batch: Batch) -> None:
    info = make_vec(TASK, 3, sim_backend="physx_cuda").step(None)[4]
    assert info["final_info"]["elapsed_steps"].tolist() == [0, 32, 0]
    assert info["final_obs"]["touch"].sum(1).tolist() == [0, 2, 0]
    assert info["_final_obs"].tolist() == [False, True, False]
    assert batch.resets == [(None, [1])]


def test_a_goal_that_workers_cannot_import_is_told_of() -> None:
    class Hover(Touch):
        pass

    blue = TouchObject("blue", (0.2, 0.0))
    task = Experiment("Hover-v1", (blue,), (Instruction("Up.", Hover(Ref("blue"))),))
    message = "Hover.*; worker processes import goals.* at the top level of a .py file"
    with pytest.raises(WorkerError, match=message):
        ProcessVectorEnv(task, 1)
