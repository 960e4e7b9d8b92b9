"""An experiment of one's own: objects, places, sentences, reward, and one call.

python examples/custom_experiment.py [--train-steps 100000]
"""

from typing import Any

import gymnasium as gym
import tyro

from ir_maniskill import Experiment, Instruction, Ref, Touch, TouchObject, register
from ir_maniskill.language.tokens import VOCABULARY
from ir_maniskill.training.config import TrainConfig
from ir_maniskill.training.train import train

LEMON = TouchObject("yellow", (0.21, 0.06))  # x forward, y left of the torso [m]
PLUM = TouchObject("purple", (0.21, -0.06), shape="button")
SWEET = Instruction("Touch the plum, not the lemon.", Touch(Ref("purple")))
SOUR = Instruction("Touch the lemon.", Touch(Ref("yellow")))
WORDS = (*VOCABULARY, "plum", "lemon", "not")
FRUIT = Experiment(
    "TouchFruit-v1", (LEMON, PLUM), (SWEET, SOUR), wrong_penalty=0.1, vocabulary=WORDS
)
register(FRUIT)


def main(train_steps: int = 0) -> None:
    env: Any = gym.make(FRUIT.id, obs_mode="state_dict", reward_mode="dense").unwrapped
    obs, _ = env.reset(seed=0)
    print(env.get_language_instruction(), obs["extra"]["instruction"])
    print("dense reward:", float(env.step(env.action_space.sample())[1]))
    if train_steps:
        train(TrainConfig(FRUIT.id, "runs/fruit", total_steps=train_steps))


if __name__ == "__main__":
    tyro.cli(main)
