"""Experiment I: three objects in a line, one instruction (paper, Sec. IV-A)."""

from ir_maniskill.experiment import Experiment, TouchObject, touch_instructions
from ir_maniskill.language.tokens import VOCABULARY
from ir_maniskill.registration import register


def single(task_id: str, shape: str) -> Experiment:
    """Return the single-instruction experiment with objects of the given shape."""
    objects = (
        TouchObject("blue", (0.20, 0.0), shape),  # x forward, y left of the torso [m]
        TouchObject("red", (0.20, 0.10), shape),
        TouchObject("green", (0.20, -0.10), shape),
    )
    return Experiment(
        id=task_id,
        objects=objects,
        instructions=touch_instructions(objects[:1]),
        reward="binary",
        senses=("vision",),
        vocabulary=VOCABULARY,
    )


CUBE = register(single("NaoTouchCubeSingle-v1", "cube"))
BUTTON = register(single("NaoTouchButtonSingle-v1", "button"))
