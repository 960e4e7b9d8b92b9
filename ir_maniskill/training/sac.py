"""Soft actor-critic (Haarnoja et al., 2018) with hindsight under other sentences.

The critics read the simulator's state and the goal, in training only; the actor sees
what it will see later, and reads the sentence.

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

from ir_maniskill.agent.agent import Agent, StateSpec
from ir_maniskill.agent.cell_vision import CellVision
from ir_maniskill.checks import require
from ir_maniskill.environment.senses import State, read_text
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
from ir_maniskill.training.hindsight import FACTS, LENGTH, Hindsight, simulated
from ir_maniskill.training.replay import Replay

log = logging.getLogger(__name__)

TEMPERATURE = 0.1
"""Weight of the entropy at the start."""
READING_RATE, RARE = 3e-3, -5.0
"""Adam's step size while only reading is learned; logit of a fact at the start."""
LOGGED = 64
"""Updates from one row of the log to the next."""
WIDTHS = (384, 384)
"""Units of each critic's layers."""


class Critics(nn.Module):
    """Two judges Q(s, g, a), whose layers are computed together."""

    def __init__(self, inputs: int) -> None:
        """Make the layers for D + A numbers."""
        super().__init__()
        widths = (inputs, *WIDTHS, 1)
        pairs = list(itertools.pairwise(widths))
        bound = [1 / math.sqrt(into) for into, _ in pairs]
        self.weights = nn.ParameterList(
            torch.empty(2, *pair).uniform_(-b, b)
            for pair, b in zip(pairs, bound, strict=True)
        )
        self.biases = nn.ParameterList(
            torch.empty(2, 1, out).uniform_(-b, b)
            for (_, out), b in zip(pairs, bound, strict=True)
        )

    def forward(self, known: Tensor, action: Tensor) -> Tensor:
        """Return both values [2, B] of what is known [B, D] and done [B, A]."""
        x = torch.cat([known, action], dim=1).expand(2, -1, -1)
        *hidden, last = zip(self.weights, self.biases, strict=True)
        for weight, bias in hidden:
            x = torch.baddbmm(bias, x, weight)
            x = functional.relu(functional.layer_norm(x, x.shape[-1:]))
        weight, bias = last
        return torch.baddbmm(bias, x, weight).squeeze(-1)


