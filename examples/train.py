"""Train an agent on an experiment of the paper: single, multi or triangle.

    python examples/train.py single
    python examples/train.py triangle --preset paper
    python examples/train.py multi --resume

The default preset gives the policy the sentence, two cameras, joints and touch, and
lets its critic and an auxiliary loss read the simulator's state in training; "vision"
gives it the sentence and the cameras alone, "paper" what the paper does. Ctrl-C keeps a
checkpoint, from which --resume goes on. `ir-maniskill train ID` does the same with
every number as an option.
"""

import logging
from typing import Annotated, Literal

import tyro

from ir_maniskill.training.train import train

TASKS = {
    "single": "NaoTouchCubeSingle-v1",  # experiment I: one sentence
    "multi": "NaoTouchCubeMulti-v1",  # experiment II: three sentences
    "triangle": "NaoTouchCubeTriangle-v1",  # experiment III: a reward per finger
}
STEPS = {
    "default": {"single": 60_000, "multi": 250_000, "triangle": 250_000},
    "vision": {"single": 60_000, "multi": 250_000, "triangle": 250_000},
    # The paper does not say how long its third experiment took: as its second.
    "paper": {"single": 150_000, "multi": 2_200_000, "triangle": 2_200_000},
}


def main(
    experiment: Annotated[
        Literal["single", "multi", "triangle"], tyro.conf.Positional
    ] = "single",
    preset: Literal["default", "vision", "paper"] = "default",
    steps: int | None = None,
    out: str | None = None,
    resume: bool = False,
) -> None:
    """Train, and say where the best policy is."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    changes = {} if resume else {"total_steps": STEPS[preset][experiment]}
    if steps is not None:
        changes["total_steps"] = steps
    out = out or f"runs/{experiment}"
    best = train(TASKS[experiment], resume, preset=preset, out=out, **changes)
    print(f"The best policy is in {best}.")


if __name__ == "__main__":
    tyro.cli(main)
