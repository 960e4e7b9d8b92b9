"""Proximal policy optimization (Schulman et al., 2017)."""

from collections import defaultdict
from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torch.nn import functional

from ir_maniskill.agent.agent import Agent
from ir_maniskill.training import distributed
from ir_maniskill.training.config import PPOConfig
from ir_maniskill.training.finite import check_finite
from ir_maniskill.training.rollout import Batch, Rollout

DECIMETER = 0.1
"""Unit of the auxiliary loss [m]: about the spacing of the objects."""
RATE_CHANGE = 1.5
"""Factor by which the step size changes, at most once an epoch."""
LOWEST_RATE, HIGHEST_RATE = 1e-5, 1e-3
"""Up to which the step size shrinks and grows."""


def update(
    agent: Agent, optimizer: torch.optim.Optimizer, rollout: Rollout, config: PPOConfig
) -> dict[str, float]:
    """Improve the agent on the roll-outs; return the figures of the last epoch."""
    figures: dict[str, float] = {}
    for epoch in range(config.epochs):
        history = defaultdict(list)
        for index in minibatches(rollout, config):
            loss, terms = ppo_loss(agent, rollout.batch(index), config)
            check_finite(terms, "loss", "the learning rate is too high")
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
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
        if config.max_kl is not None and figures["kl"] > config.max_kl:
            break
    weights = dict(agent.named_parameters())
    check_finite(weights, "weight", "the learning rate is too high")
    figures["explained_variance"] = explained_variance(rollout)
    figures["learning_rate"] = optimizer.param_groups[0]["lr"]
    return figures


def adapt_rate(
    optimizer: torch.optim.Optimizer, kl: float, target: float | None
) -> None:
    """Change the step size if an epoch moved the policy too far, or hardly.

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


def ppo_loss(
    agent: Agent, batch: Batch, config: PPOConfig
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the loss of a minibatch, and its terms for the log.

    The policy's part is -E[min(r A, clip(r, 1 - c, 1 + c) A)], r = pi / pi_old.
    """
    now = agent.evaluate_actions(batch.state, batch.action)
    advantage = normalize(batch.advantage)
    log_ratio = now.log_prob - batch.log_prob
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1 - config.clip, 1 + config.clip)
    terms = {
        "policy": -torch.minimum(ratio * advantage, clipped * advantage).mean(),
        "value": 0.5 * functional.mse_loss(now.value, batch.returns),
        "entropy": now.entropy.mean(),
    }
    loss = terms["policy"] + config.value_weight * terms["value"]
    loss = loss - config.entropy_weight * terms["entropy"]
    if now.named_position is not None:
        guess, truth = now.named_position, batch.state["named_position"]
        # The square up to 1 dm: objects that fall off the table are meters away.
        terms["auxiliary"] = 2 * functional.huber_loss(
            guess / DECIMETER, truth / DECIMETER
        )
        loss = loss + agent.config.auxiliary_weight * terms["auxiliary"]
    terms["kl"] = (ratio - 1 - log_ratio).mean()  # low-variance estimate, never < 0
    terms["clipped"] = ((ratio - 1).abs() > config.clip).float().mean()
    return loss, {name: term.detach() for name, term in terms.items()}


def normalize(advantage: Tensor) -> Tensor:
    """Return the advantages with mean 0 and standard deviation 1 over all ranks."""
    joined = distributed.gather(advantage)
    return (advantage - joined.mean()) / (joined.std(correction=0) + 1e-8)


def clip_gradient(agent: Agent, max_norm: float | None) -> Tensor:
    """Shorten the gradient to `max_norm`; return how long it was."""
    limit = float("inf") if max_norm is None else max_norm
    norm = nn.utils.clip_grad_norm_(agent.parameters(), limit)
    if not norm.isfinite():
        gradients = {
            name: weight.grad
            for name, weight in agent.named_parameters()
            if weight.grad is not None
        }
        check_finite(gradients, "gradient", "the learning rate is too high")
    return norm


def explained_variance(rollout: Rollout) -> float:
    """Return the share of the returns' variance that the critic foresaw (1: all)."""
    returns, missed = map(distributed.gather, (rollout.returns, rollout.advantage))
    variance = returns.var()
    return float(1 - missed.var() / variance) if variance > 0 else 0.0
