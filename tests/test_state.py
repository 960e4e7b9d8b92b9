"""States stack three observations, and a reset of one env leaves the others alone."""

import torch

from ir_maniskill.environment.state import StateStack, flatten


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
            "top_camera": {"rgb": picture},
            "front_camera": {"rgb": picture + 100},
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
        obs["extra"]["target_object"] = torch.tensor([[0.0, 1.0, 0.0]] * batch)
    return obs


def history(state: dict, key: str = "proprioception") -> list:
    """Return what each env remembers, newest first."""
    return state[key].flatten(2)[..., 0].tolist()


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
    assert state["images"][0, 0, :, 0, 0, 0].tolist() == [1, 101]  # top, front


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
    assert state["named_position"].tolist() == [[3.0, 4.0, 5.0]] * 2
