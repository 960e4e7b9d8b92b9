"""Shared fixtures. Simulated envs are dear, and a process can make only some 25."""

import os

# Several processes run tests: none may take more than its core. Read when torch and the
# software renderer are loaded, here and in all processes that tests start.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("LP_NUM_THREADS", "0")

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import pytest
import torch
from hypothesis import settings

import ir_maniskill
from ir_maniskill.environment.process_vector import ProcessVectorEnv
from ir_maniskill.training import ppo

settings.register_profile("busy machines", deadline=None)
settings.load_profile("busy machines")

SMALL = {"width": 32, "height": 64, "shader_pack": "trivial"}
"""Cameras of the tests: small, and with the shaders that compile fastest."""
ENV_KWARGS = {
    "obs_mode": "rgb",
    "control_mode": "pd_joint_target_delta_pos",
    "sensor_configs": SMALL,
}


@pytest.fixture(scope="session")
def env_kwargs() -> dict[str, Any]:
    """What the envs below are made with."""
    return dict(ENV_KWARGS)


@pytest.fixture(scope="session")
def multi_env() -> Iterator[gym.Env]:
    """One NaoTouchCubeMulti-v1 with small pictures; reset it before use."""
    env = gym.make("NaoTouchCubeMulti-v1", num_envs=1, **ENV_KWARGS)
    yield env
    env.close()


@pytest.fixture(scope="session")
def multi_vec() -> Iterator[ProcessVectorEnv]:
    """Two NaoTouchCubeMulti-v1 in two processes; reset them before use."""
    envs = ir_maniskill.make_vec(
        "NaoTouchCubeMulti-v1", 2, num_workers=2, sim_backend="physx_cpu", **ENV_KWARGS
    )
    yield envs
    envs.close()


@pytest.fixture(scope="session")
def reflex() -> Any:
    """A fixed policy that depends on every sense, and moves the arms a lot."""
    generator = torch.Generator().manual_seed(1)
    weights = 0.6 * torch.randn(2 * 78 + 18, 26, generator=generator)

    def policy(state: dict[str, torch.Tensor]) -> torch.Tensor:
        body = ("proprioception", "target", "touch")
        felt = torch.cat([state[key].flatten(1) for key in body], dim=1)  # [N, 174]
        seen = state["images"].float().mean(dim=(1, 2, 3, 4, 5)) / 255  # [N]
        return torch.tanh(felt @ weights + seen[:, None])

    return policy


@pytest.fixture
def before_update(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Do something before the gradients of the n-th update of PPO."""

    def arrange(count, action):
        improve, calls = ppo.improve, []

        def patched(*arguments):
            calls.append(None)
            if len(calls) == count:
                action()
            return improve(*arguments)

        monkeypatch.setattr(ppo, "improve", patched)

    return arrange
