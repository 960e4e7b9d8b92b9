"""Version 0.1's episodes, played again: same starts, same rewards for same contacts.

`data/episodes_0_1.npz` holds, for each task, six episodes of random actions: objects'
and joints' start, the sentence, and at each step the contacts of the last physics
substep and the sparse reward. Contacts now count at every substep.
"""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import ir_maniskill

DATA = np.load(Path(__file__).parent / "data" / "episodes_0_1.npz")


@pytest.mark.parametrize(
    "task",
    [
        "NaoTouchCubeShuffled-v1",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ir_maniskill.available()[:8]
            if name != "NaoTouchCubeShuffled-v1"
        ),
    ],
)
def test_starts_and_rewards_are_those_of_version_0_1(task: str) -> None:
    env = gym.make(
        task,
        obs_mode="none",
        control_mode="pd_joint_target_delta_pos",
        render_backend="none",
    )
    base = env.unwrapped
    shape = DATA[f"{task}/shape"]  # episodes, steps, fingers, objects
    bits = np.unpackbits(DATA[f"{task}/contact"])[: np.prod(shape)]
    last_substep = bits.reshape(shape).astype(bool)
    same = more = 0
    for seed in range(shape[0]):
        env.reset(seed=seed)
        poses = [thing.pose.raw_pose[0] for thing in base.objects]
        start = np.concatenate([*poses, base.agent.robot.get_qpos()[0]])
        np.testing.assert_allclose(start, DATA[f"{task}/start"][seed], atol=1e-6)
        assert base.instruction_index.item() == DATA[f"{task}/instruction"][seed]
        rng = np.random.default_rng(seed)
        for step in range(shape[1]):
            action = rng.uniform(-1, 1, 26).astype(np.float32)
            _, reward, _, _, info = env.step(action)
            contact, before = info["contact"][0].numpy(), last_substep[seed, step]
            if np.array_equal(contact, before):
                same += 1
                assert float(reward) == DATA[f"{task}/reward"][seed, step]
            more += int((contact > before).any())
    env.close()
    assert same > 150  # of 192; the others had a touch before the last substep
    assert more > 0
