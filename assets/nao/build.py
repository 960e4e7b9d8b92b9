"""Builds the meshes beside it: `python -m ir_maniskill.assets.nao.build`.

The same sources give the same files. What never moves is merged, in the posture of
`facts/posture.csv`, into the mesh of the link `torso`.
"""

from pathlib import Path

from . import facts
from .parts import PALETTE, parts
from .shapes import bake

FOLDER = Path(__file__).with_name("meshes")


def meshes() -> dict[str, bytes]:
    """Return the content of every mesh file by file name."""
    return {
        f"{name}.glb": bake(part.surface, PALETTE, part.light).export(
            file_type="glb", include_normals=True
        )
        for name, part in parts(facts.link_frames()).items()
    }


def main() -> None:
    """Write every mesh."""
    for name, content in meshes().items():
        (FOLDER / name).write_bytes(content)


if __name__ == "__main__":
    main()
