"""Goals on scenes made by hand: what holds, how far it is, what is a foul."""

import dataclasses
import math
import runpy
from pathlib import Path

import pytest
import torch
from scenes import HANDS, scene

import ir_maniskill
from ir_maniskill import Avoid, Both, Instruction, Push, Ref, Then, Touch
from ir_maniskill.environment.instructional_set import GoalTable
from ir_maniskill.environment.reward_generator import judge
from ir_maniskill.goals import GoalError, left_of, other_than, right_of

BLUE, RED, GREEN = Ref("blue"), Ref("red"), Ref("green")
CPU = torch.device("cpu")


def measured(goal, at):
    """Return the measure and the verdict of one goal in all scenes."""
    index = torch.zeros(len(at.stage), dtype=torch.int64)
    measure = GoalTable([goal], HANDS, CPU).deal(index, at).measure(at)
    return measure, judge(at, measure)


def outcome(goal, at):
    """Return whether the goal holds, its gap, and whether there is a foul."""
    measure, verdict = measured(goal, at)
    return measure.holds.item(), measure.gap.item(), verdict.foul.item()


# -- References ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ref", "object_index"),
    [
        (Ref("red", "cube"), 1),
        (Ref(shape="button"), 2),
        (Ref(where="leftmost"), 1),
        (Ref(where="rightmost"), 2),
        (Ref(where="nearest"), 0),
        (Ref(shape="cube", where="farthest"), 1),
        (Ref(where=left_of(BLUE)), 1),
        (Ref(where=right_of(BLUE)), 2),
        (Ref(shape="cube", where=other_than(RED)), 0),
    ],
)
def test_a_reference_fits_the_object_it_describes(ref, object_index):
    assert ref.resolve(scene())[0].nonzero().flatten().tolist() == [object_index]


@pytest.mark.parametrize("ref", [Ref(shape="button"), GREEN, Ref(where="rightmost")])
def test_what_is_fixed_to_the_table_is_not_to_be_moved(ref):
    measured(Touch(ref), scene())
    for goal in (Push(ref, "left"), Both(Push(ref, "left"), Touch(BLUE))):
        with pytest.raises(GoalError, match="got a button to move in env 0, expected"):
            measured(goal, scene())


def test_a_verb_says_which_of_its_references_are_to_be_moved():
    @dataclasses.dataclass(frozen=True)
    class Carry(Touch):
        MOVES = ("ref",)
        to: Ref = GREEN
        after: Touch = dataclasses.field(default_factory=lambda: Touch(GREEN))

    assert Both(Carry(RED), Touch(BLUE)).moved == (RED,)
    measured(Carry(RED), scene())
    with pytest.raises(GoalError, match="got a button to move in env 0, expected"):
        measured(Carry(GREEN), scene())
    with pytest.raises(GoalError, match="'Carry it.': got a button to move, expected"):
        Instruction("Carry it.", Carry(Ref(shape="button")))


def test_a_reference_means_what_it_meant_when_the_episode_began():
    at = scene(moved=(0.0, 0.2, 0.0), which=2)  # now green is leftmost
    assert Ref(where="leftmost").resolve(at)[0].tolist() == [False, True, False]


@pytest.mark.parametrize(
    "ref",
    [
        Ref("yellow"),
        Ref(shape="cube"),
        Ref("red", where=left_of(Ref("yellow"))),  # there is no yellow one
        Ref("green", where=right_of(Ref(shape="cube"))),  # there are two cubes
    ],
)
def test_a_reference_that_fits_none_or_two_is_refused_where_it_counts(ref):
    with pytest.raises(
        GoalError, match="got [02] objects .* expected exactly one of its .*red cube"
    ):
        measured(Touch(ref), scene())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Ref("pink"), "color of a Ref: got 'pink', available: blue"),
        (lambda: Ref(shape="ball"), "shape of a Ref: got 'ball'"),
        (lambda: Ref(where="behind"), "where of a Ref: got 'behind', available: left"),
        (lambda: Touch("blue cube"), "ref of Touch: got 'blue cube', expected a Ref"),
        (lambda: Push(RED, "up"), "direction of Push: got 'up', available: left"),
        (lambda: Push(RED, "left", -1.0), "distance of Push: got -1.0"),
        (lambda: Both(Touch(RED), Then(Touch(RED), Touch(BLUE))), "a Then around it"),
        (lambda: Then(Then(Touch(RED), Touch(RED)), Touch(RED)), "expected it as `b`"),
    ],
)
def test_malformed_goals_are_refused(make, message):
    with pytest.raises(GoalError, match=message):
        make()


def test_a_hand_that_the_robot_lacks_is_refused():
    with pytest.raises(GoalError, match="got 'third', available on this robot: left"):
        GoalTable([Touch(RED, "third")], HANDS, CPU)


# -- Kinds of goal -------------------------------------------------------------------

FAR = (0.23**2 + 0.08**2 + 0.05**2) ** 0.5  # from the origin to the red cube [m]


