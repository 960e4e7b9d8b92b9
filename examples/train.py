"""Train a policy, see how it does in new scenes, and film it.

    python examples/train.py
    python examples/train.py --task NaoTouchCubeTriangle-v1 --steps 250000
    python examples/train.py --preset paper --steps 150000

The first takes a few minutes on two cores. Ctrl-C keeps a checkpoint, from which
--resume goes on. `ir-maniskill train --help-all` lists every number there is.
"""

import logging

import tyro

import ir_maniskill


def main(
    task: str = "NaoTouchCubeSingle-v1",
    preset: str = "default",
    steps: int = 60_000,
    episodes: int = 100,
    resume: bool = False,
) -> None:
    """Train, print the figures of the best policy, and write its film."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    best = ir_maniskill.train(task, resume, preset=preset, total_steps=steps)
    print(ir_maniskill.evaluate(best, episodes=episodes))
    film = best.with_name("film.mp4")
    ir_maniskill.record(best, film)
    print(f"Policy: {best}. Film: {film}.")


if __name__ == "__main__":
    tyro.cli(main)
