"""Reading: what a typed sentence means in the scene, and what the policy is told."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from ir_maniskill.environment.senses import TEXT_BYTES
from ir_maniskill.goals import (
    COLORS,
    SHAPES,
    Avoid,
    Both,
    Goal,
    GoalError,
    Instruction,
    Push,
    Ref,
    Then,
    Touch,
)
from ir_maniskill.language import SentenceError, parse
from ir_maniskill.language.tokens import split_words
from ir_maniskill.snapshot import Snapshot

LONGEST = TEXT_BYTES - 8
"""Of a sentence no more is heard [byte]."""


EXPECTED = 7
"""How many of the words that were expected are told at most, beyond the first."""


@dataclass(frozen=True)
class Reading:
    """How a sentence was understood."""

    heard: str
    """As it was typed, less what no sentence has."""
    said: str
    """What the policy is told."""
    goal: Goal | None
    """What it is judged by; None: nobody knows what it asks for."""
    meaning: str
    """The goal in plain words; without one, why there is none."""
    objects: tuple[int, ...]
    """Places of the objects meant among the scene's."""
    unknown: tuple[str, ...]
    """Words of `said` that the policy never learned."""


def clean(text: str) -> str:
    """Return typed text on one line, without what cannot be written."""
    kept = (c if unicodedata.category(c)[0] != "C" else " " for c in text[:10_000])
    line = " ".join("".join(kept).split())
    return line.encode()[:LONGEST].decode(errors="ignore").strip()


def read(
    text: str,
    known: Sequence[Instruction],
    scene: Snapshot,
    vocabulary: Sequence[str] | None = None,
) -> Reading:
    """Read a sentence in a scene as it is now.

    One that asks for what a sentence of the task asks for, in other words than the
    policy knows, is told to it as that sentence.

    Args:
        text: Anything that was typed, with at least one word.
        known: Sentences of the task.
        scene: One scene.
        vocabulary: Words that the policy knows; None: it does not listen.
    """
    heard = clean(text)
    scene = replace(scene, start=scene.pose)
    same = [i for i in known if _words(i.text) == _words(heard)]
    try:
        goal = same[0].goal if same else parse(heard)
        meant = grounded(goal, scene)
    except GoalError as error:
        return Reading(heard, heard, None, _why(error), (), _new(heard, vocabulary))
    said = same[0].text if same else heard
    if not same and _new(heard, vocabulary):
        alike = (i.text for i in known if _means(i.goal, scene) == meant)
        said = next(alike, heard)
    objects = tuple(dict.fromkeys(_objects(meant)))
    unknown = _new(said, vocabulary)
    return Reading(heard, said, goal, in_words(meant, names(scene)), objects, unknown)


def _words(text: str) -> list[str]:
    return [word for word in split_words(text) if word != "."]


def _new(text: str, vocabulary: Sequence[str] | None) -> tuple[str, ...]:
    known = split_words(text) if vocabulary is None else vocabulary
    return tuple(dict.fromkeys(w for w in _words(text) if w not in known))


def _why(error: GoalError) -> str:
    """Return what is wrong with a sentence, with a few of the words that would do."""
    if not isinstance(error, SentenceError):
        return str(error)
    _, _, complaint = str(error).partition(": ")
    first, *more = complaint.split(", ")
    return ", ".join([first, *more[:EXPECTED]]) + ", ..." * (len(more) > EXPECTED)


# -- Meaning ---------------------------------------------------------------------------


def grounded(goal: Goal, scene: Snapshot) -> tuple[Any, ...]:
    """Return a goal's kind and fields, each reference as the place of its object.

    Raises:
        GoalError: A reference does not fit exactly one object.
    """
    values = (getattr(goal, field.name) for field in fields(goal))
    return type(goal), *(_grounded(value, scene) for value in values)


def _grounded(value: Any, scene: Snapshot) -> Any:
    if isinstance(value, Goal):
        return grounded(value, scene)
    if not isinstance(value, Ref):
        return value
    fits = value.resolve(scene)[0].nonzero().flatten().tolist()
    if len(fits) != 1:
        here = ", ".join(n for n in names(scene) if n)
        raise GoalError(f"{_spoken(value)} fits {len(fits)} objects here, of: {here}")
    return _Object(fits[0])


class _Object(int):
    """Place of an object among those of a scene."""


def _means(goal: Goal, scene: Snapshot) -> tuple[Any, ...] | None:
    try:
        return grounded(goal, scene)
    except GoalError:
        return None


def _objects(meant: tuple[Any, ...]) -> list[int]:
    found: list[int] = []
    for value in meant:
        if isinstance(value, tuple):
            found += _objects(value)
        elif isinstance(value, _Object):
            found.append(int(value))
    return found


def names(scene: Snapshot) -> list[str]:
    """Return what the objects of a scene are called, "" where there is none."""
    pairs = zip(scene.color[0].tolist(), scene.shape[0].tolist(), strict=True)
    colors = list(COLORS)
    return [f"{colors[c]} {SHAPES[s]}" if c >= 0 else "" for c, s in pairs]


def in_words(meant: tuple[Any, ...], names: Sequence[str]) -> str:
    """Return a grounded goal in plain words, as short as its kind allows."""
    kind, *values = meant
    said = [in_words(v, names) if isinstance(v, tuple) else v for v in values]
    said = [f"the {names[v]}" if isinstance(v, _Object) else v for v in said]
    if kind is Touch:
        hand = f" with the {said[1]} hand" if said[1] else ""
        return f"touch {said[0]}{hand}"
    if kind is Push:
        way = "away" if said[1] == "away" else f"to the {said[1]}"
        return f"push {said[0]} {way}"
    if kind is Avoid:
        return f"leave {said[0]} alone"
    if kind in (Both, Then):
        return f"{said[0]}{' and ' if kind is Both else ', then '}{said[1]}"
    return f"{kind.__name__.lower()} {', '.join(map(str, said))}"


def _spoken(ref: Ref) -> str:
    where = ref.where if isinstance(ref.where, str | None) else ref.where.kind
    parts = (where, ref.color, ref.shape or "object")
    return "the " + " ".join(part.replace("_", " ") for part in parts if part)
