"""One list of senses: what is observed, stacked, and read by the agent."""

import gymnasium as gym
import pytest
import sapien
import torch
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils.registration import REGISTERED_ENVS, register_env

from ir_maniskill.agent import Agent, StateSpec
from ir_maniskill.agent.config import AgentConfig
from ir_maniskill.environment import senses
from ir_maniskill.environment.senses import StateStack, Term, flatten
from ir_maniskill.environment.touch_env import TouchEnv
from ir_maniskill.environment.vector import make_vec


def observation(*values: float, privileged: bool = False) -> dict:
    """Return an observation of len(values) envs whose entries all equal the value."""
    value = torch.tensor(values)
    picture = value.to(torch.uint8)[:, None, None, None].expand(-1, 4, 2, 3)
    obs = {
        "agent": {
            "proprioception": value[:, None].expand(-1, 26),
            "target": value[:, None].expand(-1, 26),
        },
        "extra": {
            "touch": value[:, None].expand(-1, 6),
            "instruction": value.long()[:, None].expand(-1, 5),
        },
        "sensor_data": {
            "front_camera": {"rgb": picture + 100},
            "top_camera": {"rgb": picture},
        },
    }
    if privileged:
        batch = len(values)
        obs["agent"]["velocity"] = torch.zeros(batch, 26)
        obs["extra"]["object_position"] = (
            torch.arange(9.0).view(1, 3, 3).repeat(batch, 1, 1)
        )
        obs["extra"]["finger_position"] = torch.zeros(batch, 6, 3)
        obs["extra"]["wrong_once"] = torch.zeros(batch, 1)
        named = [[0.0, 1.0, 0.0], [1.0, 0.0, 1.0]]
        obs["extra"]["target_object"] = torch.tensor(named[:batch])
    return obs


def history(state: dict, key: str = "proprioception") -> list:
    """Return what each env remembers, newest first."""
    return state[key].flatten(2)[..., 0].tolist()


@pytest.fixture
def own_senses(monkeypatch):
    """Undo what the test registers."""
    monkeypatch.setattr(senses, "_TERMS", list(senses._TERMS))


# -- The state -------------------------------------------------------------------------


def test_shapes_and_dtypes() -> None:
    state = StateStack(3).reset(observation(1, 2))
    assert {key: tuple(value.shape) for key, value in state.items()} == {
        "instruction": (2, 5),
        "proprioception": (2, 3, 26),
        "target": (2, 3, 26),
        "touch": (2, 3, 6),
        "images": (2, 3, 2, 4, 2, 3),
    }
    assert state["images"].dtype == torch.uint8


def test_the_cameras_are_those_of_the_observation_in_whatever_order_it_has_them():
    obs = observation(1)
    assert senses.cameras(obs) == ("top_camera", "front_camera")
    assert flatten(obs)["images"][0, :, 0, 0, 0].tolist() == [1, 101]
    wrist = {"rgb": torch.full((1, 4, 2, 3), 7, dtype=torch.uint8)}
    obs["sensor_data"] |= {"wrist_camera": wrist, "depth_camera": {"depth": None}}
    assert flatten(obs)["images"][0, :, 0, 0, 0].tolist() == [7, 1, 101]
    wrist["rgb"] = wrist["rgb"][:, :3]
    with pytest.raises(ValueError, match=r"got \[\(3, 2\), \(4, 2\)\], expected one"):
        flatten(obs)


def test_the_first_observation_fills_the_stack_and_newer_ones_come_first() -> None:
    stack = StateStack(3)
    assert history(stack.reset(observation(1, 2))) == [[1, 1, 1], [2, 2, 2]]
    assert history(stack.push(observation(3, 4))) == [[3, 1, 1], [4, 2, 2]]
    assert history(stack.push(observation(5, 6)), "images") == [[5, 3, 1], [6, 4, 2]]


def test_resetting_one_env_leaves_the_others_histories_intact() -> None:
    stack = StateStack(3)
    stack.reset(observation(1, 2))
    stack.push(observation(3, 4))
    state = stack.push(observation(50, 6), done=torch.tensor([True, False]))
    for key in ("proprioception", "target", "touch", "images"):
        assert history(state, key) == [[50, 50, 50], [6, 4, 2]]
    assert history(stack.push(observation(7, 8))) == [[7, 50, 50], [8, 6, 4]]


def test_peeking_changes_nothing() -> None:
    stack = StateStack(3)
    stack.reset(observation(1))
    assert history(stack.peek(observation(9))) == [[9, 1, 1]]
    assert history(stack.push(observation(2))) == [[2, 1, 1]]


def test_the_simulators_state_is_there_only_when_asked_for() -> None:
    assert "privileged" not in flatten(observation(1))
    state = flatten(observation(1, 2, privileged=True))
    assert state["privileged"].shape == (2, 26 + 9 + 18 + 3 + 1)
    # Where a sentence names two objects, it is the middle between them.
    assert state["named_position"].tolist() == [[3.0, 4.0, 5.0], [3.0, 4.0, 5.0]]


def test_text_comes_back_from_its_bytes() -> None:
    said = ["Touch the blue cube.", "Toque o cubo verde, à esquerda.", ""]
    rows = senses.text_of(said)
    assert rows.dtype == torch.uint8 and rows.shape == (3, 256)
    assert senses.read_text(rows) == said


# -- What envs observe -----------------------------------------------------------------


