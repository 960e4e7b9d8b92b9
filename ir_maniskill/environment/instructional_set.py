"""Instructional Set: sentences i_t, their tokens and their goals (Sec. III-A).

Legend: I instructions, N envs, L tokens, B bytes, F fingers, C objects.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from numbers import Real
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from ir_maniskill.checks import require_choice, require_type
from ir_maniskill.environment.senses import TEXT_BYTES, text_of, tokens_of
from ir_maniskill.experiment import Experiment, Spoken
from ir_maniskill.goals import (
    DIRECTIONS,
    FIXED,
    MOVABLE,
    SHAPES,
    Goal,
    GoalError,
    Instruction,
    Measure,
    Ref,
    Touch,
)
from ir_maniskill.language.draw import things
from ir_maniskill.snapshot import Snapshot

Deal = Callable[[Tensor, Tensor, Snapshot], Any]
"""Gives each scene its value of one field: rows [N] of the table, which rows count
[N] bool, scenes."""


class InstructionalSet:
    """The instructions of an experiment, and those that envs were told beside them.

    The I of the experiment come first; row I + n is what env n was told. `tokens` are
    their ids [I + N, L] int64, `text` is UTF-8 [I + N, B] uint8, both padded; `hands`
    says which fingers belong to each of the robot's hands [F] bool.

    Raises:
        GoalError: A goal asks for a hand that the robot does not have.
    """

    def __init__(
        self,
        experiment: Experiment,
        hands: Mapping[str, Tensor],
        device: torch.device,
        num_envs: int = 1,
    ) -> None:
        fixed = experiment.instructions
        own = () if isinstance(fixed, Spoken) else fixed
        self._experiment, self._size = experiment, len(own)
        self._hands, self._device = hands, device
        self._write([*own, *[UNTOLD] * num_envs])

    def __len__(self) -> int:
        """Return the number of the experiment's own: I."""
        return self._size

    def pick(self, uniform: Tensor) -> Tensor:
        """Map uniform numbers in [0, 1) to the experiment's own [N] int64."""
        return (uniform * len(self)).long().clamp(max=len(self) - 1)

    def told(self, said: Mapping[int, Instruction]) -> InstructionalSet:
        """Return the set in which some envs, by their places, were told something.

        Raises:
            GoalError: A sentence asks for a hand that the robot does not have.
        """
        instructions, other = list(self.instructions), copy.copy(self)
        for env, instruction in said.items():
            instructions[self._size + env] = instruction
        other._write(instructions)
        return other

    def _write(self, instructions: list[Instruction]) -> None:
        length, device = self._experiment.max_tokens, self._device
        texts = [instruction.text for instruction in instructions]
        self.instructions = instructions
        self.tokens = tokens_of(texts, self._experiment.vocabulary, length).to(device)
        self.text = text_of(texts, TEXT_BYTES).to(device)
        self.goals = GoalTable([i.goal for i in instructions], self._hands, device)


UNTOLD = Instruction("", Touch(Ref()))
"""What an env was told that was told nothing."""


@dataclass(frozen=True)
class GoalBatch:
    """One goal for each of N scenes; kinds may be mixed."""

    parts: tuple[tuple[Tensor, type[Goal], SimpleNamespace], ...]
    """For each kind: where it is asked [N] bool, the kind, its fields stacked."""

    def measure(self, scene: Snapshot) -> Measure:
        """Measure the goal of each scene."""
        (_, kind, asked), *others = self.parts
        measure = _measured(kind, scene, asked)
        for chosen, kind, asked in others:
            measure = Measure.where(chosen, _measured(kind, scene, asked), measure)
        return measure

    def rows(self, index: Tensor) -> GoalBatch:
        """Return the goals of some scenes [M], each as often as its row is named."""

        def pick(value: Tensor | GoalBatch) -> Tensor | GoalBatch:
            return value.rows(index) if isinstance(value, GoalBatch) else value[index]

        parts = []
        for chosen, kind, asked in self.parts:
            picked = {name: pick(value) for name, value in vars(asked).items()}
            parts.append((chosen[index], kind, SimpleNamespace(**picked)))
        return GoalBatch(tuple(parts))


def _measured(kind: type[Goal], scene: Snapshot, asked: SimpleNamespace) -> Measure:
    measure = kind.measure(scene, asked)
    require_type(f"{kind.__name__}.measure", measure, Measure, GoalError)
    measure.require_fit(scene)
    return measure


