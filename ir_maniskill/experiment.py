"""What one experiment is: objects, instructions, reward, senses (Sec. III-A, IV).

An `Experiment` is plain data; a new task is a new `Experiment` handed to
`ir_maniskill.register`.
"""

from __future__ import annotations

import importlib
import itertools
import math
import os
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from numbers import Integral, Real
from typing import Any, Literal

import torch

from ir_maniskill import checks
from ir_maniskill.goals import (
    COLORS,
    FIXED,
    MOVABLE,
    SHAPES,
    GoalError,
    Instruction,
    Ref,
    Touch,
)
from ir_maniskill.language import Thing
from ir_maniskill.language import words as words_of_language
from ir_maniskill.language.splits import KINDS, SPLITS
from ir_maniskill.language.tokens import (
    VOCABULARY,
    split_words,
    tokenize,
    warn_of_unknown,
    words_of,
)
from ir_maniskill.snapshot import Snapshot

SENSES = ("vision", "proprioception", "touch")
"""The sensory modules that the Perceptual System may use."""

OBJECT_SIZE = 0.04
"""Edge of a cube, and diameter of a button and a can [m]."""

TABLE = ((0.10, 0.40), (-0.34, 0.34))
"""Extent of the table top along x and y [m]."""


class ExperimentError(GoalError):
    """An experiment is malformed: says what was got and what was expected."""


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


Area = tuple[tuple[float, float], tuple[float, float]]
"""Bounds along x and y, (low, high) each [m]."""


@dataclass(frozen=True)
class Drawn:
    """Objects that are drawn anew for every episode: which, and where they lie.

    No two are alike, and each lies where an arm of the robot reaches it.

    Raises:
        ExperimentError: A field is malformed, or so many objects cannot be there.
    """

    count: tuple[int, int] = (2, 5)
    """The fewest and the most."""
    colors: tuple[str, ...] = tuple(COLORS)
    """Keys of `COLORS`."""
    shapes: tuple[str, ...] = SHAPES
    """Some of `SHAPES`."""
    area: Area = ((0.14, 0.26), (-0.15, 0.15))
    """Where their centers may be [m]."""
    apart: float = 0.065
    """Least distance between their centers [m]."""
    held_out: Area = ((0.14, 0.26), (0.03, 0.07))
    """What lies in here is named in the split `places` alone [m]."""

    def __post_init__(self) -> None:
        for name, known in (("colors", COLORS), ("shapes", SHAPES)):
            values, what = getattr(self, name), f"drawn {name}"
            _require_tuple(what, values, str)
            for value in values:
                _require_choice(what, value, known)
            distinct = 0 < len(values) == len(set(values))
            _require(distinct, what, values, "at least one and no two alike")
        _require_tuple("drawn count", self.count, Integral)
        most = len(self.pool)
        valid = len(self.count) == 2 and 1 <= self.count[0] <= self.count[1] <= most
        _require(valid, "drawn count", self.count, f"(fewest, most), 1 to {most}")
        diagonal = round(OBJECT_SIZE * math.sqrt(2), 3)
        _require_number("drawn apart", self.apart, diagonal, 1)
        for name in ("area", "held_out"):
            self._require_on_table(name)
        self._require_room()

    @property
    def pool(self) -> tuple[TouchObject, ...]:
        """All that may be drawn; their places mean nothing."""
        middle = sum(TABLE[0]) / 2, sum(TABLE[1]) / 2
        kinds = itertools.product(self.colors, self.shapes)
        return tuple(TouchObject(color, middle, shape) for color, shape in kinds)

    def is_held_out(self, x: float, y: float) -> bool:
        """Return whether a place is in the part that is held out [m]."""
        bounds = zip((x, y), self.held_out, strict=True)
        return all(low <= value <= high for value, (low, high) in bounds)

    def _require_on_table(self, name: str) -> None:
        area, margin = getattr(self, name), OBJECT_SIZE / math.sqrt(2)
        try:
            inside = all(
                low + margin <= first <= last <= high - margin
                for (first, last), (low, high) in zip(area, TABLE, strict=True)
            )
        except (TypeError, ValueError):  # not two pairs of numbers
            inside = False
        expected = f"bounds (low, high) of x and y, {margin:.3f} m within {TABLE}"
        _require(inside, f"drawn {name}", area, expected)

    def _require_room(self) -> None:
        """Raise if the most objects fill more than a third of the area."""
        (x0, x1), (y0, y1) = self.area
        room = (x1 - x0 + self.apart) * (y1 - y0 + self.apart)
        most = int(room / (3 * math.pi * (self.apart / 2) ** 2))
        expected = f"at most {most} objects in this area, {self.apart} m apart"
        _require(self.count[1] <= most, "drawn count", self.count, expected)


