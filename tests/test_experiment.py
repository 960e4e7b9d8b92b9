"""Experiments are checked where they are made, and the catalog keeps them apart."""

import dataclasses
import pickle
import re

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scenes import HANDS

import ir_maniskill
from ir_maniskill import experiment as catalog
from ir_maniskill.environment.instructional_set import InstructionalSet
from ir_maniskill.experiment import (
    Drawn,
    Experiment,
    ExperimentError,
    Jitter,
    Spoken,
    TouchObject,
    touch_instructions,
)
from ir_maniskill.goals import (
    Both,
    GoalError,
    Instruction,
    Push,
    Ref,
    Touch,
    left_of,
    other_than,
)
from ir_maniskill.language.tokens import VOCABULARY

IDS = ir_maniskill.available()[:8]
BLUE = TouchObject("blue", (0.20, 0.0))
RED = TouchObject("red", (0.20, 0.10))
SOUND, PINK, CUBE = Touch(Ref("red")), Touch(Ref("purple")), Touch(Ref(shape="cube"))


def make(**changes: object) -> Experiment:
    """Return a sound experiment with some fields changed."""
    sound = Experiment("Sound-v1", (BLUE, RED), touch_instructions((BLUE, RED)))
    return dataclasses.replace(sound, **changes)


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
    with pytest.raises(ExperimentError) as error:
        catalog.get("NaoTouchCubeSolo-v1")
    assert "'NaoTouchCubeSolo-v1'" in str(error.value)
    assert all(task_id in str(error.value) for task_id in IDS)
    with pytest.raises(ExperimentError, match="module of the task: got './mine.py'"):
        catalog.get("./mine.py:Mine-v1")


def test_an_id_cannot_be_taken_twice() -> None:
    single = catalog.get("NaoTouchCubeSingle-v1")
    ir_maniskill.register(single)  # the same again is fine
    with pytest.raises(ExperimentError, match="is taken"):
        ir_maniskill.register(dataclasses.replace(single, episode_steps=64))


@pytest.mark.parametrize("task_id", ["PickCube-v1", "CartPole-v1"])
def test_an_id_of_another_package_is_taken(task_id: str) -> None:
    with pytest.raises(ExperimentError, match=f"got '{task_id}', which is taken"):
        ir_maniskill.register(make(id=task_id))
    assert task_id not in ir_maniskill.available()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"id": "no version"}, "experiment id: got 'no version'"),
        ({"reward": "loud"}, "reward: got 'loud', available: binary, per_finger"),
        ({"wrong_penalty": -1.0}, "wrong_penalty: got -1.0"),
        ({"episode_steps": 0}, "episode_steps: got 0"),
        ({"senses": ("smell",)}, "sense: got 'smell'"),
        ({"instructions": ()}, r"instructions: got \(\), expected at least one"),
        ({"instructions": (Instruction("Go.", PINK),)}, "fits: got 0, expected"),
        ({"instructions": (Instruction("Go.", CUBE),)}, "fits: got 2, expected"),
        ({"objects": ()}, "at least one"),
        ({"objects": (BLUE, BLUE)}, "no two alike"),
        ({"vocabulary": ("touch", "the")}, "vocabulary: got"),
        ({"vocabulary": (*VOCABULARY, "Car")}, "got 'Car', expected words in lower"),
        ({"vocabulary": (*VOCABULARY, "cube")}, "got 'cube', .* no two alike"),
        ({"vocabulary": "touch"}, r"vocabulary: got 'touch', expected \(str, ...\)"),
        ({"instructions": (Instruction("?!", SOUND),)}, "got '\\?!', expected a word"),
        ({"shuffled": "no"}, "shuffled: got 'no', expected a bool"),
        ({"jitter": 0.01}, "jitter: got 0.01, expected a Jitter"),
        ({"episode_steps": 32.0}, "episode_steps: got 32.0"),
    ],
)
def test_malformed_experiments_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(GoalError, match=message):
        make(**changes)


@pytest.mark.parametrize(
    ("position", "message"),
    [
        # With 1 cm of jitter a turned cube needs 0.04 / sqrt(2) + 0.01 m to an edge,
        # and 0.04 sqrt(2) + 2 sqrt(2) 0.01 m to another one.
        ((0.1382, 0.0), "not wholly on the table"),
        ((0.20, -0.302), "not wholly on the table"),
        ((0.20, 0.016), "may overlap: centers as close as 0.056 m"),
        ((float("nan"), 0.0), "two finite numbers"),
    ],
)
def test_layouts_that_cannot_work_are_refused(
    position: tuple[float, float], message: str
) -> None:
    with pytest.raises(GoalError, match=message):
        make(objects=(TouchObject("blue", position), RED))
    make(objects=(TouchObject("blue", (0.1384, -0.3016)), RED))
    make(objects=(TouchObject("blue", (0.20, 0.0149)), RED))