class GoalTable:
    """Goals as columns of tensors, by kind, to be dealt to any batch of scenes.

    Raises:
        GoalError: A field has a value that cannot be stacked.
    """

    def __init__(
        self, goals: Sequence[Goal], hands: Mapping[str, Tensor], device: torch.device
    ) -> None:
        self.kinds = list(dict.fromkeys(type(goal) for goal in goals))
        place = [self.kinds.index(type(goal)) for goal in goals]
        row = [place[:index].count(kind) for index, kind in enumerate(place)]
        self._kind = torch.tensor(place, device=device)  # [I] place in `kinds`
        self._row = torch.tensor(row, device=device)  # [I] row among its kind
        self._columns: list[dict[str, Deal]] = []
        for kind in self.kinds:
            alike = [goal for goal in goals if type(goal) is kind]
            columns = {}
            for name in (field.name for field in fields(kind)):
                values = [getattr(goal, name) for goal in alike]
                columns[name] = _column(name, values, hands, name in kind.MOVES)
            self._columns.append(columns)

    def deal(
        self, index: Tensor, scene: Snapshot, counts: Tensor | None = None
    ) -> GoalBatch:
        """Give each scene the goal of an index [N], its references resolved there.

        `counts` says which rows are asked at all [N] bool; None: all.

        Raises:
            GoalError: A reference does not fit exactly one object, or one that is to
                be moved and is fixed.
        """
        kind, row = self._kind[index], self._row[index]  # [N]
        parts = []
        for place in kind.unique().tolist():
            chosen = kind == place  # [N]
            counted = chosen if counts is None else chosen & counts
            rows = row.where(chosen, 0)
            asked = {
                name: deal(rows, counted, scene)
                for name, deal in self._columns[place].items()
            }
            parts.append((chosen, self.kinds[place], SimpleNamespace(**asked)))
        return GoalBatch(tuple(parts))


def _column(
    name: str, values: list[Any], hands: Mapping[str, Tensor], moves: bool
) -> Deal:
    """Return how the values of one field are dealt; see `goals` for the rules."""
    device = next(iter(hands.values())).device
    if all(isinstance(value, Ref) for value in values):
        return _refs(values, device, moves)
    if all(isinstance(value, Goal) for value in values):
        table = GoalTable(values, hands, device)
        return lambda rows, counts, scene: table.deal(rows, scene, counts)
    if name == "hand":
        return _indexed(torch.stack([_fingers(value, hands) for value in values]))
    if name == "direction":
        for value in values:
            require_choice("direction of a goal", value, DIRECTIONS, GoalError)
        return _indexed(torch.tensor([DIRECTIONS[v] for v in values], device=device))
    if all(isinstance(value, Real) for value in values):
        return _indexed(torch.tensor(values, dtype=torch.float32, device=device))
    got = " and ".join({type(value): repr(value) for value in values}.values())
    raise GoalError(
        f"field {name!r} of a goal: got {got}, expected a Ref, a Goal, a number, or a "
        "field named `hand` or `direction`; the same in all goals of its kind"
    )


def _indexed(column: Tensor) -> Deal:
    return lambda rows, counts, scene: column[rows]


def _fingers(hand: str | None, hands: Mapping[str, Tensor]) -> Tensor:
    if hand is None:
        return torch.stack(list(hands.values())).any(dim=0)
    if hand not in hands:
        raise GoalError(
            f"hand of a goal: got {hand!r}, available on this robot: {', '.join(hands)}"
        )
    return hands[hand]


def _refs(refs: list[Ref], device: torch.device, moves: bool) -> Deal:
    """Return how references become masks [N, C]; each is looked up once."""
    distinct = list(dict.fromkeys(refs))
    which = torch.tensor([distinct.index(ref) for ref in refs], device=device)

    def deal(rows: Tensor, counts: Tensor, scene: Snapshot) -> Tensor:
        used = which[rows]  # [N]
        masks = torch.zeros_like(scene.color, dtype=torch.bool)
        for place in used.unique().tolist():
            fits = distinct[place].resolve(scene)
            masks = torch.where((used == place)[:, None], fits, masks)
        wrong = counts & (masks.sum(dim=1) != 1)
        if wrong.any():
            env = int(wrong.nonzero()[0])
            there = ", ".join(f"{t.color} {t.shape}" for t in things(scene)[env])
            raise GoalError(
                f"{distinct[int(used[env])]}: got {int(masks[env].sum())} objects that "
                f"fit in env {env}, expected exactly one of its {there}"
            )
        if moves:
            stays = torch.tensor([s in FIXED for s in SHAPES], device=device)
            fixed = masks & stays[scene.shape.clamp(min=0)] & counts[:, None]
            if fixed.any():
                env, place = fixed.nonzero()[0].tolist()
                got = f"got a {SHAPES[int(scene.shape[env, place])]} to move"
                ref = distinct[int(used[env])]
                raise GoalError(f"{ref}: {got} in env {env}, expected {MOVABLE}")
        return masks

    return deal
