"""The objects: the bodies that there are, and which of them lie on the table.

An experiment's objects all lie there, or some are drawn for each episode from a pool.
Those on the table have a slot each; the others stand on a shelf, out of sight and, on
the CPU, out of the simulation, so that a pool costs no more than what lies there.

Legend: N envs, b envs being reset, B bodies, C slots, F fingers.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Pose
from sapien.physx import PhysxRigidBaseComponent
from sapien.render import RenderBodyComponent
from torch import Tensor

from ir_maniskill.environment import table_scene
from ir_maniskill.environment.bodies import poses, velocities
from ir_maniskill.experiment import Drawn, Experiment
from ir_maniskill.goals import COLORS, SHAPES

EMPTY = -1
"""Marks a slot without an object."""

PARTS = (PhysxRigidBaseComponent, RenderBodyComponent)
"""Components that the simulator and the renderer know a body by."""


class TableObjects:
    """The bodies of all envs; `slot` says which lies where [N, C] int64, or `EMPTY`."""

    def __init__(
        self, scene: ManiSkillScene, experiment: Experiment, scale: float
    ) -> None:
        """Build the bodies, where they lie or, if they are drawn, on the shelf."""
        things, device = experiment.bodies, scene.device
        self._drawn = isinstance(experiment.objects, Drawn)
        height = [table_scene.OBJECT_HEIGHT[thing.shape] / 2 for thing in things]
        above = np.array([[0, 0, h] for h in height])  # [B, 3]
        if self._drawn:
            places = table_scene.build_shelf(scene, len(things), scale) + scale * above
        else:
            flat = [[*thing.position, table_scene.TABLE_TOP] for thing in things]
            places = scale * (np.array(flat) + above)
        self._shelf = torch.tensor(places, dtype=torch.float32, device=device)
        self.bodies = [
            table_scene.build_object(scene, thing, place, scale)
            for thing, place in zip(things, places, strict=True)
        ]
        kinds = [(list(COLORS).index(o.color), SHAPES.index(o.shape)) for o in things]
        self._kinds = torch.tensor(kinds, device=device)  # [B, 2]
        z = [scale * (table_scene.TABLE_TOP + h) for h in height]
        self.z = torch.tensor(z, dtype=torch.float32, device=device)
        """Height of each body's middle while it stands on the table [B] [m]."""
        self._gpu = scene.gpu_sim_enabled
        self._shown = [True] * len(things)  # on the CPU: whether they are simulated
        shape = scene.num_envs, experiment.slots
        self.slot = torch.full(shape, EMPTY, device=device)
        """Which body is in each slot, or `EMPTY` [N, C] int64."""
        self.put(slice(None), self.slot)

    # -- Where they are --------------------------------------------------------------

    def lay_out(
        self, env_idx: Tensor, slot: Tensor, xy: Tensor, rotation: Tensor
    ) -> Tensor:
        """Put objects on the table, and all others on the shelf.

        Args:
            env_idx: The envs being reset [b].
            slot: Which body is in each slot, or `EMPTY` [b, C].
            xy: Where [b, C, 2] [m].
            rotation: Unit quaternions (w, x, y, z) [b, C, 4].

        Returns:
            Their poses, zeros in empty slots [b, C, 7].
        """
        taken = (slot >= 0)[..., None]  # [b, C, 1]
        pose = torch.cat([xy, self.z[slot][..., None], rotation], dim=-1) * taken
        upright = torch.tensor([1.0, 0, 0, 0], device=pose.device)
        self.put(env_idx, slot)
        for index, body in enumerate(self.bodies):
            here = (slot == index)[..., None]  # [b, C, 1]
            shelved = torch.cat([self._shelf[index], upright])
            at = torch.where(here.any(dim=1), (pose * here).sum(dim=1), shelved)
            if self._gpu or self._shown[index]:
                body.set_pose(Pose.create(at))
        return pose

    def put(self, env_idx: Tensor | slice, slot: Tensor) -> None:
        """Say which bodies lie on the table, wherever they are."""
        self.slot = self.slot.clone()
        self.slot[env_idx] = slot
        kinds = self._kinds[self.slot].where((self.slot >= 0)[..., None], EMPTY)
        self.color, self.shape = kinds.unbind(dim=-1)
        """Places of their colors in `COLORS`, and of their shapes in `SHAPES`, -1 in
        empty slots [N, C] int64."""
        if self._drawn and not self._gpu:
            on_table = set(self.slot.flatten().tolist())
            for index in range(len(self.bodies)):
                self._show(index, index in on_table)

    def _show(self, index: int, shown: bool) -> None:
        """Let the only env simulate and draw a body, or not."""
        if self._shown[index] == shown:
            return
        self._shown[index] = shown
        (entity,) = self.bodies[index]._objs
        for part in entity.components:
            if isinstance(part, PARTS):
                part.enable() if shown else part.disable()

    # -- What is measured ------------------------------------------------------------

    def poses(self) -> Tensor:
        """Return positions [m] and quaternions, zeros in empty slots [N, C, 7]."""
        return self._of_slots(poses, 7)

    def velocities(self) -> Tensor:
        """Return how their centers move, zeros in empty slots [N, C, 3] [m/s]."""
        return self._of_slots(velocities, 3)

    def contact(self, contact: Tensor) -> Tensor:
        """Return contacts of slots [N, F, C] from those of bodies [N, F, B] bool."""
        if not self._drawn:
            return contact
        slot = self.slot[:, None].expand(-1, contact.shape[1], -1)  # [N, F, C]
        return contact.gather(2, slot.clamp(min=0)) & (slot >= 0)

    def _of_slots(self, read: Callable, width: int) -> Tensor:
        """Return what is read of bodies, by slot [N, C, width]."""
        if not self._drawn:
            return read(self.bodies)
        if self._gpu:
            slot = self.slot[..., None].expand(-1, -1, width)  # [N, C, width]
            found = read(self.bodies).gather(1, slot.clamp(min=0))
            return found * (slot >= 0)
        values = torch.zeros(*self.slot.shape, width)
        (slots,) = self.slot.tolist()
        taken = [place for place, index in enumerate(slots) if index >= 0]
        if taken:
            values[:, taken] = read([self.bodies[slots[place]] for place in taken])
        return values
