"""Speaker: draws scenes with something to say of each, and says it (Sec. III-A).

Legend: b scenes, C slots.
"""

from __future__ import annotations

from collections.abc import Sequence
from random import Random
from typing import NamedTuple

import numpy as np

from ir_maniskill.environment.layout import Free, Seats, hands_of
from ir_maniskill.experiment import Experiment, Spoken, scene_of
from ir_maniskill.goals import FIXED, Goal, GoalError, Instruction, Ref
from ir_maniskill.language import Thing, draw, handwritten, kind_of, say
from ir_maniskill.language.splits import HELD_OBJECTS, acts_of, refs_of, status
from ir_maniskill.language.tokens import split_words

SCENES = 5000
"""How many scenes are drawn at most to find one that a sentence is true of."""

PATIENCE = 100
"""How many of them for a kind of sentence, before another one will do."""

BY_HAND = 0.5
"""Share of the sentences of the split `wording` that were written by hand."""


class _Wish(NamedTuple):
    """What a scene is to be drawn for."""

    rng: Random
    """Draws what is said."""
    wanted: Instruction | None = None
    """What is to be said; None: anything."""
    kind: str = ""
    """Of which kind, if that can be; empty: of any."""
    free: bool = False
    """Whether it may be asked where training would not ask it."""


