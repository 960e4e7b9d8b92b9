"""Scripted: obeys any goal from the simulator's state alone, which no policy sees.

It shows that what is asked can be done, and what limits the rest. A hand goes by way
points (lift, over, down, sweep); damped least squares find the joints for each.
Lengths are those of a scene at NAO's scale [m].

Legend: N envs, J joints, C objects, F fingers, X numbers of a hand: its arm's joints
[rad] and how far its fingers are stretched (0 to 1), P points of a hand and forearm.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from mani_skill.utils.structs import Articulation
from numpy.typing import NDArray
from torch import Tensor

from ir_maniskill.environment.layout import BEHIND
from ir_maniskill.environment.robots.robot import Robot
from ir_maniskill.environment.table_scene import OBJECT_HEIGHT, TABLE_TOP
from ir_maniskill.experiment import OBJECT_SIZE
from ir_maniskill.goals import DIRECTIONS, SHAPES, Avoid, Goal, Push, Then, Touch
from ir_maniskill.snapshot import Snapshot

Array = NDArray[np.float64]
Tips = tuple[int, ...]
"""Which fingers of a hand touch."""

# -- Weights of the least squares, each of a unit of its residual ----------------------

AT_TIP = 60.0
"""Of the distance from the tip to its aim, and of what gets into what [1/m]."""
STEEP = 0.25
"""Of how the hand points beside `DOWN`, which keeps it off other objects."""
STAY = 0.1
"""Of leaving the numbers that the search began with."""
ACROSS = 0.3
"""Of fingers that are not side by side behind what they push."""
DOWN = 0.86
"""How far down a hand is to point; level is 0."""
SAMPLES = 6000
"""Random postures of a hand that searches may start from."""

# -- Sizes and way points --------------------------------------------------------------

FINGER, PALM = 0.0055, 0.026
"""Radii of balls that stand for a finger's parts, and for palm and forearm [m]."""
OVER = 0.03
"""How high above an object a hand passes [m]."""
LIFT = 2
"""Steps of raising the hand straight up before it goes anywhere."""
RAISED = np.array([0, 0, 0.05])
"""Where it is raised to, and waits if it has nothing to do, above its start [m]."""
LOW = TABLE_TOP + 0.03
"""Height of the fingertips when they push [m]."""
PASSED = 0.004
"""From which distance behind an object's middle the tip has slid over it [m]."""
SWEEP = 0.028
"""How far ahead of the tip its aim is while it pushes [m]."""
ASTRAY = 0.014
"""Twice how far beside its line the tip pushes half as far ahead [m]."""
BEYOND = 0.06
"""How far beyond a push's end it heads, so that it turns gently [m]."""
NEAR = 0.015
"""How near its way point is near enough [m]."""
FAST, AHEAD = 0.35, 0.6
"""Largest change of the numbers in a step, and lead over where they are [rad]."""


class NotScriptedError(ValueError):
    """A robot or a goal that the scripted solution cannot play."""


class Hand(NamedTuple):
    """Where a hand is."""

    tip: Array
    """What is to touch [3] [m]."""
    pointing: Array
    """Unit vector from the palm to the tip [3]."""
    across: Array
    """Unit vector from the first finger to the second [3]."""
    balls: Array
    """Centers of what must not get into anything [P, 3] [m]."""


@dataclass(frozen=True)
class Aim:
    """Where a hand is to go, and what is in its way."""

    tip: Array | None
    """Where its tip is to be [3] [m]; None: anywhere."""
    boxes: Array
    """Center, yaw and height of the objects [C, 5] [m] [rad]."""
    margins: Array
    """How far to stay away from each [C] [m]."""
    push: Array | None = None
    """Direction in which something is pushed [3]."""


