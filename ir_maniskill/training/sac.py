"""Soft actor-critic (Haarnoja et al., 2018), hindsight, and a policy that imitates.

First a teacher, which reads the simulator's state and the goal, learns from reward
alone. Then a policy, which reads the sentence and perceives what it will later, learns
to do the same, also where it got to by itself (DAgger, Ross et al., 2011).

Legend: N envs, B steps of a batch, A numbers of an action, D numbers a critic reads.
"""

from __future__ import annotations

import copy
import itertools
import logging
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from ir_maniskill.agent.actor import Squashed, SquashedActor
from ir_maniskill.agent.agent import Agent, StateSpec
from ir_maniskill.agent.object_vision import LENGTH, ObjectVision
from ir_maniskill.checks import require
from ir_maniskill.environment.robots.robot import robot_class
from ir_maniskill.environment.senses import State, read_text, stacked
from ir_maniskill.snapshot import Snapshot
from ir_maniskill.training import distributed
from ir_maniskill.training.algorithm import (
    Algorithm,
    Outcome,
    averages,
    copied,
    load_averages,
    under,
)
from ir_maniskill.training.config import SACConfig, TrainConfig
from ir_maniskill.training.finite import check_finite
from ir_maniskill.training.gradient import Loss, backward
from ir_maniskill.training.hindsight import Hindsight, Pursuit
from ir_maniskill.training.mirror import Mirror
from ir_maniskill.training.replay import Replay
from ir_maniskill.training.schedules import linear

log = logging.getLogger(__name__)

INITIAL_TEMPERATURE = 0.03
"""Weight of the entropy at the start."""
TEMPERATURE_RATE = 1e-3
"""Adam's learning rate of its logarithm."""
TARGET_ENTROPY = (0.25, -0.75)
"""Entropy of each number of an action that the temperature aims at, in the first third
of the teacher's training and at its end [nat]."""
WARMUP = 0.03
"""Share of a training in which the learning rate grows."""
MAX_GRAD_NORM = 10.0
"""Longest gradient of a step."""
LOGGED = 64
"""Updates from one row of the log to the next."""
WIDTHS = (384, 384)
"""Units of each critic's layers."""
PARTS = ("agent", "critics", "target_critics", "teacher", "replay")
"""What of the algorithm is in a checkpoint, beside optimizers and numbers."""


def bfloat16_autocast() -> torch.autocast:
    """Return a context that multiplies in 16 bits where that is faster."""
    known = getattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)
    return torch.autocast("cpu", torch.bfloat16, enabled=known())


class Critics(nn.Module):
    """Two judges Q(s, g, a), whose layers are computed together."""

    def __init__(self, inputs: int) -> None:
        """Make the layers for D + A numbers."""
        super().__init__()
        sizes = list(itertools.pairwise((inputs, *WIDTHS, 1)))
        self.weights = nn.ParameterList(_drawn(2, n, m, of=n) for n, m in sizes)
        self.biases = nn.ParameterList(_drawn(2, 1, m, of=n) for n, m in sizes)

    def forward(self, known: Tensor, action: Tensor) -> Tensor:
        """Return both values [2, B] of what is known [B, D] and done [B, A]."""
        x = torch.cat([known, action], dim=1).expand(2, -1, -1)
        *hidden, last = zip(self.weights, self.biases, strict=True)
        with bfloat16_autocast():
            for weight, bias in hidden:
                x = torch.baddbmm(bias, x, weight)
                x = functional.relu(functional.layer_norm(x, x.shape[-1:]))
        weight, bias = last
        return torch.baddbmm(bias, x.float(), weight).squeeze(-1)


def _drawn(*shape: int, of: int) -> Tensor:
    """Return numbers of a layer `of` so many inputs, as nn.Linear draws them."""
    return torch.empty(shape).uniform_(-1 / math.sqrt(of), 1 / math.sqrt(of))


def adam(weights: Iterable[Tensor], rate: float) -> torch.optim.Adam:
    """Return an optimizer."""
    return torch.optim.Adam(list(weights), rate, fused=True)


