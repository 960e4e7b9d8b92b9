"""PPO laid out as ManiSkill's own script, with its wrappers around one of our tasks.

    python examples/maniskill_ppo.py [--task NaoTouchCubeSingle-v1] [--iterations 20]
    python examples/maniskill_ppo.py --num-envs 256 --steps 32  # with a GPU

`FlattenRGBDObservationWrapper` stacks the pictures of both cameras in the channels, and
puts all else into one vector of floats, `state`. The sentence's tokens end it, as plain
numbers: `Agent.read` cuts them off and makes them one-hot. Scripts that feed `state` to
a linear layer as it is would take token 8 for twice token 4.
"""

from dataclasses import dataclass

import gymnasium as gym
import torch
import tyro
from mani_skill.utils.wrappers import FlattenRGBDObservationWrapper
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv
from torch import Tensor, nn
from torch.distributions import Normal

import ir_maniskill  # noqa: F401 - registers the tasks

Obs = dict[str, Tensor]


@dataclass(frozen=True)
class Args:
    """What can be told on the command line."""

    task: str = "NaoTouchCubeSingle-v1"
    num_envs: int = 1
    """More than one needs a GPU."""
    iterations: int = 20
    steps: int = 128
    """Steps of each env in an iteration."""
    epochs: int = 4
    minibatch: int = 64
    gamma: float = 0.9
    gae_lambda: float = 0.9
    clip: float = 0.2
    learning_rate: float = 3e-4
    seed: int = 0


class Agent(nn.Module):
    """Actor and critic on the flattened observation."""

    def __init__(self, envs: ManiSkillVectorEnv) -> None:
        super().__init__()
        experiment = envs.base_env.experiment
        self.tokens = envs.base_env.instructional_set.tokens.shape[1]
        self.vocabulary = len(experiment.vocabulary)
        height, width, channels = envs.single_observation_space["rgb"].shape
        self.vision = nn.Sequential(
            nn.Conv2d(channels, 16, 4, stride=4), nn.ReLU(),
            nn.Conv2d(16, 32, 4, stride=4), nn.ReLU(), nn.Flatten(),
        )  # fmt: skip
        seen = 32 * (height // 16) * (width // 16)
        body = envs.single_observation_space["state"].shape[0] - self.tokens
        self.trunk = nn.Sequential(
            nn.Linear(seen + body + self.tokens * self.vocabulary, 256), nn.Tanh()
        )
        self.actor = nn.Linear(256, envs.single_action_space.shape[0])
        self.critic = nn.Linear(256, 1)
        self.log_std = nn.Parameter(torch.full_like(self.actor.bias, -0.7))

    def read(self, obs: Obs) -> Tensor:
        """Return the features of pictures, body and sentence [N, 256]."""
        seen = self.vision(obs["rgb"].permute(0, 3, 1, 2) / 255 - 0.5)
        body, tokens = obs["state"].tensor_split([-self.tokens], dim=1)
        words = nn.functional.one_hot(tokens.long(), self.vocabulary).flatten(1)
        return self.trunk(torch.cat([seen, body, words], dim=1))

    def forward(self, obs: Obs) -> tuple[Normal, Tensor]:
        """Return the distribution of actions [N, A] and the values [N]."""
        features = self.read(obs)
        policy = Normal(self.actor(features), self.log_std.exp())
        return policy, self.critic(features)[:, 0]


def make(args: Args) -> ManiSkillVectorEnv:
    """Make the envs, flattened and starting anew by themselves."""
    env = gym.make(
        args.task,
        num_envs=args.num_envs,
        obs_mode="rgb",
        reward_mode="normalized_dense",
        control_mode="pd_joint_target_delta_pos",
        sensor_configs={"width": 32, "height": 64, "shader_pack": "unlit"},
    )
    env = FlattenRGBDObservationWrapper(env, rgb=True, depth=False, state=True)
    return ManiSkillVectorEnv(env, ignore_terminations=True)


@torch.no_grad()
def collect(envs: ManiSkillVectorEnv, agent: Agent, obs: Obs, args: Args) -> tuple:
    """Return the steps as a dict of [T, N, ...], the next observation, successes."""
    steps, success = [], []
    for _ in range(args.steps):
        policy, value = agent(obs)
        action = policy.sample()
        following, reward, _, truncated, info = envs.step(action.clamp(-1, 1))
        seen = info.get("final_observation", following)  # what the action led to
        step = {f"obs/{name}": leaf for name, leaf in obs.items()}
        log_prob = policy.log_prob(action).sum(1)
        step |= {"action": action, "log_prob": log_prob, "reward": reward}
        step |= {"value": value, "next_value": agent(seen)[1], "done": truncated}
        steps.append(step)
        if truncated.any():
            success += info["final_info"]["success_once"][truncated].tolist()
        obs = following
    batch = {name: torch.stack([step[name] for step in steps]) for name in steps[0]}
    return batch, obs, success


def advantages(batch: dict[str, Tensor], args: Args) -> Tensor:
    """Return the generalized advantage estimates [T, N]."""
    delta = batch["reward"] + args.gamma * batch["next_value"] - batch["value"]
    goes_on = (~batch["done"]).float() * args.gamma * args.gae_lambda
    advantage, last = torch.zeros_like(delta), torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        last = delta[t] + goes_on[t] * last
        advantage[t] = last
    return advantage


def update(
    agent: Agent, optimizer: torch.optim.Optimizer, batch: dict[str, Tensor], args: Args
) -> None:
    """Make the epochs of clipped policy gradients over the steps."""
    batch["advantage"] = advantages(batch, args)
    batch["return"] = batch["advantage"] + batch["value"]
    flat = {name: leaf.flatten(0, 1) for name, leaf in batch.items()}
    for _ in range(args.epochs):
        for rows in torch.randperm(len(flat["return"])).split(args.minibatch):
            part = {name: leaf[rows] for name, leaf in flat.items()}
            obs = {name: part[f"obs/{name}"] for name in ("rgb", "state")}
            policy, value = agent(obs)
            log_prob = policy.log_prob(part["action"]).sum(1)
            ratio = (log_prob - part["log_prob"]).exp()
            advantage = part["advantage"] - part["advantage"].mean()
            advantage = advantage / (part["advantage"].std() + 1e-8)
            clipped = ratio.clamp(1 - args.clip, 1 + args.clip)
            gain = torch.min(ratio * advantage, clipped * advantage).mean()
            loss = 0.5 * (value - part["return"]).square().mean() - gain
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimizer.step()


def main(args: Args) -> None:
    """Train, and say after each iteration how it goes."""
    torch.manual_seed(args.seed)
    envs = make(args)
    agent = Agent(envs).to(envs.device)
    optimizer = torch.optim.Adam(agent.parameters(), args.learning_rate, eps=1e-5)
    obs, _ = envs.reset(seed=args.seed)
    for iteration in range(args.iterations):
        batch, obs, success = collect(envs, agent, obs, args)
        update(agent, optimizer, batch, args)
        steps = (iteration + 1) * args.steps * args.num_envs
        reward = float(batch["reward"].mean())
        touched = f"{sum(success)} of {len(success)} episodes touched the right object"
        print(f"step {steps}: mean reward {reward:.3f}, {touched}")
    envs.close()


if __name__ == "__main__":
    main(tyro.cli(Args))
