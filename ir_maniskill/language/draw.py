"""Drawing: a goal that is true of a scene, for training or for a split held out of it.

Objects are those of one scene, by their places in it. Lengths are those of a scene at
NAO's scale [m].
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import partial
from itertools import product
from random import Random
from typing import NamedTuple, TypeVar

from ir_maniskill.goals import (
    COLORS,
    EXTREMES,
    FIXED,
    RELATIONS,
    SHAPES,
    Avoid,
    Both,
    Goal,
    GoalError,
    Push,
    Ref,
    Relation,
    Then,
    Touch,
)
from ir_maniskill.language.splits import (
    HELD_OBJECTS,
    KINDS,
    SPLITS,
    TEAMS,
    VERBS,
    Name,
    status,
)
from ir_maniskill.snapshot import Snapshot

T = TypeVar("T")
Where = str | Relation | None
"""An extreme, or a relation to another object."""
Found = tuple[Name, Where, int]
"""An object: its description, and its place in the scene."""
Act = tuple[str, Name, Where, int]
"""A verb and its object."""

Allows = Callable[[Sequence[tuple[str, int]]], bool]
"""Whether verbs can be done to objects together, by their places in the scene; the verb
"name" only names one."""

MARGIN = 0.02
"""By how much a relation must be true to be said [m]."""


class Thing(NamedTuple):
    """An object on the table."""

    color: str
    """A key of `COLORS`."""
    shape: str
    """One of `SHAPES`."""
    x: float
    """How far ahead of the robot [m]."""
    y: float
    """How far to its left [m]."""


def things(scene: Snapshot) -> list[tuple[Thing, ...]]:
    """Return the objects of each of N scenes, as they lay at the start."""
    colors, shapes = tuple(COLORS), SHAPES
    rows = zip(
        scene.color.tolist(),
        scene.shape.tolist(),
        scene.start[..., :2].tolist(),
        strict=True,
    )
    return [
        tuple(
            Thing(colors[color], shapes[shape], *place)
            for color, shape, place in zip(*row, strict=True)
            if color >= 0
        )
        for row in rows
    ]


# -- Drawing ---------------------------------------------------------------------------


class _Scene:
    """What can be said of the objects of a scene."""

    def __init__(self, scene: Sequence[Thing], split: str, allows: Allows) -> None:
        self.things = scene
        self.allows = allows
        self.split = split if split in ("objects", "pairs") else "train"
        self.groups: dict[Name, list[int]] = {}  # whom each description fits
        for index, (color, shape, _, _) in enumerate(scene):
            for name in ((color, shape), (color, None), (None, shape), (None, None)):
                self.groups.setdefault(name, []).append(index)
        self.plain: list[Found] = [
            (name, None, group[0])
            for name, group in self.groups.items()
            if len(group) == 1 and name != (None, None)
        ]
        self.known = [  # what training may name beside what it acts on
            (name, index)
            for name, _, index in self.plain
            if scene[index][:2] not in HELD_OBJECTS and allows([("name", index)])
        ]

    def acts(
        self,
        verbs: Sequence[str],
        refs: Sequence[Found],
        split: str,
        alone: bool = True,
    ) -> list[Act]:
        """Return what verbs can do to objects in a split; `alone` asks `allows`."""
        return [
            (verb, name, where, index)
            for name, where, index in refs
            for color, shape, *_ in (self.things[index],)
            for verb in verbs
            # In other splits, the sentence must name what is new.
            if status(verb, color, shape) == split == status(verb, *name)
            and not (verb in VERBS["push"] and shape in FIXED)
            and (not alone or self.allows([(verb, index)]))
        ]

    def related(self, relation: str) -> list[Found]:
        """Return the objects that fit a relation, each with its description."""
        if relation in EXTREMES:
            return list(self._extreme(relation))
        return [
            found
            for landmark, at in self.known
            for found in self._beside(relation, landmark, at)
        ]

    def _extreme(self, relation: str) -> Iterator[Found]:
        axis, sign = EXTREMES[relation]
        far = [sign * (thing.x, thing.y)[axis] for thing in self.things]
        for name, group in self.groups.items():
            first, *others = sorted(group, key=far.__getitem__, reverse=True)
            if others and far[first] - far[others[0]] > MARGIN:
                yield name, relation, first

    def _beside(self, relation: str, landmark: Name, at: int) -> Iterator[Found]:
        where = Relation(relation, Ref(*landmark))
        sure, perhaps = self._side(relation, at)
        for name, group in self.groups.items():
            fits = [index for index in group if index in perhaps]
            if len(fits) != 1 or fits[0] not in sure:
                continue
            if relation != "other_than" or at in group:
                yield name, where, fits[0]

    def _side(self, relation: str, at: int) -> tuple[set[int], set[int]]:
        """Return who is surely on a side of an object, and who perhaps."""
        others = set(range(len(self.things))) - {at}
        if relation == "other_than":
            return others, others
        sign = 1 if relation == "left_of" else -1
        beyond = {i: sign * (self.things[i].y - self.things[at].y) for i in others}
        sure = {i for i in others if beyond[i] > MARGIN}
        return sure, {i for i in others if beyond[i] > -MARGIN}


def draw(
    scene: Sequence[Thing],
    kinds: Collection[str],
    rng: Random,
    split: str = "train",
    allows: Allows = lambda acts: True,
) -> Goal:
    """Return a goal that is true of a scene: each `Ref` fits exactly one object.

    Args:
        scene: What lies on the table; see `things`.
        kinds: Of `KINDS`; those that the scene allows are equally likely.
        rng: Draws it.
        split: One of `SPLITS`.
        allows: What the robot can do in this scene.

    Raises:
        GoalError: The scene allows none, or there is no such kind or split.
    """
    for what, got, known in (("kind", kinds, KINDS), ("split", (split,), SPLITS)):
        if unknown := [name for name in got if name not in known]:
            raise GoalError(
                f"{what}: got {unknown[0]!r}, available: {', '.join(known)}"
            )
    view = _Scene(scene, split, allows)
    for kind in _shuffled(kinds, rng):
        goal = _DRAW[kind](view, rng)
        if goal is not None:
            return goal
    names = ", ".join(f"{thing.color} {thing.shape}" for thing in scene)
    raise GoalError(
        f"draw: got a scene of {names or 'nothing'}, expected one of which a goal of "
        f"the split {split!r} and of these kinds is true: {', '.join(kinds)}"
    )


def _shuffled(values: Iterable[T], rng: Random) -> list[T]:
    return sorted(values, key=lambda _: rng.random())


def _pick(options: Sequence[T], rng: Random) -> T:
    return options[int(rng.random() * len(options))]


def _goal(found: Act) -> Goal:
    verb, name, where, _ = found
    first, _, last = verb.partition(" ")
    ref = Ref(*name, where)
    return Push(ref, last) if first == "push" else Touch(ref, first if last else None)


def _one(view: _Scene, rng: Random, verbs: Sequence[str]) -> Goal | None:
    """Return a goal with one of the verbs."""
    acts = view.acts(verbs, view.plain, view.split)
    return _goal(_pick(acts, rng)) if acts else None


def _where(view: _Scene, rng: Random) -> Goal | None:
    """Return a goal with a relation, or with something to leave alone."""
    hows = (*EXTREMES, *RELATIONS, "avoid")
    for how, verbs in _shuffled(product(hows, VERBS.values()), rng):
        refs = view.plain if how == "avoid" else view.related(how)
        for found in _shuffled(view.acts(verbs, refs, view.split), rng):
            if how != "avoid":
                return _goal(found)
            others = [name for name, index in view.known if index != found[3]]
            if others:
                return Both(_goal(found), Avoid(Ref(*_pick(others, rng))))
    return None


def _two(
    view: _Scene,
    rng: Random,
    kind: type[Both] | type[Then],
    verbs: Sequence[tuple[Sequence[str], Sequence[str]]],
) -> Goal | None:
    """Return a goal with two objects; what the split holds out is in one of them."""
    for pair, new in _shuffled(product(verbs, (0, 1)), rng):
        a, b = (
            view.acts(
                pair[i],
                view.plain,
                view.split if i == new else "train",
                alone=kind is Then,
            )
            for i in (0, 1)
        )
        both = [
            (x, y)
            for x, y in product(a, b)
            if x[3] != y[3]
            and (kind is Then or view.allows([(x[0], x[3]), (y[0], y[3])]))
        ]
        if both:
            return kind(*map(_goal, _pick(both, rng)))
    return None


_DRAW: dict[str, Callable[[_Scene, Random], Goal | None]] = {
    **{kind: partial(_one, verbs=verbs) for kind, verbs in VERBS.items()},
    "where": _where,
    "both": partial(_two, kind=Both, verbs=[((a,), (b,)) for a, b in TEAMS]),
    "then": partial(_two, kind=Then, verbs=[*product(VERBS.values(), VERBS.values())]),
}
