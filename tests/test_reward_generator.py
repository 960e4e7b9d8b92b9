"""The paper's rewards, by hand, without a simulator."""

import dataclasses
import math
from itertools import product
from random import Random

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn.functional import one_hot

from ir_maniskill import experiment as catalog
from ir_maniskill.environment.reward_generator import (
    PUSH_LIMIT,
    DenseWeights,
    FingerCount,
    count_fingers,
    dense_reward,
    highest_reward,
    sparse_reward,
)

LINE = catalog.get("NaoTouchCubeMulti-v1")
TRIANGLE = catalog.get("NaoTouchCubeTriangle-v1")


def contact(*touching: tuple[int, int]) -> torch.Tensor:
    """Return contacts [1, 6, 3] with the given (finger, object) pairs on."""
    table = torch.zeros(1, 6, 3, dtype=torch.bool)
    for finger, thing in touching:
        table[0, finger, thing] = True
    return table


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
def test_the_papers_rewards(
    touching: list[tuple[int, int]], binary: float, per_finger: float
) -> None:
    count = count_fingers(contact(*touching), torch.tensor([[False, True, False]]))
    assert sparse_reward(LINE, count).item() == pytest.approx(binary)
    assert sparse_reward(TRIANGLE, count).item() == pytest.approx(per_finger)


def test_each_env_is_counted_by_its_own_sentence() -> None:
    contacts = contact((3, 0), (4, 0), (5, 2)).repeat(3, 1, 1)
    count = count_fingers(contacts, torch.eye(3, dtype=torch.bool))
    assert count.right.tolist() == [2, 0, 1]
    assert count.wrong.tolist() == [1, 3, 2]


