"""A task small enough to be learned in seconds, for the tests of the learner."""

import csv
from types import SimpleNamespace

import numpy as np
import torch
from gymnasium.spaces import Box

from ir_maniskill.agent import StateSpec
from ir_maniskill.environment.senses import text_of, tokens_of
from ir_maniskill.experiment import Experiment, TouchObject
from ir_maniskill.goals import Instruction, Ref, Touch
from ir_maniskill.language.tokens import VOCABULARY
from ir_maniskill.snapshot import Snapshot
from ir_maniskill.training.config import (
    AgentConfig,
    PPOConfig,
    SACConfig,
    TrainConfig,
)

LENGTH = 8  # steps of an episode
JOINTS, FINGERS = 2, 2
SENTENCES = ("Go left.", "Go right.")
GOALS = torch.tensor([-0.6, 0.6])


def toy_state(n=3):
    """Return a state of n envs, at random."""
    return {
        "instruction": torch.ones(n, 2, dtype=torch.long),
        "proprioception": torch.rand(n, 3, JOINTS),
        "target": torch.rand(n, 3, JOINTS),
        "touch": torch.zeros(n, 3, FINGERS),
        "privileged": torch.rand(n, 7),
        "named_position": torch.rand(n, 3),
    }


TASK = Experiment(
    "ToyTouch-v1",
    (TouchObject("blue", (0.2, 0.06)), TouchObject("red", (0.2, -0.06))),
    (
        Instruction(SENTENCES[0], Touch(Ref("red"))),
        Instruction(SENTENCES[1], Touch(Ref("blue"))),
    ),
    vocabulary=(*VOCABULARY[:3], "go", "left", "right"),
)
"""The same as goals: joint 0 moves two fingers 6 cm to either side of the middle."""
HANDS = {"left": ("a",), "right": ("b",)}

SPEC = StateSpec.of(toy_state(), JOINTS)
"""Shapes of `toy_state`, and of a toy agent that reads and does as much."""


