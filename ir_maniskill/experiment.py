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
from functools import lru_cache
from numbers import Integral, Real
from typing import Any, Literal, get_args

import torch

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


@dataclass(frozen=True)
class TouchObject:
    """A thing on the table that a finger can touch."""

    color: str
    """A key of `COLORS`."""
    position: tuple[float, float]
    """Place of its center on the table (x forward, y left) [m]."""
    shape: str = "cube"
    """One of `SHAPES`."""

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            ExperimentError: The color, shape or place is not one we can build.
        """
        _check_choice("object color", self.color, COLORS)
        _check_choice("object shape", self.shape, SHAPES)
        _check_tuple(f"position of the {self.name}", self.position, Real)
        if len(self.position) != 2 or not all(map(math.isfinite, self.position)):
            raise ExperimentError(
                f"position of the {self.name}: got {self.position!r}, "
                "expected two finite numbers (x, y) in meters"
            )

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
        """Check the fields.

        Raises:
            ExperimentError: One has another type.
        """
        _check_type("instruction text", self.text, str)
        _check_type("instruction goal", self.goal, Goal)


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
        """Check the fields.

        Raises:
            ExperimentError: A half-width is negative or too large to be safe.
        """
        for name, largest in (("position", 0.05), ("yaw", math.pi), ("joints", 0.3)):
            _check_number(f"jitter.{name}", getattr(self, name), 0, largest)


RewardKind = Literal["binary", "per_finger"]


@dataclass(frozen=True)
class Experiment:
    """One experiment of the Environment block (paper, Sec. III-A and IV)."""

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
        """Check that the experiment can be built and said.

        Raises:
            ExperimentError: Some field is malformed; the message says which.
        """
        _check_id(self.id)
        _check_choice("reward", self.reward, get_args(RewardKind))
        _check_number("wrong_penalty", self.wrong_penalty, 0, 10)
        _check_number("episode_steps", self.episode_steps, 1, 10_000, Integral)
        _check_type("jitter", self.jitter, Jitter)
        _check_type("shuffled", self.shuffled, bool)
        _check_tuple("senses", self.senses, str)
        for sense in self.senses:
            _check_choice("sense", sense, SENSES)
        _check_tuple("objects", self.objects, TouchObject)
        _check_tuple("instructions", self.instructions, Instruction)
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
        _check_tuple("vocabulary", self.vocabulary, str)
        if self.vocabulary[:2] != VOCABULARY[:2]:
            raise ExperimentError(
                f"vocabulary: got {self.vocabulary[:2]!r} as its first two tokens, "
                f"expected {VOCABULARY[:2]!r}"
            )
        for index, word in enumerate(self.vocabulary[2:], start=2):
            if tokenize(word, self.vocabulary) != [index]:
                raise ExperimentError(
                    f"vocabulary: got {word!r}, expected words in lower case and "
                    "full stops, no two alike"
                )

    def _check_instructions(self) -> None:
        names = [thing.name for thing in self.objects]
        if len(set(names)) != len(names) or not names:
            raise ExperimentError(
                f"objects: got {names}, expected at least one and no two alike"
            )
        if not self.instructions:
            raise ExperimentError("instructions: got none, expected at least one")
        said: dict[tuple[int, ...], Instruction] = {}
        for instruction in self.instructions:
            self._check_refs(instruction)
            tokens = tuple(tokenize(instruction.text, self.vocabulary))
            if not tokens:
                raise ExperimentError(
                    f"instruction text: got {instruction.text!r}, an empty sentence"
                )
            other = said.setdefault(tokens, instruction)
            if other.goal != instruction.goal:
                raise ExperimentError(
                    f"instructions: got {other.text!r} and {instruction.text!r}, which "
                    f"are the same to the vocabulary {self.vocabulary}; expected it to "
                    "have the words that tell their goals apart"
                )

    def _check_refs(self, instruction: Instruction) -> None:
        """Raise unless each reference fits one object, as far as the layout says."""
        layout = _layout(self.objects)
        for ref in instruction.goal.refs:
            fits = int(ref.resolve(layout).sum())
            unknown = self.shuffled and ref.where is not None  # told at each reset
            if fits != 1 and not unknown:
                names = ", ".join(thing.name for thing in self.objects)
                raise ExperimentError(
                    f"instruction {instruction.text!r}: got {ref}, which fits {fits} "
                    f"of the objects, expected exactly one of: {names}"
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
    """Split a sentence into words and full stops and return their ids.

    Args:
        sentence: Any text; case does not matter, unknown words become `<unk>`.
        vocabulary: The known tokens; an id is a place in it.
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
    known = _CATALOG.get(experiment.id)
    if known is not None and known != experiment:
        raise ExperimentError(
            f"experiment id: got {experiment.id!r}, which is taken; "
            "register yours under another id"
        )
    _CATALOG[experiment.id] = experiment


def get(experiment_id: str) -> Experiment:
    """Return the experiment of that id.

    Args:
        experiment_id: The id; with "MODULE:" before it the module, one in the current
            folder too, is imported first, so that it can register its tasks.

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


def _check_choice(what: str, got: Any, choices: Iterable[str]) -> None:
    if got not in (available := tuple(choices)):
        raise ExperimentError(f"{what}: got {got!r}, available: {', '.join(available)}")


def _check_number(
    what: str, got: Any, low: float, high: float, kind: type = Real
) -> None:
    if not (isinstance(got, kind) and low <= got <= high):  # type: ignore[operator]
        raise ExperimentError(f"{what}: got {got!r}, expected {low} to {high}")


def _check_type(what: str, got: Any, kind: type) -> None:
    if not isinstance(got, kind):
        raise ExperimentError(f"{what}: got {got!r}, expected a {kind.__name__}")


def _check_tuple(what: str, got: Any, kind: type) -> None:
    if not (isinstance(got, tuple) and all(isinstance(item, kind) for item in got)):
        raise ExperimentError(f"{what}: got {got!r}, expected ({kind.__name__}, ...)")


def _check_id(experiment_id: Any) -> None:
    form = r"\w[\w-]*-v\d+"
    if not (
        isinstance(experiment_id, str) and re.fullmatch(form, experiment_id, re.ASCII)
    ):
        raise ExperimentError(
            f'experiment id: got {experiment_id!r}, expected a form like "MyTask-v1"'
        )
