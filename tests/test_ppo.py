import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from toy_envs import SPEC, toy_config, toy_state

from ir_maniskill.agent import Agent
from ir_maniskill.agent.agent import Act, Judgement
from ir_maniskill.environment.reward_generator import TERMS
from ir_maniskill.environment.senses import StateStack
from ir_maniskill.training import ppo
from ir_maniskill.training.algorithm import Outcome
from ir_maniskill.training.config import PPOConfig, TrainConfig
from ir_maniskill.training.finite import TrainingDivergedError, check_finite
from ir_maniskill.training.rollout import Batch, RewardScale, Rollout, advantages
from ir_maniskill.training.schedules import linear


def column(*values):
    return torch.tensor(values)[:, None]


def test_advantages_by_hand():
    # gamma 0.5, lambda 0.5; the episode ends after step 1, where the cut-off future
    # is worth 4; step 2 starts another, whose next state is worth 2.
    reward, value = column(1.0, 2.0, 3.0), column(1.0, 1.0, 1.0)
    next_value, done = column(1.0, 4.0, 2.0), column(False, True, False)
    got = advantages(reward, value, next_value, done, 0.5, 0.5)
    # deltas: 1 + .5 - 1 = .5;  2 + 2 - 1 = 3;  3 + 1 - 1 = 3
    assert got.flatten().tolist() == [0.5 + 0.25 * 3, 3.0, 3.0]


def test_lambda_one_gives_monte_carlo_returns():
    reward, value = column(1.0, 1.0, 1.0), column(5.0, -3.0, 2.0)
    next_value = column(-3.0, 2.0, 0.0)
    done = column(False, False, True)
    got = advantages(reward, value, next_value, done, 0.5, 1.0) + value
    assert got.flatten().tolist() == pytest.approx([1.75, 1.5, 1.0])


def test_finish_takes_the_value_of_the_next_state_unless_the_episode_ended():
    rollout = Rollout(2, tiny_state(1), 1)
    rollout.value[:] = column(10.0, 20.0)
    rollout.add_outcome(0, torch.zeros(1), torch.tensor([True]), torch.tensor([7.0]))
    rollout.add_outcome(1, torch.zeros(1), torch.tensor([False]), torch.zeros(1))
    rollout.finish(torch.tensor([30.0]), gamma=1.0, gae_lambda=0.0)
    assert rollout.returns.flatten().tolist() == [7, 30]


def tiny_state(n, image=0, frames=3):
    images = torch.full((n, frames, 1, 1, 1, 3), image, dtype=torch.uint8)
    return {
        "instruction": torch.ones(n, 1, dtype=torch.long),
        "images": images,
        "proprioception": torch.zeros(n, frames, 1),
        "target": torch.zeros(n, frames, 1),
        "touch": torch.zeros(n, frames, 1),
    }


def test_stacks_gathered_from_single_images_equal_the_states_across_resets():
    generator = torch.Generator().manual_seed(0)
    n, steps, frames = 3, 12, 3

    def observe():
        image = torch.randint(256, (n, 2, 1, 3), dtype=torch.uint8, generator=generator)
        camera = {"rgb": image}
        empty = torch.zeros(n, 1)
        return {
            "agent": {"proprioception": empty, "target": empty},
            "extra": {"touch": empty, "instruction": torch.ones(n, 1).long()},
            "sensor_data": {"top_camera": camera, "front_camera": camera},
        }

    stack = StateStack(frames)
    state = stack.reset(observe())
    state = stack.push(observe(), torch.zeros(n, dtype=torch.bool))
    rollout = Rollout(steps, state, 1)
    for _ in range(2):  # a second roll-out goes on in the middle of episodes
        rollout.begin(state)
        states = []
        for t in range(steps):
            states.append(state["images"].clone())
            act = Act(torch.zeros(n, 1), torch.zeros(n), torch.zeros(n))
            rollout.add(t, state, act)
            done = torch.rand(n, generator=generator) < 0.3
            rollout.add_outcome(t, torch.zeros(n), done, torch.zeros(n))
            state = stack.push(observe(), done)
        everything = rollout.batch(torch.arange(steps * n)).state["images"]
        assert torch.equal(everything, torch.cat(states))


def test_each_image_is_stored_once():
    rollout = Rollout(10, tiny_state(4), 1)
    assert rollout.frames.images.shape[:2] == (10 + 2, 4)


# -- The algorithm ---------------------------------------------------------------------


def toy_ppo(**changes):
    """Return an algorithm for four envs whose roll-outs are two steps long."""
    config = toy_config("x")
    learner = replace(config.ppo, **{"steps_per_update": 8, "minibatch": 4} | changes)
    return ppo.PPO(replace(config, ppo=learner, num_envs=4), toy_state(4), 2)


