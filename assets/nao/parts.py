"""What NAO looks like: the surface of every link, in the frame of the link.

The left side is drawn; the right side is its mirror image. Lengths are in [m].
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from . import facts
from .facts import Frames
from .shapes import Section, Surface, join, loft


class Color(IntEnum):
    """A swatch of the palette."""

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

SHELLS = {
    "trunk": ("z", 12),
    "neck": ("z", 6),
    "button": ("x", 8),  # on the chest
    "skull": ("z", 12),
    "eye": ("x", 10),
    "ear": ("x", 8),
    "crown": ("x", 4),  # the three touch sensors on the head, front to back
    "thigh": ("z", 6),  # ends in the knee
    "shin": ("z", 6),
    "foot": ("z", 8),  # its sole at z = -0.04511
    "drum": ("y", 8),  # of the shoulder, round about the axis it turns on
    "bicep": ("x", 8),  # from the shoulder's cap
    "elbow": ("x", 8),  # a sleeve and a ball, round about the axis of the yaw
    "forearm": ("x", 8),  # round about the axis of the wrist
    "palm": ("x", 8),  # and the seats of the fingers
    "phalanx": ("x", 5),
    "fingertip": ("x", 5),  # its open foot hides in the phalanx before
}
"""Axis and points per section of each shell in `facts/shells.csv`."""


@dataclass(frozen=True)
class Part:
    """One mesh file."""

    surface: Surface
    """What is drawn."""
    light: tuple[float, float, float] = (0.35, 0.0, 1.0)
    """Where the baked light comes from, in the frame of the link."""


def parts(frames: Frames) -> dict[str, Part]:
    """Return every mesh by file name.

    Args:
        frames: Frame of every link in the torso's, in the posture to be merged.
    """
    meshes = {"torso": Part(body(frames))}
    for name, surface in (("bicep", bicep()), ("hand", hand())):
        meshes[f"l_{name}"] = Part(surface)
        meshes[f"r_{name}"] = Part(surface.mirrored())
    for name in ("phalanx", "fingertip"):
        # Lit from the back of the finger, see the folder's README.
        meshes[name] = Part(shell(name), light=(0.0, 1.0, 0.0))
    return meshes


def shell(name: str, base: int | None = None) -> Surface:
    """Return a shell of the table; `base` is the color of a lid at its low end."""
    sections = [
        Section(
            at=float(row["at_m"]),
            half=(float(row["half_u_m"]), float(row["half_v_m"])),
            color=Color[row["color"].upper()] if row["color"] else None,
            center=(float(row["center_u_m"]), float(row["center_v_m"])),
            power=float(row["power"]),
        )
        for row in facts.read("shells")
        if row["shell"] == name
    ]
    return loft(*SHELLS[name], sections, base)


def body(frames: Frames) -> Surface:
    """Return all that never moves, and the shoulders, in the torso's frame."""
    pieces = [torso(), head().moved(frames["Head"])]
    pieces += _both(shell("drum").shifted(0, 0.098, 0.1))
    legs = {"Thigh": thigh(), "Tibia": shell("shin"), "_ankle": shell("foot")}
    for link, surface in legs.items():
        left, right = ("l", "r") if link[0] == "_" else ("L", "R")
        pieces.append(surface.moved(frames[left + link]))
        pieces.append(surface.mirrored().moved(frames[right + link]))
    return join(pieces)


def torso() -> Surface:
    """Return the trunk with neck, chest button and sonars."""
    button = shell("button").shifted(0.0515, 0, 0.055)
    sonar = _spot(Color.DARK, 0.0085, points=6).turned(0, 0.06, 0.3)
    sonars = _both(sonar.shifted(0.0525, 0.023, 0.018))
    return join([_trunk(), shell("neck"), button, *sonars])


def _trunk() -> Surface:
    trunk = shell("trunk", base=Color.GREY)
    flank = trunk.painted(
        Color.ORANGE,
        lambda c: (abs(c[1]) > 1.3 * abs(c[0])) & (c[2] > -0.03) & (c[2] < 0.09),
    )
    return flank.painted(
        Color.SHELL, lambda c: _behind(c) & (c[2] > -0.03) & (c[2] < 0.09)
    )


def _behind(middles: np.ndarray) -> np.ndarray:
    """Return which cells face the back of what is round about the z axis."""
    return (middles[0] < 0) & (abs(middles[1]) < 1.2 * abs(middles[0]))


def head() -> Surface:
    """Return the round head with eyes, ears, cameras and touch sensors."""
    skull = shell("skull").painted(
        Color.ORANGE, lambda c: _behind(c) & (c[2] > 0.03) & (c[2] < 0.1)
    )
    ear = shell("ear").turned(0, 0, np.pi / 2).shifted(-0.006, 0.0585, 0.050)
    camera = _spot(Color.BLACK, 0.0062, points=6)
    cameras = (
        camera.turned(0, -0.35, 0).shifted(0.0600, 0, 0.0790),
        camera.turned(0, 0.6, 0).shifted(0.0550, 0, 0.0180),
    )
    return join([skull, *_both(_eye()), *_both(ear), shell("crown"), *cameras])


def _eye() -> Surface:
    highlight = _spot(Color.GLOW, 0.0032, points=4).shifted(0.0065, -0.0035, 0.0045)
    eye = join([shell("eye"), highlight])
    return eye.turned(0, -0.04, 0.48).shifted(0.0535, 0.0280, 0.0485)


def thigh() -> Surface:
    """Return the left thigh."""
    return shell("thigh").painted(
        Color.ORANGE, lambda c: (c[1] > 0.012) & (c[2] > -0.06) & (c[2] < 0)
    )


def bicep() -> Surface:
    """Return the left upper arm, from the shoulder's cap to the elbow's ball."""
    arm = shell("bicep").painted(
        Color.ORANGE, lambda c: (c[1] > 0.016) & (abs(c[0]) < 0.03)
    )
    return join([arm, shell("elbow").shifted(0.105, 0.015, 0)])


def hand() -> Surface:
    """Return the left hand: forearm, wrist, palm and the seats of the fingers."""
    palm = shell("palm").painted(Color.GREY, lambda c: (c[2] < -0.008) & (c[0] > 0.012))
    return join([shell("forearm").shifted(-0.05595, 0, 0), palm])


def _both(surface: Surface) -> tuple[Surface, Surface]:
    """Return a surface of the left side, and its mirror image."""
    return surface, surface.mirrored()


def _spot(color: int, radius: float, points: int) -> Surface:
    """Return a flat disc at the origin that looks along +x."""
    return loft("x", points, [Section(0, (radius, radius), color)])
