"""The scripted solution knows where the hands are, and obeys."""

import contextlib

import numpy as np
import pytest
import torch

from ir_maniskill import (
    Experiment,
    Instruction,
    Jitter,
    Push,
    Ref,
    TouchObject,
    register,
)
from ir_maniskill.evaluation.audit import blind
from ir_maniskill.evaluation.evaluate import play
from ir_maniskill.evaluation.scripted import (
    Aim,
    NotScriptedError,
    Scripted,
    acts_in,
    clearance,
)
from ir_maniskill.goals import Avoid, Both, Then, Touch

RED, BLUE = Ref("red"), Ref("blue")
GOALS = {
    "Touch red.": Touch(RED),
    "Touch red with your right hand.": Touch(RED, "right"),
    "Touch both.": Both(Touch(RED), Touch(BLUE)),
    "Touch red, not blue.": Both(Touch(RED), Avoid(BLUE)),
    "Push red left.": Push(RED, "left"),
    "Push blue away.": Push(BLUE, "away"),
    "Touch red, then push blue right.": Then(Touch(RED), Push(BLUE, "right")),
}
TASK = register(
    Experiment(
        "TwoCubes-v1",
        (TouchObject("red", (0.19, -0.09)), TouchObject("blue", (0.21, 0.10))),
        tuple(Instruction(text, goal) for text, goal in GOALS.items()),
        jitter=Jitter(0.0, 0.0, 0.0),
        episode_steps=64,
    )
)


@pytest.fixture(scope="module")
def envs():
    with contextlib.closing(blind(TASK)) as made:
        made.reset(seed=0)
        yield made


@pytest.fixture(scope="module")
def scripted(envs):
    return Scripted(envs.base_env)


def test_clearance_is_that_of_the_nearest_face_of_a_turned_box():
    # A cube of 4 cm at the origin, turned by 45 degrees: a corner is 2.83 cm ahead.
    box = np.array([[0.0, 0.0, 0.0, np.pi / 4, 0.04]])
    balls = np.array([[0.05, 0.0, 0.0], [0.0, 0.0, 0.05], [0.0, 0.0, 0.0]])
    away = clearance(balls, np.full(3, 0.01), box)[:, 0]
    assert away == pytest.approx([0.05 - 0.02828 - 0.01, 0.02, -0.03], abs=1e-4)


def test_the_model_has_the_hands_where_the_simulator_has_them(envs, scripted):
    robot = envs.base_env.agent
    order = robot.controller.active_joint_indices
    joints = robot.robot.get_qpos()[0, order].numpy().astype(float)
    expected = robot.finger_position()[0].numpy()  # [F, 3]
    for arm, first in zip(scripted.arms.values(), (0, 3), strict=True):
        arm.rest = joints
        bent = arm.to_joints(arm.numbers(joints), joints)
        assert bent == pytest.approx(joints, abs=0.2), "fingers bend alike"
        tip = arm.hand(arm.numbers(joints), (2,)).tip
        assert tip == pytest.approx(expected[first + 2], abs=0.005)


def test_least_squares_bring_the_tip_where_it_shall_be(scripted):
    arm = scripted.arms["left"]
    none = np.zeros((0, 5)), np.zeros(0)
    for place in ([0.20, 0.05, 0.09], [0.16, 0.16, 0.10]):
        aim = Aim(np.array(place), *none)
        x = arm.search((0, 1), aim)
        assert arm.miss(x, (0, 1), aim) < 0.003
    far = Aim(np.array([0.35, 0.05, 0.09]), *none)
    assert arm.miss(arm.search((0, 1), far), (0, 1), far) > 0.05


def test_what_is_to_be_left_alone_is_nothing_to_do():
    assert acts_in(GOALS["Touch red, not blue."]) == [Touch(RED)]
    with pytest.raises(NotScriptedError, match="expected Touch, Push, Avoid"):
        acts_in(object.__new__(type("Spin", (Push.__mro__[1],), {"measure": None})))


def test_two_things_for_one_hand_are_refused(envs, scripted):
    goal = Both(Touch(RED, "left"), Touch(BLUE, "left"))
    with pytest.raises(NotScriptedError, match="expected a hand for each"):
        play(scripted, envs, [Instruction("Touch both.", goal)], [0])


@pytest.mark.parametrize("text", GOALS)
def test_every_kind_of_goal_is_reached_without_a_foul(envs, scripted, text):
    figures, _ = play(scripted, envs, [Instruction(text, GOALS[text])], [0])
    assert torch.equal(figures[0, :2], torch.ones(2, dtype=torch.float64))
