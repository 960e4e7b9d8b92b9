"""The controls take away what they say, and nothing else."""

import controls
import pytest
import torch

from ir_maniskill.environment.senses import tokens_of
from ir_maniskill.experiment import get

TASK = get("NaoTouchCubeTriangle-v1")
TOKENS = tokens_of(TASK.sentences, TASK.vocabulary)


def state(told=0):
    body = {key: torch.ones(2, 3) for key in ("proprioception", "target", "touch")}
    images = torch.full((2, 3, 2, 4, 4, 3), 9, dtype=torch.uint8)
    return {**body, "images": images, "instruction": TOKENS[[told, 0]]}


@pytest.mark.parametrize(
    "name, taken",
    [
        ("nothing taken away", set()),
        ("black pictures", {"images"}),
        ("without touch", {"touch"}),
        ("without joint positions and targets", {"proprioception", "target"}),
    ],
)
def test_a_control_blanks_what_it_names_and_nothing_else(name, taken):
    before = state()
    after = controls.controls(TASK)[name](before)
    changed = {key for key in before if not torch.equal(after[key], before[key])}
    assert changed == taken
    assert all(not after[key].any() for key in taken)
    assert after.keys() == before.keys() and before["images"].all()


@pytest.mark.parametrize("told, instead", [(0, 1), (1, 2), (2, 0)])
def test_another_sentence_is_never_the_true_one(told, instead):
    after = controls.controls(TASK)["the sentence of another object"](state(told))
    assert torch.equal(after["instruction"], TOKENS[[instead, 1]])


def test_a_constant_sentence_is_the_first_whatever_was_told():
    after = controls.controls(TASK)["always the first sentence"](state(told=2))
    assert torch.equal(after["instruction"], TOKENS[[0, 0]])


def test_a_task_of_one_sentence_has_no_other_to_give():
    assert not any(
        "sentence" in n for n in controls.controls(get("NaoTouchCubeSingle-v1"))
    )


def test_a_sense_that_the_policy_lacks_cannot_be_taken():
    blind = {k: v for k, v in state().items() if k != "images"}
    assert controls.without("images")(blind).keys() == blind.keys()
