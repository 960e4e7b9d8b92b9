"""Experiment II: three objects in a line, three instructions (paper, Sec. IV-B)."""

from ir_maniskill.experiment import Experiment, touch_instructions
from ir_maniskill.language.tokens import VOCABULARY
from ir_maniskill.registration import register
from ir_maniskill.tasks.layouts import line


def multi(task_id: str, shape: str) -> Experiment:
    """Return the multi-instruction experiment with objects of the given shape."""
    objects = line(shape)
    return Experiment(
        id=task_id,
        objects=objects,
        instructions=touch_instructions(objects),
        reward="binary",
        senses=("vision",),
        vocabulary=VOCABULARY,
    )


CUBE = register(multi("NaoTouchCubeMulti-v1", "cube"))
BUTTON = register(multi("NaoTouchButtonMulti-v1", "button"))
