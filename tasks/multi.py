"""Experiment II: the same three objects, three instructions (paper, Sec. IV-B)."""

from dataclasses import replace

from ir_maniskill.experiment import Experiment, touch_instructions
from ir_maniskill.registration import register
from ir_maniskill.tasks.single import single


def multi(task_id: str, shape: str) -> Experiment:
    """Return the multi-instruction experiment with objects of the given shape."""
    one = single(task_id, shape)
    return replace(one, instructions=touch_instructions(one.bodies))


CUBE = register(multi("NaoTouchCubeMulti-v1", "cube"))
BUTTON = register(multi("NaoTouchButtonMulti-v1", "button"))