@pytest.mark.parametrize("field", ["position", "yaw", "joints"])
def test_jitter_is_bounded(field: str) -> None:
    with pytest.raises(ExperimentError, match=rf"jitter\.{field}: got -1"):
        Jitter(**{field: -1})


def test_sentences_that_the_learner_cannot_tell_apart_are_refused() -> None:
    things = (TouchObject("purple", (0.2, 0.0)), TouchObject("orange", (0.2, 0.1)))
    with pytest.raises(ExperimentError, match="the words that tell their goals"):
        Experiment(
            "Fruit-v1", things, touch_instructions(things), vocabulary=VOCABULARY
        )
    words = (*VOCABULARY, "purple")
    Experiment("Fruit-v1", things, touch_instructions(things), vocabulary=words)


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner).map(tuple) | st.dictionaries(st.text(), inner),
    max_leaves=4,
)


@pytest.mark.parametrize(
    "sound", [make(), BLUE, Jitter(), Drawn(), Spoken()], ids=lambda x: type(x)
)
@given(data=st.data())
def test_whatever_a_field_is_set_to_it_works_or_is_refused(
    sound: Experiment | TouchObject | Jitter | Drawn | Spoken, data: st.DataObject
) -> None:
    field = data.draw(st.sampled_from([f.name for f in dataclasses.fields(sound)]))
    value = data.draw(
        ANYTHING | st.sampled_from(("binary", 0.01, (0.2, -0.1), 32.0, 10**5))
    )
    try:
        made = dataclasses.replace(sound, **{field: value})
    except ExperimentError as error:
        what, got, _ = str(error).partition(": got ")
        about = rf"\b({field.removesuffix('s')}|drawn count)"
        assert got and re.search(about, what), str(error)
        return
    assert pickle.loads(pickle.dumps(made)) == made  # workers get it like this
    if isinstance(made, Experiment):
        assert isinstance(made.episode_steps, int) and 1 <= made.episode_steps <= 10**4
        assert 0 <= made.wrong_penalty <= 10
        assert isinstance(made.shuffled, bool)
        InstructionalSet(made, HANDS, torch.device("cpu"))


@pytest.mark.parametrize(("text", "goal"), [(3, SOUND), ("Go.", "red cube")])
def test_instructions_of_other_types_are_refused(text: object, goal: object) -> None:
    with pytest.raises(GoalError, match="got (3|'red cube'), expected a (str|G)"):
        Instruction(text, goal)


def test_a_relation_in_shuffled_places_is_left_to_the_reset() -> None:
    left = Instruction("Touch the left one.", Touch(Ref(where=left_of(Ref("blue")))))
    make(instructions=(left,))
    green = TouchObject("green", (0.20, -0.10))
    two = Instruction("Touch that.", Touch(Ref(where=other_than(Ref("blue")))))
    with pytest.raises(ExperimentError, match="fits: got 2, expected exactly"):
        make(objects=(BLUE, RED, green), instructions=(two,))
    make(objects=(BLUE, RED, green), instructions=(two,), shuffled=True)


def test_what_is_fixed_to_the_table_is_not_to_be_pushed() -> None:
    button = TouchObject("green", (0.20, -0.10), shape="button")
    push = Push(Ref("green"), "left")
    both = Instruction("Push green left, touch blue.", Both(push, Touch(Ref("blue"))))
    with pytest.raises(ExperimentError, match="it moves: got 'green button', expected"):
        make(objects=(BLUE, button), instructions=(both,))


def test_a_vocabulary_that_was_derived_is_derived_anew_when_replaced() -> None:
    single = catalog.get("NaoTouchCubeSingle-v1")
    blue = Instruction("Grab the banana.", Touch(Ref("blue")))
    derived = dataclasses.replace(single, vocabulary=())
    assert "banana" not in derived.vocabulary
    other = pickle.loads(
        pickle.dumps(dataclasses.replace(derived, instructions=(blue,)))
    )
    assert {"grab", "banana"} <= {*other.vocabulary}
    given = dataclasses.replace(single, instructions=(blue,), vocabulary=VOCABULARY)
    assert given.vocabulary == VOCABULARY
