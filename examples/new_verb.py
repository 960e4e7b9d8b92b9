"""A verb of one's own: what it asks, a task, a training, and the figures.

python examples/new_verb.py [--train-steps 20000]
"""

from dataclasses import dataclass
from types import SimpleNamespace

import torch
import tyro
from torch import Tensor

import ir_maniskill
from ir_maniskill import Experiment, Goal, Instruction, Ref, TouchObject
from ir_maniskill.goals import Measure
from ir_maniskill.snapshot import Snapshot


@dataclass(frozen=True)
class Spin(Goal):
    """Turn an object about the vertical by so many radians, either way."""

    MOVES = ("ref",)  # what is fixed to the table cannot be turned

    ref: Ref
    angle: float = 0.8

    @staticmethod
    def measure(scene: Snapshot, asked: SimpleNamespace) -> Measure:
        """Hold where the object has turned so far; touching another is a foul."""
        turned = (yaw(scene.pose) - yaw(scene.start)).cos().acos()  # [N, C], to pi
        turned = (turned * asked.ref).sum(dim=1)  # [N]
        gap = 0.03 * (asked.angle - turned).clamp(min=0)  # [m] along the cube's edge
        serves = asked.ref[:, None].expand_as(scene.contact)  # [N, F, C]
        return Measure(gap == 0, gap, serves, level=(turned / asked.angle).clamp(max=1))


def yaw(pose: Tensor) -> Tensor:
    """Return the angles about the vertical [...] of poses [..., 7] [rad]."""
    w, x, y, z = pose[..., 3:].unbind(-1)
    return torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


CUBES = (TouchObject("orange", (0.2, 0.06)), TouchObject("purple", (0.2, -0.06)))
TASK = Experiment(
    "NaoSpin-v1",
    CUBES,
    tuple(Instruction(f"Spin the {c.color} one.", Spin(Ref(c.color))) for c in CUBES),
)
ir_maniskill.register(TASK)


def main(train_steps: int = 20_000) -> None:
    ir_maniskill.train(TASK.id, total_steps=train_steps, out="runs/spin")
    print(ir_maniskill.evaluate("runs/spin/best.safetensors", TASK.id, episodes=40))


if __name__ == "__main__":
    tyro.cli(main)
