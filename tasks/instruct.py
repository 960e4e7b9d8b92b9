"""Beyond the paper: sentences of a language, in scenes that were never seen."""

from ir_maniskill.experiment import Drawn, Experiment, Spoken
from ir_maniskill.language import KINDS
from ir_maniskill.registration import register


def instruct(task_id: str, *kinds: str, episode_steps: int = 32) -> Experiment:
    """Return an experiment with sentences of these kinds, in free scenes."""
    return Experiment(
        id=task_id,
        objects=Drawn(),
        instructions=Spoken(kinds),
        reward="per_finger",
        wrong_penalty=0.1,
        episode_steps=episode_steps,
    )


TOUCH = register(instruct("NaoInstructTouch-v1", "touch"))
HAND = register(instruct("NaoInstructHand-v1", "hand"))
PUSH = register(instruct("NaoInstructPush-v1", "push"))
WHERE = register(instruct("NaoInstructWhere-v1", "where"))
THEN = register(instruct("NaoInstructThen-v1", "then", episode_steps=64))
ALL = register(instruct("NaoInstruct-v1", *(kind for kind in KINDS if kind != "then")))
