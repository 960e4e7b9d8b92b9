"""The NAO V5 model: a URDF, and low-poly meshes that `build.py` writes."""

from pathlib import Path

URDF_PATH = Path(__file__).with_name("nao.urdf")
"""The robot, root link `torso` (x forward, y left, z up)."""

SOLE_HEIGHT = -0.319856
"""Height of the soles in the torso frame, where the ground belongs [m]."""
