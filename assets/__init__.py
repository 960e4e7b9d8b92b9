"""What is loaded from files: robot, scene, shaders, word vectors and policies."""

from pathlib import Path

FOLDER = Path(__file__).parent
"""Where they are."""
