"""Trains the toy task, kills the training at random moments, and resumes it.

    python tests/killed_training.py FOLDER KILLS

Prints a line of JSON for each life: the signal that ended it, and the steps of the
newest checkpoint. It is a program of its own because only a process without threads may
fork one that trains.
"""

import json
import os
import random
import signal
import sys
import time
from pathlib import Path

import psutil
import torch
from toy_envs import LENGTH, ToyVectorEnv, toy_config

from ir_maniskill.training import checkpoint, runner
from ir_maniskill.training import train as training
from ir_maniskill.training.config import PPOConfig

UPDATE = 8 * LENGTH
"""Steps of an update, each of which ends with a checkpoint."""
UPDATES = 90


def train(folder):
    """Train in this process, from the folder's checkpoint if there is one."""
    runner.FINAL_EPISODES = 16
    ppo = PPOConfig(8 * LENGTH, epochs=1, minibatch=None)
    every = {"total_steps": UPDATES * UPDATE, "checkpoint_interval": UPDATE}
    config = toy_config(folder, ppo=ppo, eval_interval=20 * UPDATE, **every)
    envs, evaluated_in = (ToyVectorEnv(config.num_envs) for _ in range(2))
    training.run(config, resume=True, envs=envs, eval_envs=evaluated_in)


def killed_at_any_time(folder, generator):
    """Train in another process and kill it after a random time of work."""
    child = fork(lambda: train(folder))
    moment, process = generator.uniform(0, 0.6), psutil.Process(child)
    while sum(process.cpu_times()[:2]) < moment and process.status() != "zombie":
        time.sleep(0.005)
    os.kill(child, signal.SIGKILL)
    return os.waitpid(child, 0)[1]


def killed_while_writing(folder, generator):
    """Train in another process that is killed before or after it syncs a file."""
    calls, last, sync = [], generator.randrange(20), os.fsync

    def dying_sync(descriptor):
        calls.append(descriptor)
        if len(calls) > last // 2:
            if last % 2:
                sync(descriptor)
            os.kill(os.getpid(), signal.SIGKILL)
        sync(descriptor)

    def train_and_die():
        os.fsync = dying_sync
        train(folder)

    return os.waitpid(fork(train_and_die), 0)[1]


def fork(work):
    child = os.fork()
    if child:
        return child
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    work()
    os._exit(0)


def main(folder, kills):
    torch.optim.Adam([torch.zeros(1)])  # imports much, once for all lives
    generator, last = random.Random(0), folder / "last.safetensors"
    for count in range(kills):
        die = killed_while_writing if count % 2 else killed_at_any_time
        status = die(folder, generator)
        steps = checkpoint.read(last).metadata["steps"] if last.exists() else 0
        print(json.dumps([os.WTERMSIG(status), steps]), flush=True)
    train(folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
