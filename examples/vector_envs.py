"""Many envs at once: worker processes on the CPU, one batch on a GPU.

    python examples/vector_envs.py [--num-envs 16] [--steps 64]

Shows what a training loop of one's own needs: batched torch tensors, envs that start
anew in the step that ends their episode, and the state s_t of three observations.
"""

import time

import torch
import tyro

from ir_maniskill import make_vec
from ir_maniskill.environment.senses import StateStack


def main(num_envs: int = 4, steps: int = 64) -> None:
    """Step random actions in all envs and count the touches."""
    envs = make_vec(
        "NaoTouchCubeTriangle-v1",
        num_envs,
        obs_mode="rgb",
        sensor_configs={"width": 32, "height": 64, "shader_pack": "trivial"},
    )
    stack = StateStack(frames=3)
    obs, _ = envs.reset(seed=0)  # env i gets seed + i
    state = stack.reset(obs)
    print({name: tuple(value.shape) for name, value in state.items()})
    start = time.perf_counter()
    for _ in range(steps):
        action = 2 * torch.rand(num_envs, 26, device=envs.device) - 1
        obs, _, terminated, truncated, info = envs.step(action)
        done = terminated | truncated
        state = stack.push(obs, done)
        if done.any():  # `obs` is of the next episode, `final_info` of the ended one
            touched = info["final_info"]["success_once"][done]
            print(f"{int(touched.sum())} of {int(done.sum())} touched the right cube")
    speed = num_envs * steps / (time.perf_counter() - start)
    print(f"{speed:.0f} steps a second in all, with pictures of both cameras")
    envs.close()


if __name__ == "__main__":
    tyro.cli(main)
