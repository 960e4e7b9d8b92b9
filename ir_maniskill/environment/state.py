"""The state s_t = [o_t, o_{t-1}, o_{t-2}]: stacked observations (paper, Sec. III-A).

Legend: N envs, S stacked observations, K cameras, H x W pixels, J joints, F fingers,
L tokens, P privileged numbers.
"""

from __future__ import annotations

import torch
from torch import Tensor

CAMERAS = ("top_camera", "front_camera")
"""Order of the K cameras in `images`."""
STACKED = ("images", "proprioception", "target", "touch")
"""What is stacked; the instruction is constant within an episode."""

State = dict[str, Tensor]
"""s_t of N envs; `flatten` and `StateStack` tell what it holds."""


def flatten(obs: dict) -> State:
    """Return one observation o_t as a flat dict.

    Args:
        obs: An observation of `TouchEnv` in an image or state_dict mode.

    Returns:
        `instruction` [N, L], `proprioception` and `target` [N, J], `touch` [N, F];
        `images` [N, K, H, W, 3] if there are pictures; `privileged` [N, P] and
        `named_position` [N, 3] [m] if the simulator's state is there.
    """
    agent, extra = obs["agent"], obs["extra"]
    state = {
        "instruction": extra["instruction"],
        "proprioception": agent["proprioception"],
        "target": agent["target"],
        "touch": extra["touch"],
    }
    if "sensor_data" in obs:
        pictures = [obs["sensor_data"][camera]["rgb"] for camera in CAMERAS]
        state["images"] = torch.stack(pictures, dim=1)
    if "object_position" in extra:
        positions, chosen = extra["object_position"], extra["target_object"]
        parts = [agent["velocity"], positions]
        parts += [
            extra[key] for key in ("finger_position", "target_object", "wrong_once")
        ]
        state["privileged"] = torch.cat([part.flatten(1) for part in parts], dim=1)
        state["named_position"] = (positions * chosen[..., None]).sum(dim=1)
    return state


class StateStack:
    """Turns successive observations of a batch of envs into states s_t.

    At the start of an episode the first observation fills the whole stack.
    """

    def __init__(self, frames: int = 3) -> None:
        """Start with no history.

        Args:
            frames: Number of stacked observations S.
        """
        self.frames = frames
        self._state: State = {}

    def reset(self, obs: dict) -> State:
        """Start a new history in every env and return its state.

        Args:
            obs: The observation after a reset of all envs.
        """
        self._state = {
            key: self._repeat(value) if key in STACKED else value
            for key, value in flatten(obs).items()
        }
        return dict(self._state)

    def push(self, obs: dict, done: Tensor | None = None) -> State:
        """Add an observation and return the state.

        Args:
            obs: The newest observation; where `done`, the first of a new episode.
            done: Envs whose history starts anew [N] bool; none if left out.
        """
        self._state = self._pushed(obs, done)
        return dict(self._state)

    def peek(self, obs: dict) -> State:
        """Return the state that `push(obs)` would give, and change nothing.

        Args:
            obs: E.g. the final observation of an episode.
        """
        return self._pushed(obs, None)

    def _pushed(self, obs: dict, done: Tensor | None) -> State:
        state = flatten(obs)
        for key in STACKED:
            if key not in state:
                continue
            newest = state[key]
            stack = torch.cat([newest[:, None], self._state[key][:, :-1]], dim=1)
            if done is not None and done.any():
                stack[done] = self._repeat(newest[done])
            state[key] = stack
        return state

    def _repeat(self, value: Tensor) -> Tensor:
        """Fill a stack with one observation: [N, ...] -> [N, S, ...]."""
        return value[:, None].repeat_interleave(self.frames, dim=1)
