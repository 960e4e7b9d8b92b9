import dataclasses

import pytest
import torch
from torch.distributions import Normal, TanhTransform, TransformedDistribution
from torch.nn import functional
from toy_envs import HANDS, LENGTH, TASK, ToyVectorEnv, steps_of, toy_sac

from ir_maniskill.agent.actor import Squashed
from ir_maniskill.checks import ConfigError
from ir_maniskill.environment import senses
from ir_maniskill.environment.reward_generator import RewardWeights
from ir_maniskill.environment.senses import StateStack
from ir_maniskill.training import checkpoint, runner
from ir_maniskill.training.algorithm import Outcome
from ir_maniskill.training.hindsight import Hindsight
from ir_maniskill.training.runner import Runner
from ir_maniskill.training.sac import SAC, Critics
from ir_maniskill.training.train import run


@pytest.fixture(autouse=True)
def of_the_toy_task(monkeypatch):
    judge = Hindsight(TASK, HANDS, RewardWeights().vector(), others=1)
    monkeypatch.setattr(Hindsight, "of", lambda *_: judge)


def learn(out, steps, resume=False, **changes):
    """Train on the toy task; return the file of the best policy."""
    envs = ToyVectorEnv(snapshots=True)
    config = toy_sac(out, total_steps=steps, **changes)
    evaluated_in = ToyVectorEnv(snapshots=True)
    return run(config, resume, envs, evaluated_in)


# -- Parts -----------------------------------------------------------------------------


def test_squashed_actions_are_as_likely_as_torch_says() -> None:
    torch.manual_seed(0)
    center, log_std = torch.randn(4, 3), torch.randn(4, 3).clamp(-1, 0)
    action, log_prob = Squashed(center, log_std).rsample()
    normal = Normal(center.double(), log_std.double().exp())
    known = TransformedDistribution(normal, [TanhTransform()])
    expected = known.log_prob(action.double()).sum(1)
    torch.testing.assert_close(log_prob.double(), expected, rtol=1e-3, atol=1e-3)


def test_both_critics_are_plain_networks_side_by_side() -> None:
    torch.manual_seed(0)
    critics = Critics(5)
    known, action = torch.randn(6, 3), torch.randn(6, 2)
    both = critics(known, action)
    for index in range(2):
        x = torch.cat([known, action], dim=1)
        for layer in range(3):
            x = x @ critics.weights[layer][index] + critics.biases[layer][index]
            if layer < 2:
                x = functional.relu(functional.layer_norm(x, x.shape[1:]))
        # Products may be in 16 bits.
        torch.testing.assert_close(both[index], x[:, 0], rtol=0.02, atol=0.01)


# -- The algorithm ---------------------------------------------------------------------


def test_it_learns_to_touch_what_the_sentence_names(tmp_path) -> None:
    best = learn(tmp_path / "run", 2000)
    agent, _, metadata = checkpoint.load_agent(best)
    assert metadata["evaluation"]["overall"]["success"] == 1
    assert agent.locator is None, "a policy file has what only training needs"


def test_steps_are_drawn_with_the_sentence_that_they_are_judged_under(tmp_path) -> None:
    algorithm = collected(tmp_path, ToyVectorEnv(snapshots=True))
    algorithm.config = dataclasses.replace(algorithm.config, batch=600)
    drawn = same(algorithm._draw)
    seen = same(lambda: algorithm._policy_batch(*algorithm._rows()))
    goal = torch.where(seen["instruction"][:, 1] == 4, -0.6, 0.6)  # token 4: "left"
    off = (drawn["next.now.proprioception"][:, 0] - goal).abs()
    near, far = off < 0.2, off > 0.5
    assert near.sum() > 5 and far.sum() > 5
    # Where it holds, a finger each pays 1, or a quarter of it after a foul.
    assert drawn["reward"][near].min() > 1
    assert drawn["reward"][far].max() < 3
    torch.testing.assert_close(seen["named"][:, 1], 0.1 * goal)


def same(draw):
    """Return what is drawn at random, always the same rows."""
    torch.manual_seed(1)
    return draw()


