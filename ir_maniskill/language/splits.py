"""Splits: what training never says, which words there are, and how many sentences.

An object is described by a `Name`, its color and shape, either of which may be None.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from functools import cache
from itertools import product

from ir_maniskill.goals import (
    COLORS,
    EXTREMES,
    FIXED,
    RELATIONS,
    SHAPES,
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
from ir_maniskill.language.grammar import count, load_json, parse, words_by_mark
from ir_maniskill.language.tokens import words_of

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

_HELD = load_json("grammar.json")["held_out"]
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


def act(verb: str, name: Name, where: str | Relation | None = None) -> Touch | Push:
    """Return the goal of doing one of `VERBS` to an object."""
    first, _, last = verb.partition(" ")
    ref = Ref(*name, where)
    return Push(ref, last) if first == "push" else Touch(ref, first if last else None)


def can(verb: str, name: Name) -> bool:
    """Return whether a verb can be done to an object so described."""
    return not (verb in VERBS["push"] and name[1] in FIXED)


def split_of(goal: Goal) -> str | None:
    """Return the split whose sentences ask for a goal: train, objects or pairs.

    None: none of them, as more than one thing is new in it. This reads the goal alone;
    `draw` also minds what a "red one" is in its scene.
    """
    acts = [(verb, (ref.color, ref.shape)) for verb, ref in acts_of(goal)]
    named = {(r.color, r.shape) for r in _refs(goal)}
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


def _refs(goal: Goal) -> list[Ref]:
    """Return the references in a goal, and those in their relations."""
    inner = [r.where.ref for r in goal.refs if isinstance(r.where, Relation)]
    return [*goal.refs, *inner]


# -- Words and sentences ---------------------------------------------------------------


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
def words(split: str = "train") -> tuple[str, ...]:
    """Return `<pad>`, `<unk>`, and all words that the sentences of a split may have."""
    if split != "wording":
        return words_by_mark("train")
    texts = words_of(instruction.text for instruction in handwritten())
    return tuple(dict.fromkeys((*words_by_mark("train", "wording"), *texts)))


def counts(
    split: str = "train", kinds: Collection[str] = KINDS
) -> dict[str, tuple[int, int]]:
    """Return how many goals and sentences a split has, by kind.

    Goals count that can be said; a few of them are true of no scene.
    """
    new = split if split in ("objects", "pairs") else "train"
    sizes = {
        kind: [count(g, split == "wording") for g in _goals(kind) if split_of(g) == new]
        for kind in kinds
    }
    return {kind: (len(found), sum(found)) for kind, found in sizes.items()}


NAMES: tuple[Name, ...] = (*product(COLORS, (None, *SHAPES)), *product([None], SHAPES))
"""All descriptions without a relation."""


def _covers(name: Name, other: Name) -> bool:
    """Return whether all that fits the other description fits this one."""
    return all(a in (None, b) for a, b in zip(name, other, strict=True))


def _goals(kind: str) -> Iterator[Goal]:
    """Yield all goals of a kind, less those that name one object twice."""
    every = [verb for group in VERBS.values() for verb in group]
    apart = [
        (name, other)
        for name, other in product(NAMES, NAMES)
        if not (_covers(name, other) or _covers(other, name))
    ]
    if kind in VERBS:
        yield from (act(*a) for a in product(VERBS[kind], NAMES) if can(*a))
    elif kind == "where":
        for verb, (name, other) in product(every, apart):
            if can(verb, name):
                yield Both(act(verb, name), Avoid(Ref(*other)))
        for verb, name in product(every, (*NAMES, (None, None))):
            if can(verb, name):
                yield from (act(verb, name, where) for where in _wheres(name))
    else:
        both = kind == "both"
        for (v, w), (n, m) in product(TEAMS if both else product(every, every), apart):
            if can(v, n) and can(w, m):
                yield (Both if both else Then)(act(v, n), act(w, m))


def _wheres(name: Name) -> Iterator[str | Relation]:
    yield from EXTREMES
    for kind, other in product(RELATIONS, NAMES):
        if not _covers(other, name):
            yield Relation(kind, Ref(*other))
