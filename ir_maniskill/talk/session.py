"""Session: one robot, one scene, and what it is told; no web in here.

All calls come from one thread, the simulator's. Legend: F fingers, C objects, B bodies.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Any

import gymnasium as gym
import numpy as np
import sapien
import torch
from mani_skill.utils.structs import Actor

from ir_maniskill import experiment as catalog
from ir_maniskill.checks import require_choice
from ir_maniskill.environment.robots.nao import Nao
from ir_maniskill.environment.robots.robot import available_robots, short_name
from ir_maniskill.environment.senses import cameras
from ir_maniskill.experiment import OBJECT_SIZE, TABLE, Spoken
from ir_maniskill.goals import GoalError, Instruction
from ir_maniskill.language import draw, say, things
from ir_maniskill.policy import Policy
from ir_maniskill.snapshot import Snapshot
from ir_maniskill.talk.players import (
    RANDOM,
    RandomMotion,
    fitting,
    guesses,
    load,
    shortened,
)
from ir_maniskill.talk.reading import Reading, clean, names, read

PAPER = {
    "I": "NaoTouchCubeSingle-v1",
    "II": "NaoTouchCubeMulti-v1",
    "III": "NaoTouchCubeTriangle-v1",
}
"""The paper's experiments."""
APART = 1.25 * OBJECT_SIZE
"""How near an object may be dragged to another one, between centers [m]."""
LASTS = 2
"""How long a run of an experiment gives each sentence [episodes]."""


def robots() -> list[str]:
    """Return the names of the robots that there are."""
    return [short_name(uid) for uid in available_robots()]


@dataclass(frozen=True)
class Choice:
    """What is played."""

    task: str
    """Id of the task."""
    robot: str
    """Its name."""
    policy: str
    """Name of what moves it."""


@dataclass(frozen=True)
class Score:
    """What came of the sentence so far."""

    success: bool = False
    """Whether the goal holds now."""
    success_once: bool = False
    """Whether it has held."""
    wrong: int = 0
    """How often a finger began to touch what the sentence does not allow."""
    steps: int = 0
    """Steps since it was said."""
    reward: float = 0.0
    """Sum of the rewards since then."""


@dataclass(frozen=True)
class Run:
    """A run of an experiment: its sentences one after the other."""

    sentences: tuple[str, ...]
    """What is said, in order."""
    reached: tuple[bool, ...] = ()
    """Of those that are over: whether the goal was reached."""

    @property
    def over(self) -> bool:
        """Whether all sentences are."""
        return len(self.reached) == len(self.sentences)


