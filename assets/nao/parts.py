"""What NAO looks like: the surface of every link, in the frame of the link.

The left side is drawn; the right side is its mirror image. Lengths are in [m].
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .facts import Frames
from .shapes import Section, Surface, join, knob, loft

WHITE, SHELL, GREY, DARK, BLACK, ORANGE, CYAN, GLOW = range(8)

PALETTE = (
    (246, 247, 249),  # WHITE: the shell
    (214, 219, 226),  # SHELL: its shaded panels
    (142, 149, 160),  # GREY: joints
    (74, 80, 92),  # DARK: rubber
    (24, 26, 32),  # BLACK: lenses and eye rings
    (244, 122, 32),  # ORANGE: accents
    (72, 196, 255),  # CYAN: lit eyes
    (232, 250, 255),  # GLOW: what shines brightest
)
"""Color of every swatch, red, green, blue in [0, 255]."""


@dataclass(frozen=True)
class Part:
    """One mesh file."""

    surface: Surface
    """What is drawn."""
    light: tuple[float, float, float]
    """Where the baked light comes from, in the frame of the link."""


_BODY_LIGHT = (0.35, 0.0, 1.0)
_FINGER_LIGHT = (0.0, 1.0, 0.0)  # the back of a finger, see the folder's README


def parts(frames: Frames) -> dict[str, Part]:
    """Returns every mesh by file name.

    Args:
        frames: Frame of every link in the torso's, in the posture to be merged.
    """
    arm = {
        "shoulder": shoulder(),
        "bicep": bicep(),
        "elbow": elbow(),
        "forearm": forearm(),
        "hand": hand(),
    }
    meshes = {"torso": Part(body(frames), _BODY_LIGHT)}
    for name, surface in arm.items():
        meshes[f"l_{name}"] = Part(surface, _BODY_LIGHT)
        meshes[f"r_{name}"] = Part(surface.mirrored(), _BODY_LIGHT)
    meshes["phalanx"] = Part(phalanx(), _FINGER_LIGHT)
    meshes["fingertip"] = Part(fingertip(), _FINGER_LIGHT)
    return meshes


def body(frames: Frames) -> Surface:
    """Returns all that never moves, in the torso's frame."""
    left = {"LThigh": thigh(), "LTibia": shin(), "l_ankle": foot()}
    pieces = [torso(), head().moved(frames["Head"])]
    for link, surface in left.items():
        right = link.replace("L", "R", 1) if link[0] == "L" else link.replace("l", "r", 1)
        pieces.append(surface.moved(frames[link]))
        pieces.append(surface.mirrored().moved(frames[right]))
    return join(pieces)


def torso() -> Surface:
    """Returns the trunk with neck, chest button and sonars."""
    trunk = loft(
        "z",
        [GREY, GREY, WHITE, WHITE, WHITE, WHITE, WHITE, WHITE],
        [
            Section(-0.120, (0.030, 0.036), power=2.5),
            Section(-0.100, (0.042, 0.048), power=2.5),
            Section(-0.072, (0.047, 0.056), power=2.5),
            Section(-0.045, (0.045, 0.053), power=2.4),
            Section(-0.005, (0.050, 0.062), power=2.4),
            Section(0.045, (0.054, 0.072), power=2.4),
            Section(0.085, (0.052, 0.074), power=2.4),
            Section(0.110, (0.042, 0.062), power=2.2),
            Section(0.122, (0.024, 0.032)),
        ],
        segments=16,
    )
    trunk = trunk.painted(ORANGE, lambda c: (abs(c[1]) > 0.055) & (c[2] > -0.02))
    neck = loft(
        "z",
        GREY,
        [Section(0.116, (0.021, 0.021)), Section(0.136, (0.019, 0.019))],
        segments=8,
        caps="none",
    )
    button = knob([SHELL, GREY, GLOW], [(0, 0.016), (0.004, 0.014), (0.004, 0.010), (0.006, 0.007)], 10)
    sonar = knob(DARK, [(0, 0.009), (0.002, 0.007)], 8)
    return join(
        [
            trunk,
            neck,
            button.shifted(0.051, 0, 0.055),
            *(sonar.turned(0, 0.05, 0.39 * s).shifted(0.049, s * 0.027, 0.028) for s in (1, -1)),
        ]
    )


def head() -> Surface:
    """Returns the round head with eyes, ears, cameras and touch sensors."""
    skull = loft(
        "z",
        WHITE,
        [
            Section(-0.006, (0.020, 0.022)),
            Section(0.004, (0.042, 0.043), power=2.2),
            Section(0.024, (0.057, 0.056), power=2.3),
            Section(0.050, (0.062, 0.060), power=2.3),
            Section(0.075, (0.059, 0.058), power=2.3),
            Section(0.096, (0.044, 0.044), power=2.2),
            Section(0.110, (0.021, 0.021)),
            Section(0.1135, (0, 0)),
        ],
        segments=16,
        caps="none",
    )
    eye = knob([BLACK, CYAN, GLOW], [(0, 0.0155), (0.004, 0.0125), (0.0025, 0.0085), (0.0045, 0.004)], 10)
    ear = knob([SHELL, GREY, WHITE], [(0, 0.029), (0.010, 0.027), (0.010, 0.020), (0.013, 0.013)], 12)
    camera = knob([SHELL, BLACK], [(0, 0.007), (0.003, 0.006), (0.003, 0.0045)], 8)
    sides = (1, -1)
    return join(
        [
            skull,
            *(eye.turned(0, -0.05, 0.42 * s).shifted(0.0525, s * 0.0257, 0.0500) for s in sides),
            *(ear.turned(0, 0, s * np.pi / 2).shifted(-0.004, s * 0.0575, 0.050) for s in sides),
            camera.turned(0, -0.35, 0).shifted(0.0575, 0, 0.0775),
            camera.turned(0, 0.6, 0).shifted(0.0535, 0, 0.019),
        ]
    )


