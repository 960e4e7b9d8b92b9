"""Goals: what a sentence asks for, as data that can be measured (Sec. III-A).

A goal is a frozen dataclass. Its fields say what is asked, e.g.
`Touch(Ref("blue", "cube"), hand="left")`, and its method `measure` says how far that is
reached in N scenes at once. A verb of your own is one more such class:
`examples/new_verb.py` has one.

`measure` gets many goals of its kind stacked, as tensors under the fields' names:

| field | tensor |
| --- | --- |
| a `Ref` | mask over the objects [N, C] bool, exactly one |
| a number | [N] float32 |
| `hand`, a name or None | mask over the fingers [N, F] bool |
| `direction`, a key of `DIRECTIONS` | unit vector [N, 3] |
| a `Goal` | its `measure(scene)` |

Legend: N scenes, F fingers, C objects. Lengths are at NAO's scale [m].
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, fields
from functools import partial
from numbers import Real
from types import SimpleNamespace
from typing import ClassVar

import torch
from torch import Tensor

from ir_maniskill import checks
from ir_maniskill.snapshot import Lazy, Snapshot, later

COLORS: dict[str, tuple[float, float, float]] = {
    "blue": (0.05, 0.16, 0.85),
    "red": (0.85, 0.06, 0.05),
    "green": (0.04, 0.60, 0.12),
    "yellow": (0.95, 0.75, 0.05),
    "purple": (0.50, 0.10, 0.65),
    "orange": (0.95, 0.40, 0.03),
}
"""Linear RGB of every color an object may have."""

SHAPES = ("cube", "button", "can", "pyramid")
"""Bodies of some 4 cm; all but `FIXED` are free."""

FIXED = ("button",)
"""Shapes that stay where they are put."""

DIRECTIONS = {
    "left": (0.0, 1.0, 0.0),
    "right": (0.0, -1.0, 0.0),
    "away": (1.0, 0.0, 0.0),
}
"""Where something may be pushed to, as seen by the robot."""

EXTREMES = {
    "leftmost": (1, 1.0),
    "rightmost": (1, -1.0),
    "nearest": (0, -1.0),
    "farthest": (0, 1.0),
}
"""Relations that one of several objects fits: axis and sign of what is largest."""

RELATIONS = ("left_of", "right_of", "other_than")
"""Relations to another object."""

MOVABLE = "what is not fixed to the table"
"""What errors expect where something else is to be moved."""

MOVED = 0.02
"""From which distance on an object counts as moved [m]."""


class GoalError(ValueError):
    """A goal or reference is malformed, or does not fit its scene."""


_require_choice = partial(checks.require_choice, error=GoalError)
_require_type = partial(checks.require_type, error=GoalError)


# -- References ------------------------------------------------------------------------


@dataclass(frozen=True)
class Relation:
    """Where an object is, beside another one."""

    kind: str
    """One of `RELATIONS`."""
    ref: Ref
    """The other object; nothing is left or right of none, or of several."""

    def __post_init__(self) -> None:
        _require_choice("relation", self.kind, RELATIONS)
        _require_type(self.kind, self.ref, Ref)

    def fits(self, scene: Snapshot) -> Tensor:
        """Return which objects are so [N, C] bool."""
        other = self.ref.resolve(scene)  # [N, C]
        if self.kind == "other_than":
            return ~other
        y = scene.start[..., 1]  # [N, C]
        at = (y * other).sum(dim=1, keepdim=True)
        beyond = y > at if self.kind == "left_of" else y < at
        return beyond & (other.sum(dim=1, keepdim=True) == 1)


left_of = partial(Relation, "left_of")
"""The relation "left of the ...", of its `Ref`."""
right_of = partial(Relation, "right_of")
"""The relation "right of the ...", of its `Ref`."""
other_than = partial(Relation, "other_than")
"""The relation "the one that is not the ...", of its `Ref`."""


@dataclass(frozen=True)
class Ref:
    """Says which object is meant; in its scene it must fit exactly one.

    It is resolved when an episode begins: what was leftmost then is meant to the end.

    Raises:
        GoalError: There is no such color, shape or relation.
    """

    color: str | None = None
    """A key of `COLORS`; None: any."""
    shape: str | None = None
    """One of `SHAPES`; None: any."""
    where: str | Relation | None = None
    """A key of `EXTREMES`, or a relation such as `left_of(Ref("red"))`; None: any."""

    def __post_init__(self) -> None:
        if self.color is not None:
            _require_choice("color of a Ref", self.color, COLORS)
        if self.shape is not None:
            _require_choice("shape of a Ref", self.shape, SHAPES)
        if not (self.where is None or isinstance(self.where, Relation)):
            _require_choice("where of a Ref", self.where, EXTREMES)

    def resolve(self, scene: Snapshot) -> Tensor:
        """Return which objects fit, one or not, at the start of the episode [N, C]."""
        fits = scene.color >= 0
        if self.color is not None:
            fits = fits & (scene.color == list(COLORS).index(self.color))
        if self.shape is not None:
            fits = fits & (scene.shape == SHAPES.index(self.shape))
        if isinstance(self.where, Relation):
            fits = fits & self.where.fits(scene)
        elif self.where is not None:
            axis, sign = EXTREMES[self.where]
            rank = torch.where(fits, sign * scene.start[..., axis], -torch.inf)
            fits = fits & (rank == rank.amax(dim=1, keepdim=True))
        return fits


# -- Measures --------------------------------------------------------------------------


def _left_out() -> Tensor:
    """Return what stands for a field that was left out."""
    return None  # type: ignore[return-value]


@dataclass(frozen=True)
class Measure(Lazy):
    """How far a goal is reached in N scenes, and what it allows.

    A field may be given as `later(function)`; what is left out comes later, too.
    """

    holds: Tensor
    """Whether the goal is reached now [N] bool."""
    gap: Tensor
    """How far it is from that, 0 where it holds [N] [m]."""
    serves: Tensor
    """Which contacts serve it; any other contact is a foul. Where no contact does,
    none is a foul but those in `bars` [N, F, C] bool."""
    bars: Tensor = field(default_factory=_left_out)
    """Which contacts are a foul in any case [N, F, C] bool; None: none."""
    level: Tensor = field(default_factory=_left_out)
    """How much of it is reached: what the reward counts [N]; None: 1 where it holds."""
    still: Tensor = field(default_factory=_left_out)
    """Objects whose motion the dense reward penalizes [N, C] bool; None: none."""
    may_move: Tensor = field(default_factory=_left_out)
    """Objects that may be moved; moving others is a foul [N, C] bool; None: all."""
    aim: Tensor = field(default_factory=_left_out)
    """Where fingertips should be to serve it, from each object's center [N, C, 3] [m];
    None: at it."""
    stage: Tensor = field(default_factory=_left_out)
    """How many goals of a sequence `Then` are reached [N] int64; None: 0."""

    def __post_init__(self) -> None:
        """Have what was left out come later."""
        defaults = {
            "bars": lambda: torch.zeros_like(self.serves),
            "level": lambda: self.holds.float(),
            "still": lambda: torch.zeros_like(self._objects),
            "may_move": lambda: torch.ones_like(self._objects),
            "aim": lambda: self._objects[..., None] * self.gap.new_zeros(3),
            "stage": lambda: torch.zeros_like(self.holds, dtype=torch.int64),
        }
        missing = {name for name in defaults if vars(self)[name] is None}
        vars(self).update((name, later(defaults[name])) for name in missing)
        vars(self)["_missing"] = missing
        super().__post_init__()

    @property
    def _objects(self) -> Tensor:
        """Something of the objects' shape [N, C] bool."""
        return self.serves[:, 0]

    def require_fit(self, scene: Snapshot) -> None:
        """Raise GoalError unless all that is known already is what it should be."""
        n, f, c = scene.contact.shape
        truth, number, count = torch.bool, torch.float32, torch.int64
        kinds = {
            "holds": (truth, n),
            "gap": (number, n),
            "serves": (truth, n, f, c),
            "bars": (truth, n, f, c),
            "level": (number, n),
            "still": (truth, n, c),
            "may_move": (truth, n, c),
            "aim": (number, n, c, 3),
            "stage": (count, n),
        }
        for name, (dtype, *shape) in kinds.items():
            value = vars(self).get(name)  # none if it comes later
            got = [getattr(value, "dtype", None), *getattr(value, "shape", ())]
            if value is not None and got != [dtype, *shape]:
                told = repr(value) if got == [None] else f"{got[0]} {got[1:]}"
                expected = f"{dtype} {shape} (N, F, C = {n}, {f}, {c})"
                raise GoalError(f"{name} of a Measure: got {told}, expected {expected}")

    def has(self, name: str) -> bool:
        """Return whether a field was given, not left out."""
        return name not in vars(self)["_missing"]

    @staticmethod
    def where(chosen: Tensor, first: Measure, second: Measure) -> Measure:
        """Return the first measure in the scenes chosen [N] bool, else the second."""

        def pick(name: str) -> Tensor:
            a, b = getattr(first, name), getattr(second, name)
            return torch.where(chosen.view(-1, *[1] * (a.ndim - 1)), a, b)

        names = [field.name for field in fields(Measure)]
        return Measure(**{name: later(partial(pick, name)) for name in names})


