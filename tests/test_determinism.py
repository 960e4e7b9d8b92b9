"""Same seed, same trajectory on the CPU, whatever runs beside it."""

import pytest
import torch
from trees import leaves

from ir_maniskill import make_vec

STEPS = 36
"""An episode of 32 steps, and the beginning of the one that follows it by itself."""


def trajectory(task: str, seeds: list[int], row: int) -> list[dict[str, torch.Tensor]]:
    """Return all that one of several envs, in new processes, gave at each step."""
    envs = make_vec(
        task,
        len(seeds),
        num_workers=2,
        sim_backend="physx_cpu",
        obs_mode="state_dict",
        render_backend="none",
    )
    generator = torch.Generator().manual_seed(0)
    seen = [leaves(envs.reset(seed=seeds)[0])]
    for _ in range(STEPS):
        action = 2 * torch.rand(1, 26, generator=generator) - 1  # the same for all
        obs, reward, _, _, info = envs.step(action.repeat(len(seeds), 1))
        seen.append(leaves({"obs": obs, "reward": reward, "info": info}))
    envs.close()
    return [{path: leaf[row] for path, leaf in step.items()} for step in seen]


@pytest.mark.slow
@pytest.mark.parametrize("task", ["NaoTouchCubeMulti-v1", "NaoTouchButtonShuffled-v1"])
def test_a_seed_fixes_the_trajectory_across_processes_and_num_envs(task: str) -> None:
    alone = trajectory(task, [7], 0)
    among = trajectory(task, [3, 7, 5], 1)
    for step, (one, other) in enumerate(zip(alone, among, strict=True)):
        assert one.keys() == other.keys()
        different = [path for path in one if not torch.equal(one[path], other[path])]
        assert not different, f"step {step}"
    last = alone[-1]
    assert last["info/elapsed_steps"] == STEPS - 32
    assert not torch.equal(
        alone[0]["extra/object_position"], last["obs/extra/object_position"]
    )