@dataclass(frozen=True)
class Spoken:
    """Sentences of the instruction language, drawn anew for every scene.

    Raises:
        ExperimentError: There is no such kind or split.
    """

    kinds: tuple[str, ...] = KINDS
    """Kinds of sentences, each as likely as the others where the scene allows it."""
    split: str = "train"
    """One of `SPLITS`: what is held out of the others."""

    MAX_TOKENS = 40
    """Most words and full stops of a sentence."""

    def __post_init__(self) -> None:
        _require_tuple("kinds", self.kinds, str)
        _require(self.kinds != (), "kinds", (), f"some of {KINDS}")
        for kind in self.kinds:
            _require_choice("kind", kind, KINDS)
        _require_choice("split", self.split, SPLITS)


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


class _Derived(tuple):
    """A vocabulary that was derived, which `dataclasses.replace` derives anew."""


@dataclass(frozen=True)
class Experiment:
    """One experiment of the Environment block (paper, Sec. III-A and IV).

    Raises:
        ExperimentError: Some field is malformed; the message says which.
    """

    id: str
    """Id for `gym.make`, e.g. "NaoTouchCubeSingle-v1"."""
    objects: tuple[TouchObject, ...] | Drawn
    """What lies on the table."""
    instructions: tuple[Instruction, ...] | Spoken
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
        if not isinstance(self.objects, Drawn):
            _require_tuple("objects", self.objects, TouchObject)
        if not isinstance(self.instructions, Spoken):
            _require_tuple("instructions", self.instructions, Instruction)
        if self.vocabulary == () or isinstance(self.vocabulary, _Derived):
            spoken = isinstance(self.instructions, Spoken)
            words = words_of_language() if spoken else words_of(self.sentences)
            object.__setattr__(self, "vocabulary", _Derived(words))
        self._check_vocabulary()
        for sentence in self.sentences:
            warn_of_unknown(sentence, self.vocabulary)
        self._check_objects()
        self._check_instructions()

    @property
    def sentences(self) -> tuple[str, ...]:
        """The sentences of the Instructional Set, in order; none if they are spoken."""
        if isinstance(self.instructions, Spoken):
            return ()
        return tuple(instruction.text for instruction in self.instructions)

    @property
    def bodies(self) -> tuple[TouchObject, ...]:
        """All objects that may lie on the table."""
        return self.objects.pool if isinstance(self.objects, Drawn) else self.objects

    @property
    def slots(self) -> int:
        """How many objects lie on the table at most: C."""
        if isinstance(self.objects, Drawn):
            return self.objects.count[1]
        return len(self.objects)

    @property
    def max_tokens(self) -> int:
        """Most words and full stops that a sentence may have: L."""
        if isinstance(self.instructions, Spoken):
            return Spoken.MAX_TOKENS
        return max(len(split_words(sentence)) for sentence in self.sentences)

    def in_split(
        self, split: str | None = None, kinds: Sequence[str] | None = None
    ) -> Experiment:
        """Return the same with the sentences and places of a split; None: its own.

        `kinds` are those of its sentences to draw, each as often as it stands there.

        Raises:
            ExperimentError: There is no such split or kind, or the sentences are not
                spoken.
        """
        own = self.instructions
        if not isinstance(own, Spoken):
            fits, none = split in (None, "train"), "'train': it has none"
            _require(fits, f"split of {self.id}", split, none)
            _require(kinds is None, f"kinds of {self.id}", kinds, "None: it has none")
            return self
        for kind in kinds or ():
            _require_choice(f"kind of {self.id}", kind, own.kinds)
        kinds = own.kinds if kinds is None else tuple(kinds)
        spoken = replace(own, split=split or own.split, kinds=kinds)
        return replace(self, instructions=spoken)

    def _check_vocabulary(self) -> None:
        _require_tuple("vocabulary", self.vocabulary, str)
        first, expected = self.vocabulary[:2], f"{VOCABULARY[:2]} as its first tokens"
        _require(first == VOCABULARY[:2], "vocabulary", first, expected)
        expected = "words in lower case and full stops, no two alike"
        for index, word in enumerate(self.vocabulary[2:], start=2):
            itself = tokenize(word, self.vocabulary) == [index]
            _require(itself, "vocabulary", word, expected)

    def _check_objects(self) -> None:
        if isinstance(self.objects, Drawn):
            spoken, shuffled = isinstance(self.instructions, Spoken), self.shuffled
            expected = "Spoken(...), as the objects are drawn"
            _require(spoken, "instructions", self.instructions, expected)
            _require(not shuffled, "shuffled", shuffled, "False: objects are drawn")
            return
        names = [thing.name for thing in self.objects]
        distinct = 0 < len(names) == len(set(names))
        _require(distinct, "objects", names, "at least one and no two alike")
        self._check_layout(self.objects)

    def _check_instructions(self) -> None:
        if isinstance(self.instructions, Spoken):
            return
        _require(self.instructions != (), "instructions", (), "at least one")
        said: dict[tuple[int, ...], Instruction] = {}
        for instruction in self.instructions:
            text = instruction.text
            self.check_refs(instruction)
            tokens = tuple(tokenize(text, self.vocabulary))
            _require(tokens != (), "instruction text", text, "a word or full stop")
            other = said.setdefault(tokens, instruction)
            _require(
                other.goal == instruction.goal,
                f"instructions that are the same to the vocabulary {self.vocabulary}",
                (other.text, text),
                "it to have the words that tell their goals apart",
            )

    def check_refs(self, instruction: Instruction) -> None:
        """Raise unless each reference fits one object, as far as the layout says."""
        layout = scene_of(Thing(o.color, o.shape, *o.position) for o in self.bodies)
        what, goal = f"instruction {instruction.text!r}", instruction.goal
        for ref in goal.refs:
            if self.shuffled and ref.where is not None:
                continue  # what fits is told at each reset
            fits = list(itertools.compress(self.bodies, ref.resolve(layout)[0]))
            _require(
                len(fits) == 1,
                f"{what}: objects that {ref} fits",
                len(fits),
                "exactly one of: " + ", ".join(thing.name for thing in self.bodies),
            )
            free = ref not in goal.moved or fits[0].shape not in FIXED
            _require(free, f"{what}: what it moves", fits[0].name, MOVABLE)

    def _check_layout(self, objects: tuple[TouchObject, ...]) -> None:
        slack = self.jitter.position * math.sqrt(2)
        for thing in objects:
            margin = OBJECT_SIZE / math.sqrt(2) + self.jitter.position
            for value, (low, high) in zip(thing.position, TABLE, strict=True):
                if not low + margin <= value <= high - margin:
                    raise ExperimentError(
                        f"{thing.name} at {thing.position}: not wholly on the table, "
                        f"which spans x {TABLE[0]} and y {TABLE[1]} m"
                    )
        for a, b in itertools.combinations(objects, 2):
            gap = math.dist(a.position, b.position) - 2 * slack
            if gap < OBJECT_SIZE * math.sqrt(2):
                raise ExperimentError(
                    f"{a.name} and {b.name} may overlap: centers as close as "
                    f"{gap:.3f} m with jitter, expected at least "
                    f"{OBJECT_SIZE * math.sqrt(2):.3f} m"
                )


