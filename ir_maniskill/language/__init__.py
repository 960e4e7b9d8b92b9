"""The instruction language: goals as sentences, sentences as goals, and splits.

`grammar.json` has the phrasings, `wording.json` sentences written by hand.
"""

from ir_maniskill.language.draw import Allows, Thing, draw, things
from ir_maniskill.language.grammar import SentenceError, parse, say
from ir_maniskill.language.splits import (
    HELD_OBJECTS,
    HELD_PAIRS,
    KINDS,
    SPLITS,
    handwritten,
    kind_of,
    loosely,
    split_of,
    words,
)

__all__ = [
    "HELD_OBJECTS",
    "HELD_PAIRS",
    "KINDS",
    "SPLITS",
    "Allows",
    "SentenceError",
    "Thing",
    "draw",
    "handwritten",
    "kind_of",
    "loosely",
    "parse",
    "say",
    "split_of",
    "things",
    "words",
]
