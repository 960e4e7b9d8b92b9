"""What one experiment is: objects, instructions, reward, senses (Sec. III-A, IV).

An `Experiment` is plain data; a new task is a new `Experiment` handed to
`ir_maniskill.register`.
"""

from __future__ import annotations

import importlib
import itertools
import logging
import math
import os
import re
import sys
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache, partial
from numbers import Integral, Real
from typing import Any, Literal

import torch

from ir_maniskill import checks
from ir_maniskill.goals import COLORS, SHAPES, Goal, GoalError, Ref, Touch
from ir_maniskill.snapshot import Snapshot

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

SENSES = ("vision", "proprioception", "touch")
"""The sensory modules that the Perceptual System may use."""

OBJECT_SIZE = 0.04
"""Edge of a cube and diameter of a button [m]."""

TABLE = ((0.10, 0.40), (-0.34, 0.34))
"""Extent of the table top along x and y [m]."""


class ExperimentError(GoalError):
    """An experiment is malformed: says what was got and what was expected."""


class UnknownExperimentError(KeyError):
    """No experiment has that id: says which there are."""

    def __str__(self) -> str:
        """Return the message as it is (`KeyError` would quote it)."""
        return str(self.args[0])


_require = partial(checks.require, error=ExperimentError)
_require_choice = partial(checks.require_choice, error=ExperimentError)
_require_type = partial(checks.require_type, error=ExperimentError)


@dataclass(frozen=True)
class TouchObject:
    """A thing on the table that a finger can touch.

    Raises:
        ExperimentError: The color, shape or place is not one we can build.
    """

    color: str
    """A key of `COLORS`."""
    position: tuple[float, float]
    """Place of its center on the table (x forward, y left) [m]."""
    shape: str = "cube"
    """One of `SHAPES`."""

    def __post_init__(self) -> None:
        _require_choice("object color", self.color, COLORS)
        _require_choice("object shape", self.shape, SHAPES)
        what, expected = f"position of the {self.name}", "two finite numbers (x, y) [m]"
        _require_tuple(what, self.position, Real)
        finite = len(self.position) == 2 and all(map(math.isfinite, self.position))
        _require(finite, what, self.position, expected)

    @property
    def name(self) -> str:
        """What a sentence calls it, e.g. "blue cube"."""
        return f"{self.color} {self.shape}"


@dataclass(frozen=True)
class Instruction:
    """An instruction i_t and the goal that it asks for."""

    text: str
    """The sentence."""
    goal: Goal
    """What it asks for, e.g. `Touch(Ref("blue", "cube"))`."""

    def __post_init__(self) -> None:
        _require_type("instruction text", self.text, str)
        _require_type("instruction goal", self.goal, Goal)


@dataclass(frozen=True)
class Jitter:
    """Half-widths of the uniform noise that each episode starts with; 0 turns it off.

    With all zeros the scene is the paper's fixed one.
    """

    position: float = 0.01
    """Of each object's center along x and y [m]."""
    yaw: float = 0.2
    """Of each object about the vertical [rad]."""
    joints: float = 0.05
    """Of each actuated joint about its start [rad]."""

    def __post_init__(self) -> None:
        for name, largest in (("position", 0.05), ("yaw", math.pi), ("joints", 0.3)):
            _require_number(f"jitter.{name}", getattr(self, name), 0, largest)


RewardKind = Literal["binary", "per_finger"]