class Speaker:
    """What is said in the scenes of an experiment with `Spoken` instructions."""

    def __init__(self, experiment: Experiment, layout: Seats | Free) -> None:
        assert isinstance(experiment.instructions, Spoken)
        self.spoken = experiment.instructions
        self.bodies = experiment.bodies
        self.layout = layout
        written = handwritten() if self.spoken.split == "wording" else ()
        self.by_hand = [i for i in written if self._may_come_up(i.goal)]

    def draw(
        self,
        streams: Sequence[np.random.RandomState],
        told: Sequence[Instruction] | None = None,
    ) -> tuple[np.ndarray, np.ndarray, list[Instruction]]:
        """Draw a scene from each of b random streams.

        Args:
            streams: One for each scene.
            told: What is to be said in each; None: it is drawn.

        Returns:
            Which body is in each slot [b, C], where [b, C, 2] [m], and what is said.

        Raises:
            GoalError: No scene was found of which an instruction is true.
        """
        if told is None:
            wishes = [self._wish(stream) for stream in streams]
        else:  # what users ask for need not be in reach
            rngs = map(_rng, streams)
            wishes = [_Wish(*pair, free=True) for pair in zip(rngs, told, strict=True)]
        slots = np.empty((len(wishes), self.layout.slots), dtype=np.int64)
        places = np.empty((*slots.shape, 2))
        said: dict[int, Instruction] = {}
        left = [*range(len(wishes))]  # who has no scene yet
        for tried in range(SCENES):
            noise = [streams[i].uniform(size=self.layout.noise) for i in left]
            slots[left], places[left] = self.layout.lay_out(np.stack(noise))
            for i in left:
                there = self._things(slots[i], places[i])
                if there and (answer := self._answer(wishes[i], there, tried)):
                    said[i] = answer
            left = [i for i in left if i not in said]
            if not left:
                return slots, places, [said[i] for i in range(len(wishes))]
        wanted = wishes[left[0]].wanted
        asked = self.spoken if wanted is None else repr(wanted.text)
        raise GoalError(
            f"instruction: got {asked}, expected what is true of one of {SCENES} "
            "scenes, moves nothing fixed and, if it is drawn, is in the hands' reach"
        )

    def _may_come_up(self, goal: Goal) -> bool:
        """Return whether there are the hands and the objects that a goal takes."""
        hands, kind = self.layout.hands.keys(), kind_of(goal)
        able = hands_of(verb for verb, _ in acts_of(goal)) <= hands
        able &= kind != "both" or len(hands) == 2
        there = all(map(self._is_there, refs_of(goal)))
        return kind in self.spoken.kinds and able and there

    def _is_there(self, ref: Ref) -> bool:
        """Return whether a body has the color and shape of a reference."""
        return any(
            ref.color in (None, body.color) and ref.shape in (None, body.shape)
            for body in self.bodies
        )

    def _wish(self, stream: np.random.RandomState) -> _Wish:
        """Return what is to be said in a scene that is yet to be drawn."""
        rng = _rng(stream)
        kind = rng.choice(self.spoken.kinds)
        if self.by_hand and rng.random() < BY_HAND:
            return _Wish(rng, self.by_hand[int(rng.random() * len(self.by_hand))])
        return _Wish(rng, kind=kind)

    def _answer(
        self, wish: _Wish, scene: Sequence[Thing], tried: int
    ) -> Instruction | None:
        """Return what is said of a scene; None: it does not do."""
        never = tried > SCENES // 2 and not wish.free
        if wish.wanted is None or never:
            # What is listed may never fit what was written by hand. And a kind may be
            # impossible, such as two hands for a robot with one.
            kinds = [wish.kind] if wish.kind and tried < PATIENCE else ()
            return self.say(scene, wish.rng, kinds)
        goal = wish.wanted.goal
        fits = self.is_true(goal, scene) and (wish.free or self.can_ask(goal, scene))
        return wish.wanted if fits else None

    def _things(self, slot: np.ndarray, xy: np.ndarray) -> list[Thing]:
        """Return the objects that lie there, of slots [C] and places [C, 2]."""
        return [
            Thing(self.bodies[index].color, self.bodies[index].shape, *place)
            for index, place in zip(slot.tolist(), xy.tolist(), strict=True)
            if index >= 0
        ]

    def say(
        self, scene: Sequence[Thing], rng: Random, kinds: Sequence[str] = ()
    ) -> Instruction | None:
        """Return something to say of a scene; None: there is nothing.

        It is of one of the kinds, or of any that the experiment has.
        """
        spoken, allows = self.spoken, self.layout.allows(scene)
        try:
            goal = draw(scene, kinds or spoken.kinds, rng, spoken.split, allows)
        except GoalError:
            return None
        return Instruction(sentence(goal, rng, spoken.split), goal)

    def is_true(self, goal: Goal, scene: Sequence[Thing]) -> bool:
        """Return whether each of a goal's references fits one object of a scene.

        What is to be moved must not be fixed.
        """
        for ref in goal.refs:
            fits = _fits(ref, scene)
            if len(fits) != 1:
                return False
            if ref in goal.moved and scene[fits[0]].shape in FIXED:
                return False
        return True

    def can_ask(self, goal: Goal, scene: Sequence[Thing]) -> bool:
        """Return whether a goal that is true can be asked for in training's scenes."""
        allows = self.layout.allows(scene)
        acts = [(verb, i) for verb, ref in acts_of(goal) for i in _fits(ref, scene)]
        named = [i for ref in refs_of(goal) for i in _fits(ref, scene)]
        if any(status(verb, *scene[i][:2]) != "train" for verb, i in acts):
            return False
        if any(scene[i][:2] in HELD_OBJECTS for i in named):
            return False
        together = [acts] if kind_of(goal) == "both" else [[act] for act in acts]
        return all(allows([("name", i)]) for i in named) and all(map(allows, together))


def _rng(stream: np.random.RandomState) -> Random:
    return Random(int(stream.uniform() * 2**53))


def _fits(ref: Ref, scene: Sequence[Thing]) -> list[int]:
    """Return which objects of a scene a reference fits."""
    found: list[int] = ref.resolve(scene_of(scene))[0].nonzero().flatten().tolist()
    return found


def sentence(goal: Goal, rng: Random, split: str) -> str:
    """Return a sentence for a goal, in the wording of a split."""
    while True:
        text = say(goal, rng, wording=split == "wording")
        if len(split_words(text)) <= Spoken.MAX_TOKENS:
            return text
