"""Roll-outs: what the agent lived through, kept for one update.

Legend: T steps, N envs, S stacked observations, A numbers of an action, B steps drawn.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from ir_maniskill.agent.agent import Act
from ir_maniskill.agent.critic import Standardize
from ir_maniskill.environment.senses import State
from ir_maniskill.training import distributed


class Batch(NamedTuple):
    """Steps drawn from the roll-outs, B of them."""

    state: State  # s_t, each entry [B, ...]
    action: Tensor  # a_t as sampled, not clipped [B, A]
    log_prob: Tensor  # log pi(a_t|s_t) when it was sampled [B]
    advantage: Tensor  # A_t [B]
    returns: Tensor  # what the critic should have said [B]


class Frames:
    """The images of T steps of N envs, each stored once.

    A state stacks S images, so storing states would hold every image S times. Kept
    instead are the images of each step, and for each state the rows of its S images.
    """

    def __init__(self, steps: int, images: Tensor) -> None:
        """Make room for `steps` stacks like these images [N, S, K, H, W, 3]."""
        num_envs, self.depth, *image = images.shape
        rows = steps + self.depth - 1
        self.images = images.new_zeros(rows, num_envs, *image)
        self.rows = images.new_zeros(steps, num_envs, self.depth, dtype=torch.long)
        self.births = self.rows.new_zeros(num_envs)  # row where each episode began

    def begin(self, images: Tensor) -> None:
        """Keep the images before the first step: the history of its state."""
        self.images[: self.depth] = images.transpose(0, 1).flip(0)  # oldest first
        self.births.zero_()

    def add(self, t: int, images: Tensor, fresh: Tensor) -> None:
        """Keep the newest images of step t; `fresh` [N]: its episode begins there."""
        newest = t + self.depth - 1
        self.images[newest] = images[:, 0]
        self.births[fresh] = newest
        rows = newest - torch.arange(self.depth, device=self.rows.device)
        # A state never looks back beyond the first observation of its episode.
        self.rows[t] = torch.maximum(rows, self.births[:, None])  # [N, S]

    def batch(self, index: Tensor) -> Tensor:
        """Return the stacks [B, S, K, H, W, 3] of the flat indices t * N + n [B]."""
        num_envs = len(self.births)
        rows = self.rows.flatten(0, 1)[index]  # [B, S]
        rows = rows * num_envs + (index % num_envs)[:, None]
        images = self.images.flatten(0, 1).index_select(0, rows.flatten())
        return images.unflatten(0, rows.shape)


class Rollout:
    """T steps of N envs."""

    def __init__(self, steps: int, state: State, actions: int) -> None:
        """Make room for `steps` states like this one."""
        self.steps, self.num_envs = steps, len(state["instruction"])
        plain = {k: v for k, v in state.items() if k != "images"}
        self.state = {
            key: value.new_zeros(steps, *value.shape) for key, value in plain.items()
        }
        self.frames = Frames(steps, state["images"]) if "images" in state else None
        reward = state["touch"].new_zeros(steps, self.num_envs)
        self.action = reward.new_zeros(*reward.shape, actions)
        self.log_prob, self.value = reward.clone(), reward.clone()
        self.reward, self.next_value = reward.clone(), reward.clone()
        self.advantage, self.returns = reward.clone(), reward.clone()
        self.done = torch.zeros_like(reward, dtype=torch.bool)

    def begin(self, state: State) -> None:
        """Prepare for the steps that follow this state."""
        self.done[-1] = False
        if self.frames is not None:
            self.frames.begin(state["images"])

    def add(self, t: int, state: State, act: Act) -> None:
        """Keep the state of step t, and what the agent did."""
        for key, kept in self.state.items():
            kept[t] = state[key]
        self.action[t], self.log_prob[t], self.value[t] = act
        if self.frames is not None:
            self.frames.add(t, state["images"], self.done[t - 1])

    def add_outcome(self, t: int, reward: Tensor, done: Tensor, beyond: Tensor) -> None:
        """Keep what step t led to, all [N].

        `done` are episodes that ended, `beyond` is the value of their last states.
        """
        self.reward[t], self.done[t], self.next_value[t] = reward, done, beyond

    def finish(self, last_value: Tensor, gamma: float, gae_lambda: float) -> None:
        """Turn rewards and values into advantages and returns.

        `last_value` [N] is that of the states after the last step.
        """
        following = torch.cat([self.value[1:], last_value[None]])
        self.next_value = torch.where(self.done, self.next_value, following)
        self.advantage = advantages(
            self.reward, self.value, self.next_value, self.done, gamma, gae_lambda
        )
        self.returns = self.advantage + self.value

    def batch(self, index: Tensor) -> Batch:
        """Return the steps whose flat indices t * N + n are given [B]."""
        state = {key: kept.flatten(0, 1)[index] for key, kept in self.state.items()}
        if self.frames is not None:
            state["images"] = self.frames.batch(index)
        steps = (self.action, self.log_prob, self.advantage, self.returns)
        return Batch(state, *(kept.flatten(0, 1)[index] for kept in steps))


def advantages(
    reward: Tensor,
    value: Tensor,
    next_value: Tensor,
    done: Tensor,
    gamma: float,
    gae_lambda: float,
) -> Tensor:
    """Return the generalized advantage estimate of every step, all [T, N].

    A_t = d_t + gamma lambda A_{t+1}, with d_t = r_t + gamma V(s_{t+1}) - V(s_t); where
    an episode is done the sum ends. With lambda = 1 these are Monte-Carlo returns less
    the value.
    """
    delta = reward + gamma * next_value - value
    carry = gamma * gae_lambda * (~done).float()
    result, following = torch.zeros_like(reward), torch.zeros_like(reward[0])
    for t in reversed(range(len(reward))):
        result[t] = following = delta[t] + carry[t] * following
    return result


class RewardScale:
    """Divides rewards by the running standard deviation of the discounted return.

    Only the scale changes: a reward of 0 stays 0, a penalty stays negative.
    """

    def __init__(self, num_envs: int, gamma: float) -> None:
        """Start without any experience."""
        self.gamma = gamma
        self.running = torch.zeros(num_envs)  # [N] discounted return so far
        self.seen = Standardize(1).double()

    def __call__(self, reward: Tensor, done: Tensor) -> Tensor:
        """Return the rewards [T, N] scaled, after taking them into account."""
        running = self.running.to(reward.device)
        returns = torch.empty_like(reward)
        for t in range(len(reward)):
            returns[t] = running = self.gamma * running + reward[t]
            running = running * ~done[t]
        self.running = running
        self.seen.update(distributed.gather(returns.double().flatten())[:, None].cpu())
        # A task without any reward so far has no scale: leave its zeros alone.
        return reward / (float(self.seen.variance.sqrt()) or 1.0)

    def restart(self) -> None:
        """Forget the running returns: every env starts a new episode."""
        self.running = torch.zeros_like(self.running)