class ToyVectorEnv:
    """Reach the named number: joint 0 shall be at the goal that the sentence names.

    It offers what `make_vec` promises: same-step reset, final observation and info.
    """

    def __init__(self, num_envs=8, images=False, env_id="Toy-v1", snapshots=False):
        self.num_envs, self.images, self.snapshots = num_envs, images, snapshots
        self.device = torch.device("cpu")
        self.env_kwargs = toy_config("").env_kwargs(training=True)
        self.single_action_space = Box(-1, 1, (JOINTS,))
        senses = ("vision", "proprioception") if images else ("proprioception",)
        self.experiment = SimpleNamespace(
            id=env_id,
            sentences=SENTENCES,
            instructions=TASK.instructions,
            senses=senses,
            vocabulary=VOCABULARY,
        )
        self.joints = torch.zeros(num_envs, JOINTS)
        self.told = torch.zeros(num_envs, dtype=torch.long)
        self.clock = torch.zeros(num_envs, dtype=torch.long)
        self.touched = torch.zeros(num_envs, dtype=torch.bool)
        self.streams = [np.random.default_rng(i) for i in range(num_envs)]

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            each = seed if isinstance(seed, list) else range(seed, seed + self.num_envs)
            self.streams = [np.random.default_rng(one) for one in each]
        self._start(torch.ones(self.num_envs, dtype=torch.bool))
        if options:
            told = [SENTENCES.index(said.text) for said in options["instruction"]]
            self.told[:] = torch.tensor(told)
        return self._observe(), {}

    def step(self, action):
        assert action.abs().max() <= 1, "actions must arrive clipped"
        self.joints = (self.joints + 0.3 * action).clamp(-1, 1)
        self.clock += 1
        right = (self.joints[:, 0] - GOALS[self.told]).abs() < 0.2
        self.touched |= right
        info = {
            "right_fingers": right.long(),
            "wrong_fingers": torch.zeros_like(self.told),
            "success": right,
            "success_once": self.touched.clone(),
            "exclusive_success": self.touched.clone(),
        }
        truncated = self.clock >= LENGTH
        if truncated.any():
            ended = {"final_obs": self._observe(), "final_info": info}
            self._start(truncated)
            info = {name: torch.zeros_like(value) for name, value in info.items()}
            info |= ended
        return self._observe(), right.float(), torch.zeros_like(right), truncated, info

    def close(self):
        pass

    def _start(self, chosen):
        for row in chosen.nonzero().flatten().tolist():
            stream = self.streams[row]
            self.told[row] = int(stream.integers(2))
            self.joints[row] = torch.from_numpy(stream.uniform(-0.1, 0.1, JOINTS))
        self.clock[chosen], self.touched[chosen] = 0, False

    def _observe(self):
        goal = GOALS[self.told][:, None]
        one_hot = torch.nn.functional.one_hot(self.told, 2).float()
        obs = {
            "agent": {
                "proprioception": self.joints.clone(),
                "target": self.joints.clone(),
                "velocity": torch.zeros_like(self.joints),
            },
            "extra": {
                "touch": torch.zeros(self.num_envs, FINGERS),
                "instruction": torch.stack([self.told + 3, self.told * 0], dim=1),
                "object_position": GOALS[None, :, None].repeat(self.num_envs, 1, 3),
                "finger_position": goal[:, None].repeat(1, FINGERS, 3),
                "target_object": one_hot,
                "wrong_once": torch.zeros(self.num_envs, 1),
            },
        }
        if self.snapshots:
            tokens = tokens_of(SENTENCES, TASK.vocabulary, 3)
            obs["extra"]["instruction"] = tokens[self.told]
            obs["extra"]["snapshot"] = self._snapshot().pack()
            obs["extra"]["joint_velocity"] = torch.zeros_like(self.joints)
            obs["extra"]["text"] = text_of([SENTENCES[i] for i in self.told])
        if self.images:
            brightness = (100 * (self.joints[:, 0] + 1)).byte()
            image = brightness[:, None, None, None].repeat(1, 16, 8, 3)
            cameras = ("top_camera", "front_camera")
            obs["sensor_data"] = {name: {"rgb": image.clone()} for name in cameras}
        return obs

    def _snapshot(self):
        n, side = self.num_envs, self.joints[:, :1]
        near = (side - GOALS.flip(0)).abs() < 0.2  # [N, 2]: blue is on the right
        pose = torch.zeros(n, 2, 7)
        pose[..., 1] = 0.1 * GOALS.flip(0)
        fingertip = torch.zeros(n, FINGERS, 3)
        fingertip[..., 1] = 0.1 * side
        return Snapshot(
            contact=near[:, None].repeat(1, FINGERS, 1),
            fingertip=fingertip,
            pose=pose,
            start=pose,
            velocity=torch.zeros(n, 2, 3),
            color=torch.tensor([[0, 1]] * n),
            shape=torch.zeros(n, 2, dtype=torch.long),
            stage=torch.zeros(n, dtype=torch.long),
        )


def toy_sac(out, **changes):
    """Return a config with which the other algorithm learns the toy task in seconds."""
    agent = AgentConfig(
        senses=("proprioception", "target"),
        hidden=(32, 32),
        vision="objects",
        actor="squashed",
        critic="none",
    )
    learner = SACConfig(capacity=2000, random_steps=128, batch=64, policy_from=0.2)
    values = {"algorithm": "sac", "frames": 1, "agent": agent, "sac": learner}
    return toy_config(out, **(values | changes))


def toy_config(out, **changes):
    """Return a config with which the toy task is learned in seconds."""
    agent = AgentConfig(senses=("proprioception",), hidden=(32, 32))
    ppo = PPOConfig(32 * LENGTH, epochs=8, minibatch=64, gamma=0.95, std=0.5)
    values = {
        "env_id": "Toy-v1",
        "out": str(out),
        "total_steps": 32 * LENGTH * 4,
        "num_envs": 8,
        "threads": 1,
        "eval_episodes": 8,
        "eval_interval": 10**6,
        "checkpoint_interval": 2 * 32 * LENGTH,
        "agent": agent,
        "ppo": ppo,
    }
    return TrainConfig(**(values | changes))


def records(folder, table="metrics"):
    """Return the rows of a run's table, without how long things took."""
    with (folder / f"{table}.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return [{k: v for k, v in row.items() if "time" not in k} for row in rows]


def steps_of(folder, table="metrics"):
    """Return the steps of the rows of a run's table."""
    return [int(row["steps"]) for row in records(folder, table)]
