"""Proximal policy optimization (Schulman et al., 2017)."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

from ir_maniskill.agent.agent import Agent, StateSpec
from ir_maniskill.environment.senses import State
from ir_maniskill.training import distributed
from ir_maniskill.training.algorithm import (
    Algorithm,
    Outcome,
    averages,
    copied,
    load_averages,
    under,
)
from ir_maniskill.training.config import PPOConfig, TrainConfig
from ir_maniskill.training.finite import check_finite
from ir_maniskill.training.gradient import Loss, backward
from ir_maniskill.training.rollout import Batch, RewardScale, Rollout
from ir_maniskill.training.schedules import linear, softened

VALUE_WEIGHT = 0.5
"""Weight of the critic's loss."""
DECIMETER = 0.1
"""Unit of the auxiliary loss [m]: about the spacing of the objects."""
RATE_CHANGE = 1.5
"""Factor by which the learning rate changes, at most once an epoch."""
TOO_FAR = 10 / 3
"""Of `target_kl`: no further epoch once the policy moved so far."""
LOWEST_RATE, HIGHEST_RATE = 1e-5, 1e-3
"""Up to which the learning rate shrinks and grows."""


class PPO(Algorithm):
    """Collects T steps of all envs, then makes some epochs of gradients on them.

    Noise and curriculum change from one roll-out to the next, not within one.
    """

    def __init__(self, config: TrainConfig, state: State, actions: int) -> None:
        """Make an untrained agent, the same on all ranks."""
        self.config = config.ppo
        self._threads = config.threads or distributed.cores()
        spec = StateSpec.of(state, actions)
        self.agent = Agent(config.agent, spec).to(state["instruction"].device)
        distributed.copy_from_first(self.agent)
        rate = config.ppo.learning_rate
        weights = self.agent.parameters()
        self.optimizer = torch.optim.Adam(weights, rate, eps=1e-5, fused=True)
        self.rollout = Rollout(config.steps_per_env, state, actions)
        self.reward_scale = RewardScale(self.rollout.num_envs, config.ppo.gamma)
        self._in_full, self._warmup = config.reward_weights, config.penalty_warmup
        self._t = 0  # steps of the present roll-out

    @torch.no_grad()
    def act(self, state: State) -> Tensor:
        """Sample actions [N, A], and keep what was done in which state."""
        if self._t == 0:
            self._begin(state)
        act = self.agent.act(state)
        self.rollout.add(self._t, state, act)
        return act.action.clamp(-1, 1)

    def _begin(self, state: State) -> None:
        """Begin a roll-out: schedules take their values for all of it."""
        std, final = self.config.std, self.config.std_final
        self.agent.actor.set_std(linear(std, final, self.share))
        self._penalty = linear(0.0, 1.0, self.share, self._warmup)
        self._weights = softened(self._in_full, self._penalty).vector()
        self.rollout.begin(state)

    @torch.no_grad()
    def observe(self, outcome: Outcome) -> None:
        """Keep the reward, and the value of what truncation hides."""
        reward, beyond = outcome.reward, torch.zeros_like(outcome.reward)
        if outcome.terms is not None:
            reward = outcome.terms @ self._weights.to(reward.device)
        if self.config.bootstrap and outcome.final is not None:
            hidden = outcome.truncated & ~outcome.terminated
            beyond = values_of(self.agent, outcome.final, hidden)
            check_finite({"value": beyond}, "critic", "the learning rate is too high")
        self.rollout.add_outcome(self._t, reward, outcome.done, beyond)
        self._next = outcome.state
        self._t += 1

    def update(self) -> dict[str, float]:
        """Improve the agent once the roll-out is full."""
        if self._t < self.rollout.steps:
            return {}
        self._t, rollout, config = 0, self.rollout, self.config
        learned_from = distributed.gather(rollout.reward.mean()[None])  # [R]
        # Rewards are scaled such that returns deviate by 1, whatever the task pays.
        rollout.reward = self.reward_scale(rollout.reward, rollout.done)
        with torch.no_grad():
            last_value = self.agent.value(self._next)
        rollout.finish(last_value, config.gamma, config.gae_lambda)
        figures = improve(self.agent, self.optimizer, rollout, config, self._threads)
        if "privileged" in rollout.state:
            seen = distributed.gather(rollout.state["privileged"].flatten(0, 1))
            self.agent.observe(seen)
        figures = {f"loss/{name}": value for name, value in figures.items()}
        return figures | {
            "reward": float(learned_from.mean()),
            "penalty": self._penalty,
            "std": float(self.agent.actor.log_std.exp().mean()),
        }

    def restart(self) -> None:
        """Forget the returns so far: every env begins a new episode."""
        self.reward_scale.restart()

    def state_dict(self) -> dict[str, Tensor]:
        """Return the agent, the optimizer's averages, its learning rate, the scale."""
        rate = self.optimizer.param_groups[0]["lr"]
        return {
            **copied("agent", self.agent.state_dict()),
            **copied("optimizer", averages(self.optimizer)),
            "learning_rate": torch.tensor(rate, dtype=torch.float64),
            **copied("reward_scale", self.reward_scale.seen.state_dict()),
        }

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Go on from what `state_dict` returned."""
        self.agent.load_state_dict(under("agent", tensors))
        load_averages(self.optimizer, under("optimizer", tensors))
        for group in self.optimizer.param_groups:
            group["lr"] = float(tensors["learning_rate"])
        self.reward_scale.seen.load_state_dict(under("reward_scale", tensors))


def values_of(agent: Agent, state: State, chosen: Tensor) -> Tensor:
    """Return the value of the chosen states [N], and 0 for the others."""
    values = torch.zeros(len(chosen), device=chosen.device)
    if chosen.any():
        values[chosen] = agent.value({k: v[chosen] for k, v in state.items()})
    return values


def improve(
    agent: Agent,
    optimizer: torch.optim.Optimizer,
    rollout: Rollout,
    config: PPOConfig,
    threads: int = 1,
) -> dict[str, float]:
    """Improve the agent on the roll-outs; return the figures of the last epoch."""
    figures: dict[str, float] = {}
    for epoch in range(config.epochs):
        history = defaultdict(list)
        for index in minibatches(rollout, config):
            loss = minibatch_loss(agent, rollout, index, config)
            terms = backward(loss, len(index), list(agent.parameters()), threads)
            check_finite(terms, "loss", "the learning rate is too high")
            distributed.average_gradients(agent)
            terms["gradient"] = clip_gradient(agent, config.max_grad_norm)
            optimizer.step()
            for name, term in terms.items():
                history[name].append(term)
        means = torch.stack([torch.stack(terms).mean() for terms in history.values()])
        means = distributed.gather(means[None]).mean(dim=0)  # all ranks stop alike
        figures = dict(zip(history, means.tolist(), strict=True))
        figures["epochs"] = epoch + 1
        adapt_rate(optimizer, figures["kl"], config.target_kl)
        target = config.target_kl
        if target is not None and figures["kl"] > TOO_FAR * target:
            break
    weights = dict(agent.named_parameters())
    check_finite(weights, "weight", "the learning rate is too high")
    figures["explained_variance"] = explained_variance(rollout)
    figures["learning_rate"] = optimizer.param_groups[0]["lr"]
    return figures


def adapt_rate(
    optimizer: torch.optim.Optimizer, kl: float, target: float | None
) -> None:
    """Change the learning rate if an epoch moved the policy too far, or hardly.

    One that is beyond a bound from the start stays there rather than jump to it.
    """
    if target is None:
        return
    for group in optimizer.param_groups:
        rate = group["lr"]
        if kl > 2 * target:
            group["lr"] = min(rate, max(rate / RATE_CHANGE, LOWEST_RATE))
        elif kl < target / 2:
            group["lr"] = max(rate, min(rate * RATE_CHANGE, HIGHEST_RATE))


def minibatches(rollout: Rollout, config: PPOConfig) -> Iterator[Tensor]:
    """Yield the flat indices of all steps [B], shuffled, in equal parts.

    A minibatch is shared by the ranks, each drawing from its own steps.
    """
    total = rollout.steps * rollout.num_envs
    joined = total * distributed.size()
    parts = max(1, round(joined / (config.minibatch or joined)))
    yield from torch.randperm(total).to(rollout.reward.device).tensor_split(parts)


def minibatch_loss(
    agent: Agent, rollout: Rollout, index: Tensor, config: PPOConfig
) -> Callable[[slice], Loss]:
    """Return the loss of a part of the minibatch with these flat indices [B]."""
    advantage = normalize(rollout.advantage.flatten()[index])

    def loss(part: slice) -> Loss:
        batch = rollout.batch(index[part])._replace(advantage=advantage[part])
        return ppo_loss(agent, batch, config)

    return loss


def ppo_loss(agent: Agent, batch: Batch, config: PPOConfig) -> Loss:
    """Return the loss of a minibatch, and its terms for the log.

    The policy's part is -E[min(r A, clip(r, 1 - c, 1 + c) A)], r = pi / pi_old; the
    advantages A are normalized already.
    """
    now = agent.evaluate_actions(batch.state, batch.action)
    log_ratio = now.log_prob - batch.log_prob
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1 - config.clip, 1 + config.clip)
    gain = torch.minimum(ratio * batch.advantage, clipped * batch.advantage)
    terms = {
        "policy": -gain.mean(),
        "value": 0.5 * functional.mse_loss(now.value, batch.returns),
    }
    loss = terms["policy"] + VALUE_WEIGHT * terms["value"]
    if now.named_position is not None:
        guess, truth = now.named_position, batch.state["named_position"]
        # The square up to 1 dm: objects that fall off the table are meters away.
        off = functional.huber_loss(guess / DECIMETER, truth / DECIMETER)
        terms["auxiliary"] = 2 * off
        loss = loss + agent.config.auxiliary_weight * terms["auxiliary"]
    terms["kl"] = (ratio - 1 - log_ratio).mean()  # low-variance estimate, never < 0
    terms["clipped"] = ((ratio - 1).abs() > config.clip).float().mean()
    return loss, terms


def normalize(advantage: Tensor) -> Tensor:
    """Return the advantages with mean 0 and standard deviation 1 over all ranks."""
    joined = distributed.gather(advantage)
    return (advantage - joined.mean()) / (joined.std(correction=0) + 1e-8)


def clip_gradient(agent: Agent, max_norm: float | None) -> Tensor:
    """Shorten the gradient to `max_norm`; return how long it was."""
    limit = float("inf") if max_norm is None else max_norm
    norm = nn.utils.clip_grad_norm_(agent.parameters(), limit)
    if not norm.isfinite():
        named = agent.named_parameters()
        gradients = {name: w.grad for name, w in named if w.grad is not None}
        check_finite(gradients, "gradient", "the learning rate is too high")
    return norm


def explained_variance(rollout: Rollout) -> float:
    """Return the share of the returns' variance that the critic foresaw (1: all)."""
    returns, missed = map(distributed.gather, (rollout.returns, rollout.advantage))
    variance = returns.var()
    return float(1 - missed.var() / variance) if variance > 0 else 0.0