def touch_instructions(objects: Iterable[TouchObject]) -> tuple[Instruction, ...]:
    """Return "Touch the <name>." for each object (the paper's only template)."""
    return tuple(
        Instruction(f"Touch the {o.name}.", Touch(Ref(o.color, o.shape)))
        for o in objects
    )


def scene_of(objects: Iterable[Thing]) -> Snapshot:
    """Return a snapshot that knows only what lies where [1, ...]."""
    things = tuple(objects)
    poses = torch.tensor([[o.x, o.y, 0, 1, 0, 0, 0] for o in things]).float()[None]
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


CATALOG: dict[str, Experiment] = {}
"""All experiments by their ids; `ir_maniskill.register` adds them."""


def get(experiment_id: str) -> Experiment:
    """Return the experiment of that id.

    With "MODULE:" before it the module, one in the current folder too, is imported
    first, so that it can register its tasks.

    Raises:
        ExperimentError: There is none, and the message lists those there are; or the
            module cannot be imported.
    """
    _require_type("task id", experiment_id, str)
    module, _, experiment_id = experiment_id.rpartition(":")
    if module:
        _import(module)
    if experiment_id not in CATALOG:
        raise ExperimentError(
            f"unknown task id: got {experiment_id!r}, "
            f"available: {', '.join(available())}; for a task of your own write "
            "MODULE:ID, where MODULE registers it"
        )
    return CATALOG[experiment_id]


def _import(module: str) -> None:
    expected = "one by its name, as `import` takes it: no path"
    _require(not module.startswith("."), "module of the task", module, expected)
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
    return tuple(CATALOG)


def _require_number(
    what: str, got: Any, low: float, high: float, kind: type = Real
) -> None:
    valid = isinstance(got, kind) and low <= got <= high  # type: ignore[operator]
    _require(valid, what, got, f"{low} to {high}")


def _require_tuple(what: str, got: Any, kind: type) -> None:
    valid = isinstance(got, tuple) and all(isinstance(item, kind) for item in got)
    _require(valid, what, got, f"({kind.__name__}, ...)")
