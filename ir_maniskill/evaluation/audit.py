"""Audit: does a policy look, does it read, and how does it fare on what is new to it?

The same pinned episodes are played by the policy as they are, by it with something
taken from what it observes, and by others beside it; then sentence after sentence in
the same scene. Legend: N envs, L tokens, I instructions.
"""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import chain, islice
from random import Random
from typing import Any

import torch
from gymnasium.spaces import Dict
from torch import Tensor
from tqdm import tqdm

from ir_maniskill.checks import require_whole
from ir_maniskill.environment.robots import Nao
from ir_maniskill.environment.senses import (
    TEXT_BYTES,
    Observation,
    read_text,
    text_of,
    tokens_of,
)
from ir_maniskill.environment.shared_rows import map_leaves
from ir_maniskill.environment.speaker import sentence
from ir_maniskill.environment.vector import GpuVectorEnv, VectorEnv
from ir_maniskill.evaluation.evaluate import (
    Player,
    Rate,
    choose_instructions,
    play,
    score_by_name,
)
from ir_maniskill.evaluation.scripted import NotScriptedError, Scripted
from ir_maniskill.experiment import Experiment, Spoken
from ir_maniskill.goals import Goal, Instruction
from ir_maniskill.language import SPLITS, draw, things
from ir_maniskill.language.tokens import tokenize

log = logging.getLogger(__name__)

FEW = 100
"""Episodes below which intervals are too wide to tell much."""

SENTENCES = 4
"""How many different sentences are told in one scene at most."""

Make = Callable[..., VectorEnv]
"""Makes the envs of the task, given what is to be otherwise, such as `split`."""

Change = Callable[[Observation], Observation]
"""Takes something from what N envs observe."""


@dataclass(frozen=True)
class Row:
    """One row of the table: how often the goal was reached, and without a foul."""

    group: str
    """What is varied: "who", "kind", "split", "without" or "same scene"."""
    name: str
    """How."""
    success: Rate
    """Episodes, or scenes, in which the goal was reached."""
    exclusive: Rate
    """Those in which it was, without a foul at any step."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        names = {"group": self.group, "name": self.name, "total": self.success.total}
        rates = self.success.as_dict("success") | self.exclusive.as_dict("exclusive")
        return names | rates


@dataclass(frozen=True)
class AuditReport:
    """All that an audit found."""

    env_id: str
    """The task."""
    seed: int
    """Seed of the first episode; episode e has seed + e."""
    episodes: int
    """Episodes of each row but those of kinds and of the same scene."""
    rows: tuple[Row, ...]
    """The table."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {**vars(self), "rows": [row.as_dict() for row in self.rows]}

    def __str__(self) -> str:
        width = max(len(row.name) for row in self.rows)
        head = f"{'':<10}  {'':<{width}}      N  success [95%]        exclusive [95%]"
        lines, group = [head], ""
        for row in self.rows:
            title = row.group if row.group != group else ""
            group = row.group
            lines.append(
                f"{title:<10}  {row.name:<{width}}  {row.success.total:>5}  "
                f"{row.success!s:<19}  {row.exclusive}"
            )
        return "\n".join(lines)


def audit(
    player: Player,
    task: Experiment,
    make: Make,
    *,
    episodes: int,
    seed: int,
    progress: bool = False,
) -> AuditReport:
    """Play all that the table has.

    Args:
        player: The policy.
        task: What it plays.
        make: Makes the task's envs for it, at least two.
        episodes: How many for each row; below 100 there is a warning.
        seed: Seed of the first episode.
        progress: Whether to show a progress bar.

    Raises:
        ValueError: There are no episodes.
    """
    require_whole("episodes", episodes, 1)
    if episodes < FEW:
        log.warning("%d episodes: intervals are wide, take at least %d", episodes, FEW)
    found = _all_rows(player, task, make, episodes, seed)
    bar = tqdm(found, "audit", unit="row", disable=not progress, leave=False)
    return AuditReport(task.id, seed, episodes, tuple(chain(*bar)))