# -- Goals -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Goal(ABC):
    """What a sentence asks for. A subclass is a verb: its fields, and `measure`."""

    MOVES: ClassVar[tuple[str, ...]] = ()
    """Fields whose references are to be moved, so must not be of a `FIXED` shape."""

    @staticmethod
    @abstractmethod
    def measure(scene: Snapshot, asked: SimpleNamespace) -> Measure:
        """Measure N scenes.

        Args:
            scene: The scenes.
            asked: Goals of this kind, one for each scene, their fields stacked as the
                module's table says.
        """

    @property
    def parts(self) -> tuple[Goal, ...]:
        """The goals that this one is made of."""
        values = (getattr(self, f.name) for f in fields(self))
        return tuple(value for value in values if isinstance(value, Goal))

    @property
    def refs(self) -> tuple[Ref, ...]:
        """All references in it and its parts."""
        values = (getattr(self, f.name) for f in fields(self))
        own = tuple(value for value in values if isinstance(value, Ref))
        return own + tuple(ref for part in self.parts for ref in part.refs)

    @property
    def moved(self) -> tuple[Ref, ...]:
        """References in it and its parts to what is to be moved."""
        own = tuple(getattr(self, name) for name in self.MOVES)
        return own + tuple(ref for part in self.parts for ref in part.moved)

    def _check(self, **kinds: type) -> None:
        for name, kind in kinds.items():
            what = f"{name} of {type(self).__name__}"
            _require_type(what, getattr(self, name), kind)