def test_text_is_observed_where_it_is_asked_for() -> None:
    kwargs = {"obs_mode": "state_dict", "render_backend": "none"}
    assert senses.require_askable(name for name in ("text",)) == ("text",)
    env = gym.make("NaoTouchCubeMulti-v1", observe=("text",), **kwargs)
    obs, _ = env.reset(seed=0, options={"instruction": 1})
    env.close()
    assert [*obs["agent"]] == ["proprioception", "target", "velocity"]
    assert [*obs["extra"]][:4] == ["touch", "instruction", "text", "object_position"]
    assert senses.read_text(flatten(obs)["text"]) == ["Touch the red cube."]
    with pytest.raises(
        ValueError, match="observe: got .*'smell'.* available: .*'text'"
    ):
        gym.make("NaoTouchCubeMulti-v1", observe=("smell",), **kwargs)


def clock(env: TouchEnv, _: dict) -> torch.Tensor:
    """Return the share of the episode that is over [N, 1]."""
    return env.elapsed_steps[:, None] / env.experiment.episode_steps


def test_a_sense_of_ones_own_reaches_worker_processes(own_senses) -> None:
    senses.register(Term("clock", "body", "1", clock))
    envs = make_vec("NaoTouchCubeSingle-v1", 2, num_workers=1, obs_mode="state_dict")
    envs.reset(seed=0)
    obs, *_ = envs.step(torch.zeros(2, 26))
    envs.close()
    assert flatten(obs)["clock"].tolist() == [[1 / 32]] * 2


def test_a_sense_of_ones_own_is_one_entry(own_senses) -> None:
    senses.register(Term("clock", "body", "1", clock, stacked=True))
    senses.register(Term("clock", "body", "1", clock, stacked=True))  # twice is once
    env = gym.make("NaoTouchCubeSingle-v1", obs_mode="state_dict")
    stack = StateStack(3)
    stack.reset(env.reset(seed=0)[0])
    for _ in range(2):
        obs, *_ = env.step(env.action_space.sample())
        state = stack.push(obs)
    env.close()
    assert state["clock"].flatten().tolist() == [2 / 32, 1 / 32, 0]
    config = AgentConfig(senses=("touch", "clock"), hidden=(8,))
    agent = Agent(config, StateSpec.of(state, 26))
    action = agent.policy(state)
    assert not torch.equal(action, agent.policy(state | {"clock": state["clock"] + 1}))
    value = agent.value(state)  # the critic has it beside the simulator's state
    later = state | {"clock": state["clock"] + 1}
    assert not torch.equal(value, agent.value(later))
    senses._TERMS.pop()
    with pytest.raises(ValueError, match="got 'clock', expected one of 'vision', "):
        AgentConfig(senses=("touch", "clock"))


@pytest.mark.parametrize("value", [3.0, torch.zeros(6), torch.zeros(2, 6)])
def test_a_sense_without_a_row_for_each_env_is_refused(own_senses, value) -> None:
    senses.register(Term("clock", "body", "1", lambda *_: value))
    message = r"sense 'clock': got .*, expected a tensor \[N, 1\] with N = 1"
    with pytest.raises(ValueError, match=message):
        gym.make("NaoTouchCubeSingle-v1", obs_mode="state_dict", render_backend="none")


def test_only_dicts_become_a_state() -> None:
    with pytest.raises(ValueError, match="observation: got 'Tensor', expected a dict"):
        flatten(torch.zeros(1, 100))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("term", "message"),
    [
        (Term("touch", "body", "F"), "got 'touch', which is taken"),
        (Term("sound", "vision", "T"), "got 'vision', expected 'body' or 'privileged'"),
    ],
)
def test_senses_that_cannot_be_are_refused(own_senses, term, message) -> None:
    with pytest.raises(ValueError, match=message):
        senses.register(term)


class ThreeCameras(TouchEnv):
    """A robot with one eye more, on its left forearm."""

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        arm = self.agent.robot.links_map["LForeArm"]
        kwargs = {"width": 32, "height": 64, "fov": 1, "near": 0.02, "far": 5}
        third = CameraConfig("arm_camera", sapien.Pose(), mount=arm, **kwargs)
        return [*super()._default_sensor_configs, third]


@pytest.mark.render
def test_a_third_camera_that_moves_is_seen(env_kwargs) -> None:
    if "ThreeCameras-v1" not in REGISTERED_ENVS:
        kwargs = {"experiment": "NaoTouchCubeSingle-v1"}
        register_env("ThreeCameras-v1", max_episode_steps=32, **kwargs)(ThreeCameras)
    env = gym.make("ThreeCameras-v1", **env_kwargs)
    obs, _ = env.reset(seed=0)
    state = StateStack(3).reset(obs)
    before, now = obs["sensor_param"], env.step(torch.ones(1, 26))[0]["sensor_param"]
    still = [
        torch.equal(*(p[name]["cam2world_gl"] for p in (before, now))) for name in now
    ]
    assert dict(zip(now, still, strict=True)) == {
        "top_camera": True,
        "front_camera": True,
        "arm_camera": False,
    }
    env.close()
    assert state["images"].shape == (1, 3, 3, 64, 32, 3)
    config = AgentConfig(critic="separate", auxiliary_weight=0, hidden=(8,))
    agent = Agent(config, StateSpec.of(state, 26))
    assert agent.policy(state).shape == (1, 26)
