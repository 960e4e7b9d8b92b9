"""Snapshots made by hand: three objects, six fingers, nothing moving."""

import torch

from ir_maniskill.goals import COLORS, SHAPES
from ir_maniskill.snapshot import Snapshot

HANDS = {
    "left": torch.tensor([True] * 3 + [False] * 3),
    "right": torch.tensor([False] * 3 + [True] * 3),
}
OBJECTS = (("blue", "cube"), ("red", "cube"), ("green", "button"))
PLACES = ((0.19, 0.0, 0.05), (0.23, 0.08, 0.05), (0.23, -0.08, 0.05))


def scene(*touching, count=1, stage=0, moved=(0.0, 0.0, 0.0), which=0, places=PLACES):
    """Return N equal scenes with (finger, object) contacts on and one object moved."""
    contact = torch.zeros(count, 6, 3, dtype=torch.bool)
    for finger, thing in touching:
        contact[:, finger, thing] = True
    start = torch.zeros(count, 3, 7)
    start[..., :3], start[..., 3] = torch.tensor(places), 1
    pose = start.clone()
    pose[:, which, :3] += torch.tensor(moved)
    return Snapshot(
        contact=contact,
        fingertip=torch.zeros(count, 6, 3),
        pose=pose,
        start=start,
        velocity=torch.zeros(count, 3, 3),
        color=torch.tensor([[list(COLORS).index(c) for c, _ in OBJECTS]] * count),
        shape=torch.tensor([[SHAPES.index(s) for _, s in OBJECTS]] * count),
        stage=torch.full((count,), stage),
    )
