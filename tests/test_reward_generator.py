"""The paper's rewards and our dense terms, by hand, without a simulator."""

import dataclasses
import math

import pytest
import torch
from scenes import HANDS, scene

from ir_maniskill import Push, Ref, Touch
from ir_maniskill import experiment as catalog
from ir_maniskill.environment.instructional_set import GoalTable
from ir_maniskill.environment.reward_generator import (
    TERMS,
    RewardWeights,
    judge,
    reward_terms,
    sparse_reward,
)
from ir_maniskill.snapshot import later

LINE = catalog.get("NaoTouchCubeMulti-v1")
TRIANGLE = catalog.get("NaoTouchCubeTriangle-v1")


def measured(at, *goals):
    """Return measure and verdict of one goal for each scene."""
    table = GoalTable(goals, HANDS, torch.device("cpu"))
    measure = table.deal(torch.arange(len(goals)), at).measure(at)
    return measure, judge(at, measure)


@pytest.mark.parametrize(
    ("touching", "binary", "per_finger"),
    [
        ([], 0.0, 0.0),
        ([(0, 1)], 1.0, 1.0),
        ([(0, 1), (1, 1), (2, 1)], 1.0, 3.0),
        ([(0, 0)], 0.0, -0.1),
        ([(0, 0), (0, 2)], 0.0, -0.1),  # one finger on two wrong objects
        ([(0, 0), (1, 2)], 0.0, -0.2),
        ([(0, 0), (0, 1)], 1.0, 0.9),  # one finger on both
        ([(f, 1) for f in range(6)], 1.0, 6.0),
    ],
)
def test_the_papers_rewards(touching, binary, per_finger):
    measure, verdict = measured(scene(*touching), Touch(Ref("red")))
    wrong = verdict.wrong.sum(dim=1)
    for experiment, expected in ((LINE, binary), (TRIANGLE, per_finger)):
        got = sparse_reward(experiment, measure.holds, measure.level, wrong)
        assert got.item() == pytest.approx(expected)


def test_each_env_is_judged_by_its_own_sentence():
    at = scene((3, 0), (4, 0), (5, 2), count=3)
    goals = [Touch(Ref(color)) for color in ("blue", "red", "green")]
    _, verdict = measured(at, *goals)
    assert verdict.right.sum(dim=1).tolist() == [2, 0, 1]
    assert verdict.wrong.sum(dim=1).tolist() == [1, 3, 2]


def test_the_dense_terms_of_a_touch():
    at = scene((0, 1), (1, 1), count=2)
    at.velocity[:, 1] = torch.tensor([0.0, 0.1, 0.0])
    measure, verdict = measured(at, Touch(Ref("red")), Touch(Ref("blue")))
    terms = reward_terms(at, measure, verdict, torch.tensor([False, True]))
    red, blue = (dict(zip(TERMS, row, strict=True)) for row in terms.tolist())
    near = {name: 1 - math.tanh(d / 0.1) for name, d in (("r", RED), ("b", BLUE))}
    assert red == pytest.approx(
        {
            "hold": 2.0,
            "hold_after_foul": 0.0,
            "approach": 1.0,
            "gather": near["r"],
            "gather_after_foul": 0.0,
            "foul": 0.0,
            "speed": 0.1,
        }
    )
    assert blue == pytest.approx(
        {
            "hold": 0.0,
            "hold_after_foul": 0.0,
            "approach": near["b"],
            "gather": 0.0,
            "gather_after_foul": near["b"],
            "foul": 1.0,
            "speed": 0.0,
        },
        abs=1e-6,
    )


RED = math.sqrt(0.23**2 + 0.08**2 + 0.05**2)  # all fingertips are at the origin
BLUE = math.sqrt(0.19**2 + 0.05**2)


def test_fingers_of_the_other_hand_are_not_gathered_and_pushes_may_move():
    at = scene(count=2)
    at = dataclasses.replace(at, fingertip=at.fingertip.clone())
    at.fingertip[:, 0] = at.position[0, 1]
    at.velocity[:] = 1.0
    measure, verdict = measured(at, Touch(Ref("red"), "left"), Push(Ref("red"), "left"))
    terms = reward_terms(at, measure, verdict, torch.zeros(2, dtype=torch.bool))
    far = 1 - math.tanh(RED / 0.1)
    columns = dict(zip(TERMS, terms.T.tolist(), strict=True))
    # To push to the left, fingers go 4 cm to the right of the object's center.
    near = 1 - math.tanh(0.04 / 0.1)
    behind = 1 - math.tanh(math.hypot(0.23, 0.04, 0.05) / 0.1)
    expected = [(1 + 2 * far) / 3, (near + 5 * behind) / 6]
    assert columns["gather"] == pytest.approx(expected)
    assert columns["speed"] == pytest.approx([0.3, 0.0])  # cut at 0.3 m/s


def test_weights_have_their_signs_and_their_highest():
    weights = RewardWeights(
        hold=1, approach=0.5, gather=4, foul=0.5, speed=6, after_foul=0.25
    )
    expected = [1, 0.25, 0.5, 4, 1, -0.5, -6]
    assert weights.vector().tolist() == pytest.approx(expected)
    assert weights.highest(6) == pytest.approx(10.5)


@pytest.mark.parametrize(
    "change", [{"hold": -1.0}, {"foul": math.inf}, {"after_foul": 1.1}]
)
def test_weights_that_cannot_work_are_refused(change):
    with pytest.raises(
        ValueError, match=r"reward_weights\.\w+: got .* expected a finite"
    ):
        RewardWeights(**change)


def test_what_only_the_dense_reward_needs_is_not_read_before():
    read = []

    def fingertips():
        read.append("fingertip")
        return torch.zeros(1, 6, 3)

    at = dataclasses.replace(scene((0, 1)), fingertip=later(fingertips))
    measure, verdict = measured(at, Touch(Ref("red")))
    assert verdict.right.sum() == 1 and not verdict.foul.any()
    assert sparse_reward(LINE, measure.holds, measure.level, verdict.wrong).sum() > 0
    assert read == []
    terms = reward_terms(at, measure, verdict, torch.tensor([False]))
    assert read == ["fingertip"]
    assert torch.equal(terms, reward_terms(at, measure, verdict, torch.tensor([False])))
    assert read == ["fingertip"]