def test_touch_counts_fingers_and_measures_the_nearest():
    held, verdict = measured(Touch(RED), scene((0, 1), (4, 1)))
    assert (held.holds.item(), held.level.item(), held.gap.item()) == (True, 2.0, 0.0)
    assert verdict.right[0].tolist() == [True, False, False, False, True, False]
    assert not verdict.foul
    holds, gap, foul = outcome(Touch(RED), scene((0, 0)))
    assert (holds, foul) == (False, True)
    assert gap == pytest.approx(FAR)


def test_with_the_other_hand_a_touch_is_a_foul():
    at = scene((0, 1))
    assert outcome(Touch(RED, "left"), at) == (True, 0.0, False)
    holds, gap, foul = outcome(Touch(RED, "right"), at)
    assert (holds, foul) == (False, True)
    assert gap == pytest.approx(FAR)


@pytest.mark.parametrize(
    ("moved", "holds", "gap", "level"),
    [
        ((0.0, 0.051, 0.0), True, 0.0, 3.0),
        ((0.0, 0.02, 0.0), False, 0.03, 1.2),
        ((0.0, -0.1, 0.0), False, 0.15, 0.0),  # the wrong way: as if nothing was done
        ((0.04, 0.051, 0.0), False, 0.0094, 2.496),  # strays by 4 cm, may by 3.06
        ((0.0, 0.051, -0.3), True, 0.0, 3.0),  # a fall from the table is not sideways
    ],
)
def test_push_measures_the_way_along_and_to_the_side(moved, holds, gap, level):
    at = scene(moved=moved, which=1)
    at.fingertip[:, 4] = at.position[:, 1] - torch.tensor([0.03, 0.04, 0.02])
    measure, verdict = measured(Push(RED, "left", 0.05), at)
    assert measure.holds.item() == holds
    # A finger is 3 cm beside the way and 2 cm too low or high, which counts twice.
    way = math.hypot(0.03, 0.04)
    assert measure.gap.item() == pytest.approx(0 if holds else gap + way, abs=1e-4)
    assert measure.level.item() == pytest.approx(level)
    assert not verdict.foul


@pytest.mark.parametrize(
    ("ahead", "height"), [(-0.05, 0.0), (0.015, 0.0), (0.025, 0.02), (0.06, 0.05)]
)
def test_fingers_pass_over_what_they_push_and_go_down_behind_it(ahead, height):
    def gap(z):
        at = scene()
        at.fingertip[:, 4] = at.position[:, 1] + torch.tensor([0, ahead - 0.04, z])
        return measured(Push(RED, "left", 0.05), at)[0].gap.item()

    assert gap(height) == pytest.approx(0.05 + abs(ahead), abs=1e-4)
    assert min(gap(height + 0.01), gap(height - 0.01)) > gap(height)


def test_a_push_that_moves_another_object_is_a_foul():
    goal = Push(RED, "left", 0.05)
    assert not measured(goal, scene((0, 1), moved=(0.019, 0.0, 0.0)))[1].foul
    assert measured(goal, scene((0, 1), moved=(0.021, 0.0, 0.0)))[1].disturbed
    assert measured(goal, scene((0, 0)))[1].wrong[0, 0]


def test_avoid_bars_its_object_alone():
    assert outcome(Avoid(RED), scene((0, 0))) == (True, 0.0, False)
    holds, _, foul = outcome(Avoid(RED), scene((0, 1)))
    assert (holds, foul) == (False, True)


def test_both_holds_where_both_do_and_allows_what_either_needs():
    goal = Both(Touch(RED, "left"), Touch(BLUE, "right"))
    assert outcome(goal, scene((0, 1), (3, 0))) == (True, 0.0, False)
    assert measured(goal, scene((0, 1), (3, 0)))[0].level.item() == 2
    assert measured(goal, scene((0, 1), (1, 1)))[0].level.item() == 0.5
    holds, gap, foul = outcome(goal, scene((0, 1)))
    assert (holds, foul) == (False, False)
    assert gap == pytest.approx((0.19**2 + 0.05**2) ** 0.5)
    assert outcome(goal, scene((0, 1), (3, 1)))[2]  # red with the right hand


def test_touch_this_but_not_that():
    goal = Both(Touch(RED), Avoid(BLUE))
    assert outcome(goal, scene((0, 1))) == (True, 0.0, False)
    assert outcome(goal, scene((0, 1), (1, 0)))[2]
    assert outcome(goal, scene((0, 1), (1, 2)))[2]  # another one is no better


@pytest.mark.parametrize(
    ("goal", "foul"),
    [  # what moves is blue
        (Both(Push(RED, "left"), Avoid(GREEN)), True),
        (Both(Push(RED, "left"), Touch(BLUE)), False),
        (Then(Push(RED, "left"), Touch(BLUE)), False),
        (Then(Push(RED, "left"), Touch(GREEN)), True),
    ],
)
def test_of_two_goals_each_lets_move_what_the_other_touches(goal, foul):
    at = scene((0, 1), moved=(0.021, 0.0, 0.0), stage=1)
    assert measured(goal, at)[1].foul.item() == foul


