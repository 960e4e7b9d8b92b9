"""Pre-training: learn a task of one's own from scratch, or from a policy that listens.

    python examples/pretrained.py
    python examples/pretrained.py --init-from NaoInstruct-v1

Nobody ever named a red button or a blue can to that policy, nor spoke of bells and
crimson. Both runs have the same network, algorithm and budget; compare their curves:
`ir-maniskill curve runs/pretrained`.
"""

import logging

import tyro

import ir_maniskill
from ir_maniskill import Experiment, Instruction, Ref, Touch, TouchObject
from ir_maniskill.language import HELD_OBJECTS

BELL = TouchObject("red", (0.2, 0.09), "button")  # x forward, y left of the torso [m]
TIN = TouchObject("blue", (0.2, -0.09), "can")
assert {(thing.color, thing.shape) for thing in (BELL, TIN)} <= HELD_OBJECTS
TASK = Experiment(
    "NaoBell-v1",
    (BELL, TIN),
    (
        Instruction("Press the crimson bell.", Touch(Ref("red"))),
        Instruction("Grab the navy tin.", Touch(Ref("blue"))),
    ),
    shuffled=True,
)
ir_maniskill.register(TASK)


def main(
    init_from: str | None = None,
    steps: int = 60_000,
    eval_interval: int = 5_000,
    out: str | None = None,
) -> None:
    """Train, and say where the best policy is."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    best = ir_maniskill.train(
        TASK.id,
        preset="listen",
        init_from=init_from,
        total_steps=steps,
        eval_interval=eval_interval,
        out=out or ("runs/pretrained" if init_from else "runs/scratch"),
    )
    print(f"The best policy is in {best}.")


if __name__ == "__main__":
    tyro.cli(main)
