"""The oracle plays by the policies' rules, and its search finds what there is."""

import json

import numpy as np
import oracle
import pytest
from oracle import PLAN, Effort, Outcome

from ir_maniskill.environment.robot.nao import JOINTS

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

    effort = Effort(rounds=40, size=64, spread=0.4)
    rng = np.random.default_rng(0)
    found = oracle.search(play, [np.zeros(PLAN)], "fingers", effort, rng)
    assert np.abs(found - wanted).mean() < 0.12


def test_the_search_never_ends_with_less_than_it_began_with():
    good = np.full(PLAN, 0.3)

    def play(plan):
        return outcome([int(np.array_equal(plan, good))] * 4, nearness=0)

    effort = Effort(rounds=3, size=8, spread=0.1)
    known = [np.zeros(PLAN), good]
    found = oracle.search(play, known, "fingers", effort, np.random.default_rng(0))
    assert np.array_equal(found, good)


def test_the_search_gives_up_where_nothing_gets_better():
    tried = []

    def play(plan):
        tried.append(plan)
        return outcome([0] * 4)

    effort = Effort(rounds=50, size=8, spread=0.1, patience=3)
    oracle.search(play, [np.zeros(PLAN)], "fingers", effort, np.random.default_rng(0))
    assert len(tried) == 1 + 3 * 8


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


def test_later_scenes_begin_with_what_was_found_before(stage):
    nothing = Effort(rounds=0, size=1, spread=0.1)
    recorded = recorded_plan()["plan"]
    found = oracle.explore(
        stage, 0, [SEED, SEED + 3], "fingers", [recorded], (nothing,) * 3
    )
    assert [one.seed for one in found] == [SEED, SEED + 3]
    assert all(np.array_equal(one.plan, recorded) for one in found)
    figures = oracle.summary(found, "fingers")
    right = [one.outcome.right for one in found]
    assert figures["right_fingers"] == pytest.approx(np.mean(right))
    assert figures["episodes"] == 2


@pytest.mark.parametrize("touched, tries", [(False, [30, 20]), (True, [20, 10])])
def test_where_no_known_plan_touches_the_search_is_wider(touched, tries):
    count = {SEED: 0, SEED + 3: 0}

    class Scene:
        def start(self, seed, instruction, rebuild):
            return np.zeros(len(JOINTS))

        def play(self, plan, seed, instruction, rebuild=False):
            count[seed] += 1
            return outcome([0, int(touched), 0, 0])

    efforts = tuple(Effort(rounds=1, size=size, spread=0.1) for size in (30, 20, 10))
    oracle.explore(Scene(), 0, list(count), "fingers", [], efforts)
    # Beside the search's own tries: each known plan twice at most, and the end result.
    extra = [n - wanted for n, wanted in zip(count.values(), tries, strict=True)]
    assert all(2 <= n <= 3 for n in extra)


def test_a_recorded_plan_still_does_what_it_did(stage):
    """If this fails, the scenes have changed: run scripts/oracle.py again."""
    record = recorded_plan()
    done = stage.play(record["plan"], record["plan_seed"], 0, rebuild=True)
    assert done.exclusive
    assert done.right.mean() > 0.7 * record["right_fingers"]


def recorded_plan():
    data = json.loads(oracle.OUT.read_text())
    figures = data[TASK]["instructions"]["Touch the blue cube."]["fingers"]
    return figures | {"plan": np.array(figures["plan"])}