def collected(tmp_path, envs, episodes=4, **changes):
    """Return an algorithm that saw some episodes of random actions."""
    torch.manual_seed(0)
    stack = StateStack(1)
    state = stack.reset(envs.reset(seed=0)[0])
    config = toy_sac(tmp_path, **changes)
    algorithm = SAC(config, state, 2)
    for _ in range(episodes * LENGTH):
        action = algorithm.act(state)
        obs, reward, terminated, truncated, info = envs.step(action)
        final = stack.peek(info["final_obs"]) if "final_obs" in info else None
        state = stack.push(obs, truncated)
        algorithm.observe(Outcome(reward, terminated, truncated, state, final))
    return algorithm


def test_a_sense_of_ones_own_is_kept_whole(tmp_path, monkeypatch) -> None:
    height = senses.Term("height", "body", "F")
    monkeypatch.setattr(senses, "_TERMS", [*senses._TERMS, height])

    class Taller(ToyVectorEnv):
        def _observe(self):
            obs = super()._observe()
            obs["extra"]["height"] = torch.cat([self.joints, -self.joints], dim=1)
            return obs

    agent = toy_sac(tmp_path).agent
    agent = dataclasses.replace(agent, senses=("proprioception", "height"))
    algorithm = collected(tmp_path, Taller(snapshots=True), agent=agent)
    seen = algorithm._policy_batch(*algorithm._rows())
    joints = seen["proprioception"][:, 0]
    torch.testing.assert_close(seen["height"], torch.cat([joints, -joints], dim=1))
    algorithm.share = 0.5
    algorithm._train_policy()


def test_checkpoints_are_rarer_than_episodes(tmp_path) -> None:
    with pytest.raises(ConfigError, match="checkpoint_interval: got 100, expected at"):
        learn(tmp_path, 1000, checkpoint_interval=100)


def test_the_policy_acts_in_ever_more_of_the_envs(tmp_path) -> None:
    algorithm = collected(tmp_path, envs := ToyVectorEnv(4, snapshots=True))
    algorithm.agent.policy = lambda state: torch.full((len(state["touch"]), 2), 5.0)
    state = StateStack(1).reset(envs.reset(seed=0)[0])
    algorithm.config = dataclasses.replace(
        algorithm.config, policy_acts=0.5, policy_from=0.2
    )
    by_policy = []
    for share in (0.1, 0.6, 1.0):
        algorithm.share = share
        by_policy.append(int((algorithm.act(state) == 5.0).all(dim=1).sum()))
    assert by_policy == [0, 1, 2]


def test_the_teacher_learns_first_and_then_stays_as_it_is(tmp_path) -> None:
    algorithm = collected(tmp_path, ToyVectorEnv(snapshots=True), episodes=40)

    def changed(share):
        algorithm.share, before = share, algorithm.state_dict()
        algorithm.update()
        after = algorithm.state_dict()
        parts = ("agent.", "teacher.", "critics.")
        return [
            any(not torch.equal(before[k], after[k]) for k in after if k.startswith(p))
            for p in parts
        ]

    begun = algorithm.config.policy_from
    assert changed(0.9 * begun) == [False, True, True]
    assert changed(1.1 * begun) == [True, False, False]


def test_the_teacher_draws_the_joint_targets_to_a_posture(tmp_path) -> None:
    agent = dataclasses.replace(toy_sac(tmp_path).agent, posture_gain=2.0)
    algorithm = collected(tmp_path, ToyVectorEnv(snapshots=True), agent=agent)
    posture, last = torch.tensor([0.3, -0.5]), algorithm.teacher.layers[-1]
    with torch.no_grad():
        last.weight.zero_()
        last.bias[:2] = posture
    seen = algorithm._policy_batch(*algorithm._rows())
    seen["now.target"] = target = torch.rand_like(seen["now.target"])
    expected = torch.tanh(2 * (posture - target))
    done = algorithm._teacher_policy(seen).mean
    torch.testing.assert_close(done, expected, atol=0.01, rtol=0)


