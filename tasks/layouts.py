"""Where the objects lie, in the torso frame: x forward, y left [m]."""

from ir_maniskill.experiment import TouchObject


def line(shape: str) -> tuple[TouchObject, ...]:
    """Return three objects side by side, blue in the middle (experiments I, II)."""
    return (
        TouchObject("blue", (0.20, 0.0), shape),
        TouchObject("red", (0.20, 0.10), shape),
        TouchObject("green", (0.20, -0.10), shape),
    )


def triangle(shape: str) -> tuple[TouchObject, ...]:
    """Return three objects in a triangle, blue nearest the chest (experiment III)."""
    return (
        TouchObject("blue", (0.19, 0.0), shape),
        TouchObject("red", (0.23, 0.08), shape),
        TouchObject("green", (0.23, -0.08), shape),
    )
