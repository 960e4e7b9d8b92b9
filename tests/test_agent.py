import dataclasses

import pytest
import torch

from ir_maniskill.agent import Agent, StateSpec, language_system
from ir_maniskill.agent.actor import Actor, SquashedActor
from ir_maniskill.agent.alignment import FiLM
from ir_maniskill.agent.critic import Standardize
from ir_maniskill.agent.perceptual_system import PaperVision, PatchVision
from ir_maniskill.checks import ConfigError
from ir_maniskill.training.config import CONFIGS, AgentConfig

TOKENS, ACTIONS = 5, 26
DELTA = 0.2


def make_state(n=4, height=64, width=32, privileged=50):
    generator = torch.Generator().manual_seed(0)
    state = {
        "instruction": torch.randint(2, 10, (n, TOKENS), generator=generator),
        "images": torch.randint(
            256, (n, 3, 2, height, width, 3), dtype=torch.uint8, generator=generator
        ),
        "proprioception": torch.rand(n, 3, 26, generator=generator),
        "target": torch.rand(n, 3, 26, generator=generator),
        "touch": torch.ones(n, 3, 6),
        "privileged": torch.rand(n, privileged, generator=generator),
        "named_position": torch.rand(n, 3, generator=generator),
    }
    state["instruction"][:, -1] = 0
    return state


def make_agent(state, **changes):
    torch.manual_seed(0)
    return Agent(AgentConfig(**changes), StateSpec.of(state, ACTIONS))


def language(**changes):
    torch.manual_seed(0)
    config = AgentConfig(**changes)
    return language_system.encoder_of(config)(config)


def test_padding_neither_speaks_nor_is_heard():
    system = language()
    short = system(torch.tensor([[3, 4, 5, 0, 0]]))
    with torch.no_grad():
        system.positions[3:] += 1.0
    assert torch.equal(short, system(torch.tensor([[3, 4, 5, 0, 0]])))
    assert short[:, :150].all() and not short[:, 150:].any()
    assert torch.allclose(short, system(torch.tensor([[3, 4, 5]])), atol=1e-6)
    assert not system(torch.zeros(2, 5, dtype=torch.long)).any()


def test_sentences_of_any_length_up_to_the_longest_give_as_much():
    system = language(language_length=7)
    for length in range(1, 8):
        assert system(torch.full((1, length), 3)).shape == (1, system.width)
    padded = torch.tensor([[3, 4, 5, 6, 7, 8, 2, 0, 0]])
    assert torch.equal(system(padded), system(padded[:, :7]))
    with pytest.raises(ValueError, match="sentence of 8 tokens, expected at most 7"):
        system(torch.full((2, 8), 3))


def test_a_word_that_was_never_learned_is_named():
    with pytest.raises(ValueError, match="got the token id 10, expected one of the 10"):
        language()(torch.tensor([[3, 10]]))


def test_the_order_of_words_matters():
    system = language()
    first, second = system(torch.tensor([[3, 4, 5, 8, 2], [3, 5, 4, 8, 2]]))
    assert not torch.allclose(first, second)


def test_encoders_are_known_by_name():
    with pytest.raises(ConfigError, match="language: got 'gpt', expected one of 'tok"):
        language(language="gpt")
    with pytest.raises(ConfigError, match="got 'tokens', expected one that is not tak"):
        language_system.register("tokens", language_system.LexiconTransformer)
    with pytest.raises(ConfigError, match="encoder 'three': got 3, expected a subcl"):
        language_system.register("three", 3)


def test_what_an_encoder_reads_and_returns_is_checked(monkeypatch):
    monkeypatch.setattr(language_system, "_ENCODERS", {**language_system._ENCODERS})

    class Short(language_system.LanguageEncoder):
        width = 9
        reads = "text"

        def forward(self, ids):
            return ids.float()[:, :1].repeat(1, 8)

    with pytest.raises(ConfigError, match="reads .* 'short': got 'text', expected a t"):
        language_system.register("short", Short)
    Short.reads = ("instruction",)
    language_system.register("short", Short)
    state = make_state()
    message = r"Short: got G_t \(4, 8\), expected \(4, 9\)"
    with pytest.raises(ValueError, match=message):
        make_agent(state, language="short").policy(state)


def test_repeated_sentences_are_encoded_alike_and_share_their_gradient():
    system = language()
    batch = torch.tensor([[3, 4, 5, 8, 2], [3, 4, 6, 8, 2], [3, 4, 5, 8, 2]])
    alone = torch.cat([system._encode(row[None]) for row in batch])
    assert torch.allclose(system(batch), alone, atol=1e-6)
    weight = system.layers[0].mix.weight
    (shared,) = torch.autograd.grad((system(batch) ** 2).sum(), weight)
    (separate,) = torch.autograd.grad((alone**2).sum(), weight)
    assert torch.allclose(shared, separate, rtol=1e-3, atol=1e-4)


