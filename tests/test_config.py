import dataclasses
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ir_maniskill import experiment as catalog
from ir_maniskill.environment.reward_generator import RewardWeights
from ir_maniskill.training.config import (
    CONFIGS,
    AgentConfig,
    ConfigError,
    PPOConfig,
    TrainConfig,
    from_data,
    leaves,
    to_data,
)
from ir_maniskill.training.train import for_experiment


def through_json(config):
    return from_data(json.loads(json.dumps(to_data(config))))


@pytest.mark.parametrize("name", CONFIGS)
def test_configs_survive_json(name):
    assert through_json(CONFIGS[name]) == CONFIGS[name]


def test_a_budget_scales_all_that_follows_the_steps():
    for config in CONFIGS.values():
        dataclasses.replace(config, total_steps=6000)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sede": 1}, "unknown: \\['sede'\\]"),
        ({"seed": "1"}, "seed: got '1', expected a value of type int"),
        ({"seed": True}, "seed: got True"),
        ({"seed": 2**31}, "seed: got 2147483648, expected 0 to"),
        ({"agent": 3}, "AgentConfig: got 3, expected an object"),
        ({"num_envs": 0}, "num_envs: got 0, expected at least 1"),
        ({"penalty_warmup": 1.5}, "penalty_warmup: got 1.5, expected 0 to 1"),
        ({"reward_mode": "none"}, "reward_mode: got 'none'.*'dense'"),
        ({"control_mode": "pd_ee"}, "control_mode: got 'pd_ee'.*'pd_joint_pos'"),
        (
            {"reward_weights": vars(RewardWeights()) | {"after_foul": 1.5}},
            "reward_weights.after_foul: got 1.5",
        ),
        ({"schema": 4}, "schema: got 4, expected 3: another version"),
    ],
)
def test_wrong_configs_say_what_was_got_and_expected(change, message):
    with pytest.raises(ConfigError, match=message):
        from_data(to_data(TrainConfig()) | change)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: TrainConfig(control_mode="pd_joint_pos"),
            "posture_gain: got 1.0, expected 0 where actions do not change",
        ),
        (lambda: PPOConfig(gamma=1.1), "gamma: got 1.1, expected 0 to 1"),
        (lambda: PPOConfig(std=0.0), "std: got 0.0, expected more than 0"),
        (lambda: PPOConfig(minibatch=4096), "minibatch: got 4096, expected 2 to 2048"),
        (lambda: TrainConfig(threads=1.5), r"threads: got 1.5, .* type int \| None"),
        (lambda: TrainConfig(agent={"hidden": 8}), "agent: got .* type AgentConfig"),
        (
            lambda: dataclasses.replace(CONFIGS["listen"], total_steps=5000),
            "total_steps: got 5000, expected at least 5358: the teacher learns from",
        ),
        (lambda: PPOConfig(gamma=None), "gamma: got None, expected a .* type float"),
        (lambda: AgentConfig(hidden=[8]), r"hidden: got \[8\], .* type tuple\[int,"),
        (lambda: AgentConfig(hidden=(8.5,)), r"hidden: got \(8.5,\)"),
        (lambda: AgentConfig(senses=["touch"]), r"senses: .* tuple\[str, ...\] \| N"),
    ],
)
def test_values_that_cannot_work_are_refused(make, message):
    with pytest.raises(ConfigError, match=message):
        make()


def test_a_missing_field_is_named():
    data = to_data(TrainConfig())
    del data["ppo"]["clip"]
    with pytest.raises(ConfigError, match=r"PPOConfig.*missing: \['clip'\]"):
        from_data(data)


def test_the_papers_numbers():
    paper = CONFIGS["paper"]
    assert paper.steps_per_env == 32
    assert (paper.ppo.learning_rate, paper.ppo.epochs) == (1e-5, 60)
    assert (paper.ppo.gae_lambda, paper.ppo.minibatch) == (1.0, None)
    assert paper.ppo.std == paper.ppo.std_final == 0.36
    assert paper.env_kwargs(training=True)["obs_mode"] == "rgb"


def test_only_training_asks_for_the_simulators_state():
    config = TrainConfig(robot="panda")
    assert config.env_kwargs(training=True)["obs_mode"] == "rgb+state_dict"
    assert config.env_kwargs(training=False)["obs_mode"] == "rgb"
    assert config.env_kwargs(training=False)["robot_uids"] == "panda"
    blind = dataclasses.replace(CONFIGS["vision"], agent=AgentConfig(senses=("touch",)))
    assert blind.env_kwargs(training=False)["obs_mode"] == "state_dict"


# -- Plain data ------------------------------------------------------------------------


def replace_leaf(data, path, value):
    """Return JSON data with another value at a path of keys."""
    if not path:
        return value
    return data | {path[0]: replace_leaf(data[path[0]], path[1:], value)}


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=4,
)
DATA = to_data(TrainConfig())
PARTS = ("agent", "ppo", "sac", "reward_weights")


@given(st.data(), JSON)
def test_whatever_a_config_says_it_is_a_config_or_refused(draw, value):
    inner = [(part, name) for part in PARTS for name in DATA[part]]
    path = draw.draw(st.sampled_from([*((name,) for name in DATA), *inner]))
    try:
        config = from_data(replace_leaf(DATA, path, value))
    except ConfigError as error:
        assert "got" in str(error)
        return
    assert through_json(config) == config
    assert config.steps_per_env > 0


def test_a_task_is_trained_on_those_kinds_that_it_has():
    config = dataclasses.replace(CONFIGS["listen"], kinds=("push", "touch", "push"))
    cases = {"NaoInstruct-v1": config.kinds, "NaoInstructPush-v1": ("push", "push")}
    for task, kinds in (cases | {"NaoTouchCubeSingle-v1": None}).items():
        made = for_experiment(config, catalog.get(task))
        assert made.kinds == kinds
        assert made.env_kwargs(training=True).get("kinds") == kinds
        assert "kinds" not in made.env_kwargs(training=False)  # it is evaluated on all
    with pytest.raises(ConfigError, match="kinds: got .*'psh'.*, expected some of"):
        dataclasses.replace(config, kinds=("psh",))


def test_the_leaves_of_a_config_are_all_its_numbers():
    names = leaves(TrainConfig())
    assert names["ppo.gamma"] == 0.9 and names["reward_weights.hold"] == 1.0
    assert "ppo" not in names
