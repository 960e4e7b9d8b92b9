"""Beyond the paper: the triangle with its colors dealt anew every episode.

Only an agent that looks and reads can touch the named object and no other.
"""

from ir_maniskill.experiment import Experiment, touch_instructions
from ir_maniskill.registration import register
from ir_maniskill.tasks import layouts


def shuffled(task_id: str, shape: str) -> Experiment:
    """Return the shuffled experiment with objects of the given shape."""
    objects = layouts.triangle(shape)
    return Experiment(
        id=task_id,
        objects=objects,
        instructions=touch_instructions(objects),
        reward="per_finger",
        wrong_penalty=0.5,
        senses=("vision", "proprioception", "touch"),
        shuffled=True,
    )


CUBE = register(shuffled("NaoTouchCubeShuffled-v1", "cube"))
BUTTON = register(shuffled("NaoTouchButtonShuffled-v1", "button"))
