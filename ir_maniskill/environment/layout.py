"""Layouts: which objects an episode begins with, where, and what can be asked of them.

`Seats` lays out what an experiment lists; `Free` draws objects and places. Places are
those of a scene at NAO's scale [m]. Legend: b scenes, C slots, B bodies, K candidates.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from ir_maniskill.environment.robots.robot import Robot
from ir_maniskill.environment.table_objects import EMPTY
from ir_maniskill.experiment import Drawn, Experiment, Spoken
from ir_maniskill.goals import DIRECTIONS, Push
from ir_maniskill.language import Allows, Thing

CANDIDATES = 40
"""Places that are tried for each object; if none is free it is left out."""
NAMED_FIRST = 2
"""How many objects the split `places` lays in the part held out: those it names."""

# What a hand can do, as found with NAO's scripted solution: `evaluation/scripted.py`.
ACROSS = 0.04
"""How far past the middle line a hand touches [m]."""
INNER = 0.165 / 0.255
"""Nearest to its shoulder that a fingertip pushes, as a share of the reach."""
BEHIND, AT_END = 0.036, 0.034
"""Where the fingertip is when a push begins, behind the object's place, and when it
ends, beyond that [m]."""
PUSHES = {"outward": (0.05, math.inf), "inward": (0.02, 0.19), "away": (0.02, math.inf)}
"""How far to the hand's own side the object may lie (least, most) [m]."""
FREE_AHEAD, FREE_BEHIND, FREE_ARM = 0.06, 0.06, 0.05
"""Distance of others from where a pushed object goes, from the hand behind it, and from
the arm between shoulder and hand, which is low then [m]."""
BETWEEN_HANDS = 0.06
"""By how much the left hand's object must be further left than the other's [m]."""

Laid = tuple[np.ndarray, np.ndarray]
"""Which body is in each slot [b, C] int64, and where [b, C, 2] [m]."""


class Seats:
    """The objects of a list, each near its place, or in any of their places."""

    def __init__(self, experiment: Experiment, robot: Robot | type[Robot]) -> None:
        self.hands = robot.hands
        self.places = np.array([thing.position for thing in experiment.bodies])
        self.jitter = experiment.jitter.position
        self.shuffled = experiment.shuffled
        self.slots = len(self.places)
        self.noise = 3 * self.slots
        """Uniform numbers that a scene is made of."""

    def lay_out(self, noise: np.ndarray) -> Laid:
        """Return scenes, of uniform numbers in [0, 1) [b, 3 C]."""
        count = self.slots
        order, shift = noise[:, :count], noise[:, count:].reshape(-1, count, 2)
        seat = np.argsort(order) if self.shuffled else np.arange(count)
        xy = np.broadcast_to(self.places[seat], shift.shape)
        slots = np.broadcast_to(np.arange(count), order.shape)
        return slots, xy + self.jitter * (2 * shift - 1)

    def allows(self, things: Sequence[Thing]) -> Allows:
        """Return whether the robot has the hands that verbs take; no more is asked."""
        return lambda acts: hands_of(verb for verb, _ in acts) <= self.hands.keys()