class SAC(Algorithm):
    """A teacher learns from reward, a policy learns to do the same from what it sees.

    Teacher and critics read the simulator's state and the goal. Both learn from all
    episodes, under many sentences.
    """

    learns_while_stepping = True

    @property
    def has_policy(self) -> bool:
        """Whether the teacher is done, so that the policy learns."""
        return self._policy_progress > 0

    @staticmethod
    def device() -> torch.device:
        """Return the CPU: the replay is in files, and the networks are small."""
        return torch.device("cpu")

    def __init__(self, config: TrainConfig, state: State, actions: int) -> None:
        """Make an untrained agent.

        Raises:
            ConfigError: The agent or the number of processes does not fit.
        """
        self.config: SACConfig = config.sac
        ranks = distributed.size()
        require(ranks == 1, "processes", ranks, "1: SAC trains in a single one")
        self.hindsight = Hindsight.of(config, config.sac.others)
        rows = 2 * config.num_envs * self.hindsight.experiment.episode_steps
        expected = f"at least {rows}: episodes that a checkpoint cuts short are lost"
        every = config.checkpoint_interval
        require(every >= rows, "checkpoint_interval", every, expected)
        self.frames, self.actions = config.frames, actions
        self._threads = config.threads or distributed.cores()
        self.agent = Agent(config.agent, StateSpec.of(state, actions))
        stacks = stacked(state)
        self._sensed = {name: name in stacks for name in self.agent.encoder.sensed}
        """What the policy senses, and whether it is stacked."""
        robot, drawn = robot_class(config.robot), self.hindsight.speaker is not None
        mirror = Mirror(robot) if robot.mirror and drawn else None
        self.mirror = mirror if mirror and mirror.knows(self._sensed) else None
        read = self.agent.encoder.language.reads
        self._sentence = {name: state[name].shape[1] for name in read}
        self.pursuit = Pursuit(self.hindsight, len(state["instruction"]))
        inputs = self._critic_input(self._privileged(state)).shape[1]
        gain = config.agent.posture_gain
        self.teacher = SquashedActor(inputs, WIDTHS, actions, posture_gain=gain)
        self.critics = Critics(inputs + actions)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        start = math.log(INITIAL_TEMPERATURE)
        self.log_temperature = torch.tensor(start, requires_grad=True)
        rate = self.config.learning_rate
        self._optimizers = {
            "agent": adam(self.agent.parameters(), self.config.policy_rate),
            "teacher": adam(self.teacher.parameters(), rate),
            "critics": adam(self.critics.parameters(), rate),
            "temperature": adam([self.log_temperature], TEMPERATURE_RATE),
        }
        self.replay = Replay(config.sac.capacity, Path(config.out) / "replay")
        self.updates = 0
        self._history: dict[str, list[Tensor]] = defaultdict(list)
        self._past: list[State] = []
        """Steps of all envs whose episodes go on, the oldest first."""
        self._episode_start: Tensor
        """Of each env, which of them its episode began with."""
        self.restart()

    # -- Collecting ------------------------------------------------------------------

    @torch.no_grad()
    def act(self, state: State) -> Tensor:
        """Return actions [N, A], and remember what was done in which state.

        In some of the envs the policy acts, so that the teacher shows what to do where
        the policy gets to; these are the more, the longer the training has lasted.
        """
        count = len(state["instruction"])
        told = self._privileged(state)  # also while it is not needed
        if self.replay.written < self.config.random_steps:
            action = torch.rand(count, self.actions) * 2 - 1
        else:
            action, _ = self._teacher_policy(told).rsample()
            by_policy = round(self.config.policy_acts * self._policy_progress * count)
            if by_policy:
                some = {name: value[:by_policy] for name, value in state.items()}
                action[:by_policy] = self.agent.policy(some)
        self._past.append({**self._kept(state), "action": action})
        return action

    def _teacher_policy(self, read: State) -> Squashed:
        """Return what the teacher would do [N, A]."""
        with bfloat16_autocast():
            return self.teacher(self._critic_input(read), read["now.target"])

    def _privileged(self, state: State) -> State:
        """Return what critics read of a state, before it is put together."""
        scene = self._scene(state["snapshot"])
        goal = self.pursuit.look(scene, state["text"])
        now = {f"now.{k}": state[k][:, 0] for k in ("proprioception", "target")}
        return now | {"joint_velocity": state["joint_velocity"], "goal": goal}

    def _kept(self, state: State) -> State:
        """Return what of a state is kept: of stacks the newest alone."""
        names = {*self.agent.encoder.sensed, "proprioception", "target"}
        names |= {"joint_velocity", "snapshot", "text"}
        stacks = stacked(state)
        return {k: state[k][:, 0] if k in stacks else state[k] for k in names}

    def observe(self, outcome: Outcome) -> None:
        """Judge and keep the episodes that ended."""
        ended = outcome.done.nonzero().flatten().tolist()
        if not ended:
            return
        assert outcome.final is not None
        final = self._kept(outcome.final)
        for env in ended:
            rows = self._past[int(self._episode_start[env]) :]
            episode = {
                name: torch.stack([*(row[name][env] for row in rows), value[env]])
                for name, value in final.items()
            }
            actions = torch.stack([row["action"][env] for row in rows])
            episode["action"] = functional.pad(actions, (0, 0, 0, 1))
            terminal = torch.zeros(len(rows) + 1, dtype=torch.bool)
            terminal[-1] = outcome.terminated[env]
            self._keep({**episode, "terminal": terminal})
        self.pursuit.forget(ended)
        self._episode_start[ended] = len(self._past)
        oldest = int(self._episode_start.min())
        self._past = self._past[oldest:]
        self._episode_start -= oldest

    def _keep(self, episode: State) -> None:
        """Keep an episode, for a policy also as a mirror shows it, if that is known."""
        (said,) = read_text(episode.pop("text")[:1])
        self._add(episode, said)
        if self.mirror is not None and self.has_policy:
            self._add(self.mirror(episode), None)

    def _add(self, episode: State, said: str | None) -> None:
        """Judge an episode under several sentences, and add it to the replay."""
        scenes = self._scene(episode["snapshot"])
        chosen = self.hindsight.choose(scenes, said)
        if chosen is None:
            return
        found, judged = chosen
        sentences = self.hindsight.read(found, self._sentence)
        rows, first = len(scenes.contact), not len(self.replay)
        self.replay.add(
            episode
            | {name: each.expand(rows, *each.shape) for name, each in sentences.items()}
            | {"reward": judged.reward, "goal": judged.goal.half()}
            | {"named": judged.named}
        )
        if first:
            room, size = self.replay.capacity, self.replay.bytes
            log.info("replay: room for %d steps, %.2f GB", room, size / 1e9)

    def restart(self) -> None:
        """Forget the episodes that were not seen to end."""
        self._past = []
        self._episode_start = torch.zeros(self.pursuit.envs, dtype=torch.int64)
        self.pursuit.forget(range(self.pursuit.envs))

    # -- Learning --------------------------------------------------------------------

    def update(self) -> dict[str, float]:
        """Make some gradients, once there is enough to learn from."""
        if self.replay.written < self.config.random_steps:
            return {}
        self.updates += 1
        if self.has_policy:
            for _ in range(self.config.imitations):
                self._train_policy()
        else:
            self._train_teacher()
        if self.updates % LOGGED:
            return {}
        history = sorted(self._history.items())  # a table's columns keep their order
        means = {name: torch.stack(values).mean() for name, values in history}
        self._history.clear()
        check_finite(means, "loss", "the learning rate is too high")
        figures = {name: float(mean) for name, mean in means.items()}
        return figures | {"replay": float(len(self.replay))}

    def _draw(self) -> State:
        """Return a batch of steps, each under one of its sentences [B, ...].

        What was there after the step is named "next.", as what was before it is named.
        """
        replay = self.replay
        rows, which = self._rows()
        after = replay.after(rows)
        drawn = self._read(rows, which) | {"action": replay.read("action", rows)}
        drawn |= {f"next.{k}": v for k, v in self._read(after, which).items()}
        drawn["reward"] = replay.read("reward", after, column=which)
        drawn["terminal"] = replay.read("terminal", after)
        return drawn

    def _policy_batch(self, rows: Tensor, which: Tensor) -> State:
        """Return states as the policy perceives them, and the truth."""
        replay = self.replay
        seen = {
            name: replay.read(name, rows, frames=self.frames if stacks else None)
            for name, stacks in self._sensed.items()
        }
        seen |= {k: replay.read(k, rows, column=which) for k in self._sentence}
        if "instruction" in seen:
            seen["instruction"] = seen["instruction"].long()
        truth = {"named": replay.read("named", rows, column=which)}
        truth["snapshot"] = replay.read("snapshot", rows)
        return seen | self._read(rows, which) | truth

    def _rows(self) -> tuple[Tensor, Tensor]:
        """Return rows [B], and under which of its sentences to see each [B]."""
        which = torch.randint(self.hindsight.sentences, (self.config.batch,))
        return self.replay.draw(len(which)), which

    def _read(self, rows: Tensor, which: Tensor) -> State:
        """Return what critics read of some rows, before it is put together."""
        replay = self.replay
        now = {f"now.{k}": replay.read(k, rows) for k in ("proprioception", "target")}
        now["joint_velocity"] = replay.read("joint_velocity", rows)
        return now | {"goal": replay.read("goal", rows, column=which).float()}

    def _scene(self, rows: Tensor) -> Snapshot:
        return Snapshot.unpack(rows, self.hindsight.fingers)

    def _critic_input(self, read: State) -> Tensor:
        """Return what critics and teacher read [B, D]."""
        speed = (read["joint_velocity"] / 10).clamp(-1, 1)
        felt = read["now.target"], read["now.proprioception"]
        return torch.cat([*felt, speed, read["goal"]], dim=1)

    def _train_teacher(self) -> None:
        """Improve critics and teacher by a step of all envs."""
        for name in ("critics", "teacher"):
            self._set_rate(name, self.config.learning_rate, self._teacher_progress)
        for turn in range(self.config.gradients):
            now = self._draw()
            self._improve_critics(now)
            if turn % 2 == 0:
                self._improve_teacher(now)

    def _improve_critics(self, now: State) -> None:
        """Bring Q to r + gamma (Q' - temperature log pi), Q' being what follows."""
        temperature = self.log_temperature.detach().exp()
        with torch.no_grad():
            after = under("next", now)
            action, log_prob = self._teacher_policy(after).rsample()
            future = self.target_critics(self._critic_input(after), action).amin(dim=0)
            future = (future - temperature * log_prob) * ~now["terminal"]
            scale, gamma = self.config.reward_scale, self.config.gamma
            target = scale * now["reward"] + gamma * future
        value = self.critics(self._critic_input(now), now["action"])
        loss = functional.mse_loss(value, target.expand_as(value), reduction="sum")
        loss = loss / len(target)
        self._descend("critics", loss)
        with torch.no_grad():
            rate = self.config.polyak
            slow, fast = self.target_critics.parameters(), self.critics.parameters()
            torch._foreach_lerp_(list(slow), list(fast), rate)
        self._note(critics=loss, value=value.mean(), reward=now["reward"].mean())

    def _improve_teacher(self, now: State) -> None:
        """Do what both critics value, as randomly as the target entropy asks."""
        temperature = self.log_temperature.detach().exp()
        action, log_prob = self._teacher_policy(now).rsample()
        value = self.critics(self._critic_input(now), action).amin(dim=0)
        self._descend("teacher", (temperature * log_prob - value).mean())
        entropy = linear(*TARGET_ENTROPY, max(0.0, 1.5 * self._teacher_progress - 0.5))
        excess = -entropy * self.actions - log_prob.detach().mean()
        self._descend("temperature", self.log_temperature.exp() * excess)
        self._note(entropy=-log_prob.mean(), temperature=temperature)

    def _train_policy(self) -> None:
        """Do what the teacher does, and tell where the named object is."""
        rows, which = self._rows()
        self._set_rate("agent", self.config.policy_rate, self._policy_progress)
        means = backward(
            lambda part: self._imitation(self._policy_batch(rows[part], which[part])),
            len(rows),
            self._weights("agent"),
            self._threads,
        )
        self._step("agent")
        self._note(**means)

    def _imitation(self, now: State) -> Loss:
        """Return how far the policy is off the teacher and the truth."""
        with torch.no_grad():
            shown = self._teacher_policy(now).mean
        encoder, scene = self.agent.encoder, self._scene(now["snapshot"])
        with bfloat16_autocast():
            aligned = encoder(now)
            mean = self.agent.actor(aligned, now["now.target"]).mean
        loss = functional.mse_loss(mean, shown)
        means = {"imitation": loss}
        if isinstance(encoder.vision, ObjectVision):
            misseen = encoder.vision.misseen(aligned[:, encoder.seen], scene)
            loss = loss + misseen
            means["misseen"] = misseen
        if self.agent.locator is not None:
            guess, truth = self.agent.locator(aligned.float()), now["named"]
            off = 2 * functional.huber_loss(guess / LENGTH, truth / LENGTH)
            loss = loss + self.agent.config.auxiliary_weight * off
            means |= {"auxiliary": off, "off": (guess - truth).norm(dim=1).median()}
        return loss, means

    @property
    def _teacher_progress(self) -> float:
        """Which share of its own training the teacher has behind it."""
        return min(1.0, self.share / self.config.policy_from)

    @property
    def _policy_progress(self) -> float:
        """Which share of its own training the policy has behind it."""
        begun = self.config.policy_from
        return max(0.0, (self.share - begun) / (1 - begun))

    def _set_rate(self, name: str, rate: float, share: float) -> None:
        """Let a learning rate grow at first, and shrink in the last third."""
        part = min(share / WARMUP + 0.02, 3 * (1 - share) + 0.02, 1.0)
        self._optimizers[name].param_groups[0]["lr"] = rate * part

    def _descend(self, name: str, loss: Tensor) -> None:
        """Make one step against a loss; the others' weights get no gradient."""
        self._optimizers[name].zero_grad()
        loss.backward(inputs=self._weights(name))
        self._step(name)

    def _weights(self, name: str) -> list[Tensor]:
        """Return what an optimizer improves."""
        return self._optimizers[name].param_groups[0]["params"]

    def _step(self, name: str) -> None:
        """Make one step of an optimizer."""
        nn.utils.clip_grad_norm_(self._weights(name), MAX_GRAD_NORM)
        self._optimizers[name].step()

    def _note(self, **figures: Tensor) -> None:
        for name, value in figures.items():
            self._history[f"loss/{name}"].append(value.detach())

    # -- Checkpoints -----------------------------------------------------------------

    def state_dict(self) -> dict[str, Tensor]:
        """Return all weights, the optimizers' averages, and how full the replay is."""
        tensors = {"temperature": self.log_temperature.detach().clone()}
        tensors["updates"] = torch.tensor(self.updates)
        for name in PARTS:
            tensors |= copied(name, getattr(self, name).state_dict())
        for name, optimizer in self._optimizers.items():
            tensors |= copied(f"optimizer.{name}", averages(optimizer))
        return tensors

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Go on from what `state_dict` returned."""
        for name in PARTS:
            getattr(self, name).load_state_dict(under(name, tensors))
        for name, optimizer in self._optimizers.items():
            load_averages(optimizer, under(f"optimizer.{name}", tensors))
        with torch.no_grad():
            self.log_temperature.copy_(tensors["temperature"])
        self.updates = int(tensors["updates"])
