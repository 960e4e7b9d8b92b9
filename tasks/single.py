"""Experiment I: three objects in a line, one instruction (paper, Sec. IV-A)."""

from ir_maniskill.experiment import Experiment, touch_instructions
from ir_maniskill.language.tokens import VOCABULARY
from ir_maniskill.registration import register
from ir_maniskill.tasks.layouts import line


def single(task_id: str, shape: str) -> Experiment:
    """Return the single-instruction experiment with objects of the given shape."""
    objects = line(shape)
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
