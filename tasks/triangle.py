"""Experiment III: triangle, proprioception, reward per finger (paper, Sec. IV-C)."""

from ir_maniskill.experiment import Experiment, TouchObject, touch_instructions
from ir_maniskill.language.tokens import VOCABULARY
from ir_maniskill.registration import register


def triangle(task_id: str, shape: str) -> Experiment:
    """Return the improved multi-instruction experiment with objects of that shape."""
    objects = (
        TouchObject("blue", (0.19, 0.0), shape),  # nearest the chest
        TouchObject("red", (0.23, 0.08), shape),
        TouchObject("green", (0.23, -0.08), shape),
    )
    return Experiment(
        id=task_id,
        objects=objects,
        instructions=touch_instructions(objects),
        reward="per_finger",
        wrong_penalty=0.1,
        senses=("vision", "proprioception", "touch"),
        vocabulary=VOCABULARY,
    )


CUBE = register(triangle("NaoTouchCubeTriangle-v1", "cube"))
BUTTON = register(triangle("NaoTouchButtonTriangle-v1", "button"))
