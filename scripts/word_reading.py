"""Writes tables into docs/language.md: how held-out wording is read, word by word.

No policy acts here. A word is read right if the known word that it is most of all read
as means the same in the grammar. A sentence is read right if the colors (shapes, verbs)
that are read in it are those of its goal.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from itertools import product
from pathlib import Path
from random import Random

from ir_maniskill.goals import (
    COLORS,
    SHAPES,
    Goal,
    GoalError,
    Instruction,
)
from ir_maniskill.language import KINDS, Thing, draw, handwritten, say, words
from ir_maniskill.language.grammar import RULES
from ir_maniskill.language.lexicon import lexicon
from ir_maniskill.language.splits import acts_of, refs_of
from ir_maniskill.language.tokens import split_words

PAGE = Path(__file__).parent.parent / "docs" / "language.md"
BEGIN, END = "<!-- begin reading -->\n", "\n<!-- end reading -->"

SYMBOLS = {
    "color": ("color",),
    "shape": ("shape",),
    "verb": ("to_touch", "to_push"),
    "thing": ("thing",),
    "direction": ("direction",),
    "extreme": ("before",),
}
"""What the grammar calls the words of each kind."""

MISTYPED = {
    **{"toch": "touch", "tuoch": "touch", "toucht": "touch", "psuh": "push"},
    **{"blu": "blue", "yelow": "yellow", "purpel": "purple", "buton": "button"},
    **{"teh": "the", "wiht": "with", "frist": "first"},
}
"""Those of the sentences written by hand, and what was meant."""

DRAWN = 1_000
"""Sentences that are drawn, beside those written by hand."""

Reader = Callable[[str], str | None]
"""Returns the known word that a word is read as."""


def tokens(word: str) -> str | None:
    """Read as the encoder `tokens` does: words of training alone."""
    return word if word in words() else None


def nearest(word: str) -> str | None:
    """Read as the encoder `lexicon` does: the known word of the largest share."""
    return next(iter(lexicon(words()).read(word)), None)


def meanings(kind: str, mark: str = "train") -> dict[str, str]:
    """Return what the single words of a kind mean: "crimson" is red, "poke" touch."""
    return {
        phrase.items[0]: phrase.key or symbol.removeprefix("to_")
        for symbol in SYMBOLS[kind]
        for phrase in RULES[symbol]
        if phrase.mark == mark and len(phrase.items) == 1
    }


def word_rows() -> Iterator[tuple[str, int, int, int]]:
    """Yield each kind, with how many words are read right, wrong, and not at all."""
    for kind in SYMBOLS:
        known, held = meanings(kind), meanings(kind, "wording")
        yield kind, *_judged({w: m for w, m in held.items() if w not in words()}, known)
    yield "mistyped", *_judged(MISTYPED, {word: word for word in words()})


def _judged(meant: dict[str, str], known: dict[str, str]) -> tuple[int, int, int]:
    read = {word: nearest(word) for word in meant}
    right = sum(
        known.get(str(read[word])) == meaning for word, meaning in meant.items()
    )
    unread = sum(word is None for word in read.values())
    return right, len(meant) - right - unread, unread


def right_sentences(said: Collection[Instruction], reader: Reader) -> Counter[str]:
    """Return in how many sentences the words of each kind are those of the goal."""
    known = {kind: meanings(kind) for kind in ("color", "shape", "verb")}
    counts: Counter[str] = Counter()
    for instruction in said:
        read = {reader(word) for word in split_words(instruction.text)}
        for kind, goal in named(instruction.goal).items():
            heard = {known[kind][str(word)] for word in read & known[kind].keys()}
            counts[kind] += heard - {"thing"} == goal
    return counts


def named(goal: Goal) -> dict[str, set[str | None]]:
    """Return the colors, shapes and verbs that a sentence of a goal must have."""
    verbs = {verb.split()[0] for verb, _ in acts_of(goal)}
    return {
        "color": {ref.color for ref in refs_of(goal)} - {None},
        "shape": {ref.shape for ref in refs_of(goal)} - {None},
        "verb": {"push" if verb == "push" else "touch" for verb in verbs},
    }


def drawn(count: int) -> Iterator[Instruction]:
    """Yield sentences of held-out wording, each true of a scene of four objects."""
    rng, every = Random(0), [*product(COLORS, SHAPES)]
    while count:
        scene = tuple(
            Thing(*name, rng.uniform(0.15, 0.3), rng.uniform(-0.2, 0.2))
            for name in rng.sample(every, 4)
        )
        try:
            goal = draw(scene, KINDS, rng, "wording")
        except GoalError:  # nothing can be said of this one
            continue
        yield Instruction(say(goal, rng, wording=True), goal)
        count -= 1


def tables() -> str:
    """Return both tables in Markdown."""
    lines = ["| words | right | wrong | not read |", "| --- | --- | --- | --- |"]
    lines += [f"| {' | '.join(map(str, row))} |" for row in word_rows()]
    kinds = ("color", "shape", "verb")
    lines += ["", f"| sentences | encoder | {' | '.join(kinds)} |", "| --- " * 5 + "|"]
    for name, said in (("by hand", handwritten()), ("drawn", tuple(drawn(DRAWN)))):
        for encoder, reader in (("`tokens`", tokens), ("`lexicon`", nearest)):
            counts = right_sentences(said, reader)
            rates = " | ".join(
                f"{100 * counts[kind] / len(said):.0f}%" for kind in kinds
            )
            lines.append(f"| {len(said):,} {name} | {encoder} | {rates} |")
    return "\n".join(lines)


if __name__ == "__main__":
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    PAGE.write_text(before + BEGIN + tables() + END + rest.split(END)[1], "utf-8")