class Arm:
    """An arm and its hand: where it is by its numbers, and the numbers for an aim."""

    def __init__(self, robot: Robot, hand: str) -> None:
        """Read a hand's kinematics, and try random postures to start searches from.

        Raises:
            NotScriptedError: The fingers have no joints.
        """
        self.scale, fingers = robot.scale, robot.hands[hand]
        articulation = robot.robot
        self._model = articulation._objs[0].create_pinocchio_model()
        self._mount = robot.mount.to_transformation_matrix()
        self._order = robot.controller.active_joint_indices.cpu().numpy()
        names = [link.name for link in articulation.links]
        chains = [_chain(articulation, robot.fingertips[f]) for f in fingers]
        palm = next(n for n in chains[0] if all(n in chain for chain in chains))
        upper = _chain(articulation, palm)
        moved = [articulation.joints_map[j].child_link.name for j in robot.joints]
        distal = set(itertools.chain(*chains)) - set(upper)
        if not distal.intersection(moved):
            raise NotScriptedError(
                f"hand {hand!r} of {robot.uid!r}: got stiff fingers, expected joints"
            )
        self.joints = np.array([i for i, name in enumerate(moved) if name in upper])
        self._bends = np.array([i for i, name in enumerate(moved) if name in distal])
        self._low = robot.controller.lower.cpu().numpy().astype(float)
        self._high = robot.controller.upper.cpu().numpy().astype(float)
        parts = [[n for n in reversed(chain) if n in distal] for chain in chains]
        self._links = [
            names.index(n) for n in (*itertools.chain(*parts), palm, upper[1])
        ]
        count = np.cumsum([len(part) for part in parts])
        balls = len(self._links) - 2 + len(chains), 5  # of fingers, of the rest
        self._radii = np.repeat([FINGER, PALM], balls)  # of `Hand.balls` [P]
        self._first, self._last = count - [len(part) for part in parts], count - 1
        self.shoulder = articulation.links_map[moved[self.joints[0]]].pose.p[0].cpu()
        self.shoulder = self.shoulder.numpy().astype(float) / self.scale
        self.side = 1.0 if self.shoulder[1] >= 0 else -1.0
        self.tips = _tips(len(fingers))
        """Which fingers may be what touches, the best first."""
        self.rest = np.zeros(len(moved))
        """All joints, of which those that are not the hand's stay so [J] [rad]."""
        self._tables = {tips: self._table(tips) for tips in self.tips}

    def numbers(self, joints: Array) -> Array:
        """Return the numbers of the hand, of all joints [J]: [X]."""
        stretched = (joints - self._low) / (self._high - self._low)
        return np.append(joints[self.joints], stretched[self._bends].mean())

    def to_joints(self, x: Array, joints: Array) -> Array:
        """Return all joints [J] with those of the hand set by its numbers."""
        joints, low, bends = joints.copy(), self._low, self._bends
        joints[self.joints] = x[:-1]
        joints[bends] = low[bends] + x[-1] * (self._high - low)[bends]
        return joints

    # -- Where it is -----------------------------------------------------------------

    def hand(self, x: Array, tips: Tips) -> Hand:
        """Return where the hand is with these numbers [X], touching with `tips`."""
        qpos = np.empty(len(self.rest))
        qpos[self._order] = self.to_joints(x, self.rest)
        self._model.compute_forward_kinematics(qpos)
        links = np.array([self._model.get_link_pose(i).p for i in self._links])
        links = (links @ self._mount[:3, :3].T + self._mount[:3, 3]) / self.scale
        fingers, palm, elbow = links[:-2], links[-2], links[-1]
        ends = fingers[self._last]
        tip = ends[list(tips)].mean(axis=0)
        knuckles = fingers[self._first[:2]].mean(axis=0)
        pads = ends + 0.7 * (ends - fingers[np.maximum(self._last - 1, self._first)])
        solid = palm + np.outer((0.2, 0.5, 0.8), knuckles - palm)
        solid = np.concatenate([solid, elbow + np.outer((0.3, 0.7), palm - elbow)])
        across = ends[1 % len(ends)] - ends[0]
        balls = np.concatenate([fingers, pads, solid])
        return Hand(tip, _unit(tip - palm), _unit(across), balls)

    def miss(self, x: Array, tips: Tips, aim: Aim) -> float:
        """Return how far the tip is from its aim, and the hand in what is there [m]."""
        hand = self.hand(x, tips)
        room = clearance(hand.balls, self._radii, aim.boxes)
        away = 0.0 if aim.tip is None else np.linalg.norm(hand.tip - aim.tip)
        return float(away + max(0.0, -room.min(initial=0.0)))

    # -- The numbers for an aim --------------------------------------------------------

    def search(self, tips: Tips, aim: Aim) -> Array:
        """Return numbers for an aim, from the best of the postures tried before."""
        hands, low = self._tables[tips][1:]
        assert aim.tip is not None
        cost = AT_TIP**2 * ((hands.tip - aim.tip) ** 2).sum(1) + low
        cost += STEEP**2 * ((hands.pointing - self._steep(aim.tip)) ** 2).sum(1)
        near = np.argpartition(cost, 150)[:150]
        for i in near:
            room = clearance(hands.balls[i], self._radii, aim.boxes)
            cost[i] += AT_TIP**2 * (np.minimum(room - aim.margins, 0) ** 2).sum()
        best = near[np.argsort(cost[near])[:4]]
        found = [self.improve(self._tables[tips][0][i], tips, aim, 15) for i in best]
        residuals = [self._residual(x, tips, aim, x) for x in found]
        return found[np.argmin([r @ r for r in residuals])]

    def improve(self, x: Array, tips: Tips, aim: Aim, steps: int) -> Array:
        """Return numbers nearer to an aim: damped least squares (Levenberg-Marquardt).

        dx = -(J^T J + lambda I)^-1 J^T r, with J by finite differences.
        """
        low = np.append(self._low[self.joints], 0.0)
        high = np.append(self._high[self.joints], 1.0)
        first, damping, small = x, 0.02, 1e-4
        r = self._residual(x, tips, aim, first)
        for _ in range(steps):
            if r @ r < 1e-6:
                break
            moved = [x + small * unit for unit in np.eye(len(x))]
            rows = [(self._residual(m, tips, aim, first) - r) / small for m in moved]
            jacobian = np.array(rows).T
            square = jacobian.T @ jacobian + damping * np.eye(len(x))
            step = -np.linalg.solve(square, jacobian.T @ r)
            if np.abs(step).max() < 1e-3:
                break
            new = np.clip(x + np.clip(step, -0.3, 0.3), low, high)
            less = self._residual(new, tips, aim, first)
            if less @ less < r @ r:
                x, r, damping = new, less, max(damping / 3, 1e-4)
            else:
                damping *= 8
        return x

    def _residual(self, x: Array, tips: Tips, aim: Aim, first: Array) -> Array:
        hand = self.hand(x, tips)
        room = clearance(hand.balls, self._radii, aim.boxes) - aim.margins
        above = hand.balls[:, 2] - self._radii - TABLE_TOP - 0.004
        parts = [AT_TIP * np.minimum(np.append(room.ravel(), above), 0)]
        if aim.tip is None:
            return np.concatenate([*parts, x - first])
        if aim.push is not None:
            parts.append(np.array([ACROSS * hand.across @ aim.push]))
        pointing = STEEP * (hand.pointing - self._steep(aim.tip))
        tip = AT_TIP * (hand.tip - aim.tip)
        return np.concatenate([*parts, tip, pointing, STAY * (x - first)])

    def _steep(self, tip: Array) -> Array:
        """Return how the hand is to point at a place: down, and away from the body."""
        level = _unit((tip - self.shoulder) * (1, 1, 0))
        return 0.5 * level - np.array([0, 0, DOWN])

    def _table(self, tips: Tips) -> tuple[Array, Hand, Array]:
        """Return random numbers, the hands that they make, and what these cost."""
        uniform = np.random.default_rng(0).uniform(size=(SAMPLES, len(self.joints) + 1))
        low, high = self._low[self.joints], self._high[self.joints]
        numbers = uniform * np.append(high - low, 1) + np.append(low, 0)
        tried = zip(*(self.hand(x, tips) for x in numbers), strict=True)
        hands = Hand(*map(np.array, tried))
        above = (hands.balls[..., 2] - self._radii).min(axis=1) - TABLE_TOP
        return numbers, hands, AT_TIP**2 * np.minimum(above, 0) ** 2


