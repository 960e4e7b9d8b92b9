"""Mirror: an episode as a mirror shows it, in which the robot's left is its right.

A symmetric robot could have lived it just as well. Legend: R rows of an episode,
J joints, F fingers.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ir_maniskill.environment.robots.robot import Robot
from ir_maniskill.environment.senses import State
from ir_maniskill.snapshot import Snapshot

ACROSS = torch.tensor([1.0, -1.0, 1.0])
"""Signs of a place or a velocity (x, y, z) in the mirror."""
TURNED = torch.tensor([1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0])
"""Those of a place and a quaternion (w, x, y, z)."""


class Mirror:
    """Mirrors episodes of a robot whose `mirror` says which of its parts are alike."""

    def __init__(self, robot: type[Robot]) -> None:
        """Read which joint and which finger is whose mirror image."""
        fingers = [finger for hand in robot.hands.values() for finger in hand]
        self._joints, self._signs = _order(robot, robot.joints)
        self._fingers, _ = _order(robot, fingers)
        self._changes: dict[str, Callable[[Tensor], Tensor]] = {
            "images": lambda rows: rows.flip(-2),
            "touch": lambda rows: rows[:, self._fingers],
            "snapshot": self._snapshot,
            "terminal": lambda rows: rows,
        }
        for name in ("proprioception", "target", "joint_velocity", "action"):
            self._changes[name] = self.joints

    def knows(self, senses: Collection[str]) -> bool:
        """Return whether it can mirror all of these."""
        return self._changes.keys() >= set(senses)

    def __call__(self, episode: State) -> State:
        """Return an episode's mirror image [R, ...]; what is said is not in it."""
        return {name: self._changes[name](rows) for name, rows in episode.items()}

    def joints(self, values: Tensor) -> Tensor:
        """Return numbers of the joints in the mirror [..., J]."""
        return values[..., self._joints] * self._signs

    def scene(self, scene: Snapshot) -> Snapshot:
        """Return scenes in the mirror."""
        return replace(
            scene,
            contact=scene.contact[:, self._fingers],
            fingertip=scene.fingertip[:, self._fingers] * ACROSS,
            pose=scene.pose * TURNED,
            start=scene.start * TURNED,
            velocity=scene.velocity * ACROSS,
        )

    def _snapshot(self, rows: Tensor) -> Tensor:
        return self.scene(Snapshot.unpack(rows, len(self._fingers))).pack()


def _order(robot: type[Robot], parts: Sequence[str]) -> tuple[Tensor, Tensor]:
    """Return the place of each part's mirror image among them, and the signs."""
    images = [robot.mirror[part] for part in parts]
    places = torch.tensor([list(parts).index(name) for name, _ in images])
    return places, torch.tensor([sign for _, sign in images])
