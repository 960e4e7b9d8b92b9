"""Reading: what a typed sentence means in the scene, and what the policy is told."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

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
    guesses: tuple[str, ...] = ()
    """What it takes some of them for, e.g. "crimson as red"."""


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
        alike = (i.text for i in known if _means(i.goal, meant, scene))
        said = next(alike, heard)
    objects = tuple(dict.fromkeys(_place(ref, scene) for ref in meant.refs))
    return Reading(heard, said, goal, in_words(meant), objects, _new(said, vocabulary))


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


def grounded(goal: Goal, scene: Snapshot) -> Goal:
    """Return a goal whose references say color and shape of the objects they fit.

    Raises:
        GoalError: A reference does not fit exactly one object.
    """
    plain: dict[str, Goal | Ref] = {}
    for name in (field.name for field in fields(goal)):
        value = getattr(goal, name)
        if isinstance(value, Goal):
            plain[name] = grounded(value, scene)
        elif isinstance(value, Ref):
            color, shape = names(scene)[_place(value, scene)].split()
            plain[name] = Ref(color, shape)
    return replace(goal, **plain)


def _place(ref: Ref, scene: Snapshot) -> int:
    """Return the place of the object that a reference fits among the scene's."""
    fits = ref.resolve(scene)[0].nonzero().flatten().tolist()
    if len(fits) != 1:
        here = ", ".join(n for n in names(scene) if n)
        raise GoalError(f"{_spoken(ref)} fits {len(fits)} objects here, of: {here}")
    return fits[0]


def _means(goal: Goal, meant: Goal, scene: Snapshot) -> bool:
    try:
        return grounded(goal, scene) == meant
    except GoalError:
        return False


def names(scene: Snapshot) -> list[str]:
    """Return what the objects of a scene are called, "" where there is none."""
    pairs = zip(scene.color[0].tolist(), scene.shape[0].tolist(), strict=True)
    colors = list(COLORS)
    return [f"{colors[c]} {SHAPES[s]}" if c >= 0 else "" for c, s in pairs]


def in_words(goal: Goal) -> str:
    """Return a goal in plain words, as short as its kind allows."""
    match goal:
        case Touch(ref, hand):
            return f"touch {_spoken(ref)}" + (f" with the {hand} hand" if hand else "")
        case Push(ref, way):
            return f"push {_spoken(ref)} {'away' if way == 'away' else f'to the {way}'}"
        case Avoid(ref):
            return f"leave {_spoken(ref)} alone"
        case Both(a, b):
            return f"{in_words(a)} and {in_words(b)}"
        case Then(a, b):
            return f"{in_words(a)}, then {in_words(b)}"
    objects = ", ".join(map(_spoken, goal.refs))
    return f"{type(goal).__name__.lower()} {objects}"


def _spoken(ref: Ref) -> str:
    where = ref.where if isinstance(ref.where, str | None) else ref.where.kind
    parts = (where, ref.color, ref.shape or "object")
    return "the " + " ".join(part.replace("_", " ") for part in parts if part)
