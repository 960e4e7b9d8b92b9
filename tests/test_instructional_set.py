"""Sentences become the tokens of the paper's vocabulary."""

import dataclasses
from random import Random

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scenes import HANDS

from ir_maniskill import experiment as catalog
from ir_maniskill.environment.arguments import instructions_of
from ir_maniskill.environment.instructional_set import InstructionalSet
from ir_maniskill.experiment import Experiment, TouchObject
from ir_maniskill.goals import Instruction, Ref, Touch
from ir_maniskill.language.tokens import PAD, UNK, VOCABULARY, split_words, tokenize

CPU = torch.device("cpu")


def test_the_papers_sentence_has_five_tokens_and_unknown_words_are_unk() -> None:
    assert tokenize("Touch the blue cube.") == [3, 4, 5, 8, 2]
    assert tokenize("Touch the purple, cube") == [3, 4, UNK, 8]


@given(st.text())
def test_any_text_gives_known_ids_and_never_padding(text: str) -> None:
    ids = tokenize(text)
    assert all(0 < token < len(VOCABULARY) for token in ids)


@given(
    st.lists(st.sampled_from(VOCABULARY[2:])),
    st.text(" _-,;!?'\n\t", min_size=1),
    st.randoms(use_true_random=False),
)
def test_tokens_name_their_words_in_any_case_and_spacing(
    words: list[str], between: str, random: Random
) -> None:
    text = "".join(random.choice((c, c.upper())) for c in between.join(words))
    assert [VOCABULARY[t] for t in tokenize(text)] == words


def test_shorter_sentences_are_padded_and_words_are_numbered_as_they_come() -> None:
    blue, red = TouchObject("blue", (0.2, 0.0)), TouchObject("red", (0.2, 0.1))
    both = Experiment(
        "Pad-v1",
        (blue, red),
        (
            Instruction("Touch the red cube.", Touch(Ref("red"))),
            Instruction("Blue, the...", Touch(Ref("blue"))),
        ),
    )
    instructions = InstructionalSet(both, HANDS, CPU)
    assert both.vocabulary[2:] == ("touch", "the", "red", "cube", ".", "blue")
    assert instructions.tokens[:2].tolist() == [[2, 3, 4, 5, 6], [7, 3, 6, 6, 6]]
    assert len(instructions) == 2 and not instructions.tokens[2:].any()
    short = Experiment("Pad-v1", (blue,), (Instruction("Blue", Touch(Ref("blue"))),))
    both = dataclasses.replace(
        both, instructions=both.instructions[:1] + short.instructions
    )
    assert InstructionalSet(both, HANDS, CPU).tokens[1].tolist() == [7, *[PAD] * 4]


@pytest.mark.parametrize(
    ("sentence", "words"),
    [
        ("Wu\u0308rfel", ["w\u00fcrfel"]),
        ("\u0928\u0940\u0932\u093e!", ["\u0928\u0940\u0932\u093e"]),
        ("l\u2019objet_bleu.", ["l", "objet", "bleu", "."]),
    ],
)
def test_words_of_any_script_stay_whole(sentence: str, words: list[str]) -> None:
    assert split_words(sentence) == words


def test_uniform_numbers_pick_every_instruction_equally() -> None:
    instructions = InstructionalSet(catalog.get("NaoTouchCubeMulti-v1"), HANDS, CPU)
    picks = instructions.pick(torch.tensor([0.0, 0.33, 0.34, 0.66, 0.67, 1.0]))
    assert picks.tolist() == [0, 0, 1, 1, 2, 2]


def test_a_word_that_is_not_in_the_vocabulary_is_warned_of_once(caplog) -> None:
    blue = TouchObject("blue", (0.20, 0.0))
    said = Instruction("Kindly, kindly touch the blue cube.", Touch(Ref("blue")))
    for _ in range(3):
        Experiment("Kind-v1", (blue,), (said,), vocabulary=VOCABULARY)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "'Kindly, kindly touch the blue cube.'" in caplog.text
    assert caplog.text.strip().endswith("not in the vocabulary: kindly")
    Experiment("Kind-v1", (blue,), (said,))  # its words are those of the sentence
    assert len(caplog.records) == 1


def test_words_that_a_task_does_not_know_are_warned_of_when_they_are_told(caplog):
    triangle = catalog.get("NaoTouchCubeTriangle-v1")
    instructions_of("Push the red cube left", triangle, 1)
    assert caplog.text.strip().endswith("not in the vocabulary: push, left")
