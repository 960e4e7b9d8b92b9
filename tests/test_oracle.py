"""The oracle plays by the policies' rules, and its search finds what there is."""

import json

import numpy as np
import oracle
import pytest
from oracle import PLAN, SIDE, Effort, Efforts, Known, Outcome

from ir_maniskill.environment.robots.nao import JOINTS

TASK, SEED = "NaoTouchCubeTriangle-v1", 2_000_000


@pytest.fixture(scope="module")
def stage():
    stage = oracle.Stage(TASK)
    yield stage
    stage.close()


def outcome(right, wrong=(0, 0, 0, 0), nearness=0.5):
    return Outcome(np.array(right), np.array(wrong), nearness)


def test_scores_are_those_worked_out_by_hand():
    held = outcome([0, 2, 3, 3])
    assert held.score("fingers") == 2 + 0.25
    assert held.score("touching") == 0.75 + 0.25
    assert held.exclusive and not outcome([0, 0, 0, 0]).exclusive


def test_touching_another_object_outweighs_all_that_it_may_gain():
    spoiled = outcome([6, 6, 6, 6], wrong=[0, 0, 1, 0])
    assert spoiled.score("fingers") == 6 + 0.25 - (1 + 8 / 4)
    assert spoiled.score("touching") < outcome([0, 0, 0, 0], nearness=0).score(
        "touching"
    )
    assert not spoiled.exclusive


def test_the_search_finds_the_best_plan_of_a_simple_scene():
    wanted = np.linspace(-0.8, 0.8, PLAN)

    def play(plan):
        miss = float(((plan - wanted) ** 2).mean())
        return outcome([0] * 4, nearness=1 - miss)

    found = search(play, [np.zeros(PLAN)], Effort(40, 64, spread=0.4, patience=40))
    assert np.abs(found - wanted).mean() < 0.12


def search(play, known, effort, free=1.0):
    rng = np.random.default_rng(0)
    return oracle.search(play, known, "fingers", (effort, effort), rng, free)


def test_the_search_never_ends_with_less_than_it_began_with():
    good = np.full(PLAN, 0.3)

    def play(plan):
        return outcome([int(np.array_equal(plan, good))] * 4, nearness=0)

    effort = Effort(rounds=3, size=8, spread=0.1, patience=3)
    assert np.array_equal(search(play, [np.zeros(PLAN), good], effort), good)


def test_the_search_gives_up_where_nothing_gets_better():
    tried = []

    def play(plan):
        tried.append(plan)
        return outcome([0] * 4)

    search(play, [np.zeros(PLAN)], Effort(rounds=50, size=8, spread=0.1, patience=3))
    assert len(tried) == 1 + 3 * 8


def test_the_search_leaves_alone_what_is_not_free():
    tried = []

    def play(plan):
        tried.append(plan)
        return outcome([0] * 4)

    free = np.arange(PLAN) % 2
    effort = Effort(rounds=2, size=8, spread=0.1, patience=9)
    search(play, [np.zeros(PLAN)], effort, free)
    moved = np.any(tried, axis=0)
    assert np.array_equal(moved, free.astype(bool))


@pytest.mark.parametrize("touches, size", [(0, 30), (1, 10)])
def test_where_no_known_plan_touches_the_search_is_wider(touches, size):
    tried = []

    def play(plan):
        tried.append(plan)
        return outcome([0, 0, 0, touches], wrong=[1, 0, 0, 0])

    efforts = tuple(Effort(rounds=1, size=n, spread=0.1, patience=1) for n in (30, 10))
    rng = np.random.default_rng(0)
    oracle.search(play, [np.zeros(PLAN)], "fingers", efforts, rng)
    assert len(tried) == 1 + size


def test_a_plan_that_only_brushes_another_object_is_more_promising_than_none():
    brushes = outcome([0, 3, 3, 3], wrong=[0, 1, 0, 0])
    nothing = outcome([0, 0, 0, 0])
    assert brushes.score("fingers") == 2.25 + 0.25 - (1 + 8 / 4) < 0
    assert brushes.promise("fingers") > nothing.promise("fingers")
    assert brushes.promise("fingers") == 2.25 + 0.5 - 2 / 4


def test_a_mirrored_plan_exchanges_the_sides_within_the_joints_limits(stage):
    controller = stage._env.agent.controller
    low, high = controller.lower.numpy(), controller.upper.numpy()
    half = len(JOINTS) // 2
    plan = np.concatenate([np.arange(2 * len(JOINTS)), [0.25]])
    twin = oracle.mirror(plan)
    assert np.array_equal(oracle.mirror(twin), plan) and twin[-1] == 0.25
    sign = twin[:half] / plan[half : 2 * half]
    left = np.stack([low[:half], high[:half]])
    right = np.sort(sign * np.stack([low[half:], high[half:]]), axis=0)
    assert np.allclose(left, right, atol=1e-6)