def nearest(scene: Snapshot, serves: Tensor) -> Tensor:
    """Return how near a fingertip is to what it may touch [N, F, C] bool: [N] [m]."""
    return scene.distance.where(serves, torch.inf).flatten(1).amin(dim=1)


@dataclass(frozen=True)
class Touch(Goal):
    """Touch an object: "Touch the blue cube.", "... with your left hand."."""

    ref: Ref
    """Which object."""
    hand: str | None = None
    """With which of the robot's hands; None: any."""

    def __post_init__(self) -> None:
        self._check(ref=Ref)

    @staticmethod
    def measure(scene: Snapshot, asked: SimpleNamespace) -> Measure:
        """Hold while a finger is on the object; the level counts such fingers."""
        serves = asked.hand[:, :, None] & asked.ref[:, None]  # [N, F, C]
        fingers = (scene.contact & serves).any(dim=2).sum(dim=1)  # [N]
        holds = fingers > 0
        gap = later(lambda: nearest(scene, serves).masked_fill(holds, 0.0))
        return Measure(holds, gap, serves, level=fingers.float(), still=asked.ref)


@dataclass(frozen=True)
class Push(Goal):
    """Push an object so far: "Push the red cube to the left."."""

    MOVES = ("ref",)

    ref: Ref
    """Which object."""
    direction: str
    """A key of `DIRECTIONS`."""
    distance: float = 0.05
    """How far [m]."""

    STRAIGHT = 0.6
    """Largest share of the way that it may stray to the side."""
    LEVEL = 3.0
    """Level of a whole push: that of a touch with all fingers of one hand of NAO."""
    BEHIND = 0.04
    """How far behind its center fingers should be to push it [m]."""
    OVER = 0.05
    """How high above its center they pass over it on their way there [m]."""
    DOWN = 0.015
    """How near that place, seen from above, they are down [m]."""
    STEEP = 2.0
    """How steep they go down to it; also the weight of being higher or lower."""

    def __post_init__(self) -> None:
        self._check(ref=Ref, distance=Real)
        _require_choice("direction of Push", self.direction, DIRECTIONS)
        if not 0 < self.distance <= 0.5:
            raise GoalError(f"distance of Push: got {self.distance}, expected 0 to 0.5")

    @staticmethod
    def measure(scene: Snapshot, asked: SimpleNamespace) -> Measure:
        """Hold where the object is so far that way, and not far to the side."""
        moved = (scene.moved * asked.ref[..., None]).sum(dim=1)  # [N, 3]
        along = (moved * asked.direction).sum(dim=1)  # [N]
        aside = (moved - along[:, None] * asked.direction)[:, :2].norm(dim=1)
        holds = (along >= asked.distance) & (aside <= Push.STRAIGHT * along)
        strayed = (aside - Push.STRAIGHT * along.clamp(min=0)).clamp(min=0)
        serves = asked.ref[:, None].expand_as(scene.contact)
        behind = -Push.BEHIND * asked.ref[..., None] * asked.direction[:, None]
        off = scene.to_object - behind[:, None]  # [N, F, C, 3], from there
        ahead = (off * asked.direction[:, None, None]).sum(dim=3)
        over = (Push.STEEP * (ahead - Push.DOWN)).clamp(0, Push.OVER)
        x, y, z = off.unbind(dim=3)
        way = (x.square() + y.square() + (Push.STEEP * (z - over)).square()).sqrt()
        way = way.where(serves, torch.inf).flatten(1).amin(dim=1)
        gap = (asked.distance - along).clamp(min=0) + strayed + way
        gap = gap.masked_fill(holds, 0.0)
        progress = Push.LEVEL * ((along - strayed) / asked.distance).clamp(0, 1)
        return Measure(
            *(holds, gap, serves), level=progress, may_move=asked.ref, aim=behind
        )


