"""Experiments are checked where they are made, and the catalog keeps them apart."""

import dataclasses
import json

import gymnasium as gym
import pytest
from hypothesis import given
from hypothesis import strategies as st

import ir_maniskill
from ir_maniskill import experiment as catalog
from ir_maniskill.experiment import (
    COLORS,
    Experiment,
    ExperimentError,
    Instruction,
    Jitter,
    TouchObject,
    UnknownExperimentError,
    touch_instructions,
)

IDS = (
    "NaoTouchCubeMulti-v1",
    "NaoTouchButtonMulti-v1",
    "NaoTouchCubeShuffled-v1",
    "NaoTouchButtonShuffled-v1",
    "NaoTouchCubeSingle-v1",
    "NaoTouchButtonSingle-v1",
    "NaoTouchCubeTriangle-v1",
    "NaoTouchButtonTriangle-v1",
)
BLUE = TouchObject("blue", (0.20, 0.0))
RED = TouchObject("red", (0.20, 0.10))


def make(**changes: object) -> Experiment:
    """Return a sound experiment with some fields changed."""
    sound = Experiment("Sound-v1", (BLUE, RED), touch_instructions((BLUE, RED)))
    return dataclasses.replace(sound, **changes)


def test_import_registers_the_eight_tasks() -> None:
    assert set(IDS) <= set(ir_maniskill.available())
    assert all(task_id in gym.registry for task_id in IDS)


def test_registered_tasks_take_json_able_arguments() -> None:
    for task_id in IDS:
        json.dumps(gym.spec(task_id).kwargs)


def test_the_papers_experiments_are_as_the_paper_says() -> None:
    single = catalog.get("NaoTouchCubeSingle-v1")
    triangle = catalog.get("NaoTouchCubeTriangle-v1")
    assert single.sentences == ("Touch the blue cube.",)
    assert (single.reward, single.wrong_penalty) == ("binary", 0.0)
    assert single.senses == ("vision",)
    assert len(catalog.get("NaoTouchCubeMulti-v1").instructions) == 3
    assert (triangle.reward, triangle.wrong_penalty) == ("per_finger", 0.1)
    assert "proprioception" in triangle.senses
    assert {e.episode_steps for e in map(catalog.get, IDS)} == {32}


def test_unknown_id_lists_what_there_is() -> None:
    with pytest.raises(UnknownExperimentError) as error:
        catalog.get("NaoTouchCubeSolo-v1")
    assert "'NaoTouchCubeSolo-v1'" in str(error.value)
    assert all(task_id in str(error.value) for task_id in IDS)


def test_an_id_cannot_be_taken_twice() -> None:
    single = catalog.get("NaoTouchCubeSingle-v1")
    catalog.add(single)  # the same again is fine
    with pytest.raises(ExperimentError, match="is taken"):
        catalog.add(dataclasses.replace(single, episode_steps=64))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"id": "no version"}, "experiment id: got 'no version'"),
        ({"reward": "loud"}, "reward: got 'loud', available: binary, per_finger"),
        ({"wrong_penalty": -1.0}, "wrong_penalty: got -1.0"),
        ({"episode_steps": 0}, "episode_steps: got 0"),
        ({"senses": ("smell",)}, "sense: got 'smell'"),
        ({"instructions": ()}, "instructions: got none"),
        ({"instructions": (Instruction("Go.", "sky"),)}, "target: got 'sky'"),
        ({"instructions": (Instruction(" ", "red cube"),)}, "an empty sentence"),
        ({"objects": ()}, "at least one"),
        ({"objects": (BLUE, BLUE)}, "no two alike"),
        ({"vocabulary": ("touch", "the")}, "vocabulary: got"),
    ],
)
def test_malformed_experiments_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(ExperimentError, match=message):
        make(**changes)


@pytest.mark.parametrize(
    ("position", "message"),
    [
        ((0.38, 0.0), "m from the nearest shoulder"),
        ((0.11, 0.0), "not wholly on the table"),
        ((0.20, 0.05), "may overlap"),
        ((float("nan"), 0.0), "two finite numbers"),
    ],
)
def test_layouts_that_cannot_work_are_refused(
    position: tuple[float, float], message: str
) -> None:
    with pytest.raises(ExperimentError, match=message):
        make(objects=(TouchObject("blue", position), RED))


@pytest.mark.parametrize("field", ["position", "yaw", "joints"])
def test_jitter_is_bounded(field: str) -> None:
    with pytest.raises(ExperimentError, match=rf"jitter\.{field}: got -1"):
        Jitter(**{field: -1})


@given(
    places=st.lists(
        st.tuples(st.floats(0.0, 0.5), st.floats(-0.4, 0.4)), min_size=1, max_size=4
    ),
    jitter=st.floats(0, 0.05),
)
def test_whatever_is_accepted_can_be_reached_and_does_not_overlap(
    places: list[tuple[float, float]], jitter: float
) -> None:
    objects = tuple(map(TouchObject, COLORS, places))
    try:
        made = make(
            objects=objects,
            instructions=touch_instructions(objects),
            jitter=Jitter(position=jitter),
        )
    except ExperimentError:
        return
    for i, a in enumerate(made.objects):
        x, y = a.position
        assert x - 0.02 - jitter >= 0.10
        assert x + 0.02 + jitter <= 0.40
        nearest = min((x**2 + (y - s) ** 2) ** 0.5 for s in (0.098, -0.098))
        assert nearest <= 0.255 + 1e-6
        for b in made.objects[:i]:
            dx, dy = x - b.position[0], y - b.position[1]
            assert (dx**2 + dy**2) ** 0.5 > 0.04