def test_targets_move_no_faster_than_a_policy_can_move_them(stage):
    start = stage.start(SEED, 0, rebuild=False)
    sent = []
    step = stage._env.step
    stage._env.step = lambda action: sent.append(action) or step(action)
    try:
        stage.play(np.ones(PLAN), SEED, 0)
    finally:
        del stage._env.step
    assert max(action.abs().max() for action in sent) <= 1
    moved = stage._env.agent.get_proprioception()["target"][0].numpy()
    assert start.max() < 0.5 and np.allclose(moved, 1, atol=1e-5)


def test_a_plan_does_the_same_in_a_scene_built_anew_whatever_came_before(stage):
    plan = np.random.default_rng(1).uniform(-0.5, 0.5, PLAN)
    first = stage.play(plan, SEED, 0, rebuild=True)
    stage.play(-plan, SEED + 1, 1)
    again = stage.play(plan, SEED, 0, rebuild=True)
    assert np.array_equal(first.right, again.right) and first.nearness == again.nearness


@pytest.mark.parametrize("y, moving", [(0.1, "left"), (0.0, "both"), (-0.1, "right")])
def test_an_object_on_one_side_is_for_the_hand_of_that_side(y, moving):
    left, right = oracle.hands(np.array([0.2, y, 0.05]))[: 2 * SIDE].reshape(2, SIDE)
    assert left.all() == (moving != "right") and right.all() == (moving != "left")
    assert left.any() == left.all() and right.any() == right.all()


def test_a_shifted_plan_has_the_fingers_where_they_were_plus_the_offset(stage):
    stage.start(SEED, 0, rebuild=False)
    plan, offset = recorded_plan().plan, np.array([0.01, -0.01, 0.005])
    moved = stage.shifted(plan, offset)
    before, after = plan[: 2 * SIDE].clip(-1, 1), moved[: 2 * SIDE]
    miss = stage._fingers_at(after) - stage._fingers_at(before) - offset
    # Three fingers of a hand keep their form: an arm has five joints for six wishes.
    assert np.abs(miss).max() < 0.006
    fingers = np.setdiff1d(np.arange(2 * SIDE), oracle.ARM_INDEX)
    assert np.array_equal(after[fingers], before[fingers]) and moved[-1] == plan[-1]


def test_a_plan_for_the_other_side_is_a_start_once_mirrored(stage):
    stage.start(SEED, 0, rebuild=False)
    still = np.full(PLAN, 0.5)
    known = Known(np.linspace(-0.5, 0.5, PLAN), np.array([0.23, 0.08, 0.05]))
    place = known.place * [1, -1, 1]
    first, as_it_is, shifted = oracle.starts(stage, [known], place, still)
    assert first is still
    free = oracle.hands(place)
    assert np.array_equal(as_it_is[free], oracle.mirror(known.plan)[free])
    assert np.all(as_it_is[~free] == 0.5) and np.all(shifted[~free] == 0.5)
    assert np.allclose(shifted, as_it_is, atol=1e-4)  # it lies just there


def test_later_scenes_begin_with_what_was_found_before(stage):
    nothing = Effort(rounds=0, size=1, spread=0.1, patience=1)
    recorded, seeds = recorded_plan(), [recorded_figures()["plan_seed"], SEED + 3]
    efforts = Efforts(nothing, nothing, nothing)
    found = oracle.explore(stage, 0, seeds, "fingers", [recorded], efforts)
    assert [one.seed for one in found] == seeds
    assert all(one.outcome.right.mean() > 2 for one in found)
    figures = oracle.summary(found, "fingers")
    right = [one.outcome.right for one in found]
    assert figures["right_fingers"] == pytest.approx(np.mean(right))
    assert figures["episodes"] == 2


@pytest.mark.parametrize(
    ("goal", "changes", "is_kept"),
    [
        ("fingers", {"right_fingers": 2.1}, True),
        ("fingers", {"right_fingers": 1.9}, False),
        ("touching", {"right_fingers": 2.1}, False),
        ("touching", {"touching": 0.96}, True),
        ("fingers", {"right_fingers": 2.1, "exclusive": 0.5}, False),
        ("fingers", {"right_fingers": 2.1, "episodes": 4}, False),
    ],
)
def test_of_two_searches_of_the_same_scenes_the_better_one_stays(
    goal, changes, is_kept
):
    new = {"episodes": 2, "exclusive": 1.0, "touching": 0.95, "right_fingers": 2.0}
    old = {**new, **changes}
    assert (oracle.better(goal, new, old) is old) == is_kept
    assert oracle.better(goal, new, None) is new


def test_a_recorded_plan_still_does_what_it_did(stage):
    """If this fails, the scenes have changed: run scripts/oracle.py again."""
    record, figures = recorded_plan(), recorded_figures()
    done = stage.play(record.plan, figures["plan_seed"], 0, rebuild=True)
    assert done.exclusive
    assert done.right.mean() > 0.7 * figures["right_fingers"]


def recorded_figures():
    data = json.loads(oracle.OUT.read_text())
    return data[TASK]["instructions"]["Touch the blue cube."]["fingers"]


def recorded_plan():
    figures = recorded_figures()
    return Known(np.array(figures["plan"]), np.array(figures["plan_place"]))