class SAC(Algorithm):
    """Keeps all episodes, and learns from their steps under many sentences."""

    learns_while_stepping = True

    def __init__(
        self,
        config: TrainConfig,
        state: State,
        actions: int,
        hindsight: Hindsight | None = None,
    ) -> None:
        """Make an untrained agent.

        `hindsight` judges the episodes; None: that of the config's task.

        Raises:
            ConfigError: The agent or the number of processes does not fit.
        """
        self.config: SACConfig = config.sac
        ranks = distributed.size()
        require(ranks == 1, "processes", ranks, "1: SAC trains in a single one")
        self.hindsight = hindsight or Hindsight.of(config, config.sac.others)
        self.frames = config.frames
        self.agent = Agent(config.agent, StateSpec.of(state, actions))
        self.agent.to(state["instruction"].device)
        self._use_16_bits()
        read = self.agent.encoder.language.reads
        self._sentence = {name: state[name].shape[1] for name in read}
        inputs = self._known(self._sizes(state)).shape[1]
        self.critics = Critics(inputs + actions)
        self.slow = copy.deepcopy(self.critics).requires_grad_(False)
        self.log_temperature = torch.tensor(math.log(TEMPERATURE), requires_grad=True)
        self.asked = nn.Linear(self.agent.encoder.reading_width, FACTS)
        """Tells from G_t what the goal is; most facts are not true at first."""
        nn.init.constant_(self.asked.bias, RARE)
        self._optimizers = {
            "agent": self._adam_of_agent(),
            "critics": self._adam(self.critics.parameters()),
            "temperature": self._adam([self.log_temperature]),
        }
        self.replay = Replay(config.sac.capacity)
        self.actions, self.updates = actions, 0
        self._history: dict[str, list[Tensor]] = defaultdict(list)
        self._past: list[State] = []
        """Steps of all envs whose episodes go on, the oldest first."""
        self._began = torch.zeros(len(state["instruction"]), dtype=torch.int64)
        """Of each env, which of them its episode began with."""

    def _adam(self, weights: Iterable[Tensor]) -> torch.optim.Adam:
        return torch.optim.Adam(list(weights), self.config.learning_rate, fused=True)

    def _adam_of_agent(self) -> torch.optim.Adam:
        encoder = [*self.agent.encoder.parameters(), *self.asked.parameters()]
        others = [self.agent.actor, self.agent.locator]
        weights = [w for part in others if part is not None for w in part.parameters()]
        groups = [{"params": encoder, "lr": self.config.encoder_rate}]
        groups += [{"params": weights, "lr": self.config.learning_rate}]
        return torch.optim.Adam(groups, fused=True)

    def _use_16_bits(self) -> None:
        """Compute pictures' maps in 16 bits where the processor does so at speed."""
        vision = self.agent.encoder.vision
        if isinstance(vision, CellVision) and torch.cpu._is_avx512_bf16_supported():
            vision.dtype = torch.bfloat16

    def keep_in(self, folder: Path) -> None:
        """Keep the replay there."""
        self.replay.keep_in(folder / "replay")

    # -- Collecting ------------------------------------------------------------------

    @torch.no_grad()
    def act(self, state: State) -> Tensor:
        """Sample actions [N, A], and remember what was done in which state."""
        count = len(state["instruction"])
        if self.replay.written < self.config.random_steps:
            action = torch.rand(count, self.actions) * 2 - 1
        else:
            action, _ = self.agent.actor(self.agent.encoder(state)).rsample()
        self._past.append({**self._kept(state), "action": action})
        return action

    def _kept(self, state: State) -> State:
        """Return what of a state is kept: of stacks the newest alone."""
        stacked = {*self.agent.encoder.sensed, "proprioception", "target"}
        newest = {name: state[name][:, 0] for name in stacked}
        once = ("joint_velocity", "snapshot", "text")
        return newest | {name: state[name] for name in once}

    def observe(self, outcome: Outcome) -> None:
        """Judge and keep the episodes that ended."""
        ended = outcome.done.nonzero().flatten().tolist()
        if not ended:
            return
        assert outcome.final is not None
        final = self._kept(outcome.final)
        for env in ended:
            rows = self._past[int(self._began[env]) :]
            episode = {
                name: torch.stack([*(row[name][env] for row in rows), value[env]])
                for name, value in final.items()
            }
            actions = torch.stack([row["action"][env] for row in rows])
            episode["action"] = functional.pad(actions, (0, 0, 0, 1))
            terminal = torch.zeros(len(rows) + 1, dtype=torch.bool)
            terminal[-1] = outcome.terminated[env]
            self._keep({**episode, "terminal": terminal})
        self._began[ended] = len(self._past)
        oldest = int(self._began.min())
        self._past, self._began = self._past[oldest:], self._began - oldest

    def _keep(self, episode: State) -> None:
        """Judge an episode under several sentences, and add it to the replay."""
        scenes = Snapshot.unpack(episode["snapshot"], self.hindsight.fingers)
        (said,) = read_text(episode.pop("text")[:1])
        found = self.hindsight.find(scenes.rows(torch.tensor([0])), said)
        judged = self.hindsight.judge(scenes, found)
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
        self._past, self._began = [], torch.zeros_like(self._began)

    # -- Learning --------------------------------------------------------------------

    def update(self) -> dict[str, float]:
        """Make some gradients, once there is enough to learn from."""
        if self.replay.written < self.config.first_steps:
            return {}
        if not self.updates:
            self._learn_to_read()
            for _ in range(self.config.looking_steps):
                now = self._draw()
                self._step("agent", self._auxiliary(self.agent.encoder(now), now))
        self.updates += 1
        for turn in range(self.config.gradients):
            now = self._draw()
            self._improve_critics(now)
            if turn % self.config.actor_every == 0:
                self._improve_agent(now)
        if self.updates % LOGGED:
            return {}
        history = sorted(self._history.items())  # a table's columns keep their order
        figures = {k: float(torch.stack(v).mean()) for k, v in history}
        self._history.clear()
        check_finite(
            {k: torch.tensor(v) for k, v in figures.items()},
            *("loss", "the learning rate is too high"),
        )
        return figures | {"replay": float(len(self.replay))}

    def _draw(self) -> State:
        """Return a batch of steps, each under one of its sentences [B, ...].

        What was there after the step is named "next.", as what was before it is named.
        """
        replay, each = self.replay, self.config.each
        episodes = -(-self.config.batch // each)
        rows = replay.draw(episodes, each)
        which = torch.randint(self.hindsight.sentences, (episodes,))
        which[torch.rand(episodes) < self.config.own] = 0
        which = which.repeat(each)  # a sentence is read once, whatever is done under it
        drawn = self._read(rows, which) | {"action": replay.read("action", rows)}
        after = replay.after(rows)
        drawn |= {f"next.{k}": v for k, v in self._read(after, which).items()}
        drawn["facts"] = replay.read("facts", rows, column=which)
        drawn["reward"] = replay.read("reward", after, column=which)
        drawn["terminal"] = replay.read("terminal", after)
        return drawn

    def _read(self, rows: Tensor, which: Tensor) -> State:
        replay, frames = self.replay, self.frames
        sensed = self.agent.encoder.sensed
        read = {name: replay.read(name, rows, frames=frames) for name in sensed}
        read |= self._sentences(rows, which)
        for name in ("proprioception", "target"):
            read[f"now.{name}"] = replay.read(name, rows)
        for name in ("joint_velocity", "snapshot"):
            read[name] = replay.read(name, rows)
        for name in ("goal", "named"):
            read[name] = replay.read(name, rows, column=which).float()
        return read

    def _sentences(self, rows: Tensor, which: Tensor) -> State:
        read = {k: self.replay.read(k, rows, column=which) for k in self._sentence}
        if "instruction" in read:
            read["instruction"] = read["instruction"].long()
        return read

    def _known(self, read: State) -> Tensor:
        """Return what critics read [B, D]."""
        scene = simulated(Snapshot.unpack(read["snapshot"], self.hindsight.fingers))
        speed = (read["joint_velocity"] / 10).clamp(-1, 1)
        felt = read["now.proprioception"], read["now.target"]
        return torch.cat([*felt, speed, scene, read["goal"]], dim=1)

    def _sizes(self, state: State) -> State:
        """Return what `_read` would, of a state whose goal means nothing."""
        snapshot = state["snapshot"][:1]
        scene = Snapshot.unpack(snapshot, self.hindsight.fingers)
        text = read_text(state["text"][:1])[0]
        judged = self.hindsight.judge(scene, self.hindsight.find(scene, text)[:1])
        joints = {f"now.{k}": state[k][:1, 0] for k in ("proprioception", "target")}
        velocity = state["joint_velocity"][:1]
        return {
            **joints,
            "joint_velocity": velocity,
            "snapshot": snapshot,
            "goal": judged.goal[:, 0],
        }

    def _improve_critics(self, now: State) -> None:
        """Bring Q to r + gamma (Q' - temperature log pi), Q' being what follows."""
        temperature = self.log_temperature.detach().exp()
        after = under("next", now)
        with torch.no_grad():
            action, log_prob = self.agent.actor(self.agent.encoder(after)).rsample()
            future = self.slow(self._known(after), action).amin(dim=0)
            future = (future - temperature * log_prob) * ~now["terminal"]
            scale, gamma = self.config.reward_scale, self.config.gamma
            target = scale * now["reward"] + gamma * future
        value = self.critics(self._known(now), now["action"])
        loss = functional.mse_loss(value, target.expand_as(value), reduction="sum")
        loss = loss / len(target)
        self._step("critics", loss)
        with torch.no_grad():
            rate = self.config.polyak
            slow, fast = self.slow.parameters(), self.critics.parameters()
            torch._foreach_lerp_(list(slow), list(fast), rate)
        self._note(critics=loss, value=value.mean(), reward=now["reward"].mean())

    def _improve_agent(self, now: State) -> None:
        """Do what both critics value, as randomly as the target entropy asks."""
        temperature = self.log_temperature.detach().exp()
        aligned = self.agent.encoder(now)
        action, log_prob = self.agent.actor(aligned).rsample()
        value = self.critics(self._known(now), action).amin(dim=0)
        loss = (temperature * log_prob - value).mean()
        loss = loss + self._auxiliary(aligned, now)
        self._step("agent", loss)
        excess = 0.5 * self.actions - log_prob.detach().mean()  # entropy over -A/2
        self._step("temperature", self.log_temperature.exp() * excess)
        self._note(entropy=-log_prob.mean(), temperature=temperature)

    def _auxiliary(self, aligned: Tensor, now: State) -> Tensor:
        """Return the weighted losses of what B_t should tell: facts, and a place."""
        loss = torch.zeros(())
        if self.agent.locator is not None:
            guess, truth = self.agent.locator(aligned), now["named"]
            off = 2 * functional.huber_loss(guess / LENGTH, truth / LENGTH)
            loss = loss + self.agent.config.auxiliary_weight * off
            self._note(auxiliary=off)
        if self.config.facts_weight > 0:
            said = aligned[:, : self.agent.encoder.reading_width]
            unread = self._unread(said, now["facts"])
            loss = loss + self.config.facts_weight * unread
            self._note(unread=unread)
        return loss

    def _learn_to_read(self) -> None:
        """Learn to tell from the sentences alone what the goals are."""
        encoder = self.agent.encoder
        parts = (encoder.language, encoder.reading, self.asked)
        weights = [w for part in parts if part is not None for w in part.parameters()]
        optimizer = torch.optim.Adam(weights, READING_RATE, fused=True)
        for _ in range(self.config.reading_steps):
            rows = self.replay.draw(self.config.batch)
            which = torch.randint(self.hindsight.sentences, rows.shape)
            said = encoder.read(self._sentences(rows, which))
            optimizer.zero_grad()
            self._unread(said, self.replay.read("facts", rows, column=which)).backward()
            optimizer.step()

    def _unread(self, said: Tensor, facts: Tensor) -> Tensor:
        """Return the cross-entropy of the facts [B, n] given G_t [B, D'], summed."""
        true = torch.zeros(len(facts), FACTS + 1).scatter_(1, facts.long(), 1.0)
        told = self.asked(said)
        return functional.binary_cross_entropy_with_logits(
            told, true[:, :FACTS], reduction="sum"
        ) / len(facts)

    def _step(self, name: str, loss: Tensor) -> None:
        """Make one step of an optimizer; the others' weights get no gradient."""
        optimizer = self._optimizers[name]
        weights = [w for group in optimizer.param_groups for w in group["params"]]
        gradients = torch.autograd.grad(loss, weights, allow_unused=True)
        for weight, gradient in zip(weights, gradients, strict=True):
            weight.grad = gradient
        optimizer.step()

    def _note(self, **figures: Tensor) -> None:
        for name, value in figures.items():
            self._history[f"loss/{name}"].append(value.detach())

    # -- Checkpoints -----------------------------------------------------------------

    def state_dict(self) -> dict[str, Tensor]:
        """Return all weights, the optimizers' averages, and how full the replay is."""
        tensors = {"temperature": self.log_temperature.detach().clone()}
        tensors["updates"] = torch.tensor(self.updates)
        for name, part in self._parts().items():
            tensors |= copied(name, part)
        for name, optimizer in self._optimizers.items():
            tensors |= copied(f"optimizer.{name}", averages(optimizer))
        return tensors

    def _parts(self) -> dict[str, Mapping[str, Tensor]]:
        return {
            "agent": self.agent.state_dict(),
            "critics": self.critics.state_dict(),
            "slow": self.slow.state_dict(),
            "asked": self.asked.state_dict(),
            "replay": self.replay.state_dict(),
        }

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Go on from what `state_dict` returned."""
        self.agent.load_state_dict(under("agent", tensors))
        self.critics.load_state_dict(under("critics", tensors))
        self.slow.load_state_dict(under("slow", tensors))
        self.asked.load_state_dict(under("asked", tensors))
        self.replay.load_state_dict(under("replay", tensors))
        for name, optimizer in self._optimizers.items():
            load_averages(optimizer, under(f"optimizer.{name}", tensors))
        with torch.no_grad():
            self.log_temperature.copy_(tensors["temperature"])
        self.updates = int(tensors["updates"])