def test_vision_of_the_paper_sets_cameras_side_by_side():
    vision = PaperVision(3, (2, 128, 64), 0)
    seen = []
    vision.maps[0].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    images = torch.zeros(1, 3, 2, 128, 64, 3, dtype=torch.uint8)
    images[0, 1, 1, 5, 7, 2] = 255  # frame 1, right camera, row 5, column 7, blue
    vision(images, torch.zeros(1, 0))
    assert seen[0].shape == (1, 9, 128, 128)
    assert (seen[0] > 0).nonzero().tolist() == [[0, 5, 5, 64 + 7]]


@pytest.mark.parametrize("size", [(64, 32), (33, 17), (8, 8)])
def test_patch_vision_takes_images_of_any_size(size):
    vision = PatchVision(3, (2, *size), film_width=10)
    images = torch.zeros(2, 3, 2, *size, 3, dtype=torch.uint8)
    assert vision(images, torch.zeros(2, 10)).shape == (2, 256)


def test_film_at_first_changes_nothing_and_then_scales_and_shifts():
    film, maps = FiLM(1, 1), torch.full((1, 1, 2, 2), 3.0)
    assert torch.equal(film(maps, torch.ones(1, 1)), maps)
    with torch.no_grad():
        film.scale_and_shift.bias.copy_(torch.tensor([1.0, 0.5]))
    assert film(maps, torch.ones(1, 1)).unique().tolist() == [(1 + 1) * 3 + 0.5]


