"""Splits: what training never says, and which words there are.

An object is described by a `Name`, its color and shape, either of which may be None.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from random import Random

from ir_maniskill.goals import (
    Avoid,
    Both,
    Goal,
    Instruction,
    Push,
    Ref,
    Relation,
    Then,
    Touch,
)
from ir_maniskill.language.grammar import load_json, parse, words_by_mark
from ir_maniskill.language.tokens import split_words

Name = tuple[str | None, str | None]

KINDS = ("touch", "hand", "push", "where", "both", "then")
"""What may be drawn. "where" has a relation, or something to leave alone."""

SPLITS = ("train", "wording", "objects", "pairs", "places")
"""What may be held out: `wording` changes sentences, `places` scenes, not goals."""

VERBS = {
    "touch": ("touch",),
    "hand": ("left hand", "right hand"),
    "push": ("push left", "push right", "push away"),
}
TEAMS = (("touch", "touch"), ("left hand", "right hand"), ("right hand", "left hand"))
"""Verbs that can be done at the same time."""

_GRAMMAR = load_json("grammar.json")
_HELD = _GRAMMAR["held_out"]
HELD_OBJECTS = frozenset((color, shape) for color, shape in _HELD["objects"])
"""Colors and shapes that are never named together in training, nor meant."""
HELD_PAIRS = frozenset((v, color) for v, cs in _HELD["pairs"].items() for color in cs)
"""Verbs and colors that never come together in training."""


# -- What is held out ------------------------------------------------------------------


@cache
def status(verb: str, color: str | None, shape: str | None) -> str | None:
    """Return the split of a verb and an object so described; None: two are new."""
    objects, pairs = (color, shape) in HELD_OBJECTS, (verb, color) in HELD_PAIRS
    if objects and pairs:
        return None
    return "objects" if objects else "pairs" if pairs else "train"


def split_of(goal: Goal) -> str | None:
    """Return the split whose sentences ask for a goal: train, objects or pairs.

    None: none of them, as more than one thing is new in it. This reads the goal alone;
    `draw` also minds what a "red one" is in its scene.
    """
    acts = [(verb, (ref.color, ref.shape)) for verb, ref in acts_of(goal)]
    named = {(r.color, r.shape) for r in refs_of(goal)}
    new = {status(verb, *name) for verb, name in acts} - {"train"}
    beside = named - {name for _, name in acts}
    if beside & HELD_OBJECTS or len(new) > 1:
        return None
    return new.pop() if new else "train"


def kind_of(goal: Goal) -> str:
    """Return which of `KINDS` a goal of the language is."""
    match goal:
        case Then():
            return "then"
        case Both(_, Avoid()):
            return "where"
    if any(ref.where is not None for ref in goal.refs):
        return "where"
    match goal:
        case Push():
            return "push"
        case Touch(_, hand):
            return "hand" if hand else "touch"
    return "both"


def acts_of(goal: Goal) -> list[tuple[str, Ref]]:
    """Return the verbs in a goal, each with the object that it is done to."""
    match goal:
        case Touch(ref, hand):
            return [(f"{hand} hand" if hand else "touch", ref)]
        case Push(ref, direction):
            return [(f"push {direction}", ref)]
    return [found for part in goal.parts for found in acts_of(part)]


def refs_of(goal: Goal) -> list[Ref]:
    """Return the references in a goal, and those in their relations."""
    return [found for ref in goal.refs for found in _with_landmarks(ref)]


def _with_landmarks(ref: Ref) -> list[Ref]:
    beside = _with_landmarks(ref.where.ref) if isinstance(ref.where, Relation) else []
    return [ref, *beside]


# -- Words -----------------------------------------------------------------------------

EMPTY = frozenset(_GRAMMAR["empty"])
"""Words that a sentence of training means the same without."""
LEFT_OUT, UNKNOWN = 0.5, 0.15
"""How likely `loosely` leaves out such a word, and has `NOISE` in its place."""
NOISE = "xyz"
"""A word that is read as `<unk>`."""


def loosely(sentence: str, rng: Random) -> str:
    """Return a sentence as if typed in haste, and with words that nobody knows.

    A sentence written by hand for the split `wording` never comes of it.
    """
    said = []
    for word in split_words(sentence):
        luck = rng.random() if word in EMPTY else 1.0
        if luck >= LEFT_OUT:
            said.append(NOISE if luck < LEFT_OUT + UNKNOWN else word)
    return sentence if _core(said) in _written() else " ".join(said)


def _core(words: Iterable[str]) -> tuple[str, ...]:
    return tuple(word for word in words if word not in (".", NOISE))


@cache
def _written() -> frozenset[tuple[str, ...]]:
    return frozenset(_core(split_words(i.text)) for i in handwritten())


@cache
def handwritten() -> tuple[Instruction, ...]:
    """Return the sentences of `wording.json`: written by hand, never said in training.

    Some are typed as people type. `parse` does not understand them all.
    """
    return tuple(
        Instruction(text, parse(meaning))
        for meaning, texts in load_json("wording.json").items()
        for text in texts
    )


@cache
def words() -> tuple[str, ...]:
    """Return `<pad>`, `<unk>`, and all words that training's sentences may have."""
    return words_by_mark("train")
