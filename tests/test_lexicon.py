"""Words that were never learned: read as learned ones, and what policies make of it."""

import dataclasses
import json
import runpy
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from toy_envs import SPEC, toy_config, toy_state

from ir_maniskill.agent import Agent, language_system
from ir_maniskill.agent.agent import asks
from ir_maniskill.agent.config import AgentConfig
from ir_maniskill.agent.language_system import LexiconTransformer, TokenTransformer
from ir_maniskill.environment.senses import text_of, tokens_of
from ir_maniskill.language import handwritten, words
from ir_maniskill.language.grammar import RULES, SAID, words_by_mark
from ir_maniskill.language.lexicon import Lexicon, function_words, word_vectors
from ir_maniskill.language.tokens import split_words, words_of
from ir_maniskill.training import checkpoint

ROOT = Path(__file__).parents[1]
LEXICON = Lexicon(words())
SMALL = ("<pad>", "<unk>", "touch", "the", "red", "blue", "purple", "cube")


def read(sentence):
    """Return the words that a sentence is read as, `_` where it is not understood."""
    shares = map(LEXICON.read, sentence.lower().split())
    return " ".join(next(iter(share), "_") for share in shares)


@pytest.mark.parametrize(
    ("sentence", "as_"),
    [
        ("touch the left cube", "touch the left cube"),
        ("shove the crimson block", "push the red block"),
        ("tuch teh red cubee", "touch _ red cube"),
        ("pruple buttn", "purple button"),
        ("touched both cubes leftwards", "touch both cube left"),
        ("the government sings tuesday", "the _ _ _"),
        ("rihgt", "right"),  # no word at all, so that a letter is wrong
        ("rde", "_"),  # three letters could be anything
    ],
)
def test_words_are_read_as_the_nearest_known_ones(sentence, as_):
    assert read(sentence) == as_


def test_function_words_are_never_read_as_others():
    for word in function_words():
        expected = {word: 1.0} if word in words() else {}
        turned = word.removesuffix("s").removesuffix("ward")
        assert LEXICON.read(word) in (expected, {turned: 1.0}), word
    # Words of one letter's difference, and of much the same use.
    assert not any(map(LEXICON.read, ("never", "before", "besides", "when", "light")))
    mixed = {known for word in word_vectors()[0] for known in LEXICON.read(word)}
    assert mixed >= {"red", "push", "cube"}
    read_as = [w for w in word_vectors()[0] if {"left", "not"} & LEXICON.read(w).keys()]
    assert {*read_as} <= {"left", "not", "leftward", "leftwards"}


def test_shares_are_a_softmax_over_the_nearest():
    shares = LEXICON.read("violet")
    assert len(shares) == 3 and sum(shares.values()) == pytest.approx(1)
    assert [*shares][:2] == ["purple", "blue"]
    assert sorted(shares.values(), reverse=True) == [*shares.values()]


@given(st.text() | st.text("abcdelrtu ", max_size=40))
def test_any_text_is_read_as_known_words(text):
    few = Lexicon(("<pad>", "<unk>", "."))
    assert set(few.ids(text)) <= {1, 2}
    ids = LEXICON.ids(text)
    assert len(ids) == len(split_words(text))
    assert all(1 <= i < len(words()) + len(LEXICON.mixtures) for i in ids)


def test_the_files_fit_each_other():
    places, vectors = word_vectors()
    assert vectors.shape == (len(places), 53)
    assert set(words_by_mark(*SAID)[3:]) - places.keys() <= {"leftwards", "rightwards"}


# -- The encoder -----------------------------------------------------------------------


def encoder(name, vocabulary=SMALL, **changes):
    torch.manual_seed(0)
    config = AgentConfig(vocabulary=vocabulary, language=name, **changes)
    return language_system.encoder_of(config)(config)


def test_known_words_are_read_as_by_the_paper():
    said = ["Touch the red cube", "touch the blue", "cube"]
    plain, other = encoder("tokens"), encoder("lexicon")
    assert isinstance(other, LexiconTransformer) and isinstance(plain, TokenTransformer)
    assert torch.equal(plain(tokens_of(said, SMALL, 6)), other(text_of(said)))
    assert plain.state_dict().keys() == other.state_dict().keys()


def test_an_unknown_word_is_the_mixture_of_its_neighbors():
    system = encoder("lexicon")
    told = system(text_of(["touch violet", "touch purple", "touch government"]))
    shares = Lexicon(SMALL).read("violet")
    mixed = sum(s * system.words.weight[SMALL.index(w)] for w, s in shares.items())
    with torch.no_grad():
        system.words.weight[SMALL.index("purple")] = mixed
    again = system(text_of(["touch purple"]))
    assert torch.allclose(told[0], again[0], atol=1e-5)
    assert not torch.allclose(told[0], told[1], atol=1e-3)
    unknown = torch.tensor([[SMALL.index("touch"), SMALL.index("<unk>")]])
    assert torch.allclose(told[2], TokenTransformer.forward(system, unknown)[0])


