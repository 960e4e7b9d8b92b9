"""Vision that says what lies where."""

import pytest
import torch
from scenes import scene
from torch.nn import functional

from ir_maniskill.agent.object_vision import (
    KINDS,
    WIDTH,
    CameraView,
    Finder,
    ObjectVision,
    cells,
    kinds,
    truth,
)
from ir_maniskill.goals import COLORS, SHAPES


@pytest.fixture
def vision():
    torch.manual_seed(0)
    return ObjectVision(frames=1, size=(2, 16, 8), said=6)


def number(color, shape):
    """Return the number of a kind of object."""
    return list(COLORS).index(color) * len(SHAPES) + SHAPES.index(shape)


def test_the_truth_is_what_lies_there() -> None:
    there, place = truth(scene())  # blue and red cubes, and a green button
    expected = torch.zeros(KINDS)
    named = [("blue", "cube"), ("red", "cube"), ("green", "button")]
    expected[[number(*kind) for kind in named]] = 1
    torch.testing.assert_close(there[0], expected)
    blue = torch.tensor([1.9, 0.0, 0.5])  # 0.19, 0, 0.05 m
    torch.testing.assert_close(place[0, number("blue", "cube")], blue)
    assert not place[0, number("red", "can")].any()


def test_each_kind_has_a_color_and_a_shape() -> None:
    kind = kinds(torch.zeros(1))[number("red", "can")]
    assert kind.sum() == 2
    assert kind[list(COLORS).index("red")] == 1
    assert kind[len(COLORS) + SHAPES.index("can")] == 1


def test_cells_are_the_pixels_of_squares() -> None:
    torch.manual_seed(0)
    images = torch.randint(256, (2, 3, 2, 8, 12, 3), dtype=torch.uint8)
    found = cells(images)
    assert found.shape == (2, 2, 2, 3, 3 * 48)
    square = images[1, :, 0, 4:8, 8:12]  # frames, rows, columns, colors
    assert found[0, 1, 1, 2].tolist() == square.flatten().tolist()


def test_bytes_are_seen_as_numbers_from_minus_one_to_one() -> None:
    torch.manual_seed(0)
    camera = CameraView(1)
    byte = torch.randint(256, (1, 2, 2, 48), dtype=torch.uint8)
    weight, bias = camera.cells.parameters()
    expected = functional.linear(byte * (2 / 255) - 1, weight, bias)
    torch.testing.assert_close(camera.read(byte), expected)


def test_who_sees_all_has_no_loss(vision) -> None:
    there, place = truth(scene())
    told = torch.cat([torch.zeros(1, WIDTH), 40 * there - 20, place.flatten(1)], dim=1)
    assert vision.misseen(told, scene()) < 1e-3
    told[0, WIDTH + KINDS + 3 * number("blue", "cube")] += 0.5  # 5 cm
    assert vision.misseen(told, scene()) == pytest.approx(0.125, abs=1e-3)


def test_a_pair_fits_as_well_as_its_color_and_its_shape(vision) -> None:
    name = vision.name(kinds(vision.name.weight))
    keys = vision.finder.keys[0](torch.cat([name, torch.ones(KINDS, 4)], dim=1))
    red_cube, blue_can = keys[number("red", "cube")], keys[number("blue", "can")]
    red_can, blue_cube = keys[number("red", "can")], keys[number("blue", "cube")]
    torch.testing.assert_close(red_cube + blue_can, red_can + blue_cube)


def test_what_does_not_lie_there_is_not_looked_at() -> None:
    torch.manual_seed(0)
    finder, said = Finder(6), torch.randn(1, 6)
    entries = torch.randn(1, KINDS, 20)
    there = torch.full((1, KINDS), -30.0)
    there[0, 3] = 30.0
    found = finder(entries, there, said)
    others = entries.clone()
    others[0, 4:] += 1
    torch.testing.assert_close(finder(others, there, said), found, rtol=0.05, atol=0.05)
    others[0, 3] += 1
    assert (finder(others, there, said) - found).abs().max() > 0.1


def test_what_lies_where_can_be_learned(vision) -> None:
    """Two pictures: in one a red cube lies at one place, in the other elsewhere."""
    torch.manual_seed(0)
    images = torch.randint(256, (3, 1, 2, 16, 8, 3), dtype=torch.uint8)
    scenes = scene().rows(torch.zeros(3, dtype=torch.int64))
    scenes.pose[:, 1, 0] += torch.tensor([0.0, 0.1, -0.1])
    optimizer, said = torch.optim.Adam(vision.parameters(), 3e-3), torch.zeros(3, 6)
    losses = []
    for _ in range(150):
        loss = vision.misseen(vision(images, said), scenes)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.1 < losses[0]
