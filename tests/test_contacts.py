"""Contact forces [N, F, C] from either backend, with stand-ins for PhysX."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ir_maniskill.environment.contacts import (
    CpuContactQuery,
    GpuContactQuery,
    contact_query,
)

TIMESTEP = 0.01


def part(*bodies: object) -> SimpleNamespace:
    """Return a stand-in for a link or an actor with one body per env."""
    return SimpleNamespace(_bodies=list(bodies))


def touch(first: str, second: str, *impulses: tuple) -> SimpleNamespace:
    """Return a stand-in for a PhysX contact."""
    points = [SimpleNamespace(impulse=np.array(i, np.float32)) for i in impulses]
    return SimpleNamespace(bodies=(first, second), points=points)


def test_cpu_query_sums_a_fingers_links_in_either_order() -> None:
    contacts = [
        touch("tip", "red", (0.003, 0, 0.004)),
        touch("red", "base", (0, 0, 0.001), (0, 0, 0.001)),
        touch("tip", "table", (0, 0, 9.0)),
        touch("red", "table", (0, 0, 9.0)),
        touch("thumb", "blue", (0, 0, 0)),
    ]
    system = SimpleNamespace(get_contacts=lambda: contacts, timestep=TIMESTEP)
    scene = SimpleNamespace(px=system, gpu_sim_enabled=False)
    fingers = [[part("base"), part("tip")], [part("thumb")]]
    query = contact_query(scene, fingers, [part("blue"), part("red")])
    assert isinstance(query, CpuContactQuery)
    expected = torch.tensor([[[0.0, 0.7], [0.0, 0.0]]])
    torch.testing.assert_close(query(), expected)


class GpuSystem:
    """A stand-in that gives pair k the impulse (0, 0, k) and checks the order."""

    timestep = TIMESTEP

    def gpu_create_contact_pair_impulse_query(self, pairs: list) -> SimpleNamespace:
        self.pairs = pairs
        self.impulses = torch.zeros(len(pairs), 3)
        return SimpleNamespace(
            cuda_impulses=SimpleNamespace(torch=lambda: self.impulses)
        )

    def gpu_query_contact_pair_impulses(self, query: object) -> None:
        self.impulses[:, 2] = torch.arange(len(self.pairs))


def test_gpu_query_puts_every_pair_where_it_belongs() -> None:
    system = GpuSystem()
    scene = SimpleNamespace(px=system, gpu_sim_enabled=True, num_envs=2)
    fingers = [[part("a0", "a1"), part("b0", "b1")], [part("c0", "c1")]]
    objects = [part("x0", "x1"), part("y0", "y1")]
    query = contact_query(scene, fingers, objects)
    assert isinstance(query, GpuContactQuery)
    force = query()
    assert force.shape == (2, 2, 2)
    at = {pair: k for k, pair in enumerate(system.pairs)}
    for env in range(2):
        for c, thing in enumerate("xy"):
            first = sum(at[f"{link}{env}", f"{thing}{env}"] for link in "ab")
            second = at[f"c{env}", f"{thing}{env}"]
            expected = [first / TIMESTEP, second / TIMESTEP]
            assert force[env, :, c].tolist() == pytest.approx(expected)
