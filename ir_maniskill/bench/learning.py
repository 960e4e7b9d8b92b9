"""Speed of the learner: what training waits for, and how well it computes."""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from ir_maniskill.bench.report import Measure
from ir_maniskill.bench.simulation import OURS
from ir_maniskill.bench.timing import Stopwatch, in_turn, timed
from ir_maniskill.environment.vector import make_vec
from ir_maniskill.training import ppo
from ir_maniskill.training.config import CONFIGS, TrainConfig
from ir_maniskill.training.run_folder import RunFolder
from ir_maniskill.training.train import Trainer

Convolution = tuple[nn.Conv2d, Tensor]
"""A layer and what goes in [B, C, H, W]."""


@contextmanager
def trainer(shader: str, rollouts: int) -> Iterator[Trainer]:
    """Make a trainer with the default numbers, in a temporary folder.

    Args:
        shader: Shader pack of the cameras.
        rollouts: Roll-outs for each update, a multiple of 16.
    """
    default = CONFIGS["default"]
    numbers = replace(default.ppo, rollouts=rollouts, max_kl=None)
    with tempfile.TemporaryDirectory() as folder:
        config: TrainConfig = replace(
            default, env_id=OURS, out=folder, shader_pack=shader, ppo=numbers
        )
        kwargs = config.env_kwargs(training=True)
        with closing(make_vec(OURS, config.num_envs, **kwargs)) as envs:
            made = Trainer(config, envs, RunFolder(Path(folder), resume=False))
            made.folder.begin(made.config, 0)
            try:
                yield made
            finally:
                made.folder.close()


def overhead(made: Trainer, updates: int = 1) -> Measure:
    """Return the share of training that neither simulates nor computes the nets.

    Simulation is the time in `envs.step`, exchange with the workers included; the nets'
    is that of acting and of an update less the gathering of its minibatches.
    """
    watch = Stopwatch()
    watched = (
        (made.envs, "step", "simulation"),
        (made.agent, "act", "acting"),
        (made.agent, "value", "acting"),
        (made.rollout, "batch", "gathering minibatches"),
    )
    for owner, method, name in watched:
        watch.watch(owner, method, name)
    with _update_watched(watch):
        for _ in range(updates):
            with watch.part("other"):
                made.update()
    total = sum(watch.seconds.values())
    share = {name: part / total for name, part in watch.seconds.items()}
    spent = ("simulation", "acting", "updating")
    for owner, method, _ in watched:
        delattr(owner, method)
    return Measure(
        "training_overhead",
        "training: share neither simulation nor nets",
        1 - sum(share[name] for name in spent),
        0.10,
        at_most=True,
        detail=", ".join(f"{name} {part:.0%}" for name, part in share.items()),
    )


@contextmanager
def _update_watched(watch: Stopwatch) -> Iterator[None]:
    original = ppo.update
    watch.watch(ppo, "update", "updating")
    try:
        yield
    finally:
        ppo.update = original


def arithmetic(made: Trainer, seconds: float) -> Measure:
    """Compare the FLOP/s of a PPO gradient with those of its convolutions alone.

    On one thread: several wait for each other where other programs run, which the many
    small operations of an update suffer from more than a large one does.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    batch = made.rollout.batch(torch.arange(made.config.ppo.minibatch or 256))
    layers = _convolutions(made, lambda: _gradient(made, batch))
    side = 1024
    matrix = torch.rand(side, side)
    work: dict[str, Callable[[], Any]] = {
        "update": lambda: _improve(made, batch),
        "convolutions": lambda: _there_and_back(layers),
        "matmul": lambda: matrix @ matrix,
    }
    flops = {name: _count(job) for name, job in work.items()}
    blocks = {
        name: (lambda job=job: timed(lambda: [job() for _ in range(3)], 3))
        for name, job in work.items()
    }
    seconds_each = in_turn(blocks, seconds)
    torch.set_num_threads(threads)
    speed = {name: flops[name] / t / 1e9 for name, t in seconds_each.items()}
    return Measure(
        "update_arithmetic",
        "FLOP/s: PPO update / its convolutions alone",
        speed["update"] / speed["convolutions"],
        0.5,
        detail=", ".join(f"{name} {rate:.0f} GFLOP/s" for name, rate in speed.items()),
    )


def _gradient(made: Trainer, batch: Any) -> None:
    loss, _ = ppo.ppo_loss(made.agent, batch, made.config.ppo)
    made.optimizer.zero_grad(set_to_none=True)
    loss.backward()


def _improve(made: Trainer, batch: Any) -> None:
    _gradient(made, batch)
    ppo.clip_gradient(made.agent, made.config.ppo.max_grad_norm)
    made.optimizer.step()


def _convolutions(made: Trainer, run: Callable[[], None]) -> list[Convolution]:
    """Return every convolution of the agent with what goes into it in `run`."""
    found: list[Convolution] = []

    def note(layer: nn.Module, inputs: tuple[Tensor, ...], _: Tensor) -> None:
        assert isinstance(layer, nn.Conv2d)
        given = inputs[0].detach().clone()
        given.requires_grad_(inputs[0].requires_grad)
        found.append((layer, given))

    convolutions = (m for m in made.agent.modules() if isinstance(m, nn.Conv2d))
    handles = [m.register_forward_hook(note) for m in convolutions]
    run()
    for handle in handles:
        handle.remove()
    return [(copy.deepcopy(layer), given) for layer, given in found]


def _there_and_back(convolutions: list[Convolution]) -> None:
    """Run every convolution and its gradient."""
    for layer, given in convolutions:
        out = layer(given)
        out.backward(torch.ones_like(out))


def _count(work: Callable[[], Any]) -> int:
    with FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops()
