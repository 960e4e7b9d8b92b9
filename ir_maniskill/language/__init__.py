"""The instruction language: goals as sentences, sentences as goals, and splits.

`grammar.json` has the phrasings, `wording.json` sentences written by hand.
"""

from ir_maniskill.language.draw import Thing, draw, things
from ir_maniskill.language.grammar import SentenceError, count, parse, say
from ir_maniskill.language.splits import (
    HELD_OBJECTS,
    HELD_PAIRS,
    KINDS,
    SPLITS,
    counts,
    handwritten,
    split_of,
    words,
)

__all__ = [
    "HELD_OBJECTS",
    "HELD_PAIRS",
    "KINDS",
    "SPLITS",
    "SentenceError",
    "Thing",
    "count",
    "counts",
    "draw",
    "handwritten",
    "parse",
    "say",
    "split_of",
    "things",
    "words",
]
