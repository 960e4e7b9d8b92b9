"""Meshes: what a body of the simulator looks like, as a file that browsers draw."""

from __future__ import annotations

import numpy as np
import sapien
import trimesh
from mani_skill.utils.geometry.trimesh_utils import get_render_shape_meshes
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

FINEST = 2_000
"""From this size on, a mesh is drawn coarser [triangles]."""
GRAIN = 0.003
"""Then vertices as near as this are one [m]."""


def glb(entity: sapien.Entity) -> bytes:
    """Return all that is visible of a body, in its own frame, as a GLB file."""
    body = entity.find_component_by_type(sapien.render.RenderBodyComponent)
    scene = trimesh.Scene()
    for shape in body.render_shapes:
        for mesh in _meshes(shape):
            scene.add_geometry(mesh)
    return scene.export(file_type="glb")


def _meshes(shape: sapien.render.RenderShape) -> list[trimesh.Trimesh]:
    if not isinstance(shape, sapien.render.RenderShapeTriangleMesh):
        found = get_render_shape_meshes(shape)
        for mesh in found:
            mesh.visual = TextureVisuals(material=_material(shape.parts[0].material))
        return found
    frame = shape.local_pose.to_transformation_matrix()
    found = [_mesh(part, shape.scale) for part in shape.parts]
    return [mesh.apply_transform(frame) for mesh in found if len(mesh.faces)]


def _mesh(
    part: sapien.render.RenderShapeTriangleMeshPart, scale: np.ndarray
) -> trimesh.Trimesh:
    vertices, faces = part.vertices * scale, part.triangles
    uv, normals = part.get_vertex_uv(), part.get_vertex_normal()
    if len(faces) > FINEST:  # what is merged has neither
        (vertices, faces), uv, normals = coarser(vertices, faces), None, None
    visual = TextureVisuals(uv, _material(part.material))
    return trimesh.Trimesh(
        vertices, faces, vertex_normals=normals, visual=visual, process=False
    )


def coarser(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge vertices [V, 3] that share a cell of `GRAIN`, and drop what collapses."""
    cells = np.round(vertices / GRAIN).astype(int)
    _, first, which = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    faces = which.reshape(-1)[faces]
    a, b, c = faces.T
    return vertices[first], faces[(a != b) & (b != c) & (c != a)]


def _material(given: sapien.render.RenderMaterial) -> PBRMaterial:
    texture = given.base_color_texture
    picture = None if texture is None else Image.fromarray(texture.download())
    return PBRMaterial(
        baseColorFactor=[round(255 * c) for c in given.base_color],
        baseColorTexture=picture,
        metallicFactor=0.0,
        roughnessFactor=float(given.roughness),
    )
