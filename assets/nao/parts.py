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
    """Return every mesh by file name.

    Args:
        frames: Frame of every link in the torso's, in the posture to be merged.
    """
    arm = {"bicep": bicep(), "hand": hand()}
    meshes = {"torso": Part(body(frames), _BODY_LIGHT)}
    for name, surface in arm.items():
        meshes[f"l_{name}"] = Part(surface, _BODY_LIGHT)
        meshes[f"r_{name}"] = Part(surface.mirrored(), _BODY_LIGHT)
    meshes["phalanx"] = Part(phalanx(), _FINGER_LIGHT)
    meshes["fingertip"] = Part(fingertip(), _FINGER_LIGHT)
    return meshes


def body(frames: Frames) -> Surface:
    """Return all that never moves, and the shoulders, in the torso's frame."""
    shoulder = drum().shifted(0, 0.098, 0.1)
    pieces = [torso(), head().moved(frames["Head"]), shoulder, shoulder.mirrored()]
    for link, surface in (("Thigh", thigh()), ("Tibia", shin()), ("_ankle", foot())):
        left, right = ("l", "r") if link[0] == "_" else ("L", "R")
        pieces.append(surface.moved(frames[left + link]))
        pieces.append(surface.mirrored().moved(frames[right + link]))
    return join(pieces)


def torso() -> Surface:
    """Return the trunk with neck, chest button and sonars."""
    button = knob([GREY, GLOW], [(0, 0.0165), (0.006, 0.0105)], segments=8)
    sonar = _spot(DARK, 0.0085, segments=6).turned(0, 0.06, 0.3)
    sonar = sonar.shifted(0.0525, 0.023, 0.018)
    neck = loft(
        "z",
        GREY,
        [Section(0.114, (0.022, 0.022)), Section(0.138, (0.019, 0.019))],
        segments=6,
        caps="none",
    )
    return join(
        [_trunk(), neck, button.shifted(0.0515, 0, 0.055), sonar, sonar.mirrored()]
    )


def _trunk() -> Surface:
    shell = loft(
        "z",
        [GREY, WHITE, WHITE, WHITE, WHITE],
        [
            Section(-0.122, (0.030, 0.036), power=2.4),
            Section(-0.080, (0.046, 0.056), power=2.4),
            Section(-0.036, (0.045, 0.053), power=2.3),
            Section(0.036, (0.054, 0.072), power=2.3),
            Section(0.092, (0.050, 0.072), power=2.3),
            Section(0.121, (0.025, 0.034)),
        ],
        segments=12,
        caps="low",
    )
    flank = shell.painted(
        ORANGE,
        lambda c: (abs(c[1]) > 1.3 * abs(c[0])) & (c[2] > -0.03) & (c[2] < 0.09),
    )
    return flank.painted(SHELL, lambda c: _behind(c) & (c[2] > -0.03) & (c[2] < 0.09))


def _behind(middles: np.ndarray) -> np.ndarray:
    """Return which cells face the back of what is round about the z axis."""
    return (middles[0] < 0) & (abs(middles[1]) < 1.2 * abs(middles[0]))


def head() -> Surface:
    """Return the round head with eyes, ears, cameras and touch sensors."""
    camera = _spot(BLACK, 0.0062, segments=6)
    return join(
        [
            _skull(),
            _eye(),
            _eye().mirrored(),
            _ear(),
            _ear().mirrored(),
            _crown(),
            camera.turned(0, -0.35, 0).shifted(0.0600, 0, 0.0790),
            camera.turned(0, 0.6, 0).shifted(0.0550, 0, 0.0180),
        ]
    )


def _skull() -> Surface:
    skull = loft(
        "z",
        WHITE,
        [
            Section(-0.005, (0.020, 0.021)),
            Section(0.020, (0.057, 0.059), power=2.3),
            Section(0.050, (0.0630, 0.0650), power=2.3),
            Section(0.079, (0.058, 0.059), power=2.3),
            Section(0.101, (0.038, 0.039), power=2.2),
            Section(0.112, (0, 0)),
        ],
        segments=12,
        caps="none",
    )
    return skull.painted(ORANGE, lambda c: _behind(c) & (c[2] > 0.03) & (c[2] < 0.1))


def _eye() -> Surface:
    eye = knob(
        [BLACK, CYAN, BLACK],
        [(0, 0.0190), (0.0045, 0.0168), (0.0060, 0.0098)],
        segments=10,
    )
    highlight = _spot(GLOW, 0.0032, segments=4).shifted(0.0065, -0.0035, 0.0045)
    return join([eye, highlight]).turned(0, -0.04, 0.48).shifted(0.0535, 0.0280, 0.0485)


def _ear() -> Surface:
    disc = knob(
        [SHELL, GREY, WHITE],
        [(0, 0.030), (0.0095, 0.0280), (0.0110, 0.0205)],
        segments=8,
    )
    return disc.turned(0, 0, np.pi / 2).shifted(-0.006, 0.0585, 0.050)


def _crown() -> Surface:
    """Return the three touch sensors on top of the head, front to back."""
    return loft(
        "x",
        [GREY, DARK, GREY],
        [
            Section(-0.036, (0.012, 0.006), (0, 0.0985)),
            Section(-0.014, (0.017, 0.008), (0, 0.1095)),
            Section(0.014, (0.017, 0.008), (0, 0.1095)),
            Section(0.036, (0.012, 0.006), (0, 0.0985)),
        ],
        segments=4,
        caps="none",
    )