def _tips(fingers: int) -> list[Tips]:
    """Return which fingers of a hand may touch: the first two, or the last alone."""
    return [(0, 1), (fingers - 1,)] if fingers > 2 else [tuple(range(fingers))]


def _chain(articulation: Articulation, link: str) -> list[str]:
    """Return the names of a link and of those that carry it, up to the root."""
    found, part = [], articulation.links_map[link]
    while part is not None:
        found.append(part.name)
        part = part.joint.parent_link if part.joint is not None else None
    return found


def _unit(vector: Array) -> Array:
    return vector / (np.linalg.norm(vector) + 1e-9)


def clearance(balls: Array, radii: Array, boxes: Array) -> Array:
    """Return the distance of balls [P, 3] from upright boxes [C, 5]: [P, C] [m].

    It is negative where they meet.
    """
    x, y, z = np.moveaxis(balls[:, None] - boxes[None, :, :3], -1, 0)
    cos, sin = np.cos(boxes[:, 3]), np.sin(boxes[:, 3])
    turned = np.stack([cos * x + sin * y, cos * y - sin * x, z], axis=-1)
    half = np.full((len(boxes), 3), OBJECT_SIZE / 2)
    half[:, 2] = boxes[:, 4] / 2
    outside = np.abs(turned) - half
    distance = np.linalg.norm(np.maximum(outside, 0), axis=-1)
    return distance + np.minimum(outside.max(axis=-1), 0) - radii[:, None]


