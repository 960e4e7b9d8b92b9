"""Snapshot: what goals are measured on, as plain tensors.

A snapshot is small: a replay may keep it, and judge it later under any sentence that is
true of its scene. Lengths are those of a scene at NAO's scale.
Legend: N envs, F fingers, C objects.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, cast

import torch
from torch import Tensor


class Later:
    """What a field of a `Lazy` dataclass shall be, worked out when it is first read."""

    def __init__(self, work: Callable[[], Tensor]) -> None:
        self.work = work


def later(work: Callable[[], Tensor]) -> Tensor:
    """Return what stands for a tensor in a `Lazy` dataclass until it is read."""
    return cast(Tensor, Later(work))


class Lazy:
    """A frozen dataclass whose fields may come `later`: most steps read few of them."""

    def __post_init__(self) -> None:
        """Set aside what comes later; `__getattr__` is asked for what is not there."""
        found = {k: v.work for k, v in vars(self).items() if isinstance(v, Later)}
        for name in found:
            del vars(self)[name]
        if found:
            vars(self)["_later"] = found

    def __getattr__(self, name: str) -> Any:
        work = vars(self).get("_later", {}).get(name)
        if work is None:
            raise AttributeError(f"{type(self).__name__} has no {name!r}")
        value = vars(self)[name] = work()
        return value

    def values(self) -> list[Any]:
        """Return the values of all fields in their order."""
        return [getattr(self, field.name) for field in fields(cast(Any, self))]


@dataclass(frozen=True)
class Snapshot(Lazy):
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
        return self.to_object.norm(dim=-1)

    @property
    def to_object(self) -> Tensor:
        """From each object's center to each fingertip [N, F, C, 3] [m]."""
        return self.fingertip[:, :, None] - self.position[:, None]

    def rows(self, index: Tensor) -> Snapshot:
        """Return some of the scenes [M], each as often as its row is named."""
        return Snapshot(*(part[index] for part in self.values()))

    def at_stage(self, stage: Tensor) -> Snapshot:
        """Return the same scenes at another stage of their goals [N] int64."""
        return replace(self, stage=stage)

    def pack(self) -> Tensor:
        """Return all of it as one row of numbers per env [N, P] float32."""
        parts = [part.reshape(len(part), -1) for part in self.values()]
        return torch.cat([part.float() for part in parts], dim=1)

    @classmethod
    def unpack(cls, rows: Tensor, fingers: int) -> Snapshot:
        """Return what `pack` made of scenes with F fingers [..., P] -> [..., F, C]."""
        # P = F C + 3 F + 19 C + 1: contact, fingertip, all that objects have, stage
        objects = (rows.shape[-1] - 3 * fingers - 1) // (fingers + 19)
        shapes = {
            "contact": (fingers, objects),
            "fingertip": (fingers, 3),
            "pose": (objects, 7),
            "start": (objects, 7),
            "velocity": (objects, 3),
            "color": (objects,),
            "shape": (objects,),
            "stage": (),
        }
        sizes = [math.prod(shape) for shape in shapes.values()]
        parts = zip(shapes.items(), rows.split(sizes, dim=-1), strict=True)
        fields = {k: v.reshape(*rows.shape[:-1], *shape) for (k, shape), v in parts}
        fields["contact"] = fields["contact"] > 0
        for name in ("color", "shape", "stage"):
            fields[name] = fields[name].long()
        return cls(**fields)
