"""What NAO looks like: the surface of every link, in the frame of the link.

The left side is drawn; the right side is its mirror image. Lengths are in [m].
"""

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
    (255, 160, 56),  # ORANGE: accents
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
    pieces = [torso(), head().moved(frames["Head"])]
    for link, surface in (("Thigh", thigh()), ("Tibia", shin()), ("_ankle", foot())):
        left, right = ("l", "r") if link[0] == "_" else ("L", "R")
        pieces.append(surface.moved(frames[left + link]))
        pieces.append(surface.mirrored().moved(frames[right + link]))
    return join(pieces)


def torso() -> Surface:
    """Returns the trunk with neck, chest button and sonars."""
    button = knob(
        [SHELL, GREY, GLOW],
        [(0, 0.017), (0.005, 0.0145), (0.006, 0.0095)],
        segments=10,
    ).shifted(0.051, 0, 0.055)
    sonar = _spot(DARK, 0.0085, segments=8).turned(0, 0.06, 0.3)
    sonar = sonar.shifted(0.0525, 0.023, 0.018)
    neck = loft(
        "z",
        GREY,
        [Section(0.114, (0.022, 0.022)), Section(0.138, (0.019, 0.019))],
        segments=8,
        caps="none",
    )
    return join([_trunk(), neck, button, sonar, sonar.mirrored()])


def _trunk() -> Surface:
    shell = loft(
        "z",
        [GREY, GREY, WHITE, WHITE, WHITE, WHITE, WHITE, WHITE],
        [
            Section(-0.122, (0.028, 0.034), power=2.4),
            Section(-0.104, (0.040, 0.046), power=2.4),
            Section(-0.076, (0.046, 0.056), power=2.4),
            Section(-0.042, (0.044, 0.052), power=2.3),
            Section(-0.004, (0.049, 0.061), power=2.3),
            Section(0.040, (0.054, 0.072), power=2.3),
            Section(0.082, (0.053, 0.075), power=2.3),
            Section(0.108, (0.043, 0.063), power=2.2),
            Section(0.121, (0.025, 0.034)),
        ],
        segments=16,
    )
    flank = shell.painted(
        ORANGE, lambda c: (abs(c[1]) > 0.044) & (c[2] > -0.03) & (c[2] < 0.09)
    )
    return flank.painted(
        SHELL,
        lambda c: (c[0] < -0.03) & (abs(c[1]) < 0.035) & (c[2] > 0) & (c[2] < 0.09),
    )


def head() -> Surface:
    """Returns the round head with eyes, ears, cameras and touch sensors."""
    camera = knob([SHELL, BLACK], [(0, 0.0075), (0.003, 0.0055)], 8)
    return join(
        [
            _skull(),
            _eye(),
            _eye().mirrored(),
            _ear(),
            _ear().mirrored(),
            _crown(),
            camera.turned(0, -0.35, 0).shifted(0.0585, 0, 0.0790),
            camera.turned(0, 0.6, 0).shifted(0.0535, 0, 0.0180),
        ]
    )


def _skull() -> Surface:
    skull = loft(
        "z",
        WHITE,
        [
            Section(-0.008, (0.024, 0.026)),
            Section(0.003, (0.044, 0.046), power=2.2),
            Section(0.024, (0.058, 0.060), power=2.3),
            Section(0.050, (0.0625, 0.0645), power=2.3),
            Section(0.076, (0.059, 0.060), power=2.3),
            Section(0.097, (0.043, 0.044), power=2.2),
            Section(0.109, (0.021, 0.022)),
            Section(0.112, (0, 0)),
        ],
        segments=16,
        caps="none",
    )
    return skull.painted(
        ORANGE, lambda c: (c[0] < -0.03) & (abs(c[1]) < 0.03) & (c[2] > 0.03)
    )


def _eye() -> Surface:
    eye = knob(
        [BLACK, CYAN, BLACK],
        [(0, 0.0190), (0.0045, 0.0168), (0.0060, 0.0098)],
        segments=12,
    )
    highlight = _spot(GLOW, 0.0030, segments=5).shifted(0.0065, -0.0035, 0.0045)
    return join([eye, highlight]).turned(0, -0.04, 0.48).shifted(0.0535, 0.0280, 0.0485)


def _ear() -> Surface:
    disc = knob(
        [SHELL, GREY, WHITE],
        [(0, 0.030), (0.0095, 0.0275), (0.0110, 0.0200)],
        segments=12,
    )
    return disc.turned(0, 0, np.pi / 2).shifted(-0.006, 0.0585, 0.050)


def _crown() -> Surface:
    """Returns the three touch sensors on top of the head, front to back."""
    return loft(
        "x",
        [GREY, DARK, GREY],
        [
            Section(-0.036, (0.009, 0.004), (0, 0.0985)),
            Section(-0.014, (0.013, 0.006), (0, 0.1095)),
            Section(0.014, (0.013, 0.006), (0, 0.1095)),
            Section(0.036, (0.009, 0.004), (0, 0.0985)),
        ],
        segments=6,
    )


