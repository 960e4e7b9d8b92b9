"""Beyond the paper: the triangle with its colors dealt anew every episode.

Only an agent that looks and reads can touch the named object and no other.
"""

from dataclasses import replace

from ir_maniskill.experiment import Experiment
from ir_maniskill.registration import register
from ir_maniskill.tasks.triangle import triangle


def shuffled(task_id: str, shape: str) -> Experiment:
    """Return the shuffled experiment with objects of the given shape."""
    return replace(triangle(task_id, shape), shuffled=True)


CUBE = register(shuffled("NaoTouchCubeShuffled-v1", "cube"))
BUTTON = register(shuffled("NaoTouchButtonShuffled-v1", "button"))
