"""Contact forces between fingers and objects: all that differs between backends.

Both queries answer with forces [N, F, C] in newtons. Legend: N envs, F fingers,
C objects. The CPU one walks the contact list once; the GPU one asks for all pairs in
one impulse query.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Link
from torch import Tensor

ContactQuery = Callable[[], Tensor]
"""Returns the force of every finger on every object [N, F, C] [N]."""


def contact_query(
    scene: ManiSkillScene,
    fingers: Sequence[Sequence[Link]],
    objects: Sequence[Actor],
) -> ContactQuery:
    """Return the query for the backend that `scene` runs on.

    Args:
        scene: The ManiSkill scene, set up.
        fingers: The links of each finger.
        objects: What they may touch.
    """
    kind = GpuContactQuery if scene.gpu_sim_enabled else CpuContactQuery
    return kind(scene, fingers, objects)


class CpuContactQuery:
    """Reads the contact list of PhysX on the CPU, where N is 1."""

    def __init__(
        self,
        scene: ManiSkillScene,
        fingers: Sequence[Sequence[Link]],
        objects: Sequence[Actor],
    ) -> None:
        """Remember which two bodies are which finger and object."""
        self._system = scene.px
        self._place: dict[tuple, tuple[int, int, int]] = {}
        for f, links in enumerate(fingers):
            for c, actor in enumerate(objects):
                for link in links:
                    pair = link._bodies[0], actor._bodies[0]
                    self._place[pair] = self._place[pair[::-1]] = (0, f, c)
        self._shape = (1, len(fingers), len(objects))

    def __call__(self) -> Tensor:
        """Return the forces of the last physics step [1, F, C] [N]."""
        force = np.zeros(self._shape, dtype=np.float32)
        for contact in self._system.get_contacts():
            place = self._place.get(tuple(contact.bodies))
            if place is not None:
                impulse = sum(point.impulse for point in contact.points)
                force[place] += np.linalg.norm(impulse)
        force /= self._system.timestep
        return torch.from_numpy(force)


class GpuContactQuery:
    """Asks PhysX on the GPU for the impulses of all pairs at once.

    Not yet run on a GPU: tested with a stand-in for the physics system.
    """

    def __init__(
        self,
        scene: ManiSkillScene,
        fingers: Sequence[Sequence[Link]],
        objects: Sequence[Actor],
    ) -> None:
        """Create the impulse query, pairs ordered (link, object, env)."""
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

    def __call__(self) -> Tensor:
        """Return the forces of the last physics step [N, F, C] [N]."""
        self._system.gpu_query_contact_pair_impulses(self._query)
        impulse = self._query.cuda_impulses.torch().view(self._shape)
        force = impulse.norm(dim=-1) / self._system.timestep  # [links, C, N]
        per_finger = [part.sum(0) for part in force.split(self._sizes)]  # F x [C, N]
        return torch.stack(per_finger).permute(2, 0, 1)  # [N, F, C]
