"""What one experiment is: objects, instructions, reward, senses (Sec. III-A, IV).

An `Experiment` is plain data; a new task is a new `Experiment` handed to
`ir_maniskill.register`.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from numbers import Integral, Real
from typing import Any, Literal, get_args

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

COLORS: dict[str, tuple[float, float, float]] = {
    "blue": (0.05, 0.16, 0.85),
    "red": (0.85, 0.06, 0.05),
    "green": (0.04, 0.60, 0.12),
    "yellow": (0.95, 0.75, 0.05),
    "purple": (0.50, 0.10, 0.65),
    "orange": (0.95, 0.40, 0.03),
}
"""Linear RGB of every color an object may have."""

SENSES = ("vision", "proprioception", "touch")
"""The sensory modules that the Perceptual System may use."""

SHAPES = ("cube", "button")
"""A cube is a free 4 cm body, a button is fixed to the table."""

OBJECT_SIZE = 0.04
"""Edge of a cube and diameter of a button [m]."""

SHOULDERS = ((0.0, 0.098), (0.0, -0.098))
"""Where the arms start, seen from above, in the torso frame (x, y) [m]."""

REACH = 0.255
"""Farthest that an object's center may be from a shoulder, seen from above [m]."""

TABLE = ((0.10, 0.40), (-0.34, 0.34))
"""Extent of the table top along x and y [m]."""


class ExperimentError(ValueError):
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
    """An instruction i_t and the object that it asks to touch."""

    text: str
    """The sentence."""
    target: str
    """Name of the object, e.g. "blue cube"."""


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
    """"binary": 1 while the named object is touched (experiments I and II);
    "per_finger": 1 for each finger on it (experiment III)."""
    wrong_penalty: float = 0.0
    """Taken from the reward for each finger on another object."""
    senses: tuple[str, ...] = SENSES
    """What the paper's agent perceives here; subset of `SENSES`."""
    jitter: Jitter = field(default_factory=Jitter)
    """How much each episode's start varies."""
    shuffled: bool = False
    """Whether the objects swap places at random every episode."""
    episode_steps: int = 32
    """Length of an episode [control steps of 50 ms]."""
    vocabulary: tuple[str, ...] = VOCABULARY
    """Tokens known to the Language System, `<pad>` and `<unk>` first."""

    def __post_init__(self) -> None:
        """Check that the experiment can be built, said and reached.

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
        self._check_vocabulary()
        self._check_instructions()
        self._check_layout()

    @property
    def sentences(self) -> tuple[str, ...]:
        """The sentences of the Instructional Set, in order."""
        return tuple(instruction.text for instruction in self.instructions)

    @property
    def targets(self) -> tuple[int, ...]:
        """For each instruction, the index in `objects` of the one that it names."""
        names = [thing.name for thing in self.objects]
        return tuple(names.index(i.target) for i in self.instructions)

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
            _check_choice("instruction target", instruction.target, names)
            _check_type("instruction text", instruction.text, str)
            tokens = tuple(tokenize(instruction.text, self.vocabulary))
            if not tokens:
                raise ExperimentError(
                    f"instruction text: got {instruction.text!r}, an empty sentence"
                )
            other = said.setdefault(tokens, instruction)
            if other.target != instruction.target:
                raise ExperimentError(
                    f"instructions: got {other.text!r} and {instruction.text!r}, which "
                    f"are the same to the vocabulary {self.vocabulary}; expected it to "
                    "have the words that tell their objects apart"
                )

    def _check_layout(self) -> None:
        slack = self.jitter.position * math.sqrt(2)
        for thing in self.objects:
            reach = min(math.dist(thing.position, s) for s in SHOULDERS)
            if reach + slack > REACH + 1e-9:
                raise ExperimentError(
                    f"{thing.name} at {thing.position}: {reach + slack:.3f} m from the "
                    f"nearest shoulder with jitter, expected at most {REACH} m"
                )
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
    words = re.findall(r"[^\W_]+|\.", sentence.lower())
    ids = {word: index for index, word in enumerate(vocabulary)}
    return [ids.get(word, UNK) for word in words]


def touch_instructions(objects: Iterable[TouchObject]) -> tuple[Instruction, ...]:
    """Return "Touch the <name>." for each object (the paper's only template)."""
    return tuple(Instruction(f"Touch the {o.name}.", o.name) for o in objects)


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

    Raises:
        UnknownExperimentError: There is none; the message lists those there are.
    """
    try:
        return _CATALOG[experiment_id]
    except KeyError:
        raise UnknownExperimentError(
            f"unknown task id: got {experiment_id!r}, "
            f"available: {', '.join(available())}"
        ) from None


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