@dataclass(frozen=True)
class Avoid(Goal):
    """Leave an object alone: "... but not the red one."."""

    ref: Ref
    """Which object."""

    def __post_init__(self) -> None:
        self._check(ref=Ref)

    @staticmethod
    def measure(scene: Snapshot, asked: SimpleNamespace) -> Measure:
        """Hold while no finger is on the object."""
        bars = asked.ref[:, None].expand_as(scene.contact)
        holds = ~(scene.contact & bars).flatten(1).any(dim=1)
        gap = torch.where(holds, 0.0, MOVED)
        level = torch.zeros_like(gap)
        return Measure(holds, gap, torch.zeros_like(bars), bars=bars, level=level)


@dataclass(frozen=True)
class Both(Goal):
    """Two goals at the same time."""

    HALF = 0.25
    """What is left of its level while one of them is not reached."""

    a: Goal
    """The one."""
    b: Goal
    """The other."""

    def __post_init__(self) -> None:
        self._check(a=Goal, b=Goal)
        if any(map(_is_sequence, self.parts)):
            raise GoalError("Both: got a Then in it, expected a Then around it")

    @staticmethod
    def measure(scene: Snapshot, asked: SimpleNamespace) -> Measure:
        """Hold where both do; contacts serve that serve either."""
        a, b = asked.a.measure(scene), asked.b.measure(scene)
        holds = a.holds & b.holds
        return Measure(
            holds=holds,
            gap=later(lambda: torch.maximum(a.gap, b.gap)),
            serves=a.serves | b.serves,
            bars=a.bars | b.bars,
            level=(a.level + b.level) * torch.where(holds, 1.0, Both.HALF),
            still=later(lambda: a.still | b.still),
            may_move=_may_move(a, b),
            aim=later(lambda: a.aim + b.aim),
        )


@dataclass(frozen=True)
class Then(Goal):
    """Two goals in this order; `b` counts from the step after `a` was reached."""

    a: Goal
    """The first; no sequence itself."""
    b: Goal
    """The second; it may be a sequence."""

    def __post_init__(self) -> None:
        self._check(a=Goal, b=Goal)
        if _is_sequence(self.a):
            raise GoalError("Then: got a Then as `a`, expected it as `b`")

    @staticmethod
    def measure(scene: Snapshot, asked: SimpleNamespace) -> Measure:
        """Hold where `a` was reached before and `b` holds now."""
        begun = scene.stage > 0  # [N], with `b`
        a = asked.a.measure(scene)
        b = asked.b.measure(scene.at_stage((scene.stage - 1).clamp(min=0)))
        first = dataclasses.replace(
            a, holds=torch.zeros_like(begun), stage=a.holds.long()
        )
        second = dataclasses.replace(
            b,
            serves=a.serves | b.serves,  # the hand is still where it was sent first
            level=1 + b.level,
            may_move=_may_move(a, b),
            stage=1 + b.stage,
        )
        return Measure.where(begun, second, first)


def _may_move(a: Measure, b: Measure) -> Tensor:
    """Return what two goals let move: each also what the other touches [N, C] bool."""
    touched_by_a, touched_by_b = a.serves.any(dim=1), b.serves.any(dim=1)
    return (a.may_move | touched_by_b) & (b.may_move | touched_by_a)


def _is_sequence(goal: Goal) -> bool:
    return isinstance(goal, Then) or any(map(_is_sequence, goal.parts))


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
        for ref in self.goal.moved:
            if ref.shape in FIXED:
                got = f"got a {ref.shape} to move, expected {MOVABLE}"
                raise GoalError(f"instruction {self.text!r}: {got}")