def test_the_policy_learns_to_do_what_the_teacher_does(tmp_path) -> None:
    algorithm = collected(tmp_path, ToyVectorEnv(snapshots=True))
    seen = algorithm._policy_batch(*algorithm._rows())

    def off():
        with torch.no_grad():
            shown = algorithm._teacher_policy(seen).mean
            done = algorithm.agent.policy(seen)
            return float((shown - done).square().mean())

    before, algorithm.share = off(), 0.5
    for _ in range(60):
        algorithm._train_policy()
    assert off() < 0.3 * before


def test_the_policy_is_not_evaluated_before_it_learns(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(runner, "FINAL_EPISODES", 8)
    learner = dataclasses.replace(toy_sac(tmp_path).sac, policy_from=0.5)
    learn(tmp_path, 2000, sac=learner, eval_interval=250)
    assert len(steps_of(tmp_path)) > len(steps_of(tmp_path, "evaluations")) > 1
    assert steps_of(tmp_path, "evaluations")[0] > 1000


def test_an_evaluation_that_is_interrupted_is_made_on_resuming(
    tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(runner, "FINAL_EPISODES", 8)
    changes = {"eval_interval": 600, "checkpoint_interval": 600}
    learn(tmp_path / "whole", 1200, **changes)

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(runner, "evaluate_policy", interrupt)
        learn(tmp_path / "parts", 1200, **changes)
    learn(tmp_path / "parts", 1200, resume=True, **changes)
    whole, parts = (
        steps_of(tmp_path / name, "evaluations") for name in ("whole", "parts")
    )
    assert parts == whole


def test_every_episode_is_kept_whole(tmp_path) -> None:
    algorithm = collected(tmp_path, ToyVectorEnv(4, snapshots=True), episodes=3)
    assert algorithm.replay.episodes == 4 * 3
    assert algorithm.replay.written == 4 * 3 * (LENGTH + 1)
    rows = torch.arange(LENGTH)
    joints = algorithm.replay.read("proprioception", rows)
    actions = algorithm.replay.read("action", rows)
    after = algorithm.replay.read("proprioception", rows + 1)
    torch.testing.assert_close((joints + 0.3 * actions).clamp(-1, 1), after)


def test_a_resumed_run_equals_one_never_interrupted(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(runner, "FINAL_EPISODES", 8)
    learner = dataclasses.replace(toy_sac(tmp_path).sac, policy_from=0.8)
    config = {"checkpoint_interval": 600, "sac": learner}
    learn(tmp_path / "whole", 1000, **config)
    save = Runner.save

    def save_and_stop(self):
        save(self)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Runner, "save", save_and_stop)
        learn(tmp_path / "halves", 1000, **config)
    torch.manual_seed(123)  # whatever happens in between
    learn(tmp_path / "halves", 1000, resume=True, **config)
    whole, halves = (
        checkpoint.read(tmp_path / name / "last.safetensors").tensors
        for name in ("whole", "halves")
    )
    assert [name for name in whole if not torch.equal(whole[name], halves[name])] == []


def test_the_first_value_of_a_discounted_reward_is_the_reward(tmp_path) -> None:
    envs = ToyVectorEnv(snapshots=True)
    algorithm = collected(tmp_path, envs)
    algorithm.config = dataclasses.replace(algorithm.config, gamma=0.0)
    for _ in range(150):
        algorithm._improve_critics(algorithm._draw())
    drawn = algorithm._draw()
    value = algorithm.critics(algorithm._critic_input(drawn), drawn["action"])
    off = value - algorithm.config.reward_scale * drawn["reward"]
    assert off.abs().mean() < 0.1


@pytest.mark.parametrize("wrong", [{"actor": "gaussian"}, {"critic": "separate"}])
def test_an_agent_for_another_algorithm_is_refused(tmp_path, wrong) -> None:
    config = toy_sac(tmp_path)
    agent = dataclasses.replace(config.agent, **wrong)
    with pytest.raises(ConfigError, match="actor and critic"):
        dataclasses.replace(config, agent=agent)