# -- What is to be done ----------------------------------------------------------------


@dataclass
class Act:
    """Something that one hand does to one object."""

    goal: Touch | Push
    """What."""
    index: int
    """The object's place in the snapshot."""
    tips: Tips
    """Which fingers touch."""
    x: Array
    """Numbers of the hand at its way point [X]."""
    low: Array
    """Those with which it would be down at the object, or behind it to push it [X]."""
    miss: float
    """How far from reach it is [m]."""
    phase: int = 0
    """0: on its way over, 1: going down, 2: sweeping."""


@dataclass
class Episode:
    """What is remembered of one env's episode."""

    stage: int = -1
    """Which goal of a sequence is worked on."""
    steps: int = 0
    """Steps of this stage so far."""
    acts: dict[str, Act] = field(default_factory=dict)
    """What each hand does."""
    begun: dict[str, Array] = field(default_factory=dict)
    """Where the tips were when the stage began [3] [m]."""


def acts_in(goal: Goal) -> list[Touch | Push]:
    """Return what is to be done at the same time.

    Raises:
        NotScriptedError: There is a verb that is not scripted.
    """
    if isinstance(goal, Touch | Push):
        return [goal]
    if isinstance(goal, Avoid):
        return []
    if not goal.parts:
        raise NotScriptedError(
            f"goal: got {goal}, expected Touch, Push, Avoid, Both or Then of these"
        )
    return [act for part in goal.parts for act in acts_in(part)]