def outcome(truncated=(False,) * 4, terminated=(False,) * 4, **changes):
    """Return what a step led to in four envs."""
    ends = {"truncated": truncated, "terminated": terminated}
    values = {name: torch.tensor(value) for name, value in ends.items()}
    values |= {"reward": torch.ones(4), "terms": None, "state": toy_state(4)}
    return Outcome(**(values | {"final": None} | changes))


def test_it_learns_when_its_roll_out_is_full_and_not_before():
    algorithm = toy_ppo()
    weights = {k: v.clone() for k, v in algorithm.agent.state_dict().items()}
    for is_full in (False, True, False):
        algorithm.act(toy_state(4))
        algorithm.observe(outcome())
        assert bool(algorithm.update()) == is_full
    learned = algorithm.agent.state_dict()
    assert not torch.equal(
        learned["actor.mean.0.weight"], weights["actor.mean.0.weight"]
    )


def test_only_where_time_ran_out_the_last_state_has_a_value():
    values = {}
    for bootstrap in (True, False):
        algorithm = toy_ppo(bootstrap=bootstrap)
        with torch.no_grad():
            algorithm.agent.critic.value[-1].weight.zero_()
            algorithm.agent.critic.value[-1].bias.fill_(5.0)
        algorithm.act(toy_state(4))
        ends = {"truncated": (True, True, False, False)}
        ends["terminated"] = (False, True, True, False)
        algorithm.observe(outcome(**ends, final=toy_state(4)))
        values[bootstrap] = algorithm.rollout.next_value[0].tolist()
        assert algorithm.rollout.done[0].tolist() == [True, True, True, False]
    assert values == {True: [5, 0, 0, 0], False: [0, 0, 0, 0]}


def test_reward_terms_are_weighed_by_a_curriculum():
    row = {"hold_after_foul": 2.0, "approach": 1.0, "foul": 1.0, "speed": 0.1}
    terms = torch.tensor([[row.get(name, 0.0) for name in TERMS]] * 4)
    config = replace(toy_config("x"), penalty_warmup=0.5, num_envs=4)
    algorithm = ppo.PPO(config, toy_state(4), 2)
    got = []
    for share in (0.0, 0.25, 0.5, 1.0):
        algorithm.share, algorithm._t = share, 0
        algorithm.act(toy_state(4))
        algorithm.observe(outcome(terms=terms))
        got.append(float(algorithm.rollout.reward[0, 0]))
    # hold 2 x (1, 0.625, 0.25, 0.25) + approach 0.5 - (foul 0.5 + speed 0.6) x part
    assert got == pytest.approx([2.5, 1.75 - 0.55, 1.0 - 1.1, 1.0 - 1.1])


def test_a_schedule_changes_up_to_a_share_and_stays_then():
    shares = (0.0, 0.25, 0.5, 0.75, 1.0)
    got = [linear(2.0, 4.0, share, end_share=0.5) for share in shares]
    assert got == [2, 3, 4, 4, 4]
    assert linear(2.0, 4.0, 0.0, end_share=0.0) == 4


@pytest.mark.parametrize(("num_envs", "steps"), [(16, 128), (24, 86), (1024, 2)])
def test_any_number_of_envs_shares_an_update(num_envs, steps):
    assert TrainConfig(num_envs=num_envs).steps_per_env == steps


# -- Reward scale and losses -----------------------------------------------------------


def test_rewards_are_scaled_by_the_deviation_of_discounted_returns():
    scale = RewardScale(1, gamma=0.5)
    reward, done = column(2.0, 0.0, 4.0), column(False, True, False)
    # discounted returns: 2, 1, then anew 4; population variance 14 / 9
    scaled = scale(reward, done)
    expected = reward / math.sqrt(14 / 9)
    assert torch.allclose(scaled, expected)
    assert scale.running.tolist() == [4.0]


def test_no_reward_at_all_stays_no_reward():
    scaled = RewardScale(2, 0.9)(torch.zeros(4, 2), torch.zeros(4, 2).bool())
    assert torch.equal(scaled, torch.zeros(4, 2))


def judged(log_prob, value=0.0, target=None):
    """Return an agent that judges every action as given."""
    values = [torch.as_tensor(x, dtype=torch.float) for x in (log_prob, value)]
    judgement = Judgement(*values, target)
    config = SimpleNamespace(auxiliary_weight=2.0)
    return SimpleNamespace(evaluate_actions=lambda *_: judgement, config=config)


def batch_of(advantage, returns=(0.0, 0.0), **state):
    size = len(advantage)
    rows = (torch.tensor(advantage), torch.tensor(returns))
    return Batch(state, torch.zeros(size, 1), torch.zeros(size), *rows)


def test_policy_loss_is_clipped_by_hand():
    agent = judged([math.log(1.5), math.log(0.5)], value=[0.0, 0.0])
    _, terms = ppo.ppo_loss(agent, batch_of([1.0, -1.0]), PPOConfig(clip=0.2))
    # min(1.5, 1.2) for the good action; min(-0.5, -0.8) for the bad one
    assert float(terms["policy"]) == pytest.approx(-(1.2 - 0.8) / 2)
    assert float(terms["clipped"]) == 1.0


