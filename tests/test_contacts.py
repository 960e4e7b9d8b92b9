"""Touches [N, F, C] from either backend, with stand-ins for PhysX."""

from types import SimpleNamespace

import numpy as np
import torch

from ir_maniskill.environment.contacts import CpuTouchSensor, GpuTouchSensor

TIMESTEP = 0.01


def part(*bodies: object) -> SimpleNamespace:
    """Return a stand-in for a link or an actor with one body per env."""
    return SimpleNamespace(_bodies=list(bodies))


def touch(first: str, second: str, *impulses: tuple) -> SimpleNamespace:
    """Return a stand-in for a PhysX contact."""
    points = [SimpleNamespace(impulse=np.array(i, np.float32)) for i in impulses]
    return SimpleNamespace(bodies=(first, second), points=points)


def test_cpu_sensor_adds_up_a_fingers_links_and_keeps_each_substeps_touches() -> None:
    contacts = [
        touch("tip", "red", (0.00003, 0, 0.00004)),
        touch("red", "base", (0, 0, 0.00003), (0, 0, 0.00003)),  # 0.011 N together
        touch("tip", "table", (0, 0, 9.0)),
        touch("red", "table", (0, 0, 9.0)),
        touch("thumb", "blue", (0, 0, 0.00009)),  # 0.009 N: too light
    ]
    system = SimpleNamespace(get_contacts=lambda: contacts, timestep=TIMESTEP)
    scene = SimpleNamespace(px=system)
    fingers = [[part("base"), part("tip")], [part("thumb")]]
    sensor = CpuTouchSensor(scene, fingers, [part("blue"), part("red")])
    sensor.update()
    assert sensor.read().tolist() == [[[False, True], [False, False]]]
    contacts[:] = [touch("thumb", "blue", (0, 0, 0.002))]
    sensor.update()
    assert sensor.read().tolist() == [[[False, True], [True, False]]]
    sensor.clear()
    assert not sensor.read().any()


class GpuSystem:
    """A stand-in that gives pair k the impulse (0, 0, k) if k is chosen."""

    timestep = TIMESTEP
    chosen: tuple[int, ...] = ()

    def gpu_create_contact_pair_impulse_query(self, pairs: list) -> SimpleNamespace:
        self.pairs = pairs
        self.impulses = torch.zeros(len(pairs), 3)
        return SimpleNamespace(
            cuda_impulses=SimpleNamespace(torch=lambda: self.impulses)
        )

    def gpu_query_contact_pair_impulses(self, query: object) -> None:
        self.impulses[:, 2] = torch.tensor(
            [float(k in self.chosen) for k in range(len(self.pairs))]
        )


def test_gpu_sensor_puts_every_pair_where_it_belongs() -> None:
    system = GpuSystem()
    scene = SimpleNamespace(px=system, num_envs=2, device="cpu")
    fingers = [[part("a0", "a1"), part("b0", "b1")], [part("c0", "c1")]]
    objects = [part("x0", "x1"), part("y0", "y1")]
    sensor = GpuTouchSensor(scene, fingers, objects)
    for k, (link, thing) in enumerate(system.pairs):
        system.chosen = (k,)
        sensor.clear()
        sensor.update()
        place = (int(link[1]), int(link[0] == "c"), int(thing[0] == "y"))
        assert sensor.read().nonzero().tolist() == [list(place)]
    system.chosen = tuple(range(len(system.pairs)))
    sensor.update()
    sensor.clear(torch.tensor([1]))
    assert sensor.read().flatten(1).all(dim=1).tolist() == [True, False]
