"""Poses and velocities of many bodies at once: a ManiSkill `Pose` for each is slow.

Legend: N envs, B bodies.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from mani_skill.utils.structs import Actor, Link
from sapien.physx import PhysxRigidBodyComponent
from torch import Tensor


def poses(bodies: Sequence[Actor | Link]) -> Tensor:
    """Return positions [m] and quaternions (w, x, y, z) of bodies [N, B, 7]."""
    if bodies[0].scene.gpu_sim_enabled:
        return torch.stack([body.pose.raw_pose for body in bodies], dim=1)
    return _of_each(bodies, _pose)


def velocities(bodies: Sequence[Actor]) -> Tensor:
    """Return how the bodies' centers move [N, B, 3] [m/s]."""
    if bodies[0].scene.gpu_sim_enabled:
        return torch.stack([body.linear_velocity for body in bodies], dim=1)
    return _of_each(bodies, lambda part: part.linear_velocity)


def _pose(part: PhysxRigidBodyComponent) -> np.ndarray:
    pose = part.entity_pose
    return np.concatenate([pose.p, pose.q])


def _of_each(bodies: Sequence[Actor | Link], read: Callable) -> Tensor:
    each = [[read(part) for part in body._bodies] for body in bodies]
    return torch.from_numpy(np.array(each, dtype=np.float32)).transpose(0, 1)
