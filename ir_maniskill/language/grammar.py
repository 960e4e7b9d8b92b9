"""Grammar: goals said as sentences, and sentences read as goals (Sec. III-A).

`grammar.json` has all phrasings. A goal is said from the top down: a phrase is drawn
for the sentence, then one for each of its {slots}. Reading tries all phrases at each
word, so that a sentence with two meanings would be found out.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import resources
from itertools import chain
from random import Random
from typing import Any

from ir_maniskill.goals import (
    EXTREMES,
    Avoid,
    Both,
    Goal,
    GoalError,
    Push,
    Ref,
    Relation,
    Then,
    Touch,
)
from ir_maniskill.language.tokens import split_words, words_of

Slots = dict[str, Any]
"""The meaning of each slot of a phrase."""

MARKS = ("train", "wording", "typed")
"""Whether a phrase is said in training, held out, or understood and never said."""

TRAIN = ("train",)
SAID = ("train", "wording")
"""What is said in training, and what at all."""

LONGEST = 100
"""Most words of a sentence to read: each {polite} one is one more level of calls."""

SYMBOLS = {"a": "act", "b": "act", "other": "ref"}
"""What a slot stands for, where that is not its name."""


class SentenceError(GoalError):
    """A sentence is not understood: says at which word, and what was expected."""


@dataclass(frozen=True)
class Phrase:
    """One way to say something."""

    text: str
    """As it is written, e.g. "the {color} {shape}"."""
    mark: str
    """One of `MARKS`."""
    key: str | None
    """What it means, e.g. "red"; None: what its slots say."""
    items: tuple[str, ...]
    """Its words, and its slots in braces."""
    slots: tuple[str, ...]
    """Names of its slots."""


def load_json(name: str) -> dict[str, Any]:
    """Return the content of a data file of this package."""
    text = resources.files(__package__).joinpath(name).read_text(encoding="utf-8")
    return json.loads(text)


def _phrase(text: str, mark: str, key: str | None) -> Phrase:
    parts = re.split(r"(\{\w+\})", text)
    items = [[p] if p.startswith("{") else split_words(p) for p in parts]
    slots = tuple(part[1:-1] for part in parts if part.startswith("{"))
    return Phrase(text, mark, key, tuple(chain(*items)), slots)


def _load_rules() -> dict[str, tuple[Phrase, ...]]:
    """Return all phrases by symbol."""
    data = load_json("grammar.json")
    rules = {}
    for symbol, entry in {**data["templates"], **data["words"]}.items():
        by_key = {None: entry} if entry.keys() <= set(MARKS) else entry
        rules[symbol] = tuple(
            _phrase(text, mark, key)
            for key, marks in by_key.items()
            for mark, texts in marks.items()
            for text in texts
        )
    return rules


RULES = _load_rules()
FILLERS = {s for s, rule in RULES.items() if not any(p.key or p.slots for p in rule)}
"""Symbols that mean nothing of their own, e.g. verbs and politeness."""


def _by_slots() -> dict[tuple[str, str, frozenset[str]], list[Phrase]]:
    """Return all phrases by symbol, mark, and the slots that mean something."""
    found: dict[tuple[str, str, frozenset[str]], list[Phrase]] = {}
    for symbol, rule in RULES.items():
        for phrase in rule:
            slots = frozenset(phrase.slots) - FILLERS
            found.setdefault((symbol, phrase.mark, slots), []).append(phrase)
    return found


_SAYING = _by_slots()


# -- Meaning ---------------------------------------------------------------------------


def _take(symbol: str, value: Any) -> list[Slots]:
    """Return the slots with which a symbol can say a value; `_make` is the inverse."""
    match symbol, value:
        case "sentence", Goal():
            return [{"goal": value}, {"statement": value}]
        case "goal", Then():
            return [{"then": value}]
        case "goal", Both():
            return [{"but" if isinstance(value.b, Avoid) else "both": value}]
        case "goal", (Touch() | Push()):
            return [{"act": value}]
        case "act", Touch():
            return [{"hand" if value.hand else "touch": value}]
        case "act", Push():
            return [{"push": value}]
        case (("touch" | "hand" | "statement"), Touch(ref, hand)):
            return [{"ref": ref, "side": hand} if hand else {"ref": ref}]
        case (("push" | "statement"), Push(ref, direction, Push.distance)):
            return [{"ref": ref, "direction": direction}]
        case "but", Both(a, Avoid(other)):
            return [{"a": a, "other": other}]
        case (("both" | "then"), (Both(a, b) | Then(a, b))):
            ways: list[Slots] = [{"a": a, "b": b}]
            if isinstance(a, Touch) and isinstance(b, Touch) and not (a.hand or b.hand):
                ways.append({"ref": a.ref, "other": b.ref})
            return ways
        case "ref", Ref(where=None):
            return [{"plain": value}]
        case "ref", Ref(color, shape, where):
            sides = ("before", "after") if where in EXTREMES else ("after",)
            return [{"kernel": Ref(color, shape), side: where} for side in sides]
        case "plain", Ref(color, shape, None):
            return [{"kernel": value}, _named(color, shape)]
        case "kernel", Ref(color, shape):
            return [_named(color, shape)]
        case "after", Relation("other_than", Ref(color, shape, None) as ref):
            alone = [] if color and shape else [_named(color, shape)]
            return [{"plain": ref}, *alone]
        case "after", Relation(_, ref):
            return [{"plain": ref}]
        case _, str():
            return [{}]
    return []


def _named(color: str | None, shape: str | None) -> Slots:
    pairs = {"color": color, "shape": shape}.items()
    return {name: value for name, value in pairs if value is not None}


def _make(symbol: str, key: str | None, slots: Slots) -> Any:
    """Return the value that a phrase of a symbol means; `_take` is the inverse."""
    match symbol:
        case "sentence" | "goal" | "act":
            return next(value for value in slots.values() if value is not None)
        case "touch" | "hand" | "push" | "statement":
            if "direction" in slots:
                return Push(slots["ref"], slots["direction"])
            return Touch(slots["ref"], slots.get("side"))
        case "but":
            return Both(slots["a"], Avoid(slots["other"]))
        case "both" | "then":
            kind = Both if symbol == "both" else Then
            if "ref" in slots:
                return kind(Touch(slots["ref"]), Touch(slots["other"]))
            return kind(slots["a"], slots["b"])
        case "ref" | "plain" | "kernel":
            base = slots.get("plain") or slots.get("kernel") or _ref(slots)
            where = slots.get("before") or slots.get("after")
            return Ref(base.color, base.shape, where) if where else base
        case "after" if key not in EXTREMES:
            return Relation(str(key), slots.get("plain") or _ref(slots))
    return key


def _ref(slots: Slots) -> Ref:
    return Ref(slots.get("color"), slots.get("shape"))


# -- Saying ----------------------------------------------------------------------------


@lru_cache(10_000)
def _choices(symbol: str, value: Any, mark: str) -> tuple[tuple[Phrase, Slots], ...]:
    """Return the phrases that can say a value, with the meaning of their slots."""
    key = value.kind if isinstance(value, Relation) else value
    return tuple(
        (phrase, slots)
        for slots in ([{}] if symbol in FILLERS else _take(symbol, value))
        if all(_sayable(SYMBOLS.get(n, n), part) for n, part in slots.items())
        for phrase in _SAYING.get((symbol, mark, frozenset(slots)), ())
        if phrase.key in (None, key)
    )


def _sayable(symbol: str, value: Any) -> bool:
    return any(_choices(symbol, value, mark) for mark in SAID)


def _say(symbol: str, value: Any, rng: Random, wording: bool) -> tuple[str, bool]:
    """Return a phrase for a value, and whether anything in it is held out."""
    choices = _choices(symbol, value, "train")
    held = _choices(symbol, value, "wording") if wording else ()
    if held and (not choices or rng.random() < 0.5):
        choices = held
    elif rng.random() < 0.5:  # the plainest
        choices = choices[:1]
    phrase, slots = choices[int(rng.random() * len(choices))]
    new = phrase.mark == "wording"
    said = {}
    for name in phrase.slots:
        part = _say(SYMBOLS.get(name, name), slots.get(name), rng, wording)
        said[name], new = part[0], new or part[1]
    return phrase.text.format(**said), new


def say(goal: Goal, rng: Random, wording: bool = False) -> str:
    """Return a sentence for a goal, drawn at random.

    Args:
        goal: What it asks for.
        rng: Draws the phrases.
        wording: Use at least one phrase that training never has.

    Raises:
        GoalError: The grammar has no words for such a goal.
    """
    if not _choices("sentence", goal, "train"):
        raise GoalError(
            f"say: got {goal}, expected what the grammar has words for: Touch, Push "
            f"by {Push.distance} m, Both and Then of two such, Both with an Avoid; "
            "relations only to a Ref without a relation"
        )
    while True:
        text, new = _say("sentence", goal, rng, wording)
        if new == wording:
            return text[0].upper() + text[1:]


# -- Reading ---------------------------------------------------------------------------


class _Reader:
    """Reads one sentence: all meanings of each symbol at each word."""

    def __init__(self, words: list[str], marks: tuple[str, ...]) -> None:
        self.words = [*words, ""]  # the end
        self.marks = marks
        self.far = 0
        self.expected: set[str] = set()
        self.memory: dict[tuple[str, int], list[tuple[int, Any]]] = {}

    def read(self, symbol: str, start: int) -> list[tuple[int, Any]]:
        """Return where the symbol may end, and its meaning."""
        if (symbol, start) not in self.memory:
            phrases = _opening(symbol, self.marks)
            self._expect(start, phrases)
            found = {
                (end, _make(symbol, phrase.key, slots)): None
                for phrase in phrases.get(self.words[start], ())
                for end, slots in self._match(phrase, start)
            }
            self.memory[symbol, start] = list(found)
        return self.memory[symbol, start]

    def _match(self, phrase: Phrase, start: int) -> list[tuple[int, Slots]]:
        """Return where the phrase may end, and the meaning of its slots."""
        paths: list[tuple[int, Slots]] = [(start, {})]
        for item in phrase.items:
            if item[0] == "{":
                name = item[1:-1]
                paths = [
                    (end, {**slots, name: value})
                    for at, slots in paths
                    for end, value in self.read(SYMBOLS.get(name, name), at)
                ]
            else:
                for at, _ in paths:
                    self._expect(at, (item,))
                paths = [(at + 1, s) for at, s in paths if self.words[at] == item]
            if not paths:
                break
        return paths

    def _expect(self, at: int, words: Any) -> None:
        if at > self.far:
            self.far, self.expected = at, set()
        if at == self.far:
            self.expected.update(words)


@cache
def _opening(symbol: str, marks: tuple[str, ...]) -> dict[str, tuple[Phrase, ...]]:
    """Return the phrases of a symbol by the words that they may begin with."""
    opening: dict[str, tuple[Phrase, ...]] = {}
    for phrase in RULES[symbol]:
        if phrase.mark in marks:
            head = phrase.items[0].strip("{}")
            slot = phrase.items[0] != head
            for word in _opening(SYMBOLS.get(head, head), marks) if slot else (head,):
                opening[word] = (*opening.get(word, ()), phrase)
    return opening


def parse(sentence: str, wording: bool = True) -> Goal:
    """Return the goal that a sentence asks for.

    Case, punctuation and a missing full stop do not matter.

    Args:
        sentence: Any text.
        wording: Also read what training never says.

    Raises:
        SentenceError: It is not understood.
    """
    words = split_words(sentence)
    if len(words) > LONGEST:
        expected = f"expected at most {LONGEST}"
        raise SentenceError(f"sentence: got {len(words)} words, {expected}")
    reader = _Reader(words, MARKS if wording else TRAIN)
    goals = {goal for end, goal in reader.read("sentence", 0) if end == len(words)}
    if not goals:
        raise SentenceError(f"sentence {sentence!r}: {_complaint(reader)}")
    if len(goals) > 1:
        meanings = " or ".join(map(str, goals))
        raise SentenceError(f"sentence {sentence!r}: got {meanings}, expected one goal")
    return goals.pop()


def _complaint(reader: _Reader) -> str:
    """Return what was got and what was expected, in words of training if possible."""
    at, got = reader.far, reader.words[reader.far]
    plain = _Reader(reader.words[:-1], TRAIN)
    plain.read("sentence", 0)
    expected = sorted(plain.expected if plain.far == at else reader.expected)
    known = [word for word in expected if word in words_by_mark("train")]
    expected = [word for word in known or expected if word != "."]
    if any(end == at for end, _ in reader.read("sentence", 0)):
        expected.append("the end")
    what = f"{got!r} as word {at + 1}" if got else "the end"
    return f"got {what}, expected one of: {', '.join(expected)}"


# -- Words -----------------------------------------------------------------------------


@cache
def words_by_mark(*marks: str) -> tuple[str, ...]:
    """Return `<pad>`, `<unk>`, and the words of all phrases with these marks."""
    phrases = (phrase for rule in RULES.values() for phrase in rule)
    texts = (re.sub(r"\{\w+\}", " ", p.text) for p in phrases if p.mark in marks)
    return words_of(texts)