class Scripted:
    """Plays N envs of this process; see `evaluation.evaluate.Player`."""

    def __init__(self, env: Any) -> None:
        """Take the env, which is a `TouchEnv`."""
        self.env = env.unwrapped
        self.arms = {hand: Arm(self.env.agent, hand) for hand in self.env.agent.hands}
        self._episodes = [Episode() for _ in range(self.env.num_envs)]

    def __call__(self, obs: Any, done: Tensor | None) -> Tensor:
        """Return the next actions [N, J]; where `done`, an episode begins."""
        env, agent = self.env, self.env.agent
        joints = agent.robot.get_qpos()[:, agent.controller.active_joint_indices]
        target = agent.controller.target
        scene, wanted = env.snapshot(), target.cpu().numpy().astype(float)
        for row, instruction in enumerate(env.instructions):
            if done is None or done[row]:
                self._episodes[row] = Episode()
            view = View(scene, row)
            now = joints[row].cpu().numpy().astype(float)
            self._act(row, view, instruction.goal, now, wanted[row])
        return agent.controller.action_for(torch.as_tensor(wanted).to(target))

    def _act(self, row: int, view: View, goal: Goal, now: Array, wanted: Array) -> None:
        """Set what the joints of one env are wanted to be [J] [rad]."""
        episode = self._episodes[row]
        for arm in self.arms.values():
            arm.rest = now
        if view.stage != episode.stage:
            acts = self._assign(view, goal)
            tips = {
                hand: arm.hand(arm.numbers(now), _tips_of(arm, acts.get(hand))).tip
                for hand, arm in self.arms.items()
            }
            self._episodes[row] = episode = Episode(view.stage, 0, acts, tips)
        episode.steps += 1
        for hand, arm in self.arms.items():
            x = self._next(hand, episode, view, now, wanted)
            if x is not None:
                wanted[:] = arm.to_joints(x, wanted)

    def _next(
        self, hand: str, episode: Episode, view: View, joints: Array, wanted: Array
    ) -> Array | None:
        """Return the next numbers of a hand; None: it stays as it is."""
        arm, act = self.arms[hand], episode.acts.get(hand)
        now, target = arm.numbers(joints), arm.numbers(wanted)
        tips, raised = _tips_of(arm, act), episode.begun[hand] + RAISED
        if act is None:
            aim = view.aim(raised, [])
            x = arm.improve(target, tips, aim, 1)
        else:
            mine = [a.index for a in episode.acts.values()]
            found = self._way_point(hand, act, view, now)
            if found is None:  # a push ends at once, a touch is held
                return now if isinstance(act.goal, Push) else None
            if episode.steps <= LIFT:
                aim = view.aim(raised, mine, 0.004)
                x = arm.improve(now, tips, aim, 3)
            else:
                aim = view.aim(found[0], mine, found[1], _way(act.goal))
                x = act.x = arm.improve(act.x, tips, aim, 3)
        x = target + np.clip(x - target, -FAST, FAST)
        x = now + np.clip(x - now, -AHEAD, AHEAD)
        return arm.improve(x, tips, Aim(None, aim.boxes, aim.margins), 2)

    # -- Way points ------------------------------------------------------------------

    def _way_point(
        self, hand: str, act: Act, view: View, now: Array
    ) -> tuple[Array, float] | None:
        """Return where the tip goes, and how near the object; None: nowhere."""
        tip = self.arms[hand].hand(now, act.tips).tip
        if isinstance(act.goal, Push):
            return self._push(act, act.goal, view, tip)
        fingers = [f in self.env.agent.hands[hand] for f in self.env.agent.fingers]
        if view.touched(fingers, act.index):
            return None
        place, top = view.place(act.index), view.top(act.index)
        if act.phase == 0 and np.linalg.norm((tip - place)[:2]) > NEAR:
            return np.append(place[:2], top + OVER), 0.006
        act.phase = 1
        return np.append(place[:2], top - 0.006), -0.05

    def _push(
        self, act: Act, goal: Push, view: View, tip: Array
    ) -> tuple[Array, float] | None:
        ahead = np.array(DIRECTIONS[goal.direction])
        place, start = view.place(act.index), view.start(act.index)
        if (place - start) @ ahead >= goal.distance + 0.003:
            return None
        end = start + ahead * (goal.distance + BEYOND)
        along = _unit((end - place) * (1, 1, 0))  # what strayed is brought back
        left = np.array([-along[1], along[0], 0])
        onward, beside = float((tip - place) @ along), float((tip - place) @ left)
        behind, top = place - BEHIND * along, view.top(act.index)
        lost = onward > -PASSED or abs(beside) > 0.02 or tip[2] > top + 0.005
        if act.phase == 2 and lost:
            act.phase = 0
        if act.phase == 0 and np.linalg.norm((tip - behind)[:2]) < NEAR:
            act.phase, act.x = 1, act.low
        if act.phase == 1 and tip[2] < LOW + 0.012:
            act.phase = 2
        if act.phase == 0:
            return np.append(behind[:2], top + OVER), 0.006
        if act.phase == 1:
            return np.append(behind[:2], LOW), 0.002
        lead = SWEEP * max(0.5, 1 - abs(beside) / ASTRAY)
        aim = place + min(0.005, onward + lead) * along - 2 * beside * left
        return np.append(aim[:2], LOW), -0.05

    # -- Which hand does what ----------------------------------------------------------

    def _assign(self, view: View, goal: Goal) -> dict[str, Act]:
        """Return which hand does what: those that reach it best.

        Raises:
            NotScriptedError: There is more to do than there are hands.
        """
        for _ in range(view.stage):
            goal = goal.b if isinstance(goal, Then) else goal
        goals = acts_in(goal.a if isinstance(goal, Then) else goal)
        rated = {
            (k, hand): self._rate(view, each, hand)
            for k, each in enumerate(goals)
            for hand in self.arms
            if getattr(each, "hand", None) in (None, hand)
        }
        ways = [
            {hand: rated[k, hand] for k, hand in enumerate(way)}
            for way in itertools.permutations(self.arms, len(goals))
            if rated.keys() >= set(enumerate(way))
        ]
        if not ways:
            raise NotScriptedError(
                f"goal: got {goals}, expected a hand for each, of {[*self.arms]}"
            )
        return min(ways, key=lambda way: sum(act.miss for act in way.values()))

    def _rate(self, view: View, goal: Touch | Push, hand: str) -> Act:
        """Return how a hand would do something: with the fingers that reach it best."""
        arm, found = self.arms[hand], list[Act]()
        for tips in arm.tips:
            found.append(self._try(view, goal, arm, tips))
            if found[-1].miss < 0.004:
                break
        best = min(found, key=lambda act: act.miss)
        y = view.place(best.index)[1]
        best.miss += 0.05 * max(0.0, -arm.side * y)  # the other side
        return best

    def _try(self, view: View, goal: Touch | Push, arm: Arm, tips: Tips) -> Act:
        """Return how it would be done with these fingers, from over the object on."""
        index, push = view.index(goal), _way(goal)
        place, over = view.place(index), view.top(index) + OVER
        low = np.append(place[:2], over - OVER + 0.009)
        if push is not None:
            low = np.append((place - BEHIND * push)[:2], LOW)
        aim = view.aim(low, [index], push=push)
        x = arm.search(tips, aim)
        miss = arm.miss(x, tips, aim)
        aim = view.aim(np.append(low[:2], over), [index], push=push)
        high = arm.improve(x, tips, aim, 8)
        miss += 0.5 * arm.miss(high, tips, aim)
        if isinstance(goal, Push):
            aim = self._at_end(view, goal, index)
            miss += arm.miss(arm.improve(x, tips, aim, 12), tips, aim)
        return Act(goal, index, tips, high, x, miss)

    def _at_end(self, view: View, goal: Push, index: int) -> Aim:
        """Return the aim of a hand that has pushed something as far as it shall be."""
        push, boxes = np.array(DIRECTIONS[goal.direction]), view.boxes.copy()
        boxes[index, :2] = (view.start(index) + goal.distance * push)[:2]
        tip = np.append((boxes[index, :3] - 0.027 * push)[:2], LOW)
        return Aim(tip, boxes, view.aim(tip, [index]).margins, push)