@given(st.integers(1, 5), st.integers(1, 6), st.integers(1, 4), st.integers(0, 2**31))
def test_counts_are_those_of_a_plain_loop(n: int, f: int, c: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    contacts = torch.rand(n, f, c, generator=generator) < 0.5
    target = torch.randint(c, (n,), generator=generator)
    count = count_fingers(contacts, one_hot(target, c).bool())
    for row in range(n):
        named = contacts[row, :, target[row]]
        others = [contacts[row, :, k] for k in range(c) if k != target[row]]
        wrong = torch.stack(others).any(0) if others else torch.zeros(f)
        assert (count.right[row], count.wrong[row]) == (named.sum(), wrong.sum())


def test_dense_reward_adds_reaching_and_takes_wrong_touches() -> None:
    weights = DenseWeights(reach=0.5, reach_scale=0.1, wrong=0.3, spoiled=0.2)
    count = FingerCount(torch.tensor([0, 0, 1, 1]), torch.tensor([0, 2, 0, 0]))
    distance = torch.tensor([[0.1, 0.3], [0.3, 0.0], [0.0, 0.0], [0.0, 0.0]])
    wrong_once = torch.tensor([False, True, False, True])
    reward = dense_reward(LINE, count, distance, torch.zeros(4), wrong_once, weights)
    at_scale = 0.5 * (1 - 0.7615942)
    assert reward.tolist() == pytest.approx([at_scale, 0.5 - 0.3, 1.5, 0.5 + 0.2])


def test_where_each_finger_counts_all_are_drawn_to_the_named_object() -> None:
    weights = DenseWeights(reach=0.0, gather=4.0, gather_scale=0.05)
    count = FingerCount(torch.tensor([0]), torch.tensor([0]))
    distance = torch.tensor([[0.0, 0.05, 0.5, 0.5]])
    rest = (torch.zeros(1), torch.tensor([False]), weights)
    drawn = dense_reward(TRIANGLE, count, distance, *rest)
    assert drawn.item() == pytest.approx(1.0 + (1 - 0.7615942), abs=1e-4)
    assert dense_reward(LINE, count, distance, *rest).item() == 0


def test_each_finger_can_count_in_the_line_too() -> None:
    count = FingerCount(torch.tensor([2]), torch.tensor([0]))
    rest = (torch.full((1, 6), 0.05), torch.zeros(1), torch.tensor([False]))
    weights = DenseWeights(each_finger=True)
    line = dense_reward(LINE, count, *rest, weights)
    free = dataclasses.replace(TRIANGLE, wrong_penalty=0.0)
    assert line.item() == dense_reward(free, count, *rest, DenseWeights()).item()
    assert line.item() > 1 + dense_reward(LINE, count, *rest, DenseWeights()).item()
    assert sparse_reward(LINE, count).item() == 1  # that of evaluations stays


def test_pushing_the_named_object_costs_by_its_speed_up_to_a_limit() -> None:
    weights = DenseWeights(reach=0.0, push=2.0)
    count = FingerCount(torch.tensor([1, 1, 1]), torch.tensor([0, 0, 0]))
    speed = torch.tensor([0.0, 0.1, 5.0])
    rest = (torch.zeros(3, dtype=torch.bool), weights)
    reward = dense_reward(LINE, count, torch.zeros(3, 2), speed, *rest)
    assert reward.tolist() == pytest.approx([1.0, 0.8, 0.4])


def test_highest_reward_bounds_the_dense_one() -> None:
    all_fingers = FingerCount(torch.tensor([6]), torch.tensor([0]))
    for experiment, each_finger in product((LINE, TRIANGLE), (False, True)):
        weights = DenseWeights(each_finger=each_finger)
        best = dense_reward(
            experiment,
            all_fingers,
            torch.zeros(1, 6),
            torch.zeros(1),
            torch.zeros(1, dtype=torch.bool),
            weights,
        )
        assert best.item() == pytest.approx(highest_reward(experiment, 6, weights))


def test_a_penalty_in_the_line_is_a_field_of_the_experiment() -> None:
    stern = dataclasses.replace(LINE, id="Stern-v1", wrong_penalty=0.5)
    count = FingerCount(torch.tensor([4]), torch.tensor([2]))
    assert sparse_reward(stern, count).item() == pytest.approx(0.0)


WEIGHTS = DenseWeights(push=2.0)
"""Weights of which all count."""


@dataclasses.dataclass(frozen=True)
class Scene:
    """What a step of N envs may look like."""

    contact: torch.Tensor  # [N, F, C]
    named: torch.Tensor  # [N, C]
    distance: torch.Tensor  # [N, F] [m]
    speed: torch.Tensor  # [N] [m/s]
    wrong_once: torch.Tensor  # [N]

    def reward(self, experiment: catalog.Experiment, **changes: object) -> torch.Tensor:
        """Return the dense reward, with some of this changed."""
        scene = dataclasses.replace(self, **changes)
        count = count_fingers(scene.contact, scene.named)
        rest = (scene.distance, scene.speed, scene.wrong_once, WEIGHTS)
        return dense_reward(experiment, count, *rest)


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """Draw a scene of up to 5 envs with 6 fingers and up to 4 objects."""
    n, c = draw(st.integers(1, 5)), draw(st.integers(1, 4))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    crowd = draw(st.floats(0, 1))
    return Scene(
        torch.rand(n, 6, c, generator=generator) < crowd,
        one_hot(torch.randint(c, (n,), generator=generator), c).bool(),
        torch.rand(n, 6, generator=generator),
        torch.rand(n, generator=generator),
        torch.rand(n, generator=generator) < 0.5,
    )


experiments = st.builds(
    lambda kind, penalty: dataclasses.replace(LINE, reward=kind, wrong_penalty=penalty),
    st.sampled_from(("binary", "per_finger")),
    st.floats(0, 10),
)


@given(scenes(), experiments)
def test_rewards_stay_within_their_bounds(
    scene: Scene, experiment: catalog.Experiment
) -> None:
    dense, most = scene.reward(experiment), highest_reward(experiment, 6, WEIGHTS)
    assert dense.isfinite().all()
    assert (dense <= most + 1e-6).all()
    prices = 6 * experiment.wrong_penalty + WEIGHTS.wrong + WEIGHTS.push * PUSH_LIMIT
    assert (dense >= -prices - 1e-5).all()


@given(scenes(), experiments, st.randoms())
def test_rewards_do_not_depend_on_how_envs_fingers_and_objects_are_numbered(
    scene: Scene, experiment: catalog.Experiment, random: Random
) -> None:
    n, f, c = scene.contact.shape
    rows, fingers, things = (random.sample(range(k), k) for k in (n, f, c))
    shuffled = Scene(
        scene.contact[rows][:, fingers][:, :, things],
        scene.named[rows][:, things],
        scene.distance[rows][:, fingers],
        scene.speed[rows],
        scene.wrong_once[rows],
    )
    expected = scene.reward(experiment)[rows]
    assert torch.allclose(shuffled.reward(experiment), expected, atol=1e-6)


@given(scenes(), experiments, st.floats(0, 1))
def test_coming_nearer_holding_still_and_sparing_the_others_never_costs(
    scene: Scene, experiment: catalog.Experiment, share: float
) -> None:
    reward = scene.reward(experiment)
    assert (scene.reward(experiment, distance=share * scene.distance) >= reward).all()
    assert (scene.reward(experiment, speed=share * scene.speed) >= reward).all()
    spared = torch.zeros_like(scene.wrong_once)
    assert (scene.reward(experiment, wrong_once=spared) >= reward).all()
    alone = scene.contact & scene.named[:, None]
    assert (scene.reward(experiment, contact=alone) >= reward - 1e-6).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("reach_scale", 0.0),
        ("gather_scale", 0.0),
        ("wrong", -1.0),
        ("reach", math.nan),
        ("spoiled", math.inf),
        ("spoiled", 1.5),
    ],
)
def test_weights_that_cannot_work_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"dense_weights: got {name}={value}"):
        DenseWeights(**{name: value})


def test_prices_grow_from_nothing() -> None:
    weights = DenseWeights(wrong=0.4, push=3.0, spoiled=0.2)
    free, half = weights.at_price(0.0), weights.at_price(0.5)
    assert (free.wrong, free.push, free.spoiled) == (0.0, 0.0, 1.0)
    assert (half.wrong, half.push, half.spoiled) == pytest.approx((0.2, 1.5, 0.6))
    assert (half.reach, half.gather) == (weights.reach, weights.gather)
    assert weights.at_price(1.0) == weights