def test_the_lexicon_is_there_before_threads_ask_for_it():
    language_system.lexicon.cache_clear()
    encoder("lexicon")
    assert language_system.lexicon.cache_info().currsize == 1


def test_gradients_reach_the_words_that_are_mixed():
    system = encoder("lexicon")
    system(text_of(["violet"])).sum().backward()
    moved = system.words.weight.grad.abs().sum(dim=1).nonzero().flatten().tolist()
    assert moved == [
        SMALL.index(w) for w in SMALL if w in Lexicon(SMALL).read("violet")
    ]


def test_the_encoder_takes_other_dtypes_and_no_sentence_at_all():
    system = encoder("lexicon").double()
    assert system(text_of(["crimson cube"])).dtype == torch.double
    assert system(text_of(["", ""])).shape == (2, system.width)
    with pytest.raises(ValueError, match="sentence of 5 tokens, expected at most 4"):
        encoder("lexicon", language_length=4)(text_of(["touch the red cube now"]))


def test_a_policy_file_keeps_how_it_reads(tmp_path):
    config = toy_config(tmp_path)
    config = dataclasses.replace(
        config, agent=dataclasses.replace(config.agent, language="lexicon")
    )
    agent = Agent(config.agent, SPEC)
    assert asks(agent.config) == ("text",)
    checkpoint.save_policy(tmp_path / "p", agent, config, steps=1, evaluation={})
    loaded, *_ = checkpoint.load_agent(tmp_path / "p")
    state = toy_state() | {"text": text_of(["tuch crimson", "touch blue", "touch"])}
    assert torch.allclose(loaded.policy(state), agent.policy(state), atol=1e-2)
    blue = state | {"text": text_of(["touch azure"] * 3)}
    assert (loaded.policy(state) != loaded.policy(blue)).any()


# -- How well words are read -----------------------------------------------------------


SYMBOLS = {
    **{"color": "color", "shape": "shape", "thing": "thing", "to_touch": "verb"},
    **{"to_push": "verb", "direction": "direction", "before": "extreme"},
}
"""What the grammar calls words, and what the page calls them."""


def meanings(mark):
    """Return kind and meaning of single words: "crimson" is a color, red."""
    return {
        phrase.items[0]: (kind, phrase.key or symbol.removeprefix("to_"))
        for symbol, kind in SYMBOLS.items()
        for phrase in RULES[symbol]
        if phrase.mark == mark and len(phrase.items) == 1
    }


def nearest(word):
    return next(iter(LEXICON.read(word)), None)


def test_words_that_it_was_tuned_on_are_not_those_of_the_split():
    other = json.loads((ROOT / "tests" / "data" / "other_words.json").read_text())
    written = words_of(each.text for each in handwritten())
    known = {*words_by_mark("train", "wording"), *written}
    assert not {w for group in other.values() for w in group} & known
    known = {word: meaning for word, (_, meaning) in meanings("train").items()}
    known["touching"] = "touch"
    unrelated = other.pop("unrelated")
    read = {word: nearest(word) for group in other.values() for word in group}
    right = sum(known.get(read[w]) == m for m in other for w in other[m])
    assert right >= 70 and sum(map(bool, read.values())) - right <= 6
    assert sum(map(bool, map(LEXICON.read, unrelated))) <= 1


@pytest.mark.parametrize("kind", sorted(set(SYMBOLS.values())))
def test_the_table_of_the_page_is_what_is_measured(kind):
    known, held = meanings("train"), meanings("wording")
    meant = {w: m for w, m in held.items() if m[0] == kind and w not in words()}
    read = {word: nearest(word) for word in meant}
    unread = [*read.values()].count(None)
    right = sum(known.get(read[word]) == meaning for word, meaning in meant.items())
    row = f"| {kind} | {right} | {len(meant) - right - unread} | {unread} |"
    assert row in (ROOT / "docs" / "language.md").read_text()


# -- An encoder of one's own -----------------------------------------------------------


def test_any_function_from_sentences_to_vectors_can_be_the_encoder(monkeypatch):
    monkeypatch.setattr(language_system, "_ENCODERS", dict(language_system._ENCODERS))
    embedded = []

    def embed(sentences):
        embedded.extend(sentences)
        return torch.tensor([[len(s), s.count("e")] for s in sentences]).float()

    example = runpy.run_path(str(ROOT / "examples" / "sentence_encoder.py"))
    language_system.register("lengths", example["encoder_from"](embed, 2, width=5))
    system = encoder("lengths")
    told = system(text_of(["Touch the cube.", "Go.", "Touch the cube."]))
    assert told.shape == (3, 5) and torch.equal(told[0], told[2])
    assert sorted(embedded) == ["Go.", "Touch the cube."]  # each once
    told.sum().backward()
    assert system.layer[0].weight.grad.abs().sum() > 0
