"""Hindsight: what an episode would have been worth under other sentences.

A goal is measured on snapshots alone, so a hand that touched the wrong cube has shown
what touching that one is like. The rewards are those that the env would have given.

Legend: R = T + 1 rows of an episode of T steps, M sentences, F fingers, C objects.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from random import Random

import torch
from torch import Tensor
from torch.nn import functional

from ir_maniskill import experiment as catalog
from ir_maniskill.agent.object_vision import LENGTH
from ir_maniskill.environment import reward_generator
from ir_maniskill.environment.instructional_set import GoalBatch, GoalTable
from ir_maniskill.environment.layout import layout_of
from ir_maniskill.environment.reward_generator import Verdict
from ir_maniskill.environment.robots.robot import robot_class
from ir_maniskill.environment.senses import read_text, text_of, tokens_of
from ir_maniskill.environment.speaker import Speaker
from ir_maniskill.experiment import Experiment, Spoken
from ir_maniskill.goals import SHAPES, Goal, Instruction, Measure, Ref
from ir_maniskill.language import handwritten, loosely, parse, things
from ir_maniskill.snapshot import Snapshot
from ir_maniskill.training.config import TrainConfig

SOUGHT = 3
"""How many sentences are judged for each one that is kept."""
LOOSELY = 0.5
"""Share of the sentences that are said `loosely`, so that word by word counts."""


@dataclass(frozen=True)
class Judged:
    """An episode under M sentences; row 0 is how it began, with nothing paid."""

    reward: Tensor
    """What the step to each row is worth [R, M]."""
    goal: Tensor
    """What a critic is told of the scene, each goal and how far it is [R, M, D]."""
    named: Tensor
    """Middle of the objects that each sentence asks about [R, M, 3] [m]."""
    holds: Tensor
    """Whether each goal is reached [R, M] bool."""
    fouled: Tensor
    """Whether there was a foul so far [R, M] bool."""

    def columns(self, index: Tensor) -> Judged:
        """Return it under some of the sentences [m]."""
        return Judged(*(value[:, index] for value in vars(self).values()))


class Hindsight:
    """Finds sentences that are true of an episode's scene, and judges it under them."""

    def __init__(
        self,
        experiment: Experiment,
        hands: Mapping[str, Sequence[str]],
        weights: Tensor | None,
        others: int,
        speaker: Speaker | None = None,
    ) -> None:
        """Take what the env judges by.

        Args:
            experiment: The task.
            hands: The robot's hands, and the fingers of each.
            weights: Of the dense reward's terms [K]; None: the sparse reward.
            others: Sentences to find beside the episode's own, at most.
            speaker: Draws the sentences, if the task does not list them.
        """
        self.experiment, self.weights, self.speaker = experiment, weights, speaker
        fingers = [finger for hand in hands.values() for finger in hand]
        self.fingers = len(fingers)
        self.hands = {
            name: torch.tensor([finger in own for finger in fingers])
            for name, own in hands.items()
        }
        listed = experiment.instructions
        self._listed = () if isinstance(listed, Spoken) else listed
        self.others = min(others, len(self._listed) - 1) if self._listed else others

    @property
    def sentences(self) -> int:
        """M, under which each episode is kept."""
        return 1 + self.others

    @classmethod
    def of(cls, config: TrainConfig, others: int) -> Hindsight:
        """Return that of a training's task and robot."""
        experiment = catalog.get(config.env_id).in_split(kinds=config.kinds)
        robot = robot_class(config.robot)
        dense = config.reward_mode == "dense"
        weights = config.reward_weights.vector() if dense else None
        speaker = None
        if isinstance(experiment.instructions, Spoken):
            speaker = Speaker(experiment, layout_of(experiment, robot))
        return cls(experiment, robot.hands, weights, others, speaker)

    # -- Sentences -------------------------------------------------------------------

    def find(self, start: Snapshot, said: str | None, others: int) -> list[Instruction]:
        """Return instructions that are true of a scene [1]: what was said, and others.

        Of a task that lists its sentences, there are at most as many as it has; of one
        that draws them there is none where nothing was said and nothing can be.
        """
        own = [] if said is None else [self.said(said)]
        if self.speaker is None:
            listed = [each for each in self._listed if each not in own]
            order = torch.randperm(len(listed))[:others].tolist()
            return [*own, *(listed[i] for i in order)]
        rng = Random(int(torch.randint(2**31, ())))
        (scene,) = things(start)
        drawn = (self.speaker.say(scene, rng) for _ in range(others))
        found = own + [each for each in drawn if each is not None]
        return (found * (others + 1))[: others + 1]

    def choose(
        self, episode: Snapshot, said: str | None
    ) -> tuple[list[Instruction], Judged] | None:
        """Return the M instructions that most can be learned from, and their judgement.

        Of the others, half are those that the episode happened to fulfil, if there are
        so many, and half are any. None: nothing can be said.
        """
        found = self.find(episode.rows(torch.tensor([0])), said, SOUGHT * self.others)
        if not found:
            return None
        judged = self.judge(episode, found)
        lucky = _in_turns(found, judged.holds.any(dim=0))
        first = [0, *(i for i in lucky if i > 0)][: 1 + self.others // 2]
        others = [i for i in torch.randperm(len(found)).tolist() if i not in first]
        chosen = [*first, *others][: self.sentences]
        return [found[i] for i in chosen], judged.columns(torch.tensor(chosen))

    def said(self, text: str) -> Instruction:
        """Return the instruction of a sentence."""
        listed = self._listed or handwritten()  # of which some cannot be read
        known = {instruction.text: instruction for instruction in listed}
        return known.get(text) or Instruction(text, parse(text))

    def read(
        self, instructions: Sequence[Instruction], entries: Mapping[str, int]
    ) -> dict[str, Tensor]:
        """Return the sentences as a state has them [M, ...], in entries so long.

        Of those that are spoken, some are said `LOOSELY`.
        """
        texts, read = [instruction.text for instruction in instructions], {}
        if self.speaker is not None:
            rng = Random(int(torch.randint(2**31, ())))
            texts = [
                loosely(text, rng) if rng.random() < LOOSELY else text for text in texts
            ]
        if "instruction" in entries:
            words, length = self.experiment.vocabulary, entries["instruction"]
            read["instruction"] = tokens_of(texts, words, length).to(torch.int16)
        if "text" in entries:
            read["text"] = text_of(texts, entries["text"])
        return read

    # -- Judging ---------------------------------------------------------------------

    def judge(self, episode: Snapshot, instructions: Sequence[Instruction]) -> Judged:
        """Judge an episode [R], whose goals are resolved where it began."""
        rows, count = len(episode.contact), len(instructions)
        table = GoalTable([i.goal for i in instructions], self.hands, _CPU)
        start = episode.rows(torch.zeros(count, dtype=torch.int64))
        goals = table.deal(torch.arange(count), start)
        goals = goals.rows(torch.arange(count).repeat(rows))
        scene = episode.rows(torch.arange(rows).repeat_interleave(count))
        scene, measure, after = _staged(scene, goals, rows)
        verdict = reward_generator.judge(scene, measure)
        foul = verdict.foul.view(rows, count).clone()
        foul[0] = False  # what was before the first step is nobody's fault
        fouled = foul.cummax(dim=0).values.flatten()
        reward = self._pay(scene, measure, verdict, fouled).view(rows, count)
        goal = describe(scene, after, verdict, fouled)
        named = _middle(scene.position, after)
        return Judged(
            reward=reward * (torch.arange(rows) > 0)[:, None],
            goal=goal.view(rows, count, -1),
            named=named.view(rows, count, 3),
            holds=measure.holds.view(rows, count),
            fouled=fouled.view(rows, count),
        )

    def _pay(
        self, scene: Snapshot, measure: Measure, verdict: Verdict, fouled: Tensor
    ) -> Tensor:
        if self.weights is None:
            wrong = verdict.wrong.sum(dim=1)
            return reward_generator.sparse_reward(
                self.experiment, measure.holds, measure.level, wrong
            )
        terms = reward_generator.reward_terms(scene, measure, verdict, fouled)
        return terms @ self.weights


_CPU = torch.device("cpu")


def _in_turns(found: Sequence[Instruction], fulfilled: Tensor) -> list[int]:
    """Return which were fulfilled: what they ask takes turns, the rarest first."""
    alike: dict[object, list[int]] = defaultdict(list)
    for i in torch.randperm(len(found)).tolist():
        if fulfilled[i]:
            alike[_asked(found[i].goal)].append(i)
    turns = itertools.zip_longest(*sorted(alike.values(), key=len))
    return [i for turn in turns for i in turn if i is not None]


def _asked(goal: Goal) -> tuple[object, ...]:
    """Return what a goal asks, of whatever object."""
    values = [getattr(goal, field.name) for field in fields(goal)]
    asked = [value for value in values if not isinstance(value, Ref)]
    return type(goal), *(_asked(v) if isinstance(v, Goal) else v for v in asked)


def _staged(
    scene: Snapshot, goals: GoalBatch, rows: int
) -> tuple[Snapshot, Measure, Measure]:
    """Measure goals at the stage that sequences had reached before each row.

    Returns:
        The scenes at that stage, what was measured there, and what is asked after it.
    """
    scene = scene.at_stage(torch.zeros_like(scene.stage))
    measure = goals.measure(scene)
    while True:  # each round finds what follows from one more goal that was reached
        reached = measure.stage.view(rows, -1).clone()
        reached[0] = 0
        reached = reached.cummax(dim=0).values
        before = reached.roll(1, dims=0)
        before[0] = 0
        if torch.equal(before.flatten(), scene.stage):
            break
        scene = scene.at_stage(before.flatten())
        measure = goals.measure(scene)
    if not reached.any():
        return scene, measure, measure
    return scene, measure, goals.measure(scene.at_stage(reached.flatten()))


def _middle(values: Tensor, measure: Measure) -> Tensor:
    """Return the mean over the objects that a goal asks about [N, C, 3] -> [N, 3]."""
    named = measure.serves.any(dim=1)[..., None]  # [N, C, 1]
    return (values * named).sum(dim=1) / named.sum(dim=1).clamp(min=1)


class Pursuit:
    """The goals that N envs pursue, told as `Hindsight.judge` tells them."""

    def __init__(self, hindsight: Hindsight, envs: int) -> None:
        """Begin with no goals."""
        self.hindsight, self.envs = hindsight, envs
        self._asked: list[Goal | None] = [None] * envs
        self._goals = GoalBatch(())
        self._fouled = torch.zeros(envs, dtype=torch.bool)
        self._stage = torch.zeros(envs, dtype=torch.int64)

    def forget(self, envs: Iterable[int]) -> None:
        """Learn that new episodes begin in some envs."""
        for env in envs:
            self._asked[env] = None

    def look(self, scene: Snapshot, text: Tensor) -> Tensor:
        """Return what is told of the goals [N, D]; once a step, in its order.

        Args:
            scene: The envs now.
            text: What each was told [N, B].
        """
        new = torch.tensor([goal is None for goal in self._asked])
        if new.any():
            pairs = zip(self._asked, read_text(text), strict=True)
            asked = [goal or self.hindsight.said(said).goal for goal, said in pairs]
            table = GoalTable(asked, self.hindsight.hands, _CPU)
            self._asked = [*asked]
            self._goals = table.deal(torch.arange(self.envs), scene)
        measure = self._goals.measure(scene)
        # What was a foul depends on what was asked for when the step began.
        before = scene.at_stage(self._stage.where(~new, scene.stage))
        verdict = reward_generator.judge(before, self._goals.measure(before))
        self._fouled = (self._fouled | verdict.foul) & ~new
        self._stage = scene.stage
        return describe(scene, measure, verdict, self._fouled)


# -- What critics read -----------------------------------------------------------------


def describe(
    scene: Snapshot, measure: Measure, verdict: Verdict, fouled: Tensor
) -> Tensor:
    """Return a scene, what a goal asks of it, and how far it is, as numbers [N, D].

    Of a goal they tell what its measure says, so they serve for any kind.
    """
    serves, there = measure.serves, scene.color >= 0  # [N, F, C], [N, C]
    way = _nearest(measure.aim[:, None] - scene.to_object, serves)
    threat = _nearest(
        -scene.to_object, reward_generator.forbidden(measure) & there[:, None]
    )
    order = _order(scene, measure)
    ours = partial(_in_order, order)
    kinds = functional.one_hot(scene.shape.clamp(min=0), len(SHAPES)) * there[..., None]
    flags = (
        *(ours(serves, dim=2), ours(scene.contact, dim=2)),
        *map(ours, (measure.bars.any(dim=1), measure.may_move, measure.still, there)),
        *(ours(kinds), verdict.right, verdict.wrong, verdict.disturbed),
        *(measure.holds, fouled),
    )
    places = (scene.position, scene.moved, measure.aim)
    middle, moved, aim = (_middle(place, measure) for place in places)
    lengths = (
        *(scene.fingertip, way, threat, middle, 2 * moved, 2 * aim),
        *map(ours, (scene.position * there[..., None], 2 * scene.moved)),
        ours(scene.velocity),
    )
    numbers = (measure.level, measure.gap / LENGTH, measure.stage)
    columns = [
        *(flag.flatten(1) if flag.ndim > 1 else flag[:, None] for flag in flags),
        *(length.flatten(1) / LENGTH for length in lengths),
        *(number[:, None] for number in numbers),
    ]
    return torch.cat([column.float() for column in columns], dim=1).clamp(-10, 10)


def _order(scene: Snapshot, measure: Measure) -> Tensor:
    """Return the objects as critics read them, whatever slots they lie in [N, C].

    First comes what a goal asks about, from right to left, then the nearest to that; if
    it asks about none, as `Avoid` does, the nearest to the torso.
    """
    asked, y = measure.serves.any(dim=1), scene.start[..., 1]  # [N, C]
    off = scene.start[..., :3] - _middle(scene.start[..., :3], measure)[:, None]
    rank = torch.where(asked, y, 10 + off.norm(dim=2))
    return rank.masked_fill(scene.color < 0, torch.inf).argsort(dim=1)


def _in_order(order: Tensor, values: Tensor, dim: int = 1) -> Tensor:
    """Return what is known of each object along `dim`, in an order [N, C]."""
    shape = [1] * values.ndim
    shape[0], shape[dim] = order.shape
    return values.gather(dim, order.view(shape).expand_as(values))


def _nearest(ways: Tensor, which: Tensor) -> Tensor:
    """Return the shortest way of each finger [N, F, C, 3] to some objects [N, F, C].

    It is 0 where there is none: [N, F, 3] [m].
    """
    near = ways.norm(dim=3).where(which, torch.inf).argmin(dim=2)[..., None, None]
    shortest = ways.gather(2, near.expand(-1, -1, 1, 3)).squeeze(2)
    return shortest * which.any(dim=2, keepdim=True)
