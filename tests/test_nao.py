"""The robot as ManiSkill drives it: order, limits, modes, senses."""

from collections.abc import Iterator
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch

from ir_maniskill.environment.robots.controller import TargetController
from ir_maniskill.environment.robots.nao import JOINTS
from ir_maniskill.environment.touch_env import TouchEnv

ABSOLUTE, DELTA = "pd_joint_pos", "pd_joint_target_delta_pos"


@pytest.fixture(scope="module", params=[ABSOLUTE, DELTA])
def env(request: pytest.FixtureRequest) -> Iterator[TouchEnv]:
    """A button task without pictures in either control mode."""
    env = gym.make(
        "NaoTouchButtonTriangle-v1",
        obs_mode="state_dict",
        control_mode=request.param,
        render_backend="none",
    )
    yield env.unwrapped
    env.close()


def test_actions_are_26_joints_all_left_then_all_right(env: TouchEnv) -> None:
    assert env.action_space.shape == (26,)
    assert (env.action_space.low == -1).all()
    assert (env.action_space.high == 1).all()
    assert JOINTS[:5] == tuple(
        "L" + j
        for j in ("ShoulderPitch", "ShoulderRoll", "ElbowYaw", "ElbowRoll", "WristYaw")
    )
    assert JOINTS[13:] == tuple("R" + joint[1:] for joint in JOINTS[:13])


@pytest.mark.parametrize("joint", ["LShoulderRoll", "RElbowRoll", "LThumb2"])
def test_an_action_moves_the_joint_it_names_and_no_other(
    env: TouchEnv, joint: str
) -> None:
    obs, _ = env.reset(seed=3)
    before = obs["agent"]["proprioception"][0]
    for _ in range(6):
        still = before.numpy() if env.control_mode == ABSOLUTE else np.zeros(26)
        move = still.astype(np.float32).copy()
        move[JOINTS.index(joint)] += 0.4
        obs = env.step(move)[0]
    change = (obs["agent"]["proprioception"][0] - before).abs()
    assert change.argmax().item() == JOINTS.index(joint)
    assert change.max() > 0.2
    change[JOINTS.index(joint)] = 0
    assert change.max() < 0.1
    qpos = env.agent.robot.get_qpos()[0]
    names = [active.name for active in env.agent.robot.active_joints]
    low, high = env.agent.robot.get_qlimits()[0][names.index(joint)]
    expected = 2 * (qpos[names.index(joint)] - low) / (high - low) - 1
    felt = obs["agent"]["proprioception"][0, JOINTS.index(joint)]
    assert felt.item() == pytest.approx(expected.item(), abs=1e-5)


def test_proprioception_is_within_bounds_even_at_the_limits(env: TouchEnv) -> None:
    env.reset(seed=0)
    for sign in (1, -1):
        for _ in range(20):
            obs = env.step(np.full(26, sign, np.float32))[0]
        for felt in ("proprioception", "target"):
            assert obs["agent"][felt].abs().max() <= 1
        assert (obs["agent"]["target"] * sign).min() > 0.999
    if env.control_mode == DELTA:  # targets have not wound up
        back = env.step(np.ones(26, np.float32))[0]["agent"]["target"]
        torch.testing.assert_close(back, torch.full((1, 26), -1 + 0.2))


def test_a_control_mode_has_targets_as_soon_as_it_is_set(env: TouchEnv) -> None:
    env.reset(seed=0)
    env.agent.set_control_mode(DELTA if env.control_mode == ABSOLUTE else ABSOLUTE)
    assert env.get_state_dict()["controller"]["target_qpos"].shape == (1, 26)
    env.agent.set_control_mode()


def test_of_a_batch_the_envs_being_reset_alone_get_new_targets() -> None:
    class Batch(TargetController):
        """On a stand-in for a GPU's three envs with two joints."""

        def __init__(self) -> None:
            self.scene = SimpleNamespace(gpu_sim_enabled=True, _reset_mask=everyone)
            send = SimpleNamespace(set_joint_drive_targets=lambda t, *_: sent.append(t))
            self.articulation, self.joints = send, []
            self.active_joint_indices = torch.arange(2)
            self.lower, self.upper = -torch.ones(2), torch.ones(2)

        @property
        def qpos(self) -> torch.Tensor:
            return torch.full((3, 2), 0.5)

    everyone, some = torch.ones(3, dtype=bool), torch.tensor([True, False, True])
    sent: list[torch.Tensor] = []
    controller = Batch()
    controller.reset()
    controller.set_state({"target_qpos": torch.zeros(3, 2)})
    for restored, expected in ((False, [0.5, 0, 0.5]), (True, [0.25, 0.5, 0.25])):
        controller.scene._reset_mask = some  # as ManiSkill does, until all is in place
        controller.begin_reset()
        if restored:
            controller.set_state({"target_qpos": torch.tensor(rows([0.25, 0.5, 0.25]))})
            assert sent[-1].tolist() == rows([0.25, 0.25])
        controller.scene._reset_mask = everyone
        controller.reset()
        assert controller.target.tolist() == sent[-1].tolist() == rows(expected)


def rows(values: list[float]) -> list[list[float]]:
    """Return a row of two joints for each value."""
    return [[value, value] for value in values]


def test_drives_have_the_real_motors_limits(env: TouchEnv) -> None:
    joint = env.agent.robot.joints_map["LShoulderPitch"]._objs[0]
    assert joint.get_force_limit() == pytest.approx(1.329)
    assert joint.get_max_velocity() == pytest.approx(8.26797)
    assert joint.get_armature()[0] == pytest.approx(1e-2)
    finger = env.agent.robot.joints_map["RFinger13"]._objs[0]
    assert finger.get_armature()[0] == pytest.approx(1e-3)


def test_keyframes_are_poses_the_robot_can_take(env: TouchEnv) -> None:
    assert set(env.agent.keyframes) == {"rest", "hands_over_table"}
    low, high = env.agent.robot.get_qlimits()[0].T
    for keyframe in env.agent.keyframes.values():
        qpos = torch.as_tensor(keyframe.qpos)
        assert ((qpos >= low) & (qpos <= high)).all()
    env.reset(seed=0)
    env.agent.robot.set_qpos(torch.as_tensor(env.agent.keyframes["rest"].qpos)[None])
    assert env.agent.finger_position()[0, :, 2].max() < 0.0  # below the table top


def test_six_fingers_have_their_links_in_the_order_of_the_bits(env: TouchEnv) -> None:
    links = [[link.name for link in finger] for finger in env.agent.finger_links]
    assert [len(finger) for finger in links] == [3, 3, 2, 3, 3, 2]
    for name, finger in zip(env.agent.fingers, links, strict=True):
        assert all(link.startswith(name) for link in finger)
        assert finger == sorted(finger)
    tips = [link.name for link in env.agent.fingertip_links]
    assert tips == [finger[-1] for finger in links]
