"""Weights in few bits: what is stored stands for what was there, and acts like it."""

import dataclasses

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from toy_envs import SPEC, toy_config, toy_state

from ir_maniskill.agent import Agent
from ir_maniskill.training import quantize as module
from ir_maniskill.training.quantize import SCALE, dequantize, quantize, round_weights


@pytest.fixture
def agent(tmp_path):
    torch.manual_seed(0)
    agent = Agent(toy_config(tmp_path).agent, SPEC)
    torch.nn.init.orthogonal_(agent.actor.mean[-1].weight)  # else it hardly acts
    return agent


def make_states(n):
    """Return states whose joints go together, as those of a robot do."""
    joints = torch.rand(n, 1, 1) + 0.1 * torch.rand(n, 3, 2)
    told = torch.randint(0, 10, (n, 2))
    own = {"instruction": told, "proprioception": joints, "target": joints + 0.01}
    return toy_state(n) | own


def matrices(weights):
    return {k: v for k, v in weights.items() if v.ndim == 2 and "words" not in k}


def test_where_inputs_have_nothing_to_do_with_each_other_each_weight_is_rounded():
    weight = torch.tensor([[7.0, 3.4, -2.6], [-0.7, 0.1, 0.34]])
    numbers, scale = round_weights(weight, torch.eye(3), bits=4)
    assert numbers.tolist() == [[7, 3, -3], [-7, 1, 3]]
    assert scale.tolist() == pytest.approx([1.0, 0.1])


def test_the_next_weight_makes_up_for_what_rounding_the_last_one_changed():
    weight = torch.tensor([[7.0, 1.4, 1.4]], dtype=torch.double)
    together = torch.tensor([[1.0, 0, 0], [0, 1, 1], [0, 1, 1]])  # inputs 1 and 2
    numbers, _ = round_weights(weight, together, bits=4)
    assert numbers.tolist() == [[7, 1, 2]]  # 3 for 2.8, where each by itself gives 2
    assert weight.tolist() == [[7.0, 1.4, 1.4]]  # what is given stays as it is


def test_rows_of_zeros_and_inputs_that_never_come_are_no_trouble():
    weight = torch.tensor([[0.0, 0.0], [1.0, -1.0]])
    numbers, scale = round_weights(weight, torch.zeros(2, 2), bits=8)
    assert numbers.tolist() == [[0, 0], [127, -127]]
    assert (numbers * scale[:, None]).isfinite().all()


@given(st.lists(st.tuples(*[st.integers(-8, 7)] * 4), min_size=1, max_size=9))
def test_two_numbers_of_4_bits_share_a_byte(rows):
    numbers = torch.tensor(rows, dtype=torch.int8)
    pairs = module._pair(numbers)
    assert pairs.shape == (len(rows), 2) and pairs.dtype == torch.uint8
    assert torch.equal(module._part(pairs), numbers)


@pytest.mark.parametrize(("large", "bits", "step"), [(10**9, 8, 127), (1, 4, 7)])
def test_stored_weights_are_within_their_steps(agent, monkeypatch, large, bits, step):
    monkeypatch.setattr(module, "LARGE", large)
    monkeypatch.setattr(module, "DAMPING", 1e6)  # nothing is made up for
    weights = {k: v for k, v in agent.state_dict().items() if "critic" not in k}
    stored = quantize(agent, weights, make_states(300))
    again = dequantize(stored)
    assert again.keys() == weights.keys()
    for name, weight in matrices(weights).items():
        if name + SCALE in stored:
            assert stored[name].numel() == weight.numel() * bits // 8
            largest = weight.abs().amax(dim=1, keepdim=True)
            assert ((again[name] - weight).abs() <= 0.51 * largest / step).all()
        else:
            assert torch.equal(again[name], weight.half().float())


def test_in_what_it_has_seen_a_policy_acts_as_before(agent, monkeypatch):
    monkeypatch.setattr(module, "LARGE", 1)
    seen, new = make_states(512), make_states(200)
    before = agent.policy(new)
    weights = agent.state_dict()

    def change(damping):
        monkeypatch.setattr(module, "DAMPING", damping)
        other = Agent(agent.config, SPEC)
        other.load_state_dict(dequantize(quantize(agent, weights, seen)))
        return (other.policy(new) - before).pow(2).mean().sqrt()

    rounded, compensated = change(damping=1e6), change(damping=0.01)
    assert compensated < min(rounded / 1.8, 0.1 * before.pow(2).mean().sqrt())


def test_a_layer_with_an_odd_number_of_inputs_gets_8_bits(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "LARGE", 1)
    config = dataclasses.replace(toy_config(tmp_path).agent, hidden=(33, 32))
    agent, name = Agent(config, SPEC), "actor.mean.2.weight"
    stored = quantize(agent, {name: agent.state_dict()[name]}, make_states(8))
    assert stored[name].dtype == torch.int8 and stored[name].shape == (32, 33)


def test_weights_that_were_not_quantized_stay_as_they_are():
    count, half = torch.tensor([3]), torch.tensor([0.5], dtype=torch.half)
    again = dequantize({"count": count, "half": half, "lonely.scale": half})
    assert again["count"].dtype == torch.int64
    assert again["half"].dtype == torch.float32
    assert "lonely.scale" in again  # not a weight of any agent: refused by name