class Free:
    """Objects drawn from a pool, anywhere in an area that the robot reaches."""

    def __init__(self, drawn: Drawn, robot: Robot | type[Robot], split: str) -> None:
        self.drawn = drawn
        self.split = split
        self.reach = robot.reach / robot.scale
        shoulders = [np.array(place) / robot.scale for place in robot.shoulders]
        self.hands = dict(zip(robot.hands, shoulders, strict=True))
        self.pool, self.slots = len(drawn.pool), drawn.count[1]
        self.noise = 1 + self.pool + 2 * self.slots * CANDIDATES
        """Uniform numbers that a scene is made of."""

    # -- Where things lie ------------------------------------------------------------

    def lay_out(self, noise: np.ndarray) -> Laid:
        """Return scenes, of uniform numbers in [0, 1) [b, noise]."""
        fewest, most = self.drawn.count
        count = fewest + (noise[:, :1] * (most - fewest + 1)).astype(int)  # [b, 1]
        pool, rest = np.split(noise[:, 1:], [self.pool], axis=1)
        slots = np.argsort(pool)[:, : self.slots]  # [b, C]
        wanted = np.arange(self.slots) < count  # [b, C]
        tried = self._candidates(rest.reshape(len(noise), self.slots, CANDIDATES, 2))
        found, xy = self._apart(tried, wanted)
        return np.where(found, slots, EMPTY), xy

    def _candidates(self, uniform: np.ndarray) -> np.ndarray:
        """Return places in the area [b, C, K, 2]."""
        low, high = np.array(self.drawn.area).T
        xy = low + (high - low) * uniform
        if self.split == "places":
            low, high = np.array(self.drawn.held_out).T
            xy[:, :NAMED_FIRST] = low + (high - low) * uniform[:, :NAMED_FIRST]
        return xy

    def _apart(self, tried: np.ndarray, wanted: np.ndarray) -> Laid:
        """Take the first place of each object that is free and within reach."""
        scenes = np.arange(len(tried))
        xy = np.zeros((*wanted.shape, 2))
        found = np.zeros(wanted.shape, dtype=bool)
        for slot in range(self.slots):
            near = [self._touches(hand, tried[:, slot]) for hand in self.hands]
            fits = np.any(near, axis=0)  # [b, K]
            for other in range(slot):
                gap = np.linalg.norm(tried[:, slot] - xy[:, None, other], axis=-1)
                fits &= (gap >= self.drawn.apart) | ~found[:, None, other]
            xy[:, slot] = tried[scenes, slot, fits.argmax(axis=1)]
            found[:, slot] = fits.any(axis=1) & wanted[:, slot]
        return found, xy

    # -- What can be asked -----------------------------------------------------------

    def allows(self, things: Sequence[Thing]) -> Allows:
        """Return whether the robot can do verbs to objects of a scene together.

        In the split `places` one of these objects must lie in the part held out.
        """
        new = self.split == "places"

        def allowed(acts: Sequence[tuple[str, int]]) -> bool:
            held_out = any(self.drawn.is_held_out(*things[i][2:]) for _, i in acts)
            (verb, index), *others = acts
            if verb == "name":
                return new or not held_out
            if held_out != new:
                return False
            if others:
                return self._can_both(acts, things)
            first, _, last = verb.partition(" ")
            if first == "push":
                return self._can_push(last, index, things)
            at, hands = np.array(things[index][2:]), hands_of([verb]) or self.hands
            return any(self._touches(hand, at) for hand in hands)

        return allowed

    def _touches(self, hand: str, xy: np.ndarray) -> np.ndarray:
        """Return whether a hand touches what is at these places [..., 2]: [...]."""
        if hand not in self.hands:
            return np.zeros(xy.shape[:-1], dtype=bool)
        shoulder = self.hands[hand]
        near = np.linalg.norm(xy - shoulder, axis=-1) <= self.reach
        return near & (np.sign(shoulder[1]) * xy[..., 1] >= -ACROSS)

    def _can_push(self, direction: str, index: int, things: Sequence[Thing]) -> bool:
        """Return whether a hand can get behind an object, and push it all the way."""
        ahead = np.array(DIRECTIONS[direction][:2])
        place = np.array(things[index][2:])
        beside = [t[2:] for i, t in enumerate(things) if i != index]
        others = np.array(beside).reshape(-1, 2)
        end, behind = place + Push.distance * ahead, place - BEHIND * ahead
        free = _away(others, place, end) > FREE_AHEAD
        free &= _away(others, behind, behind) > FREE_BEHIND
        return bool(free.all()) and any(
            self._pushes(shoulder, place, ahead, others)
            for shoulder in self.hands.values()
        )

    def _pushes(
        self,
        shoulder: np.ndarray,
        place: np.ndarray,
        ahead: np.ndarray,
        others: np.ndarray,
    ) -> bool:
        """Return whether a shoulder's arm reaches all along a push, over nothing."""
        side = np.sign(shoulder[1])
        ways = {1.0: "outward", -1.0: "inward", 0.0: "away"}
        least, most = PUSHES[ways[float(side * ahead[1])]]
        if side and not least <= side * place[1] <= most:
            return False
        ends = place + np.array([[-BEHIND], [AT_END]]) * ahead
        away = np.linalg.norm(ends - shoulder, axis=1)
        if not ((INNER * self.reach <= away) & (away <= self.reach)).all():
            return False
        return all((_away(others, shoulder, end) > FREE_ARM).all() for end in ends)

    def _can_both(
        self, acts: Sequence[tuple[str, int]], things: Sequence[Thing]
    ) -> bool:
        """Return whether two hands reach one object each, without crossing."""
        acts = sorted(acts, key=lambda act: -things[act[1]].y)  # from left to right
        places = np.array([things[index][2:] for _, index in acts])
        verbs = tuple(verb for verb, _ in acts)
        if places[0, 1] - places[1, 1] < BETWEEN_HANDS:
            return False
        if verbs == ("right hand", "left hand"):
            return False
        return all(map(self._touches, ("left", "right"), places))


def _away(places: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return how far places [n, 2] are from the segment from a to b [n] [m]."""
    way = b - a
    share = ((places - a) @ way / max(way @ way, 1e-12)).clip(0, 1)
    return np.linalg.norm(places - a - share[:, None] * way, axis=1)


def hands_of(verbs: Iterable[str]) -> set[str]:
    """Return the hands that verbs name, such as "left hand"."""
    return {verb.removesuffix(" hand") for verb in verbs if verb.endswith(" hand")}


def layout_of(experiment: Experiment, robot: Robot | type[Robot]) -> Seats | Free:
    """Return how the experiment's objects are laid out for a robot."""
    drawn, spoken = experiment.objects, experiment.instructions
    if isinstance(drawn, Drawn) and isinstance(spoken, Spoken):
        return Free(drawn, robot, spoken.split)
    return Seats(experiment, robot)