def thigh() -> Surface:
    """Returns the left thigh with the knee drum."""
    shell = loft(
        "z",
        WHITE,
        [
            Section(-0.092, (0.026, 0.024)),
            Section(-0.070, (0.032, 0.028), (0.002, 0.002), 2.4),
            Section(-0.030, (0.037, 0.032), (0.002, 0.004), 2.4),
            Section(0.000, (0.036, 0.031), (0, 0.004), 2.4),
            Section(0.020, (0.022, 0.022), (0, 0.002)),
        ],
        caps="high",
    )
    shell = shell.painted(ORANGE, lambda c: (c[1] > 0.02) & (c[2] > -0.06))
    drum = loft("y", GREY, [Section(-0.026, (0.024, 0.024)), Section(0.028, (0.024, 0.024))])
    return join([shell, drum.shifted(0, 0, -0.1)])


def shin() -> Surface:
    """Returns the left shin."""
    return loft(
        "z",
        [GREY, WHITE, WHITE, WHITE],
        [
            Section(-0.108, (0.024, 0.024)),
            Section(-0.092, (0.032, 0.030), (0, 0.001), 2.3),
            Section(-0.055, (0.037, 0.033), (-0.002, 0.002), 2.4),
            Section(-0.022, (0.033, 0.030), (0.001, 0.002), 2.4),
            Section(0.012, (0.024, 0.022), (0.008, 0)),
        ],
        caps="high",
    )


def foot() -> Surface:
    """Returns the left foot, sole at z = -0.04511."""
    return loft(
        "z",
        [DARK, WHITE, WHITE, GREY],
        [
            Section(-0.04511, (0.078, 0.032), (0.022, 0.002), 3.0),
            Section(-0.038, (0.080, 0.034), (0.022, 0.002), 3.0),
            Section(-0.024, (0.070, 0.032), (0.018, 0.002), 2.6),
            Section(-0.010, (0.044, 0.029), (0.004, 0.001), 2.2),
            Section(0.010, (0.026, 0.024)),
        ],
        segments=14,
        caps="none",
    )


def shoulder() -> Surface:
    """Returns the left shoulder: the drum between trunk and upper arm."""
    return loft(
        "y",
        [GREY, DARK],
        [
            Section(-0.040, (0.027, 0.027)),
            Section(-0.022, (0.029, 0.029)),
            Section(-0.010, (0.022, 0.022)),
        ],
        caps="none",
    )


def bicep() -> Surface:
    """Returns the left upper arm with the shoulder cap."""
    shell = loft(
        "x",
        WHITE,
        [
            Section(-0.037, (0, 0)),
            Section(-0.028, (0.021, 0.022), (0.002, 0)),
            Section(-0.006, (0.031, 0.033), (0.003, 0)),
            Section(0.026, (0.030, 0.031), (0.008, 0)),
            Section(0.064, (0.022, 0.023), (0.015, 0)),
        ],
    )
    return shell.painted(ORANGE, lambda c: (c[1] > 0.016) & (c[0] < 0.04))


def elbow() -> Surface:
    """Returns the left elbow: a sleeve and the drum of the elbow's roll."""
    sleeve = loft(
        "x",
        SHELL,
        [Section(-0.043, (0.0195, 0.0195)), Section(-0.008, (0.0215, 0.0215)), Section(0.012, (0.014, 0.014))],
        caps="none",
    )
    drum = loft("z", GREY, [Section(-0.024, (0.016, 0.016)), Section(0.024, (0.016, 0.016))], 8)
    return join([sleeve, drum])


def forearm() -> Surface:
    """Returns the left forearm."""
    return loft(
        "x",
        [WHITE, WHITE, WHITE, ORANGE],
        [
            Section(0.004, (0.017, 0.017), (0.002, 0)),
            Section(0.014, (0.025, 0.025), (0.002, 0)),
            Section(0.034, (0.027, 0.027), (0.002, 0)),
            Section(0.047, (0.0245, 0.0245)),
            Section(0.053, (0.0235, 0.0235)),
        ],
    )


def hand() -> Surface:
    """Returns the left hand: wrist, palm and the seats of the fingers."""
    palm = loft(
        "x",
        [GREY, WHITE, WHITE, WHITE],
        [
            Section(-0.004, (0.019, 0.019)),
            Section(0.010, (0.021, 0.021)),
            Section(0.026, (0.025, 0.023), (0, 0.001), 2.4),
            Section(0.050, (0.026, 0.022), (0, 0.001), 2.6),
            Section(0.066, (0.021, 0.013), (0, 0.001), 2.6),
        ],
        caps="high",
    )
    return palm.painted(GREY, lambda c: (c[2] < -0.008) & (c[0] > 0.015))


def phalanx() -> Surface:
    """Returns an inner phalanx, along x."""
    return _finger_segment([SHELL] * 3, 0.0125)


def fingertip() -> Surface:
    """Returns the last phalanx, with its dark tip."""
    return _finger_segment([SHELL, SHELL, DARK], 0.0095)


def _finger_segment(colors: Sequence[int], shaft: float) -> Surface:
    return loft(
        "x",
        colors,
        [
            Section(-0.005, (0, 0)),
            Section(0.001, (0.0058, 0.0058)),
            Section(shaft, (0.0058, 0.0058)),
            Section(0.0172, (0, 0)),
        ],
        segments=7,
    )
