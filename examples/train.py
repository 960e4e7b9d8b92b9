"""Train an agent on an experiment of the paper: single, multi or triangle.

    python examples/train.py single
    python examples/train.py triangle --preset posture
    python examples/train.py multi --resume

The default preset gives the policy the sentence, two cameras, joints and touch, and
lets its critic and an auxiliary loss read the simulator's state in training; "posture"
holds an object with more fingers; "paper" gives the policy what the paper does. Ctrl-C
keeps a checkpoint, from which --resume goes on. `ir-maniskill train ID` does the same
with every number as an option.
"""

import logging
from dataclasses import replace
from typing import Annotated, Literal

import tyro

from ir_maniskill.training.config import CONFIGS, TrainConfig
from ir_maniskill.training.train import train

TASKS = {
    "single": "NaoTouchCubeSingle-v1",  # experiment I: one sentence
    "multi": "NaoTouchCubeMulti-v1",  # experiment II: three sentences
    "triangle": "NaoTouchCubeTriangle-v1",  # experiment III: a reward per finger
}
STEPS = {
    "default": {"single": 60_000, "multi": 250_000, "triangle": 250_000},
    "posture": {"single": 60_000, "multi": 250_000, "triangle": 250_000},
    # The paper does not say how long its third experiment took: as its second.
    "paper": {"single": 150_000, "multi": 2_200_000, "triangle": 2_200_000},
}


def configure(
    experiment: str, preset: str, steps: int | None, out: str | None
) -> TrainConfig:
    """Return the preset's configuration for an experiment."""
    config, steps = CONFIGS[preset], steps or STEPS[preset][experiment]
    return replace(
        config,
        env_id=TASKS[experiment],
        total_steps=steps,
        lenient_steps=min(config.lenient_steps, steps // 3),  # then at full price
        out=out or f"runs/{experiment}",
    )


def main(
    experiment: Annotated[
        Literal["single", "multi", "triangle"], tyro.conf.Positional
    ] = "single",
    preset: Literal["default", "posture", "paper"] = "default",
    steps: int | None = None,
    out: str | None = None,
    resume: bool = False,
) -> None:
    """Train, and say where the best policy is."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    best = train(configure(experiment, preset, steps, out), resume=resume)
    print(f"The best policy is in {best}.")


if __name__ == "__main__":
    tyro.cli(main)
