"""Words: a sentence as the words, and as the tokens, of a vocabulary."""

from __future__ import annotations

import logging
import unicodedata
from collections.abc import Iterable
from functools import lru_cache

log = logging.getLogger(__name__)

VOCABULARY = (
    "<pad>",
    "<unk>",
    ".",
    "touch",
    "the",
    "blue",
    "red",
    "green",
    "cube",
    "button",
)
"""The ten tokens of the paper's vocabulary; a token's id is its place here."""

PAD, UNK = 0, 1
"""Ids of `<pad>`, which fills short sentences up, and of `<unk>`, any other word."""


def tokenize(sentence: str, vocabulary: tuple[str, ...] = VOCABULARY) -> list[int]:
    """Return the ids of a sentence's words and full stops: places in the vocabulary.

    Case does not matter, unknown words become `<unk>`.
    """
    ids = {word: index for index, word in enumerate(vocabulary)}
    return [ids.get(word, UNK) for word in split_words(sentence)]


@lru_cache(1000)
def warn_of_unknown(sentence: str, vocabulary: tuple[str, ...]) -> None:
    """Log, once for each sentence, which of its words are read as `<unk>`."""
    unknown = dict.fromkeys(w for w in split_words(sentence) if w not in vocabulary)
    if unknown:
        log.warning("%r: not in the vocabulary: %s", sentence, ", ".join(unknown))


def split_words(sentence: str) -> list[str]:
    """Return the words and full stops of a sentence, in lower case.

    Letters of any script count, with the marks that belong to them.
    """
    text = unicodedata.normalize("NFC", sentence.lower()).replace(".", " . ")
    parts = (
        c if c.isalnum() or c == "." or unicodedata.category(c)[0] == "M" else " "
        for c in text
    )
    return "".join(parts).split()


def words_of(sentences: Iterable[str]) -> tuple[str, ...]:
    """Return the vocabulary of the sentences: `<pad>`, `<unk>` and their words."""
    words = (word for text in sentences for word in split_words(text))
    return (*VOCABULARY[:2], *dict.fromkeys(words))