def test_value_and_auxiliary_losses_by_hand():
    agent = judged([0.0, 0.0], value=[1.0, 3.0], target=torch.full((2, 3), 0.15))
    place = {"named_position": torch.full((2, 3), 0.1)}
    loss, terms = ppo.ppo_loss(agent, batch_of([1.0, -1.0], **place), PPOConfig())
    assert float(terms["value"]) == pytest.approx(2.5)
    assert float(terms["auxiliary"]) == pytest.approx(0.25)  # 0.5 dm off, squared
    assert float(loss) == pytest.approx(0.5 * 2.5 + 2.0 * 0.25)


def test_an_object_that_fell_far_does_not_outweigh_the_others():
    at = torch.tensor([[0.2, 0.0, 0.05], [0.2, 0.0, -4.0]])  # one falls off the table
    agent = judged([0.0, 0.0], value=[0.0, 0.0], target=torch.zeros(2, 3))
    _, terms = ppo.ppo_loss(
        agent, batch_of([1.0, -1.0], named_position=at), PPOConfig()
    )
    assert float(terms["auxiliary"]) < 20  # the mean of the squares is 267


def test_minibatches_cover_every_step_once():
    rollout = SimpleNamespace(steps=10, num_envs=10, reward=torch.zeros(1))
    parts = list(ppo.minibatches(rollout, PPOConfig(minibatch=30)))
    assert [len(part) for part in parts] == [34, 33, 33]
    assert torch.cat(parts).sort()[0].tolist() == list(range(100))
    assert len(list(ppo.minibatches(rollout, PPOConfig(minibatch=None)))) == 1


def collected():
    """Return an agent, its optimizer and a roll-out of random steps."""
    torch.manual_seed(0)
    agent = Agent(toy_config("x").agent, SPEC)
    rollout = Rollout(16, toy_state(8), 2)
    for t in range(16):
        state = toy_state(8)
        with torch.no_grad():
            rollout.add(t, state, agent.act(state))
        rollout.add_outcome(t, torch.rand(8), torch.zeros(8).bool(), torch.zeros(8))
    rollout.finish(torch.zeros(8), 0.9, 0.95)
    return agent, torch.optim.Adam(agent.parameters(), 0.01), rollout


@pytest.mark.parametrize(
    ("rate", "kl", "target", "then"),
    [
        (1.5e-4, 0.031, 0.015, 1e-4),
        (1.5e-4, 0.007, 0.015, 2.25e-4),
        (1.5e-4, 0.015, 0.015, 1.5e-4),
        (1.5e-4, 9.0, None, 1.5e-4),
        (1.2e-5, 1.0, 0.015, ppo.LOWEST_RATE),
        (9e-4, 0.0, 0.015, ppo.HIGHEST_RATE),
        (3e-6, 1.0, 0.015, 3e-6),  # beyond its bounds, never the wrong way
        (3e-3, 0.0, 0.015, 3e-3),
    ],
)
def test_the_step_size_follows_how_far_the_policy_moved(rate, kl, target, then):
    optimizer = torch.optim.Adam([torch.zeros(1, requires_grad=True)], rate)
    ppo.adapt_rate(optimizer, kl, target)
    assert optimizer.param_groups[0]["lr"] == pytest.approx(then)


def test_the_gradient_is_cut_to_its_longest_length():
    agent, _, rollout = collected()
    loss, _ = ppo.ppo_loss(agent, rollout.batch(torch.arange(128)), PPOConfig())
    (1000 * loss).backward()
    assert float(ppo.clip_gradient(agent, 0.5)) > 0.5
    norms = [p.grad.norm() for p in agent.parameters() if p.grad is not None]
    assert float(torch.stack(norms).norm()) == pytest.approx(0.5, rel=1e-3)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_no_number_is_named_with_a_cause(value):
    tensors = {"fine": torch.ones(2), "guilty": torch.tensor([1.0, value])}
    with pytest.raises(
        TrainingDivergedError, match=r"observation.*: guilty; .*unstable"
    ):
        check_finite(tensors, "observation", "the simulation became unstable")


def test_large_but_finite_numbers_are_no_alarm():
    check_finite({"a": torch.full((2,), 3e38), "b": torch.ones(1).long()}, "x", "y")


def test_an_exploding_gradient_is_named():
    agent, optimizer, rollout = collected()
    rollout.advantage[3, 2] = math.nan
    with pytest.raises(TrainingDivergedError, match="loss is no longer finite: policy"):
        ppo.improve(agent, optimizer, rollout, PPOConfig(minibatch=128))
    next(agent.parameters()).grad = torch.full_like(next(agent.parameters()), math.inf)
    with pytest.raises(TrainingDivergedError, match=r"gradient.*encoder.language"):
        ppo.clip_gradient(agent, 0.5)
