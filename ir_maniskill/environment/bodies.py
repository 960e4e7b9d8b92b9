"""Where bodies are and how fast, read at once: a ManiSkill `Pose` for each is slow.

Legend: N envs, B bodies.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from mani_skill.utils.structs import Actor, Link
from torch import Tensor


def positions(bodies: Sequence[Actor | Link]) -> Tensor:
    """Return where the bodies are [N, B, 3] [m].

    Args:
        bodies: Any that move, of one scene.
    """
    if bodies[0].scene.gpu_sim_enabled:
        return torch.stack([body.pose.p for body in bodies], dim=1)
    each = [[part.entity_pose.p for part in body._bodies] for body in bodies]
    return torch.from_numpy(np.array(each, dtype=np.float32)).transpose(0, 1)


def poses(bodies: Sequence[Actor | Link]) -> Tensor:
    """Return positions [m] and quaternions (w, x, y, z) of the bodies [N, B, 7].

    Args:
        bodies: Any that move, of one scene.
    """
    if bodies[0].scene.gpu_sim_enabled:
        return torch.stack([body.pose.raw_pose for body in bodies], dim=1)
    found = [[part.entity_pose for part in body._bodies] for body in bodies]
    each = [[np.concatenate([pose.p, pose.q]) for pose in row] for row in found]
    return torch.from_numpy(np.array(each, dtype=np.float32)).transpose(0, 1)


def velocities(bodies: Sequence[Actor]) -> Tensor:
    """Return how the bodies' centers move [N, B, 3] [m/s].

    Args:
        bodies: Any that move, of one scene.
    """
    if bodies[0].scene.gpu_sim_enabled:
        return torch.stack([body.linear_velocity for body in bodies], dim=1)
    each = [[part.linear_velocity for part in body._bodies] for body in bodies]
    return torch.from_numpy(np.array(each, dtype=np.float32)).transpose(0, 1)