def _all_rows(
    player: Player, task: Experiment, make: Make, episodes: int, seed: int
) -> Iterator[list[Row]]:
    own, seeds = choose_instructions(task, None), range(seed, seed + episodes)
    told = [own[e % len(own)] for e in range(episodes)]
    with closing(make()) as envs:
        figures, names = play(player, envs, told, seeds)
        yield [_row("who", "the policy", figures)]
        anyhow, _ = play(at_random(envs), envs, told, seeds)
        yield [_row("who", "random actions", anyhow)]
        yield _scripted(envs, told, seeds)
        for name, score in score_by_name(figures, names).items():
            if score.success.total < episodes:
                yield [Row("kind", name, score.success, score.exclusive)]
        for name, change in controls(task, envs.single_observation_space).items():
            changed, _ = play(_changed(player, change), envs, told, seeds)
            yield [_row("without", name, changed)]
        if len(task.sentences) != 1:
            scenes = max(1, episodes // (len(task.sentences) or SENTENCES))
            yield same_scene(player, envs, scenes=scenes, seed=seed)
    for split in SPLITS[1:] if isinstance(task.instructions, Spoken) else ():
        with closing(make(split=split)) as envs:
            yield [_row("split", split, play(player, envs, told, seeds)[0])]


def _row(group: str, name: str, figures: Tensor) -> Row:
    """Return the row of episodes, of which `FIGURES` are given [E, 7]."""
    counts = figures[:, :2].sum(dim=0).long().tolist()
    success, exclusive = (Rate(count, len(figures)) for count in counts)
    return Row(group, name, success, exclusive)


# -- Who plays -------------------------------------------------------------------------


def at_random(envs: VectorEnv) -> Player:
    """Return one that does anything, always alike."""
    generator = torch.Generator().manual_seed(0)
    shape = envs.action_space.shape or ()

    def player(obs: Observation, done: Tensor | None) -> Tensor:
        return (2 * torch.rand(shape, generator=generator) - 1).to(envs.device)

    return player


def _scripted(
    envs: VectorEnv, told: Sequence[Instruction | None], seeds: Sequence[int]
) -> list[Row]:
    """Return the row of the scripted solution, if there is one for goals and robot."""
    with closing(blind(envs.experiment, robot_of(envs))) as alone:
        gc.freeze()  # ManiSkill collects garbage whenever it rebuilds a scene
        try:
            figures, _ = play(Scripted(alone.base_env), alone, told, seeds)
        except NotScriptedError as error:
            log.warning("no scripted solution: %s", error)
            return []
        finally:
            gc.unfreeze()
    return [_row("who", "the scripted solution", figures)]


def robot_of(envs: VectorEnv) -> str:
    """Return the uid of the robot in these envs."""
    found = envs.get_attr("robot_uids")  # of N envs, or of N vectors of one
    return found if isinstance(found, str) else found[0]


def blind(task: Experiment, robot: str = Nao.uid) -> GpuVectorEnv:
    """Return one env of this process, without pictures, of the task's kinds."""
    spoken = task.instructions
    return GpuVectorEnv(
        task.id,
        1,
        sim_backend="physx_cpu",
        render_backend="none",
        obs_mode="state_dict",
        control_mode="pd_joint_target_delta_pos",
        robot_uids=robot,
        kinds=spoken.kinds if isinstance(spoken, Spoken) else None,
    )


# -- What is taken away ----------------------------------------------------------------


def controls(task: Experiment, space: Any) -> dict[str, Change]:
    """Return what can be taken from observations of a space, by name.

    A policy that looks must fail with black pictures, and one that reads with another
    sentence than the one that the episode is judged by.
    """
    found: dict[str, Change] = {}
    if not isinstance(space, Dict):
        return found  # one flat vector: nothing in it has a name
    parts = space.spaces  # `in` would ask a space whether it holds an observation
    extra = getattr(parts.get("extra"), "spaces", {})
    if "sensor_data" in parts:
        found["black pictures"] = _with("sensor_data", torch.zeros_like)
        found["pictures of another env"] = _with("sensor_data", _of_another)
    if "touch" in extra:
        found["no touch"] = _with("extra", torch.zeros_like, "touch")
    if "agent" in parts:
        found["no joints"] = _with("agent", torch.zeros_like)
    if "instruction" in extra:
        found["no sentence"] = _with("extra", torch.zeros_like, "instruction", "text")
        own = task.instructions
        if isinstance(own, Spoken) or len({i.goal for i in own}) > 1:
            found["another sentence"] = _another_sentence(task)
        found["words spelt backwards"] = _backwards(task.vocabulary)
    return found


def _changed(player: Player, change: Change) -> Player:
    return lambda obs, done: player(change(obs), done)


def _with(part: str, change: Callable[[Tensor], Tensor], *names: str) -> Change:
    """Return what changes a part of the observation; of names given, these alone."""

    def changed(obs: Observation) -> Observation:
        tree = obs[part]
        new = {
            name: map_leaves(change, leaf) if name in (names or tree) else leaf
            for name, leaf in tree.items()
        }
        return {**obs, part: new}

    return changed


def _of_another(leaf: Tensor) -> Tensor:
    return leaf.roll(1, dims=0)


def _another_sentence(task: Experiment) -> Change:
    """Return what tells the task's next sentence of another goal, or another env's."""
    if isinstance(task.instructions, Spoken):
        return _with("extra", _of_another, "instruction", "text")
    tokens = tokens_of(task.sentences, task.vocabulary, task.max_tokens)
    text = text_of(task.sentences, TEXT_BYTES)
    goals = [own.goal for own in task.instructions]
    others = torch.tensor([_next_other(goals, i) for i in range(len(goals))])

    def changed(obs: Observation) -> Observation:
        extra, table = obs["extra"], tokens.to(obs["extra"]["instruction"])
        said = (extra["instruction"][:, None] == table).all(dim=2).int().argmax(dim=1)
        other = others.to(said)[said]
        new = {"instruction": table[other]}
        if "text" in extra:
            new["text"] = text.to(extra["text"])[other]
        return {**obs, "extra": {**extra, **new}}

    return changed


def _next_other(goals: Sequence[Goal], place: int) -> int:
    """Return the place of the next goal, round and round, that is another one."""
    turn = (*range(place, len(goals)), *range(place))
    return next(i for i in turn if goals[i] != goals[place])


def _backwards(vocabulary: tuple[str, ...]) -> Change:
    """Return what spells each word backwards, so that hardly one is known."""
    table = [tokenize(word[::-1], vocabulary)[0] for word in vocabulary[2:]]
    ids = torch.tensor([0, 1, *table])

    def spelt(text: Tensor) -> Tensor:
        said = [" ".join(w[::-1] for w in s.split()) for s in read_text(text)]
        return text_of(said, text.shape[1]).to(text)

    words = _with("extra", lambda leaf: ids.to(leaf.device)[leaf], "instruction")
    text = _with("extra", spelt, "text")
    return lambda obs: text(words(obs))


# -- The same scene --------------------------------------------------------------------


def same_scene(player: Player, envs: VectorEnv, *, scenes: int, seed: int) -> list[Row]:
    """Return in how many scenes every sentence is obeyed, and how many sentences.

    A policy that neither looks nor reads may have every single score by chance or by
    habit; only one that does both obeys all sentences in one scene. A fixed task has
    all of its sentences told, and a spoken one several that are true of the scene.
    """
    pairs = list(_told_in_each(envs, range(seed, seed + scenes)))
    if not pairs:
        return []
    seeds, told = zip(*pairs, strict=True)
    figures, _ = play(player, envs, told, seeds)
    of_scene = torch.tensor(seeds)[:, None] == torch.tensor(sorted(set(seeds)))
    failed = (1 - figures[:, :2]).T @ of_scene.double()  # [2, scenes]
    all_obeyed = (failed == 0).double().T
    return [
        _row("same scene", "every sentence of a scene", all_obeyed),
        _row("same scene", "one of its sentences", figures),
    ]


def _told_in_each(
    envs: VectorEnv, seeds: Sequence[int]
) -> Iterator[tuple[int, Instruction]]:
    """Yield each scene's seed with each of its sentences."""
    own = envs.experiment.instructions
    if not isinstance(own, Spoken):
        yield from ((seed, one) for one in own for seed in seeds)
        return
    with closing(blind(envs.experiment, robot_of(envs))) as alone:
        for seed in seeds:
            said = _sentences(alone, seed)
            yield from ((seed, one) for one in said if len(said) > 1)


def _sentences(envs: GpuVectorEnv, seed: int) -> list[Instruction]:
    """Return different sentences that are true of the scene of a seed."""
    task, found = envs.experiment, dict[Goal, Instruction]()
    assert isinstance(task.instructions, Spoken)
    scene = _scene(envs, seed, None)
    there = things(envs.base_env.snapshot())[0]
    allows = envs.base_env.layout.allows(there)
    for number in range(3 * SENTENCES):
        rng = Random(number)
        goal = draw(there, task.instructions.kinds, rng, allows=allows)
        found.setdefault(goal, Instruction(sentence(goal, rng, "train"), goal))
    same = (i for i in found.values() if _scene(envs, seed, i).equal(scene))
    return list(islice(same, SENTENCES))


def _scene(envs: GpuVectorEnv, seed: int, told: Instruction | None) -> Tensor:
    """Return where things lie in the scene of a seed."""
    options: dict[str, Any] = {"reconfigure": False}
    if told is not None:
        options["instruction"] = [told]
    envs.reset(seed=seed, options=options)
    return envs.base_env.snapshot().start