def _tips_of(arm: Arm, act: Act | None) -> Tips:
    return arm.tips[0] if act is None else act.tips


def _way(goal: Touch | Push) -> Array | None:
    """Return the direction [3] in which a goal pushes; None: it does not."""
    return np.array(DIRECTIONS[goal.direction]) if isinstance(goal, Push) else None


class View:
    """The scene of one env, as arrays."""

    def __init__(self, scene: Snapshot, row: int) -> None:
        """Take a row of the snapshot."""
        self.scene, self.row = scene, row
        self.stage = int(scene.stage[row])
        pose = scene.pose[row].cpu().numpy().astype(float)
        yaw = 2 * np.arctan2(pose[:, 6], pose[:, 3])
        shapes = [SHAPES[i] for i in scene.shape[row].tolist()]
        height = [OBJECT_HEIGHT[shape] for shape in shapes]
        self.boxes = np.column_stack([pose[:, :3], yaw, height])  # [C, 5]
        absent = (scene.color[row] < 0).cpu().numpy()
        self.boxes[absent, 2] = -9.0

    def index(self, goal: Touch | Push) -> int:
        """Return the place of the object that is meant."""
        return int(goal.ref.resolve(self.scene)[self.row].nonzero()[0, 0])

    def place(self, index: int) -> Array:
        """Return where an object is [3] [m]."""
        return self.boxes[index, :3]

    def start(self, index: int) -> Array:
        """Return where it was when the episode began [3] [m]."""
        return self.scene.start[self.row, index, :3].cpu().numpy().astype(float)

    def top(self, index: int) -> float:
        """Return the height of its top [m]."""
        return TABLE_TOP + float(self.boxes[index, 4])

    def touched(self, fingers: Sequence[bool], index: int) -> bool:
        """Return whether one of these fingers [F] has just touched an object."""
        return bool(self.scene.contact[self.row, list(fingers), index].any())

    def aim(
        self,
        tip: Array,
        mine: Sequence[int],
        margin: float = 0.0015,
        push: Array | None = None,
    ) -> Aim:
        """Return an aim, as near to one's own objects as the margin says."""
        margins = np.full(len(self.boxes), 0.008)
        margins[list(mine)] = margin
        return Aim(tip, self.boxes, margins, push)