def test_then_goes_on_when_the_first_is_reached():
    goal = Then(Touch(RED), Then(Touch(BLUE), Touch(GREEN)))
    first, verdict = measured(goal, scene((0, 1)))
    assert (first.holds.item(), first.stage.item()) == (False, 1)
    assert measured(goal, scene((0, 0)))[1].foul  # blue is not asked yet
    second, verdict = measured(goal, scene((0, 0), (1, 1), stage=1))
    assert (second.holds.item(), second.stage.item()) == (False, 2)
    assert not verdict.foul  # a finger may still be on red
    last, _ = measured(goal, scene((0, 2), stage=2))
    assert (last.holds.item(), last.stage.item(), last.level.item()) == (True, 2, 3.0)


@pytest.mark.parametrize("turn", [-2.5, -1.5, 0.0, 1.5, 2.5, 2 * math.pi - 2.5])
def test_the_verb_of_the_example_measures_turns_either_way(turn, monkeypatch):
    monkeypatch.setattr(ir_maniskill, "register", lambda task: task)
    example = Path(__file__).parents[1] / "examples" / "new_verb.py"
    spin = runpy.run_path(str(example))["Spin"]
    at = scene((0, 1))
    at.pose[:, 1, 3], at.pose[:, 1, 6] = math.cos(turn / 2), math.sin(turn / 2)
    held, verdict = measured(spin(RED, 2.0), at)
    left = 2.0 - min(abs(turn), 2.5)
    assert held.holds.item() == (left < 0) and not verdict.foul
    assert held.gap.item() == pytest.approx(max(0.03 * left, 0), abs=1e-5)


# -- Batches -------------------------------------------------------------------------


def test_a_batch_of_mixed_goals_is_measured_as_each_alone():
    goals = [
        Touch(RED),
        Push(Ref(where="leftmost"), "left", 0.05),
        Both(Touch(RED, "left"), Avoid(BLUE)),
        Then(Touch(RED), Push(BLUE, "away", 0.03)),
        Touch(GREEN, "right"),
        Avoid(GREEN),
    ]
    index = torch.tensor([5, 0, 3, 2, 1, 4, 3, 0])
    at = scene((0, 1), (4, 2), count=8, moved=(0.0, 0.06, 0.0), which=1)
    at = dataclasses.replace(at, stage=torch.tensor([0, 0, 1, 0, 0, 0, 0, 0]))
    together = GoalTable(goals, HANDS, CPU).deal(index, at).measure(at)
    verdict = judge(at, together)
    for env, which in enumerate(index.tolist()):
        fields = vars(at).items()
        one = dataclasses.replace(at, **{k: v[env : env + 1] for k, v in fields})
        alone, judged = measured(goals[which], one)
        for field in dataclasses.fields(alone):
            mixed, value = (getattr(each, field.name) for each in (together, alone))
            torch.testing.assert_close(mixed[env], value[0])
        assert torch.equal(verdict.wrong[env], judged.wrong[0])


def test_a_field_that_cannot_be_stacked_is_refused():
    @dataclasses.dataclass(frozen=True)
    class Sing(Avoid):
        song: str = "la"

    with pytest.raises(GoalError, match="field 'song' of a goal: got 'la', expected"):
        GoalTable([Sing(RED)], HANDS, CPU)

    with pytest.raises(GoalError, match="got 'la' and None, .* same in all goals"):
        GoalTable([Sing(RED), Sing(RED, None)], HANDS, CPU)

    @dataclasses.dataclass(frozen=True)
    class Lift(Avoid):
        direction: str = "up"

    with pytest.raises(GoalError, match="direction of a goal: got 'up', available: l"):
        GoalTable([Lift(RED)], HANDS, CPU)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ({"gap": 0}, r"gap of a Measure: got 0, expected torch.float32 \[1\]"),
        ({"gap": torch.ones(1).double()}, r"gap .*: got torch.float64 \[1\], expected"),
        ({"holds": torch.ones(1)}, r"holds .*: got torch.float32 \[1\], .*bool \[1\]"),
        (
            {"level": torch.ones(1, 1)},
            r"level .*: got torch.float32 \[1, 1\], expected",
        ),
        ({"serves": torch.ones(1)}, r"serves .* \(N, F, C = 1, \d, \d\)"),
        (None, r"Hop.measure: got tensor\(.*, expected a Measure"),
    ],
)
def test_a_measure_of_the_wrong_kind_is_refused(answer, message):
    class Hop(Avoid):
        @staticmethod
        def measure(scene, asked):
            measure = Avoid.measure(scene, asked)
            if answer is None:
                return measure.holds
            return dataclasses.replace(measure, **answer)

    with pytest.raises(GoalError, match=message):
        measured(Hop(RED), scene())
