"""How much the scenes allow: a scripted oracle that knows all and tries everything.

For each scene it searches joint targets by the cross-entropy method, playing the scene
again and again, so that as many fingers as can be are on the named object at every step
(goal "fingers"), or the object is touched in as many steps as can be ("touching"), and
no other object ever is. A plan is two postures, one after the other; the joint targets
move as fast as the policies' own control mode lets them. It is no agent: it sees no
picture, reads no sentence, and may try a scene hundreds of times. What it finds is a
lower bound of what can be reached, by which the policies' figures can be judged.

    python scripts/oracle.py NaoTouchCubeTriangle-v1 --scenes 10
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import torch
from tqdm import tqdm

import ir_maniskill  # noqa: F401 - registers the tasks
from ir_maniskill import experiment as catalog
from ir_maniskill.environment.robot.nao import ARM, FINGER_JOINTS, HAND, JOINTS
from ir_maniskill.training.evaluate import versions

OUT = Path(__file__).parent.parent / "docs" / "results" / "oracle.json"
SEED = 2_000_000
"""Seed of the first scene: those of `ir-maniskill evaluate`."""
DELTA = np.array([(HAND if j[1:] in FINGER_JOINTS else ARM).delta for j in JOINTS])
"""Largest change of each joint's target in a step [half the joint's range]."""
PLAN = 2 * len(JOINTS) + 1
"""Numbers of a plan: two postures in [-1, 1], and when to change over."""

MIRROR = np.array([1, -1, -1, -1, -1] + [1] * len(FINGER_JOINTS))
"""Sign of each joint of one side on the other; pitch and fingers keep theirs."""

Goal = Literal["fingers", "touching"]
GOALS: tuple[Goal, ...] = ("fingers", "touching")


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
        env = self._env
        goal = env.objects[int(env.target_index)].pose.p  # [1, 3]
        distance = (env.agent.finger_position()[0] - goal).norm(dim=-1)  # [F] [m]
        return float((1 - torch.tanh(distance / 0.1)).mean())

    def close(self) -> None:
        """Free the simulator."""
        self._env.close()


@dataclass(frozen=True)
class Effort:
    """How hard to search."""

    rounds: int
    """Populations, at most."""
    size: int
    """Plans of a population."""
    spread: float
    """Standard deviation of the first population [half a joint's range]."""
    patience: int = 1_000
    """Populations without progress after which to give up."""


FROM_NOTHING = Effort(rounds=30, size=96, spread=0.4)
"""For the first scene of a sentence, if no known plan touches its object alone."""
ADAPT = Effort(rounds=12, size=32, spread=0.12, patience=5)
"""For the first scene if one does, and for others where none does."""
REFINE = Effort(rounds=4, size=16, spread=0.05, patience=2)
"""For other scenes, from the plans for those before."""
EFFORTS = (FROM_NOTHING, ADAPT, REFINE)


def search(
    play: Play,
    known: list[np.ndarray],
    goal: Goal,
    effort: Effort,
    rng: np.random.Generator,
) -> np.ndarray:
    """Return the best plan found by the cross-entropy method.

    Args:
        play: Tries a plan.
        known: Plans to begin with; the search spreads around the best of them.
        goal: What is good.
        effort: How hard to search.
        rng: Where chance comes from.
    """
    scores = [play(plan).score(goal) for plan in known]
    best, top = known[int(np.argmax(scores))], max(scores)
    mean, spread = best, np.full(PLAN, effort.spread)
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
        spread = 0.3 * spread + 0.7 * elite.std(0).clip(0.02)
        if stalled >= effort.patience:
            break
    return best


def mirror(plan: np.ndarray) -> np.ndarray:
    """Return the plan with left and right exchanged."""
    postures = plan[:-1].reshape(2, 2, -1)[:, ::-1] * MIRROR  # [2, sides, joints]
    return np.append(postures, plan[-1])


@dataclass(frozen=True)
class Found:
    """The best plan of a scene and what it does there."""

    seed: int
    """Of the scene."""
    plan: np.ndarray
    """[PLAN]."""
    outcome: Outcome
    """In a scene built anew, as evaluations build it."""


def explore(
    stage: Stage,
    instruction: int,
    seeds: list[int],
    goal: Goal,
    known: list[np.ndarray],
    efforts: tuple[Effort, Effort, Effort] = EFFORTS,
) -> list[Found]:
    """Return the best plans found for the scenes.

    Args:
        stage: The task.
        instruction: Index of the sentence.
        seeds: Of the scenes.
        goal: What is good.
        known: Plans to begin with, beside staying at the start.
        efforts: As `EFFORTS`.
    """
    rng = np.random.default_rng(seeds[0])
    still = stage.start(seeds[0], instruction, rebuild=True)
    known = [np.append([still, still], 0.0), *known]
    found: list[Found] = []
    for seed in tqdm(seeds, f"instruction {instruction}, {goal}"):
        play = partial(stage.play, seed=seed, instruction=instruction)
        touched = any(play(plan).exclusive for plan in known)
        effort = efforts[touched + bool(found)]
        plan = search(play, known, goal, effort, rng)
        found.append(Found(seed, plan, play(plan, rebuild=True)))
        known = [one.plan for one in found[-4:]]
    return found


def summary(found: list[Found], goal: Goal) -> dict[str, Any]:
    """Return the means over scenes, named like an evaluation's figures."""
    right = np.array([one.outcome.right for one in found])  # [scenes, T]
    best = max(found, key=lambda one: one.outcome.score(goal))
    return {
        "episodes": len(found),
        "exclusive": float(np.mean([one.outcome.exclusive for one in found])),
        "touching": float((right > 0).mean()),
        "right_fingers": float(right.mean()),
        "most_fingers": float(right.max(axis=1).mean()),
        "first_touch": float((right > 0).argmax(axis=1).mean() + 1),
        "plan": best.plan.round(3).tolist(),
        "plan_seed": best.seed,
    }


def plans_of(data: Any) -> list[np.ndarray]:
    """Return all plans in a file of figures, as they are and mirrored."""
    plans = [
        np.array(figures["plan"])
        for task in data.values()
        for goals in task["instructions"].values()
        for figures in goals.values()
    ]
    return [*plans, *map(mirror, plans)]


def measure(
    env_id: str, scenes: int, known: list[np.ndarray]
) -> dict[str, dict[Goal, dict[str, Any]]]:
    """Return the figures of each sentence and goal on the scenes of the evaluation.

    Args:
        env_id: The task.
        scenes: How many for each sentence.
        known: Plans to begin with.
    """
    sentences = catalog.get(env_id).sentences
    stage, count = Stage(env_id), len(sentences)
    figures: dict[str, dict[Goal, dict[str, Any]]] = {}
    for index, sentence in enumerate(sentences):
        seeds = [SEED + index + count * scene for scene in range(scenes)]
        figures[sentence] = {}
        for goal in GOALS:
            found = explore(stage, index, seeds, goal, known)
            figures[sentence][goal] = summary(found, goal)
            # What holds an object with many fingers also touches it soon, and the
            # scenes are nearly symmetric.
            plans = [one.plan for one in found[-2:]]
            known = [*known, *plans, *map(mirror, plans)]
    stage.close()
    return figures


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
        figures = measure(task, given.scenes, known)
        data[task] = {"seed": SEED, "versions": versions(), "instructions": figures}
        given.out.parent.mkdir(parents=True, exist_ok=True)
        given.out.write_text(json.dumps(data, indent=1) + "\n")


if __name__ == "__main__":
    main()