@dataclass(frozen=True)
class Experiment:
    """One experiment of the Environment block (paper, Sec. III-A and IV).

    Raises:
        ExperimentError: Some field is malformed; the message says which.
    """

    id: str
    """Id for `gym.make`, e.g. "NaoTouchCubeSingle-v1"."""
    objects: tuple[TouchObject, ...]
    """What lies on the table."""
    instructions: tuple[Instruction, ...]
    """The Instructional Set; one is drawn for every episode."""
    reward: RewardKind = "binary"
    """"binary": 1 while the goal holds (experiments I and II); "per_finger": its level,
    1 for each finger on the named object (experiment III)."""
    wrong_penalty: float = 0.0
    """Penalty for each finger on another object."""
    senses: tuple[str, ...] = SENSES
    """What the paper's agent perceives here; subset of `SENSES`."""
    jitter: Jitter = field(default_factory=Jitter)
    """How much each episode's start varies."""
    shuffled: bool = False
    """Whether the objects swap places at random every episode."""
    episode_steps: int = 32
    """Length of an episode [control steps of 50 ms]."""
    vocabulary: tuple[str, ...] = ()
    """Tokens known to the Language System, `<pad>` and `<unk>` first; derived from the
    sentences if left out."""

    def __post_init__(self) -> None:
        form = r"\w[\w-]*-v\d+"
        valid = isinstance(self.id, str) and re.fullmatch(form, self.id, re.ASCII)
        _require(bool(valid), "experiment id", self.id, 'a form like "MyTask-v1"')
        _require_choice("reward", self.reward, RewardKind)
        _require_number("wrong_penalty", self.wrong_penalty, 0, 10)
        _require_number("episode_steps", self.episode_steps, 1, 10_000, Integral)
        _require_type("jitter", self.jitter, Jitter)
        _require_type("shuffled", self.shuffled, bool)
        _require_tuple("senses", self.senses, str)
        for sense in self.senses:
            _require_choice("sense", sense, SENSES)
        _require_tuple("objects", self.objects, TouchObject)
        _require_tuple("instructions", self.instructions, Instruction)
        if self.vocabulary == ():
            object.__setattr__(self, "vocabulary", words_of(self.sentences))
        self._check_vocabulary()
        for sentence in self.sentences:
            warn_of_unknown(sentence, self.vocabulary)
        self._check_instructions()
        self._check_layout()

    @property
    def sentences(self) -> tuple[str, ...]:
        """The sentences of the Instructional Set, in order."""
        return tuple(instruction.text for instruction in self.instructions)

    def _check_vocabulary(self) -> None:
        _require_tuple("vocabulary", self.vocabulary, str)
        first, expected = self.vocabulary[:2], f"{VOCABULARY[:2]} as its first tokens"
        _require(first == VOCABULARY[:2], "vocabulary", first, expected)
        expected = "words in lower case and full stops, no two alike"
        for index, word in enumerate(self.vocabulary[2:], start=2):
            itself = tokenize(word, self.vocabulary) == [index]
            _require(itself, "vocabulary", word, expected)

    def _check_instructions(self) -> None:
        names = [thing.name for thing in self.objects]
        distinct = 0 < len(names) == len(set(names))
        _require(distinct, "objects", names, "at least one and no two alike")
        _require(self.instructions != (), "instructions", (), "at least one")
        said: dict[tuple[int, ...], Instruction] = {}
        for instruction in self.instructions:
            text = instruction.text
            self._check_refs(instruction)
            tokens = tuple(tokenize(text, self.vocabulary))
            _require(tokens != (), "instruction text", text, "a word or full stop")
            other = said.setdefault(tokens, instruction)
            _require(
                other.goal == instruction.goal,
                f"instructions that are the same to the vocabulary {self.vocabulary}",
                (other.text, text),
                "it to have the words that tell their goals apart",
            )

    def _check_refs(self, instruction: Instruction) -> None:
        """Raise unless each reference fits one object, as far as the layout says."""
        layout = _layout(self.objects)
        for ref in instruction.goal.refs:
            fits = int(ref.resolve(layout).sum())
            unknown = self.shuffled and ref.where is not None  # told at each reset
            _require(
                fits == 1 or unknown,
                f"instruction {instruction.text!r}: objects that {ref} fits",
                fits,
                "exactly one of: " + ", ".join(thing.name for thing in self.objects),
            )

    def _check_layout(self) -> None:
        slack = self.jitter.position * math.sqrt(2)
        for thing in self.objects:
            margin = OBJECT_SIZE / math.sqrt(2) + self.jitter.position
            for value, (low, high) in zip(thing.position, TABLE, strict=True):
                if not low + margin <= value <= high - margin:
                    raise ExperimentError(
                        f"{thing.name} at {thing.position}: not wholly on the table, "
                        f"which spans x {TABLE[0]} and y {TABLE[1]} m"
                    )
        for a, b in itertools.combinations(self.objects, 2):
            gap = math.dist(a.position, b.position) - 2 * slack
            if gap < OBJECT_SIZE * math.sqrt(2):
                raise ExperimentError(
                    f"{a.name} and {b.name} may overlap: centers as close as "
                    f"{gap:.3f} m with jitter, expected at least "
                    f"{OBJECT_SIZE * math.sqrt(2):.3f} m"
                )


