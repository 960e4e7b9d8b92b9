"""How much the scenes allow: a scripted oracle that knows all and tries everything.

For each scene it searches joint targets by the cross-entropy method, playing the scene
again and again, so that as many fingers as can be are on the named object at every step
(goal "fingers"), or the object is touched in as many steps as can be ("touching"), and
no other object ever is. A plan is two postures, one after the other; the joint targets
move as fast as the policies' own control mode lets them. Plans found before, for other
scenes, colors and tasks, are starts for new ones: mirrored where the object lies on the
other side, and with the fingers shifted by inverse kinematics as the object is.

It is no agent: it sees no picture, reads no sentence, and may try a scene hundreds of
times. What it finds is a lower bound of what can be reached, by which the policies'
figures can be judged; a further search of the same scenes can only raise it.

    python scripts/oracle.py NaoTouchCubeTriangle-v1 --scenes 6
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import torch
from scipy.optimize import least_squares
from tqdm import tqdm

import ir_maniskill  # noqa: F401 - registers the tasks
from ir_maniskill import experiment as catalog
from ir_maniskill.environment.robots.nao import (
    ARM,
    ARM_JOINTS,
    FINGER_JOINTS,
    HAND,
    JOINTS,
)
from ir_maniskill.evaluation.evaluate import EVALUATION_SEED, versions

OUT = Path(__file__).parent.parent / "docs" / "results" / "oracle.json"
DELTA = np.array([(HAND if j[1:] in FINGER_JOINTS else ARM).delta for j in JOINTS])
"""Largest change of each joint's target in a step [half the joint's range]."""
PLAN = 2 * len(JOINTS) + 1
"""Numbers of a plan: two postures in [-1, 1], and when to change over."""

SIDE = len(JOINTS) // 2
"""Joints of one side: the first so many are the left arm's and hand's."""
MIRROR = np.array([1, -1, -1, -1, -1] + [1] * len(FINGER_JOINTS))
"""Sign of each joint of one side on the other; pitch and fingers keep theirs."""

Goal = Literal["fingers", "touching"]
GOALS: tuple[Goal, ...] = ("fingers", "touching")

ARM_INDEX = np.array([i for i, joint in enumerate(JOINTS) if joint[1:] in ARM_JOINTS])
"""Which joints are those of the arms, not of the hands."""
MOST_KNOWN = 6
"""Known plans to begin with, at most: those for the nearest places."""
MIDDLE = 0.03
"""How far left or right of the chest both hands are used [m]; beyond, the near one."""


@dataclass(frozen=True)
class Outcome:
    """What a plan did in a scene."""

    right: np.ndarray
    """Fingers on the named object at each step [T]."""
    wrong: np.ndarray
    """Fingers on other objects at each step [T]."""
    nearness: float
    """How close all fingers were to the named object, 0 to 1: shows the search where
    to go before anything is touched."""

    @property
    def exclusive(self) -> bool:
        """Whether the named object was touched and no other."""
        return bool(self.right.any() and not self.wrong.any())

    def score(self, goal: Goal) -> float:
        """Return how good it is; touching another object outweighs all else."""
        touch = self.right if goal == "fingers" else self.right > 0
        spoiled = (1 + 8 * (self.wrong > 0).mean()) if self.wrong.any() else 0
        return float(touch.mean() + 0.5 * self.nearness - spoiled)

    def promise(self, goal: Goal) -> float:
        """Return how good it may become: what only brushes another object is near."""
        touch = self.right if goal == "fingers" else self.right > 0
        return float(touch.mean() + self.nearness - 2 * (self.wrong > 0).mean())


Play = Callable[[np.ndarray], Outcome]
"""Tries a plan [PLAN]."""


class Stage:
    """The scenes of a task, without pictures."""

    def __init__(self, env_id: str) -> None:
        """Build the env."""
        self._env: Any = gym.make(
            env_id,
            obs_mode="none",
            reward_mode="none",
            control_mode="pd_joint_target_delta_pos",
            render_backend="none",
        ).unwrapped

    def start(self, seed: int, instruction: int, *, rebuild: bool) -> np.ndarray:
        """Set a scene up and return the joint targets [J] in [-1, 1].

        Args:
            seed: Which scene.
            instruction: Index of the sentence.
            rebuild: Whether to build it anew, as evaluations do: slow, but then a plan
                does the same, bit for bit, whatever was played before.
        """
        options = {"instruction": instruction, "reconfigure": rebuild}
        self._env.reset(seed=seed, options=options)
        return self._env.agent.get_proprioception()["target"][0].numpy()

    def play(
        self, plan: np.ndarray, seed: int, instruction: int, *, rebuild: bool = False
    ) -> Outcome:
        """Try a plan in a scene."""
        target = self.start(seed, instruction, rebuild=rebuild)
        first, second = plan[:-1].clip(-1, 1).reshape(2, len(JOINTS))
        change = np.clip(8 + 16 * plan[-1], 1, 24)  # [step]
        steps = self._env.experiment.episode_steps
        right, wrong, near = np.zeros(steps), np.zeros(steps), []
        for t in range(steps):
            wanted = first if t < change else second
            action = ((wanted - target) / DELTA).clip(-1, 1)
            target = (target + DELTA * action).clip(-1, 1)
            *_, info = self._env.step(torch.from_numpy(action).float()[None])
            right[t], wrong[t] = info["right_fingers"], info["wrong_fingers"]
            if t % 4 == 3:
                near.append(self._nearness())
        return Outcome(right, wrong, float(np.mean(near)))

    def _nearness(self) -> float:
        distance = np.linalg.norm(self._fingers() - self.place(), axis=1)  # [F] [m]
        return float((1 - np.tanh(distance / 0.1)).mean())

    def _fingers(self) -> np.ndarray:
        return self._env.agent.finger_position()[0].numpy().astype(float)  # [F, 3] [m]

    def place(self) -> np.ndarray:
        """Return where the named object is now [3] [m]."""
        index = int(self._env.target_index)
        return self._env.objects[index].pose.p[0].numpy().astype(float)

    def shifted(self, plan: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Return the plan with all fingers moved, as far as the arms can.

        Args:
            plan: What to change; its fingers keep their angles.
            offset: How far [3] [m].
        """
        postures = [
            self._reach(posture, self._fingers_at(posture) + offset)
            for posture in plan[:-1].clip(-1, 1).reshape(2, len(JOINTS))
        ]
        return np.append(postures, plan[-1])

    def _reach(self, posture: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Return the posture with the arms changed so that the fingers are there."""

        def misses(arms: np.ndarray) -> np.ndarray:
            miss = self._fingers_at(_with_arms(posture, arms)) - goal
            # Of postures about as good it is the nearest that is wanted.
            return np.append(miss.ravel(), 0.01 * (arms - start))

        start = posture[ARM_INDEX].clip(-0.999, 0.999)
        arms = least_squares(misses, start, bounds=(-1, 1), diff_step=1e-3).x
        return _with_arms(posture, arms)

    def _fingers_at(self, posture: np.ndarray) -> np.ndarray:
        """Return where the fingers would be [F, 3] [m], moving the robot there."""
        robot, drive = self._env.agent, self._env.agent.controller
        share = torch.from_numpy((posture + 1) / 2).float()
        angles = drive.lower + share * (drive.upper - drive.lower)  # [J] [rad]
        robot.robot.set_qpos(robot.to_qpos(angles)[None])
        return self._fingers()

    def close(self) -> None:
        """Free the simulator."""
        self._env.close()


def _with_arms(posture: np.ndarray, arms: np.ndarray) -> np.ndarray:
    changed = posture.copy()
    changed[ARM_INDEX] = arms
    return changed


@dataclass(frozen=True)
class Effort:
    """How hard to search."""

    rounds: int
    """Populations, at most."""
    size: int
    """Plans of a population."""
    spread: float
    """Standard deviation of the first population [half a joint's range]."""
    patience: int
    """Populations without progress after which to give up."""


@dataclass(frozen=True)
class Efforts:
    """How hard to search, depending on what is known."""

    wide: Effort = Effort(rounds=30, size=64, spread=0.4, patience=10)
    """Where no known plan touches the object."""
    first: Effort = Effort(rounds=15, size=32, spread=0.15, patience=2)
    """Where one does: from the best of them, on the first scene of a sentence."""
    near: Effort = Effort(rounds=10, size=12, spread=0.08, patience=2)
    """The same on other scenes."""


def search(
    play: Play,
    known: list[np.ndarray],
    goal: Goal,
    efforts: tuple[Effort, Effort],
    rng: np.random.Generator,
    free: np.ndarray | float = 1.0,
) -> np.ndarray:
    """Return the best plan found by the cross-entropy method.

    Args:
        play: Tries a plan.
        known: Plans to begin with; the search spreads around the most promising.
        goal: What is good.
        efforts: How hard to search if none of them touches the object, and if one does.
        rng: Where chance comes from.
        free: Which numbers of the plan to change [PLAN] in {0, 1}.
    """
    outcomes = [play(plan) for plan in known]
    scores = [outcome.score(goal) for outcome in outcomes]
    promises = [outcome.promise(goal) for outcome in outcomes]
    best, top = known[int(np.argmax(scores))], max(scores)
    mean = known[int(np.argmax(promises))]
    effort = efforts[any(outcome.right.any() for outcome in outcomes)]
    spread = effort.spread * free
    keep, stalled = max(4, effort.size // 8), 0
    for _ in range(effort.rounds):
        plans = mean + spread * rng.standard_normal((effort.size, PLAN))
        scores = [play(plan).score(goal) for plan in plans]
        order = np.argsort(scores)[::-1]
        stalled = 0 if scores[order[0]] > top + 0.01 else stalled + 1
        if scores[order[0]] > top:
            best, top = plans[order[0]], scores[order[0]]
        # The best one so far stays among the elite, whatever the others do.
        elite = np.vstack([plans[order[:keep]], best])
        mean = 0.3 * mean + 0.7 * elite.mean(0)
        spread = (0.3 * spread + 0.7 * elite.std(0)).clip(0.02) * free
        if stalled >= effort.patience:
            break
    return best


@dataclass(frozen=True)
class Known:
    """A plan that was good somewhere."""

    plan: np.ndarray
    """[PLAN]."""
    place: np.ndarray
    """Where the object lay [3] [m]."""

    def mirrored(self) -> Known:
        """Return the same with left and right exchanged."""
        return Known(mirror(self.plan), self.place * [1, -1, 1])


def mirror(plan: np.ndarray) -> np.ndarray:
    """Return the plan with left and right exchanged."""
    postures = plan[:-1].reshape(2, 2, SIDE)[:, ::-1] * MIRROR  # [2, sides, joints]
    return np.append(postures, plan[-1])


def hands(place: np.ndarray) -> np.ndarray:
    """Return which numbers of a plan move the hands that reach a place [PLAN]."""
    left, right = place[1] > -MIDDLE, place[1] < MIDDLE
    joints = np.repeat([left, right], SIDE)
    return np.concatenate([joints, joints, [True]])


def starts(
    stage: Stage, known: list[Known], place: np.ndarray, still: np.ndarray
) -> list[np.ndarray]:
    """Return plans to begin with: the known ones, made to fit the scene.

    Args:
        stage: Whose robot tells where fingers would be.
        known: Plans for other scenes.
        place: Where the object lies [3] [m].
        still: The plan that stays at the start; a hand that cannot help does.
    """
    fits = [one.mirrored() if one.place[1] * place[1] < 0 else one for one in known]
    fits.sort(key=lambda fit: float(np.linalg.norm(fit.place - place)))
    plans = [still]
    for fit in fits[:MOST_KNOWN]:
        shifted = stage.shifted(fit.plan, place - fit.place)
        plans += [np.where(hands(place), plan, still) for plan in (fit.plan, shifted)]
    return plans


@dataclass(frozen=True)
class Found(Known):
    """The best plan of a scene and what it does there."""

    seed: int
    """Of the scene."""
    outcome: Outcome
    """In a scene built anew, as evaluations build it."""


def solve(
    stage: Stage,
    instruction: int,
    seed: int,
    goal: Goal,
    known: list[Known],
    efforts: tuple[Effort, Effort],
) -> Found:
    """Return the best plan found for a scene.

    Args:
        stage: The task.
        instruction: Index of the sentence.
        seed: Of the scene.
        goal: What is good.
        known: Plans for this or other scenes.
        efforts: As for `search`.
    """
    target = stage.start(seed, instruction, rebuild=True)
    place, still = stage.place(), np.append([target, target], 0.0)
    plans = starts(stage, known, place, still)
    play = partial(stage.play, seed=seed, instruction=instruction)
    rng = np.random.default_rng(seed)
    plan = search(play, plans, goal, efforts, rng, hands(place))
    return Found(plan, place, seed, play(plan, rebuild=True))


def explore(
    stage: Stage,
    instruction: int,
    seeds: list[int],
    goal: Goal,
    known: list[Known],
    efforts: Efforts = Efforts(),
) -> list[Found]:
    """Return the best plans found for the scenes.

    Args:
        stage: The task.
        instruction: Index of the sentence.
        seeds: Of the scenes.
        goal: What is good.
        known: Plans to begin with.
        efforts: How hard to search.
    """
    found: list[Found] = []
    for seed in tqdm(seeds, f"instruction {instruction}, {goal}"):
        before = best_of(found, goal)[:3] or known
        effort = efforts.wide, efforts.near if found else efforts.first
        found.append(solve(stage, instruction, seed, goal, before, effort))
    # What was found for later scenes may be better for earlier ones.
    best, effort = best_of(found, goal)[:2], (efforts.near, efforts.near)
    for index, one in enumerate(found):
        if one.outcome.score(goal) < best[-1].outcome.score(goal) - 0.1:
            again = solve(stage, instruction, one.seed, goal, [one, *best], effort)
            found[index] = best_of([one, again], goal)[0]
    return found


def best_of(found: list[Found], goal: Goal) -> list[Found]:
    """Return them in the order of how good they are, the best first."""
    return sorted(found, key=lambda one: one.outcome.score(goal), reverse=True)


def summary(found: list[Found], goal: Goal) -> dict[str, Any]:
    """Return the means over scenes, named like an evaluation's figures."""
    right = np.array([one.outcome.right for one in found])  # [scenes, T]
    best = best_of(found, goal)[0]
    return {
        "episodes": len(found),
        "exclusive": float(np.mean([one.outcome.exclusive for one in found])),
        "touching": float((right > 0).mean()),
        "right_fingers": float(right.mean()),
        "most_fingers": float(right.max(axis=1).mean()),
        "first_touch": float((right > 0).argmax(axis=1).mean() + 1),
        "plan": best.plan.round(3).tolist(),
        "plan_place": best.place.round(4).tolist(),
        "plan_seed": best.seed,
    }


def plans_of(data: Any) -> list[Known]:
    """Return all plans in a file of figures."""
    return [
        Known(np.array(figures["plan"]), np.array(figures["plan_place"]))
        for task in data.values()
        for goals in task["instructions"].values()
        for figures in goals.values()
    ]


def measure(
    env_id: str, scenes: int, known: list[Known]
) -> Iterator[dict[str, dict[Goal, dict[str, Any]]]]:
    """Yield the figures of each sentence and goal on the scenes of the evaluation.

    Args:
        env_id: The task.
        scenes: How many for each sentence.
        known: Plans to begin with.

    Yields:
        The figures so far, after every sentence.
    """
    sentences = catalog.get(env_id).sentences
    stage, count = Stage(env_id), len(sentences)
    figures: dict[str, dict[Goal, dict[str, Any]]] = {}
    for index, sentence in enumerate(sentences):
        seeds = [EVALUATION_SEED + index + count * scene for scene in range(scenes)]
        figures[sentence] = {}
        for goal in GOALS:
            found = explore(stage, index, seeds, goal, known)
            figures[sentence][goal] = summary(found, goal)
            # What holds an object with many fingers also touches it soon.
            known = [*best_of(found, goal)[:3], *known]
        yield figures
    stage.close()


def better(
    goal: Goal, new: dict[str, Any], old: dict[str, Any] | None
) -> dict[str, Any]:
    """Return the better figures of two searches; those of other scenes do not count."""
    if old is None or old["episodes"] != new["episodes"]:
        return new
    reached = "right_fingers" if goal == "fingers" else "touching"
    return max(new, old, key=lambda one: (one["exclusive"], one[reached]))


def main() -> None:
    """Measure the tasks given and write them into the file, beside others there."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("tasks", nargs="+", choices=catalog.available())
    parser.add_argument("--scenes", type=int, default=10, help="for each sentence")
    parser.add_argument(
        "--anew",
        action="store_true",
        help="do not begin with the plans that the file has",
    )
    parser.add_argument("--out", type=Path, default=OUT)
    given = parser.parse_args()
    torch.set_num_threads(1)
    data = json.loads(given.out.read_text()) if given.out.exists() else {}
    for task in given.tasks:
        known = [] if given.anew else plans_of(data)
        before = data.get(task, {}).get("instructions", {})
        for figures in measure(task, given.scenes, known):
            kept = {
                sentence: {
                    goal: better(goal, found, before.get(sentence, {}).get(goal))
                    for goal, found in goals.items()
                }
                for sentence, goals in figures.items()
            }
            data[task] = {
                "seed": EVALUATION_SEED,
                "versions": versions(),
                "instructions": {**before, **kept},
            }
            given.out.parent.mkdir(parents=True, exist_ok=True)
            given.out.write_text(json.dumps(data, indent=1) + "\n")


if __name__ == "__main__":
    main()