def test_no_modulation_by_the_sentence_can_blind_the_agent():
    vision = PatchVision(3, (2, 64, 32), film_width=10)
    for film in (module for module in vision.modules() if isinstance(module, FiLM)):
        film.scale_and_shift.bias.data.fill_(-30.0)
    language, images = torch.randn(2, 10), make_state(n=2)["images"]
    bright, dark = vision(images, language), vision(images // 4, language)
    assert (bright - dark).abs().mean() > 0.05


def test_film_lets_the_sentence_reach_the_convolutions():
    state = make_state()
    agent = make_agent(state)
    agent.evaluate_actions(state, torch.ones(4, ACTIONS)).log_prob.sum().backward()
    grads = [p.grad for n, p in agent.named_parameters() if "films" in n and "wei" in n]
    assert grads
    assert all(grad.abs().sum() > 0 for grad in grads)


def test_first_actions_are_near_the_middle_with_the_given_deviation():
    actor = Actor(10, (500, 256, 128), ACTIONS)
    actor.set_std(0.36)
    policy = actor(torch.randn(64, 10), torch.rand(64, ACTIONS))
    assert policy.mean.abs().max() < 0.1
    assert torch.allclose(policy.stddev, torch.tensor(0.36))


@pytest.mark.parametrize("kind", [Actor, SquashedActor])
def test_with_a_posture_gain_targets_go_to_the_posture_and_stay_there(kind):
    actor = kind(10, (20,), ACTIONS, posture_gain=0.5)
    posture = torch.linspace(-0.9, 0.9, ACTIONS)
    last = actor.mean[-1] if kind is Actor else actor.layers[-1]
    last.weight.data.zero_()
    last.bias.data[:ACTIONS] = posture
    aligned, target = torch.zeros(8, 10), torch.rand(8, ACTIONS)
    target[0] = posture
    assert torch.allclose(actor(aligned, target).mean[0], torch.zeros(1), atol=1e-6)
    for _ in range(100):
        target = target + DELTA * actor(aligned, target).mean.clamp(-1, 1)
    assert torch.allclose(target, posture.expand(8, -1), atol=1e-3)


@pytest.mark.parametrize("actor", ["gaussian", "squashed"])
def test_joint_targets_are_needed_only_to_be_drawn_to_a_posture(actor):
    state, senses = make_state(), ("touch", "proprioception")
    known = {name: value for name, value in state.items() if name != "target"}
    make_agent(state, senses=senses, actor=actor).policy(known)
    drawn = make_agent(state, senses=senses, actor=actor, posture_gain=1.0)
    with pytest.raises(ValueError, match="target of the state: got nothing, but"):
        drawn.policy(known)


def test_the_newest_joint_targets_are_what_the_posture_is_compared_with():
    state = make_state()
    agent = make_agent(state, posture_gain=2.0, senses=("touch", "proprioception"))
    before = agent.policy(state)
    agent.encoder.forward = lambda _: torch.zeros(4, agent.encoder.width)
    state["target"] = torch.zeros(4, 3, ACTIONS)
    state["target"][:, 0] = 0.25
    assert before.shape == (4, ACTIONS)
    assert torch.allclose(agent.policy(state), torch.tensor(-0.5), atol=1e-6)


def test_log_prob_of_an_action_is_that_of_the_gaussian():
    state = make_state(n=1)
    agent = make_agent(state)
    agent.actor.set_std(0.5)
    now = agent.evaluate_actions(state, agent.policy(state))  # the mean's
    expected = ACTIONS * -torch.log(torch.tensor(0.5 * (2 * torch.pi) ** 0.5))
    assert now.log_prob.item() == pytest.approx(float(expected), rel=1e-4)


@pytest.mark.parametrize("critic", ["asymmetric", "separate"])
@pytest.mark.parametrize("vision", ["patches", "paper"])
def test_judging_an_action_agrees_with_having_acted(critic, vision):
    state = make_state()
    agent = make_agent(state, critic=critic, vision=vision)
    act = agent.act(state)
    now = agent.evaluate_actions(state, act.action)
    assert torch.allclose(now.log_prob, act.log_prob)
    assert torch.allclose(now.value, act.value)
    assert torch.allclose(agent.value(state), act.value, atol=1e-5)


@pytest.mark.parametrize(
    ("senses", "read"),
    [
        (("vision",), {"images"}),
        (("proprioception",), {"proprioception"}),
        (("target",), {"target"}),
        (("touch",), {"touch"}),
        (("state",), {"privileged"}),
        (("vision", "touch"), {"images", "touch"}),
    ],
)
def test_the_actor_reads_its_senses_and_no_others(senses, read):
    state = make_state()
    agent = make_agent(state, senses=senses)
    before = agent.policy(state)
    for key in set(state) - {"instruction"}:
        changed = state | {key: state[key].flip(0) // 2}
        if key == "touch":
            changed[key] = 1 - state[key]
        after = agent.policy(changed)
        assert (not torch.allclose(before, after)) == (key in read), key


def test_the_asymmetric_critic_looks_at_the_state_instead_of_the_images():
    state = make_state()
    agent = make_agent(state)
    value = agent.value(state)
    assert torch.equal(value, agent.value(state | {"images": state["images"] // 2}))
    other = state | {"privileged": state["privileged"] + 1}
    assert not torch.allclose(value, agent.value(other))


def test_the_asymmetric_critic_asks_for_the_state():
    state = {k: v for k, v in make_state().items() if k != "privileged"}
    with pytest.raises(ValueError, match=r"rgb\+state_dict"):
        make_agent(state)


def test_the_auxiliary_head_exists_only_if_its_loss_counts():
    state = make_state()
    action = torch.zeros(4, ACTIONS)
    with_head = make_agent(state, auxiliary_weight=0.1)
    assert with_head.evaluate_actions(state, action).named_position.shape == (4, 3)
    without = make_agent(state, auxiliary_weight=0.0)
    assert without.evaluate_actions(state, action).named_position is None


def test_the_policy_is_noiseless_and_within_bounds():
    state = make_state()
    agent = make_agent(state)
    with torch.no_grad():
        agent.actor.mean[-1].bias.fill_(3.0)
    assert torch.equal(agent.policy(state), torch.ones(4, ACTIONS))


def test_the_policy_refuses_images_of_another_size():
    agent = make_agent(make_state())
    with pytest.raises(ValueError, match=r"images of .* got .*32, 32.* made for .*64"):
        agent.policy(make_state(height=32))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"senses": ("smell",)}, "senses: got 'smell', expected one of 'vision', "),
        ({"senses": ()}, r"senses: got \(\), expected at least one, or None"),
        ({"vision": "resnet"}, "'patches', 'paper'"),
        ({"vocabulary": ("<pad>",)}, "vocabulary: got .*expected <pad>, <unk> and"),
        ({"language_length": 0}, "language_length: got 0, expected at least 1"),
        ({"hidden": (8, 0)}, "hidden: got .*expected 1 to 100 positive sizes"),
        ({"posture_gain": -1.0}, "posture_gain: got -1.0, expected a finite number"),
        (
            {"posture_gain": 1.0, "senses": ("vision", "touch")},
            "posture_gain: got 1.0, expected 0 where joints are not felt",
        ),
    ],
)
def test_shapes_that_cannot_be_are_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        AgentConfig(**changes)


def test_the_papers_agent_shares_nothing_between_actor_and_critic():
    state = make_state(n=2, height=128, width=64)
    config = dataclasses.replace(CONFIGS["paper"].agent, senses=("vision",))
    agent = Agent(config, StateSpec.of(state, ACTIONS))
    agent.value(state).sum().backward()
    trained = {
        n.split(".")[0] for n, p in agent.named_parameters() if p.grad is not None
    }
    assert trained == {"critic", "critic_encoder"}
    assert agent.encoder.width == 5 * 50 + 256
    assert agent.encoder.vision.embedding[0].in_features == 10092


def test_standardizing_follows_mean_and_variance_of_all_that_was_seen():
    standardize = Standardize(2)
    seen = torch.tensor([[0.0, 5.0], [2.0, 5.0], [4.0, 5.0], [6.0, 5.0]])
    standardize.update(seen[:1])
    standardize.update(seen[1:])
    assert standardize.mean.tolist() == pytest.approx([3, 5])
    assert standardize.variance.tolist() == pytest.approx([5, 0])
    shown = standardize(torch.tensor([[3 + 5**0.5, 5.0]]))
    assert shown.flatten().tolist() == pytest.approx([1, 0])