def tokenize(sentence: str, vocabulary: tuple[str, ...] = VOCABULARY) -> list[int]:
    """Return the ids of a sentence's words and full stops: places in the vocabulary.

    Case does not matter, unknown words become `<unk>`.
    """
    ids = {word: index for index, word in enumerate(vocabulary)}
    return [ids.get(word, UNK) for word in split_words(sentence)]


@lru_cache(1000)
def warn_of_unknown(sentence: str, vocabulary: tuple[str, ...]) -> None:
    """Log, once for each sentence, which of its words are read as `<unk>`."""
    unknown = [word for word in split_words(sentence) if word not in vocabulary]
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


def touch_instructions(objects: Iterable[TouchObject]) -> tuple[Instruction, ...]:
    """Return "Touch the <name>." for each object (the paper's only template)."""
    return tuple(
        Instruction(f"Touch the {o.name}.", Touch(Ref(o.color, o.shape)))
        for o in objects
    )


def _layout(objects: Iterable[TouchObject]) -> Snapshot:
    """Return a snapshot that knows only what lies where [1, ...]."""
    things = tuple(objects)
    poses = torch.tensor([[*o.position, 0, 1, 0, 0, 0] for o in things]).float()[None]
    none = torch.zeros(1, 0, len(things))
    return Snapshot(
        contact=none.bool(),
        fingertip=torch.zeros(1, 0, 3),
        pose=poses,
        start=poses,
        velocity=torch.zeros(1, len(things), 3),
        color=torch.tensor([[list(COLORS).index(o.color) for o in things]]),
        shape=torch.tensor([[SHAPES.index(o.shape) for o in things]]),
        stage=torch.zeros(1, dtype=torch.int64),
    )


_CATALOG: dict[str, Experiment] = {}


def add(experiment: Experiment) -> None:
    """Put an experiment into the catalog.

    Raises:
        ExperimentError: Another experiment has that id already.
    """
    if _CATALOG.setdefault(experiment.id, experiment) != experiment:
        raise ExperimentError(
            f"experiment id: got {experiment.id!r}, which is taken; "
            "register yours under another id"
        )


def get(experiment_id: str) -> Experiment:
    """Return the experiment of that id.

    With "MODULE:" before it the module, one in the current folder too, is imported
    first, so that it can register its tasks.

    Raises:
        ExperimentError: The module cannot be imported.
        UnknownExperimentError: There is none; the message lists those there are.
    """
    module, _, experiment_id = experiment_id.rpartition(":")
    if module:
        _import(module)
    try:
        return _CATALOG[experiment_id]
    except KeyError:
        raise UnknownExperimentError(
            f"unknown task id: got {experiment_id!r}, "
            f"available: {', '.join(available())}; for a task of your own write "
            "MODULE:ID, where MODULE registers it"
        ) from None


def _import(module: str) -> None:
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        importlib.import_module(module)
    except ImportError as error:
        raise ExperimentError(
            f"task: got module {module!r}, which cannot be imported: {error}"
        ) from error


def available() -> tuple[str, ...]:
    """Return the ids of all experiments, in the order they were registered."""
    return tuple(_CATALOG)


def _require_number(
    what: str, got: Any, low: float, high: float, kind: type = Real
) -> None:
    valid = isinstance(got, kind) and low <= got <= high  # type: ignore[operator]
    _require(valid, what, got, f"{low} to {high}")


def _require_tuple(what: str, got: Any, kind: type) -> None:
    valid = isinstance(got, tuple) and all(isinstance(item, kind) for item in got)
    _require(valid, what, got, f"({kind.__name__}, ...)")
