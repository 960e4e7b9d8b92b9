"""Snapshot: what goals are measured on, as plain tensors.

A snapshot is small: a replay may keep it, and judge it later under any sentence that is
true of its scene. Lengths are those of a scene at NAO's scale.
Legend: N envs, F fingers, C objects.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor


@dataclass(frozen=True)
class Snapshot:
    """N scenes at one step of their episodes. Robot frame: x forward, y left, z up."""

    contact: Tensor
    """Whether finger f touched object c since the last step [N, F, C] bool."""
    fingertip: Tensor
    """Where the fingertips are [N, F, 3] [m]."""
    pose: Tensor
    """Position [m] and quaternion (w, x, y, z) of each object [N, C, 7]."""
    start: Tensor
    """The same when the episode began [N, C, 7]."""
    velocity: Tensor
    """Of each object's center [N, C, 3] [m/s]."""
    color: Tensor
    """Place of each object's color in `COLORS`; -1 where there is no object
    [N, C] int64."""
    shape: Tensor
    """Place of each object's shape in `SHAPES` [N, C] int64."""
    stage: Tensor
    """How many goals of a sequence `Then` have been reached [N] int64."""

    @property
    def position(self) -> Tensor:
        """Where the objects are [N, C, 3] [m]."""
        return self.pose[..., :3]

    @property
    def moved(self) -> Tensor:
        """How far the objects are from where they began [N, C, 3] [m]."""
        return self.pose[..., :3] - self.start[..., :3]

    @property
    def distance(self) -> Tensor:
        """From each fingertip to each object's center [N, F, C] [m]."""
        return (self.fingertip[:, :, None] - self.position[:, None]).norm(dim=-1)

    def at_stage(self, stage: Tensor) -> Snapshot:
        """Return the same scenes at another stage of their goals [N] int64."""
        return replace(self, stage=stage)
