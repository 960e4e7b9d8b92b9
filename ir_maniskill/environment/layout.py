"""Layouts: which objects an episode begins with, where, and what can be asked of them.

`Seats` lays out what an experiment lists; `Free` draws objects and places. Places are
those of a scene at NAO's scale [m]. Legend: b scenes, C slots, B bodies, K candidates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ir_maniskill.environment.robots.robot import Robot
from ir_maniskill.environment.table_objects import EMPTY
from ir_maniskill.experiment import Drawn, Experiment, Spoken
from ir_maniskill.goals import DIRECTIONS, Push
from ir_maniskill.language import Allows, Thing

CANDIDATES = 40
"""Places that are tried for each object; if none is free it is left out."""
NAMED_FIRST = 2
"""How many objects lie in the part held out, where only such may be named."""
ROOM_BEHIND = 0.09
"""Free way that a hand needs behind an object to push it [m]."""
ROOM_ASIDE = 0.055
"""Free way beside the line along which an object is pushed [m]."""

Laid = tuple[np.ndarray, np.ndarray]
"""Which body is in each slot [b, C] int64, and where [b, C, 2] [m]."""


class Seats:
    """The objects of a list, each near its place, or in any of their places."""

    def __init__(self, experiment: Experiment) -> None:
        self.places = np.array([thing.position for thing in experiment.bodies])
        self.jitter = experiment.jitter.position
        self.shuffled = experiment.shuffled
        self.noise = 3 * len(self.places)
        """Uniform numbers that a scene is made of."""

    def lay_out(self, noise: np.ndarray) -> Laid:
        """Return scenes, of uniform numbers in [0, 1) [b, 3 C]."""
        count = len(self.places)
        order, shift = noise[:, :count], noise[:, count:].reshape(-1, count, 2)
        seat = np.argsort(order) if self.shuffled else np.arange(count)
        xy = np.broadcast_to(self.places[seat], shift.shape)
        slots = np.broadcast_to(np.arange(count), order.shape)
        return slots, xy + self.jitter * (2 * shift - 1)

    def allows(self, things: Sequence[Thing]) -> Allows:
        """Return what says that anything may be asked: the experiment says what."""
        return lambda acts: True


class Free:
    """Objects drawn from a pool, anywhere in an area that the robot reaches."""

    def __init__(self, drawn: Drawn, robot: Robot, split: str) -> None:
        self.drawn = drawn
        self.split = split
        scale = robot.scale
        self.shoulders = np.array(robot.shoulders) / scale  # [hands, 2]
        self.reach = robot.reach / scale
        self.hands = dict(zip(robot.hands, self.shoulders, strict=False))
        self.slots = drawn.count[1]
        self.noise = 1 + len(drawn.pool) + 2 * self.slots * CANDIDATES
        """Uniform numbers that a scene is made of."""

    # -- Where things lie ------------------------------------------------------------

    def lay_out(self, noise: np.ndarray) -> Laid:
        """Return scenes, of uniform numbers in [0, 1) [b, noise]."""
        fewest, most = self.drawn.count
        count = fewest + (noise[:, :1] * (most - fewest + 1)).astype(int)  # [b, 1]
        pool, rest = np.split(noise[:, 1:], [len(self.drawn.pool)], axis=1)
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
            fits = np.any(self.reached(tried[:, slot]), axis=-1)  # [b, K]
            for other in range(slot):
                gap = np.linalg.norm(tried[:, slot] - xy[:, None, other], axis=-1)
                fits &= (gap >= self.drawn.apart) | ~found[:, None, other]
            xy[:, slot] = tried[scenes, slot, fits.argmax(axis=1)]
            found[:, slot] = fits.any(axis=1) & wanted[:, slot]
        return found, xy

    def reached(self, xy: np.ndarray) -> np.ndarray:
        """Return which arms reach places [..., 2] [m]: [..., arms] bool."""
        away = np.linalg.norm(xy[..., None, :] - self.shoulders, axis=-1)
        return away <= self.reach

    # -- What can be asked -----------------------------------------------------------

    def allows(self, things: Sequence[Thing]) -> Allows:
        """Return whether the robot can do verbs to objects of a scene together."""

        def allowed(acts: Sequence[tuple[str, int]]) -> bool:
            each = all(self._can(verb, index, things) for verb, index in acts)
            return each and (len(acts) == 1 or self._can_both(acts, things))

        return allowed

    def _can(self, verb: str, index: int, things: Sequence[Thing]) -> bool:
        _, _, x, y = things[index]
        held_out = self.drawn.is_held_out(x, y)
        first, _, last = verb.partition(" ")
        if first == "name":
            return self.split == "places" or not held_out
        if held_out != (self.split == "places"):
            return False
        if last == "hand":
            return self._hand_reaches(first, x, y)
        return first != "push" or self._can_push(last, index, things)

    def _hand_reaches(self, hand: str, x: float, y: float) -> bool:
        there = math.dist((x, y), self.hands[hand]) if hand in self.hands else math.inf
        return there <= self.reach

    def _can_push(self, direction: str, index: int, things: Sequence[Thing]) -> bool:
        """Return whether there is room to push, and an arm reaches all the way."""
        ahead = np.array(DIRECTIONS[direction][:2])
        start = np.array(things[index][2:])
        end = start + Push.distance * ahead
        others = np.array([t[2:] for i, t in enumerate(things) if i != index])
        if not (self.reached(start) & self.reached(end)).any():
            return False
        if not len(others):
            return True
        along = (others - start) @ ahead
        aside = np.abs((others - start) @ ahead[::-1])
        room = Push.distance + self.drawn.apart
        near = (along > -ROOM_BEHIND) & (along < room) & (aside < ROOM_ASIDE)
        return not near.any()
        return not (
            (along > -ROOM_BEHIND) & (along < room) & (aside < ROOM_ASIDE)
        ).any()

    def _can_both(
        self, acts: Sequence[tuple[str, int]], things: Sequence[Thing]
    ) -> bool:
        """Return whether two hands reach one object each, without crossing."""
        acts = sorted(acts, key=lambda act: -things[act[1]].y)  # from left to right
        verbs = tuple(verb for verb, _ in acts)
        if "touch" not in verbs:
            return verbs == ("left hand", "right hand")
        return all(
            self._hand_reaches(hand, *things[index][2:])
            for hand, (_, index) in zip(("left", "right"), acts, strict=True)
        )


def layout_of(experiment: Experiment, robot: Robot) -> Seats | Free:
    """Return how the experiment's objects are laid out for a robot."""
    drawn, spoken = experiment.objects, experiment.instructions
    if isinstance(drawn, Drawn) and isinstance(spoken, Spoken):
        return Free(drawn, robot, spoken.split)
    return Seats(experiment)