def thigh() -> Surface:
    """Return the left thigh, which ends in the knee."""
    shell = loft(
        "z",
        [GREY, WHITE, WHITE],
        [
            Section(-0.116, (0.023, 0.026)),
            Section(-0.080, (0.030, 0.029), (0.002, 0.002), 2.4),
            Section(-0.016, (0.039, 0.034), (0.002, 0.004), 2.4),
            Section(0.022, (0.022, 0.021), (-0.004, 0.002)),
        ],
        segments=6,
        caps="none",
    )
    return shell.painted(ORANGE, lambda c: (c[1] > 0.012) & (c[2] > -0.06) & (c[2] < 0))


def shin() -> Surface:
    """Return the left shin."""
    return loft(
        "z",
        [GREY, WHITE, WHITE],
        [
            Section(-0.110, (0.026, 0.026)),
            Section(-0.092, (0.035, 0.033), (0, 0.001), 2.3),
            Section(-0.046, (0.040, 0.036), (0, 0.002), 2.4),
            Section(-0.008, (0.022, 0.024), (0.005, 0.001)),
        ],
        segments=6,
        caps="none",
    )


def foot() -> Surface:
    """Return the left foot, sole at z = -0.04511."""
    return loft(
        "z",
        [DARK, WHITE],
        [
            Section(-0.04511, (0.080, 0.035), (0.022, 0.002), 3.0),
            Section(-0.036, (0.081, 0.036), (0.022, 0.002), 3.0),
            Section(-0.002, (0.032, 0.027), (0.002, 0.001), 2.2),
        ],
        segments=8,
        caps="none",
    )


def drum() -> Surface:
    """Return the left shoulder's drum, round about the axis it turns on."""
    return loft(
        "y",
        [GREY, DARK],
        [
            Section(-0.042, (0.026, 0.026)),
            Section(-0.024, (0.029, 0.029)),
            Section(-0.010, (0.022, 0.022)),
        ],
        segments=8,
        caps="none",
    )


def bicep() -> Surface:
    """Return the left upper arm, from the shoulder's cap to the elbow's ball."""
    shell = loft(
        "x",
        WHITE,
        [
            Section(-0.0360, (0, 0)),
            Section(-0.0270, (0.020, 0.021), (0.001, 0)),
            Section(-0.0100, (0.031, 0.032), (0.002, 0)),
            Section(0.0200, (0.031, 0.032), (0.007, 0)),
            Section(0.0640, (0.0225, 0.0235), (0.015, 0)),
        ],
        segments=8,
        caps="high",
    )
    shell = shell.painted(ORANGE, lambda c: (c[1] > 0.016) & (abs(c[0]) < 0.03))
    return join([shell, elbow().shifted(0.105, 0.015, 0)])


def elbow() -> Surface:
    """Return the left elbow: a sleeve and a ball, round about the axis of the yaw."""
    return loft(
        "x",
        [SHELL, GREY, GREY],
        [
            Section(-0.043, (0.0190, 0.0190)),
            Section(-0.010, (0.0215, 0.0215)),
            Section(0.012, (0.0190, 0.0190)),
            Section(0.022, (0, 0)),
        ],
        segments=8,
        caps="none",
    )


def hand() -> Surface:
    """Return the left hand: forearm, wrist, palm and the seats of the fingers."""
    palm = loft(
        "x",
        [GREY, WHITE, WHITE],
        [
            Section(-0.004, (0.020, 0.020)),
            Section(0.012, (0.022, 0.022)),
            Section(0.042, (0.0275, 0.026), (0, -0.001), 2.5),
            Section(0.067, (0.022, 0.011), (0, -0.001), 2.5),
        ],
        segments=8,
        caps="high",
        lid=GREY,
    )
    palm = palm.painted(GREY, lambda c: (c[2] < -0.008) & (c[0] > 0.012))
    return join([forearm().shifted(-0.05595, 0, 0), palm])


def forearm() -> Surface:
    """Return the left forearm, round about the axis of the wrist."""
    return loft(
        "x",
        [WHITE, WHITE, ORANGE],
        [
            Section(0.004, (0.015, 0.015)),
            Section(0.017, (0.0265, 0.0265)),
            Section(0.045, (0.0260, 0.0260)),
            Section(0.053, (0.0240, 0.0240)),
        ],
        segments=8,
        caps="high",
        lid=GREY,
    )


def phalanx() -> Surface:
    """Return an inner phalanx, along x."""
    return loft(
        "x",
        SHELL,
        [
            Section(-0.0058, (0, 0)),
            Section(-0.0005, (0.0060, 0.0060)),
            Section(0.0130, (0.0060, 0.0060)),
            Section(0.0188, (0, 0)),
        ],
        segments=5,
        caps="none",
    )


def fingertip() -> Surface:
    """Return the last phalanx; its open foot hides in the one before."""
    return loft(
        "x",
        [SHELL, DARK, DARK],
        [
            Section(-0.0025, (0.0053, 0.0053)),
            Section(0.0080, (0.0061, 0.0061)),
            Section(0.0142, (0.0046, 0.0046)),
            Section(0.0170, (0, 0)),
        ],
        segments=5,
        caps="none",
    )


def _spot(color: int, radius: float, segments: int) -> Surface:
    """Return a flat disc at the origin that looks along +x."""
    return knob([color], [(0, radius)], segments)
