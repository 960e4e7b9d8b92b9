"""Which finger touched which object: what differs between CPU and GPU physics.

A sensor is updated after every physics substep, so that a touch between two control
steps counts. The CPU one walks the contact list; the GPU one asks for all pairs in one
impulse query. Legend: N envs, F fingers, C objects.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Link
from torch import Tensor

TOUCH_FORCE = 0.01
"""Force from which a contact counts as a touch [N]."""


class CpuTouchSensor:
    """Reads the contact list of PhysX on the CPU, where N is 1."""

    def __init__(
        self,
        scene: ManiSkillScene,
        fingers: Sequence[Sequence[Link]],
        objects: Sequence[Actor],
    ) -> None:
        """Take the links of each finger, and what they may touch."""
        self._system = scene.px
        self._place: dict[tuple, tuple[int, int, int]] = {}
        for f, links in enumerate(fingers):
            for link, (c, actor) in itertools.product(links, enumerate(objects)):
                pair = link._bodies[0], actor._bodies[0]
                self._place[pair] = self._place[pair[::-1]] = (0, f, c)
        self._shape = (1, len(fingers), len(objects))
        self._touched: set[tuple[int, int, int]] = set()

    def clear(self, env_idx: Tensor | None = None) -> None:
        """Forget all touches so far."""
        self._touched.clear()

    def update(self) -> None:
        """Add the touches of the last physics step."""
        impulses: dict[tuple[int, int, int], float] = {}
        for contact in self._system.get_contacts():
            place = self._place.get(tuple(contact.bodies))
            if place is not None and place not in self._touched:
                impulse = sum(point.impulse for point in contact.points)
                impulses[place] = impulses.get(place, 0.0) + math.hypot(*impulse)
        least = TOUCH_FORCE * self._system.timestep  # [N s]
        self._touched.update(p for p, impulse in impulses.items() if impulse > least)

    def read(self) -> Tensor:
        """Return which finger has touched which object since `clear` [1, F, C] bool."""
        contact = torch.zeros(self._shape, dtype=torch.bool)
        for place in self._touched:
            contact[place] = True
        return contact


class GpuTouchSensor:
    """Asks PhysX on the GPU for the impulses of all pairs at once.

    Not yet run on a GPU: tested with a stand-in for the physics system.
    """

    def __init__(
        self,
        scene: ManiSkillScene,
        fingers: Sequence[Sequence[Link]],
        objects: Sequence[Actor],
    ) -> None:
        """Create the impulse query of all pairs, ordered (link, object, env)."""
        self._system = scene.px
        links = [link for finger in fingers for link in finger]
        pairs = [
            pair
            for link in links
            for actor in objects
            for pair in zip(link._bodies, actor._bodies, strict=True)
        ]
        self._query = self._system.gpu_create_contact_pair_impulse_query(pairs)
        self._shape = (len(links), len(objects), scene.num_envs, 3)
        self._sizes = [len(finger) for finger in fingers]
        shape = (scene.num_envs, len(fingers), len(objects))
        self._touched = torch.zeros(shape, dtype=torch.bool, device=scene.device)

    def clear(self, env_idx: Tensor | None = None) -> None:
        """Forget all touches so far, of the envs given [b] or of all."""
        rows = slice(None) if env_idx is None else env_idx
        self._touched[rows] = False

    def update(self) -> None:
        """Add the touches of the last physics step."""
        self._system.gpu_query_contact_pair_impulses(self._query)
        impulse = self._query.cuda_impulses.torch().view(self._shape)
        size = impulse.norm(dim=-1)  # [links, C, N]
        fingers = [part.sum(0) for part in size.split(self._sizes)]  # F x [C, N]
        least = TOUCH_FORCE * self._system.timestep  # [N s]
        self._touched |= torch.stack(fingers).permute(2, 0, 1) > least

    def read(self) -> Tensor:
        """Return which finger has touched which object since `clear` [N, F, C] bool."""
        return self._touched.clone()