def thigh() -> Surface:
    """Returns the left thigh with the knee drum."""
    shell = loft(
        "z",
        WHITE,
        [
            Section(-0.094, (0.023, 0.022)),
            Section(-0.074, (0.031, 0.028), (0.002, 0.002), 2.4),
            Section(-0.030, (0.037, 0.032), (0.002, 0.004), 2.4),
            Section(-0.002, (0.036, 0.031), (0, 0.004), 2.4),
            Section(0.022, (0.022, 0.021), (-0.004, 0.002)),
        ],
        caps="high",
    )
    shell = shell.painted(
        ORANGE, lambda c: (c[1] > 0.021) & (c[2] > -0.06) & (c[2] < 0)
    )
    drum = loft(
        "y",
        GREY,
        [Section(-0.026, (0.0235, 0.0235)), Section(0.029, (0.0235, 0.0235))],
    ).painted(ORANGE, lambda c: c[1] > 0.028)
    return join([shell, drum.shifted(0, 0, -0.1)])


def shin() -> Surface:
    """Returns the left shin."""
    return loft(
        "z",
        [GREY, WHITE, WHITE, WHITE],
        [
            Section(-0.110, (0.023, 0.023)),
            Section(-0.094, (0.033, 0.031), (0, 0.001), 2.3),
            Section(-0.062, (0.038, 0.034), (-0.001, 0.002), 2.4),
            Section(-0.028, (0.033, 0.030), (0.002, 0.002), 2.4),
            Section(-0.008, (0.022, 0.024), (0.005, 0.001)),
        ],
        caps="high",
    )


def foot() -> Surface:
    """Returns the left foot, sole at z = -0.04511."""
    return loft(
        "z",
        [DARK, WHITE, WHITE, GREY],
        [
            Section(-0.04511, (0.078, 0.033), (0.022, 0.002), 3.0),
            Section(-0.038, (0.080, 0.035), (0.022, 0.002), 3.0),
            Section(-0.022, (0.071, 0.033), (0.018, 0.002), 2.6),
            Section(-0.008, (0.043, 0.029), (0.004, 0.001), 2.2),
            Section(0.012, (0.024, 0.024)),
        ],
        segments=12,
        caps="none",
    )


def shoulder() -> Surface:
    """Returns the left shoulder: the drum between trunk and upper arm."""
    return loft(
        "y",
        [GREY, DARK],
        [
            Section(-0.042, (0.026, 0.026)),
            Section(-0.024, (0.029, 0.029)),
            Section(-0.010, (0.022, 0.022)),
        ],
        segments=12,
        caps="none",
    )


def bicep() -> Surface:
    """Returns the left upper arm with the shoulder cap."""
    shell = loft(
        "x",
        WHITE,
        [
            Section(-0.0360, (0, 0)),
            Section(-0.0290, (0.018, 0.019), (0.001, 0)),
            Section(-0.0120, (0.030, 0.031), (0.002, 0)),
            Section(0.0200, (0.031, 0.032), (0.007, 0)),
            Section(0.0640, (0.0225, 0.0235), (0.015, 0)),
        ],
    )
    return shell.painted(ORANGE, lambda c: (c[1] > 0.016) & (abs(c[0]) < 0.03))


def elbow() -> Surface:
    """Returns the left elbow: a sleeve and the drum of the elbow's roll."""
    sleeve = loft(
        "x",
        SHELL,
        [
            Section(-0.043, (0.0190, 0.0190)),
            Section(-0.010, (0.0205, 0.0205)),
            Section(0.012, (0.013, 0.013)),
        ],
        caps="none",
    )
    rims = [Section(z, (0.0165, 0.0165)) for z in (-0.0225, 0.0225)]
    return join([sleeve, loft("z", GREY, rims, segments=10)])


def forearm() -> Surface:
    """Returns the left forearm."""
    return loft(
        "x",
        [WHITE, WHITE, WHITE, ORANGE],
        [
            Section(0.005, (0.015, 0.015), (0.001, 0)),
            Section(0.014, (0.024, 0.024), (0.002, 0)),
            Section(0.032, (0.027, 0.027), (0.002, 0)),
            Section(0.046, (0.0250, 0.0250), (0.001, 0)),
            Section(0.053, (0.0240, 0.0240)),
        ],
        lid=GREY,
    )


def hand() -> Surface:
    """Returns the left hand: wrist, palm and the seats of the fingers."""
    palm = loft(
        "x",
        [GREY, WHITE, WHITE, WHITE],
        [
            Section(-0.004, (0.019, 0.019)),
            Section(0.010, (0.021, 0.021)),
            Section(0.028, (0.026, 0.025), (0, 0), 2.4),
            Section(0.053, (0.026, 0.024), (0, -0.002), 2.5),
            Section(0.067, (0.021, 0.011), (0, -0.001), 2.5),
        ],
        caps="high",
        lid=GREY,
    )
    return palm.painted(GREY, lambda c: (c[2] < -0.008) & (c[0] > 0.012))


def phalanx() -> Surface:
    """Returns an inner phalanx, along x."""
    return loft(
        "x",
        SHELL,
        [
            Section(-0.0058, (0, 0)),
            Section(-0.0005, (0.0059, 0.0059)),
            Section(0.0130, (0.0059, 0.0059)),
            Section(0.0188, (0, 0)),
        ],
        segments=6,
        caps="none",
    )


def fingertip() -> Surface:
    """Returns the last phalanx; its open foot hides in the one before."""
    return loft(
        "x",
        [SHELL, DARK, DARK],
        [
            Section(-0.0025, (0.0052, 0.0052)),
            Section(0.0080, (0.0060, 0.0060)),
            Section(0.0142, (0.0046, 0.0046)),
            Section(0.0170, (0, 0)),
        ],
        segments=6,
        caps="none",
    )


def _spot(color: int, radius: float, segments: int) -> Surface:
    """Returns a flat disc at the origin that looks along +x."""
    return knob([color], [(0, radius)], segments)
