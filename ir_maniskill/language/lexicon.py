"""Lexicon: words that were never learned, read as learned ones near to them.

"crimson" is read as "red" and "shove" as "push" by word vectors, "buton" as "button" by
its letters. `assets/language` has the vectors, where they are from, and the function
words (left, not, between, ...), which are never read as others.

Legend: V known words, K of them that others may be read as, C words with vectors, E
numbers of a vector.
"""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from functools import cache, cached_property, lru_cache
from threading import Lock

import numpy as np

from ir_maniskill.assets import FOLDER
from ir_maniskill.language.tokens import UNK, split_words

WORDS = FOLDER / "language"
"""Where the files are."""
ENDINGS = ("s", "es", "ed", "ing")
"""What content words may end with besides."""
TURNS = ("ward", "wards")
"""What any word may end with besides: "leftwards" is read as "left"."""
NEIGHBORS = 3
"""How many known words an unknown one is a mixture of, at most."""
CROWD = 100
"""How many words tell how near a known word is to anything at all."""
THRESHOLD = 0.4
"""How near a word must be to be read as another."""
TEMPERATURE = 0.03
"""Of the softmax that mixes."""
ALIKE = 0.75
"""How alike the letters of a mistyped word must be, by `difflib`'s ratio."""


class Lexicon:
    """Reads sentences as words of a vocabulary, and as mixtures of these."""

    def __init__(self, vocabulary: tuple[str, ...]) -> None:
        """Take the words that are known, by their ids."""
        self.vocabulary = vocabulary
        self.mixtures = np.zeros((0, len(vocabulary)), np.float32)
        """Shares of the known words in each mixture that `ids` gave so far."""
        self._ids = {word: index for index, word in enumerate(vocabulary)}
        self._rows: dict[str, int] = {}
        self._lock = Lock()
        self._content = set(vocabulary) - function_words()
        self._read = lru_cache(10_000)(self._unknown)

    def ids(self, sentence: str) -> list[int]:
        """Return the ids of a sentence's words; V and more are rows of `mixtures`."""
        return [self._id(word) for word in split_words(sentence)]

    def read(self, word: str) -> Mapping[str, float]:
        """Return the known words that a word is read as, with their shares.

        The nearest comes first. Nothing: it is not understood.
        """
        return {word: 1.0} if word in self._ids else self._read(word)

    def _id(self, word: str) -> int:
        shares = self.read(word)
        if len(shares) < 2:
            return next((self._ids[known] for known in shares), UNK)
        with self._lock:  # threads share it
            if word not in self._rows:
                row = np.array([shares.get(w, 0) for w in self.vocabulary], np.float32)
                self.mixtures = np.concatenate([self.mixtures, row[None]])
                self._rows[word] = len(self.mixtures) - 1
        return len(self.vocabulary) + self._rows[word]

    def _unknown(self, word: str) -> Mapping[str, float]:
        base = self._base(word)
        if base is not None:
            return {base: 1.0}
        if word in function_words():
            return {}
        places, vectors = word_vectors()
        if word in places:
            return self._mixture(vectors[places[word]])
        return self._mistyped(word)

    def _base(self, word: str) -> str | None:
        """Return the known word that a word is a form of."""
        for endings, known in ((TURNS, self._ids.keys()), (ENDINGS, self._content)):
            for stem in (word[: -len(e)] for e in endings if word.endswith(e)):
                for base in (stem, stem + "e"):
                    if base in known:
                        return base
        return None

    def _mixture(self, vector: np.ndarray) -> dict[str, float]:
        """Return the softmax over the known words nearest to a vector [E]."""
        names, known, crowd = self._targets
        likeness = known @ vector - crowd  # [K]
        nearest = np.argsort(-likeness)[:NEIGHBORS]
        if likeness.max(initial=-1) < THRESHOLD:
            return {}
        shares = np.exp((likeness[nearest] - likeness.max()) / TEMPERATURE)
        rows = zip(nearest, (shares / shares.sum()).tolist(), strict=True)
        return {names[i]: share for i, share in rows}

    @cached_property
    def _targets(self) -> tuple[list[str], np.ndarray, np.ndarray]:
        """Names, vectors [K, E], and half of how near each is to its crowd [K].

        Without the last, the few words that are near to everything would win.
        """
        places, vectors = word_vectors()
        names = sorted(self._content & places.keys())
        known = vectors[[places[name] for name in names]]
        likeness = np.sort(vectors @ known.T, axis=0)  # [C, K]
        return names, known, likeness[-CROWD:].mean(axis=0) / 2

    def _mistyped(self, word: str) -> dict[str, float]:
        """Return the known word that a word of none is most alike in its letters."""
        if len(word) < 4:  # three letters could be anything
            return {}
        known = [
            k for k in self.vocabulary[2:] if len(k) > (2 if k in self._content else 3)
        ]
        return dict.fromkeys(get_close_matches(word, known, n=1, cutoff=ALIKE), 1.0)


lexicon = cache(Lexicon)
"""Returns the lexicon of a vocabulary, the same one for all who ask."""


@cache
def function_words() -> frozenset[str]:
    """Return the words that are for grammar, and are never read as others."""
    return frozenset((WORDS / "function_words.txt").read_text("utf-8").split())


@cache
def word_vectors() -> tuple[dict[str, int], np.ndarray]:
    """Return the rows of words, and their vectors of length 1 [C, E]."""
    vectors = np.load(WORDS / "vectors.npy").astype(np.float32)
    words = (WORDS / "words.txt").read_text("utf-8").split()
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    return {word: row for row, word in enumerate(words)}, vectors