class Session:
    """A conversation with one robot.

    Example:
        >>> session = Session("NaoInstruct-v1")
        >>> session.tell("Touch the object nearest to you.")
        >>> for _ in range(60):
        ...     session.step()
        >>> session.score.success_once
    """

    def __init__(
        self,
        task: str,
        *,
        robot: str = Nao.uid,
        checkpoint: Path | None = None,
        policy: bool = True,
        seed: int = 0,
    ) -> None:
        """Open the scene.

        Args:
            task: Id of the task.
            robot: Who does it.
            checkpoint: A policy's file; None: what ships for the task.
            policy: Whether a policy moves the robot, if one fits, or chance.
            seed: Seed of the first scene.

        Raises:
            CheckpointError: There is no such policy.
            MismatchError: It was trained for another robot or other words.
            ExperimentError: The robot cannot reach what the task lays out.
        """
        self.note = ""
        """What the visitor should know of what was asked for last."""
        self.run: Run | None = None
        self.reading: Reading
        self.score: Score
        self._checkpoint = checkpoint
        self._envs: dict[str, Any] = {}
        if checkpoint is not None:
            fits = load(str(checkpoint)).require_match
            fits(catalog.get(task), robot, any_task=True)
        players = fitting(task, robot, checkpoint)
        self.seed = seed - 1
        self._enter(Choice(task, short_name(robot), players[0] if policy else RANDOM))

    def close(self) -> None:
        """Close all scenes."""
        for env in self._envs.values():
            env.close()
        self._envs.clear()

    # -- What is played ----------------------------------------------------------------

    def choose(self, **wanted: str) -> None:
        """Change task, robot or policy, by name; what does not fit changes nothing.

        Names come from a page: only those that are there are looked up.
        """
        choice = replace(self.choice, **wanted)
        try:
            require_choice("task", choice.task, catalog.available())
            require_choice("robot", choice.robot, robots())
            players = self.players(choice)
            if "policy" not in wanted:
                choice = replace(choice, policy=players[0])
            require_choice("policy", choice.policy, players)
            self._enter(choice)
        except ValueError as error:
            self.note = str(error)

    def players(self, choice: Choice | None = None) -> list[str]:
        """Return the names of what can move the robot in the task, the best first."""
        choice = choice or self.choice
        return fitting(choice.task, choice.robot, self._checkpoint)

    def _enter(self, choice: Choice) -> None:
        """Go to the env of a choice, which is made once."""
        policy = None if choice.policy == RANDOM else load(choice.policy)
        kwargs = (policy or RandomMotion).env_kwargs | {"robot_uids": choice.robot}
        key = f"{choice.task} {kwargs}"
        if key not in self._envs:
            # Without its wrappers: what is live has no time limit.
            self._envs[key] = gym.make(choice.task, num_envs=1, **kwargs).unwrapped
        self.env = self._envs[key]
        self._policy = policy or RandomMotion(len(self.env.agent.joints))
        self.choice = choice
        self.new_scene()

    # -- Scenes ------------------------------------------------------------------------

    def new_scene(self) -> None:
        """Lay the objects out anew, with one of the task's sentences."""
        self.seed += 1
        self._begin()
        self._say(self.env.get_language_instruction()[0])

    def reset(self) -> None:
        """Begin again in the same scene, with the same sentence."""
        heard = self.reading.heard
        self._begin()
        self._say(heard)

    def _begin(self) -> None:
        self.run, self.note = None, ""
        self.held: tuple[int, float, float] | None = None
        self.obs, _ = self.env.reset(seed=self.seed)
        self._policy.reset()
        entities = self.env.scene.sub_scenes[0].entities
        self.bodies = [entity for entity in entities if _visible(entity)]
        """The B bodies that can be seen; `poses` of them `before` a step and `now`."""
        self.before = self.now = self.poses()

    # -- Sentences ---------------------------------------------------------------------

    def tell(self, text: str) -> None:
        """Say something to the robot, as it goes on; anything may be said."""
        heard = clean(text)
        if not any(letter.isalnum() for letter in heard):
            self.note = "Nothing was said: type a sentence."
            return
        self.run = None
        self.note = "Only the start was heard." if len(text) > len(heard) + 20 else ""
        self._say(heard)

    def _say(self, heard: str) -> None:
        policy = self._policy
        reading = read(heard, self._known(), self.scene, policy.vocabulary)
        if isinstance(policy, Policy):
            said, guessed = shortened(policy, reading.said), guesses(policy, reading)
            reading = replace(reading, said=said, guesses=guessed)
        if reading.goal is not None:
            try:  # the policy is told in `step`, at any length
                self.env.tell(Instruction("", reading.goal))
            except ValueError as error:  # e.g. of a hand that this robot lacks
                reading = replace(reading, goal=None, meaning=str(error), objects=())
        self.reading, self.score = reading, Score()
        self._touching = [False] * len(self.env.agent.fingers)

    def _known(self) -> Sequence[Instruction]:
        """Return the task's own sentences; of the language there are none."""
        known = self.env.experiment.instructions
        return () if isinstance(known, Spoken) else known

    def examples(self) -> list[str]:
        """Return sentences to try: the task's, or some that can be done here."""
        if known := self._known():
            name = next(filter(None, self.names))
            more = (f"please tap the {name}", "Touch the leftmost one.")
            return [*[i.text for i in known[:5]], *more]
        (here,) = things(replace(self.scene, start=self.scene.pose))
        allows = self.env.layout.allows(here)
        found, rng = [], Random(self.seed)
        for kind in self.env.experiment.instructions.kinds:
            with suppress(GoalError):  # of some scenes there is little to say
                goal = draw(here, [kind], rng, allows=allows)
                found.append(min((say(goal, rng) for _ in range(20)), key=len))
        return found

    # -- Objects -----------------------------------------------------------------------

    @property
    def scene(self) -> Snapshot:
        """What goals are measured on, as of now."""
        return self.env.snapshot()

    @property
    def names(self) -> list[str]:
        """What the C objects are called; "" where there is none."""
        return names(self.scene)

    def thing(self, index: int) -> Actor:
        """Return the body of an object."""
        return self.env.table.bodies[int(self.env.table.slot[0, index])]

    def drag(self, index: int, x: float, y: float) -> None:
        """Hold an object over a place on the table, in the world [m]; see `drop`.

        Beyond the table's edge it stays at the edge; where another object is, where it
        was.
        """
        scale, half = self.env.agent.scale, OBJECT_SIZE / 2
        place = [
            min(max(value / scale, low + half), high - half)
            for value, (low, high) in zip((x, y), TABLE, strict=True)
        ]  # at NAO's scale
        here = self.scene.position[0, :, :2].numpy()
        apart = np.linalg.norm(here - np.array(place), axis=1)
        others = [i for i, name in enumerate(self.names) if name and i != index]
        if all(apart[i] >= APART for i in others):
            self.held = index, scale * place[0], scale * place[1]
            self._carry()
            self.before = self.now = self.poses()

    def drop(self) -> None:
        """Let go of the object that is held; the sentence counts from here."""
        if self.held is not None:
            self.held = None
            self._say(self.reading.heard)

    def _carry(self) -> None:
        """Put the held object where it is held, at rest on the table."""
        assert self.held is not None
        index, x, y = self.held
        table = self.env.table
        z = float(table.z[table.slot[0, index]])
        thing = self.thing(index)
        thing.set_pose(sapien.Pose([x, y, z]))
        if thing.px_body_type == "dynamic":
            thing.set_linear_velocity(torch.zeros(1, 3))
            thing.set_angular_velocity(torch.zeros(1, 3))

    # -- Time --------------------------------------------------------------------------

    def step(self) -> None:
        """Go on for one control step of 50 ms."""
        self.before = self.now
        if self.held is not None:
            self._carry()
        action = self._policy.act(self.obs, self.reading.said)
        self.obs, reward, _, _, info = self.env.step(action)
        self.now = self.poses()
        self._count(float(reward), info)
        self._go_on()

    def _count(self, reward: float, info: dict[str, torch.Tensor]) -> None:
        """Add what the step brought to the score."""
        wrong = self.env.verdict.wrong[0].tolist()
        pairs = zip(wrong, self._touching, strict=True)
        began = sum(now and not before for now, before in pairs)
        judged, self._touching = self.reading.goal is not None, wrong
        self.score = Score(
            success=judged and bool(info["success"]),
            success_once=judged and bool(info["success_once"]),
            wrong=self.score.wrong + began * judged,
            steps=self.score.steps + 1,
            reward=self.score.reward + reward,
        )

    # -- The paper's experiments -------------------------------------------------------

    def experiment(self, task: str) -> None:
        """Run an experiment: each of its sentences once, in scenes of their own."""
        self.choose(task=task, robot=Nao.uid, policy=task)
        self.run = Run(tuple(i.text for i in self._known()))
        self._say(self.run.sentences[0])

    def _go_on(self) -> None:
        """Go on to the next sentence of a run, once one had its time."""
        run, time = self.run, LASTS * self.env.experiment.episode_steps
        if run is None or run.over or self.score.steps < time:
            return
        reached = (*run.reached, self.score.success_once)
        run = replace(run, reached=reached)
        if not run.over:
            self.new_scene()
            self._say(run.sentences[len(reached)])
        self.run = run

    # -- What is to be seen ------------------------------------------------------------

    def poses(self) -> np.ndarray:
        """Return where they are: positions [m] and quaternions (w, x, y, z) [B, 7]."""
        return np.array([[*body.pose.p, *body.pose.q] for body in self.bodies])

    def pictures(self) -> dict[str, np.ndarray]:
        """Return what the policy's cameras see, by name [H, W, 3] uint8."""
        seen = self.obs.get("sensor_data", {})
        return {name: seen[name]["rgb"][0].cpu().numpy() for name in cameras(self.obs)}

    def lights(self) -> dict[str, dict[str, str]]:
        """Return what each finger of each hand touches: "right", "wrong" or ""."""
        verdict = self.env.verdict
        touching = self.scene.contact[0].any(dim=1)
        found = zip(verdict.right[0], verdict.wrong[0], touching, strict=True)
        if self.reading.goal is None:
            states = ("touch" if any_ else "" for _, _, any_ in found)
        else:
            states = ("wrong" if w else "right" if r else "" for r, w, _ in found)
        hands = self.env.agent.hands.items()
        return {hand: {f: next(states) for f in fingers} for hand, fingers in hands}


def _visible(entity: sapien.Entity) -> bool:
    body = entity.find_component_by_type(sapien.render.RenderBodyComponent)
    return body is not None and body.is_enabled
