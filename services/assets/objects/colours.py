"""Colours of mesh files: their textures, materials and coloured vertices, at surface points."""

import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from trimesh.visual.color import uv_to_interpolated_color

from congrasp.common.errors import CongraspError
from congrasp.common.objects.spec import COLOUR_POINTS, Colours
from congrasp.common.runtime.resources import cores
from congrasp.services.assets.objects.mesh_files import load_geometry, up_of, upright
from congrasp.services.assets.objects.options import Up

_DEFAULT_COLOUR = (102, 102, 102)
"""Colour of a material in trimesh whose file does not specify one."""
_CANDIDATES_PER_POINT = 8
"""Points that are compared, for each point of the result."""
_NEIGHBOURS = 6
_EVEN_CHANGE = 1e-3
"""Change of colour that an even surface has, so that its points can be drawn."""


def sample_colours(
    paths: Sequence[pathlib.Path], seed: int, up: Up = "auto", notes: list[str] | None = None
) -> Colours | None:
    """Samples points of the surfaces of mesh files, more of them where colours change.

    Args:
      paths: the files.
      seed: seed of the points.
      up: axis that points up in the files (`read_mesh`).
      notes: names of missing pictures are appended.

    Returns:
      `COLOUR_POINTS` of them, in the files' unit, z up; None if no file has any colour.

    Raises:
      CongraspError: a file cannot be read with its colours.
    """
    try:
        meshes: list[trimesh.Trimesh] = []
        for path in paths:
            meshes += _meshes(path, up, notes)
        if not any(_has_colours(mesh.visual) for mesh in meshes):
            return None
        return _sample_meshes(meshes, np.random.default_rng(seed))
    except Exception as error:  # pictures and texture coordinates of files raise whatever they hold
        message = str(error) or type(error).__name__
        reason = message.splitlines()[0][:100].rstrip(" .!")
        raise CongraspError(
            f"The colours of {paths[0]} cannot be read: {reason}.", "Export it without textures."
        ) from None


def _meshes(path: pathlib.Path, up: Up, notes: list[str] | None) -> list[trimesh.Trimesh]:
    """Meshes of a file's scene, placed as in the scene, with z up."""
    geometry = load_geometry(path, "Export it without textures.", notes=notes)
    parts = geometry.dump() if isinstance(geometry, trimesh.Scene) else [geometry]
    meshes = [part for part in parts if isinstance(part, trimesh.Trimesh) and part.area > 0]
    for mesh in meshes:
        mesh.vertices = upright(mesh.vertices, up_of(geometry, up))
    return meshes


def _has_colours(visual: Any) -> bool:
    """True if a file specifies the look of a mesh; an unreadable image does not count."""
    if visual is None:
        return False
    if visual.kind != "texture":
        return visual.defined
    if _image(visual.material) is not None:
        return True
    return tuple(visual.material.main_color[:3]) != _DEFAULT_COLOUR


def _image(material: Any) -> Any:
    """Image of a material's colour, if it has one."""
    return getattr(material, "baseColorTexture", None) or getattr(material, "image", None)


def _sample_meshes(meshes: list[trimesh.Trimesh], rng: np.random.Generator) -> Colours:
    """Samples `COLOUR_POINTS` of all meshes.

    The first half is spread evenly over the surfaces. The other half is where colours change, so
    that their edges are known to a fraction of a millimetre.
    """
    dense = _sample_evenly(meshes, _CANDIDATES_PER_POINT * COLOUR_POINTS, rng)
    order = rng.permutation(len(dense.points))
    even = order[: COLOUR_POINTS // 2]
    others = order[COLOUR_POINTS // 2 :]
    changes = _changes(dense)[others] + _EVEN_CHANGE
    count = COLOUR_POINTS - len(even)
    at_edges = rng.choice(others, count, replace=False, p=changes / changes.sum())
    chosen = np.concatenate([even, at_edges])
    return Colours(dense.points[chosen], dense.values[chosen])


def _changes(dense: Colours) -> np.ndarray:
    """(n,) largest difference of a point's colour to those of its nearest points, 0 to 255."""
    tree = cKDTree(dense.points)
    nearest = tree.query(dense.points, k=_NEIGHBOURS, workers=cores())[1]
    values = dense.values.astype(np.int16)
    return np.abs(values[nearest] - values[:, None]).max(axis=(1, 2)).astype(float)


def _sample_evenly(meshes: list[trimesh.Trimesh], total: int, rng: np.random.Generator) -> Colours:
    """Samples points of all meshes, in proportion to their areas."""
    areas = np.array([mesh.area for mesh in meshes])
    counts = rng.multinomial(total, areas / areas.sum())
    points = []
    colours = []
    for mesh, count in zip(meshes, counts, strict=True):
        if not count:
            continue
        mesh_points, mesh_colours = _sample_mesh(mesh, int(count), rng)
        points.append(mesh_points)
        colours.append(mesh_colours)
    return Colours(np.concatenate(points), np.concatenate(colours))


def _sample_mesh(
    mesh: trimesh.Trimesh, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Samples points (count, 3) on a mesh, and their colours (count, 3) uint8."""
    points, faces, weights = trimesh.sample.sample_surface(
        mesh, count, return_barycentric=True, seed=rng
    )
    corners = mesh.faces[faces]
    visual: Any = mesh.visual
    if visual.kind == "texture":
        uv = None
        if visual.uv is not None:
            uv = np.einsum("nk,nkd->nd", weights, visual.uv[corners])
        colours = _material_colours(visual.material, uv, count)
    elif visual.kind == "vertex":
        colours = np.einsum("nk,nkd->nd", weights, visual.vertex_colors[corners])
    else:
        colours = visual.face_colors[faces]
    return points, np.clip(np.round(colours[:, :3]), 0, 255).astype(np.uint8)


def _material_colours(material: Any, uv: np.ndarray | None, count: int) -> np.ndarray:
    """Colours (count, 3) from 0 to 255 of a material: its image times its tint.

    Args:
      material: a material of trimesh.
      uv: (count, 2) texture coordinates, if the mesh has any.
      count: number of points.
    """
    image = _image(material)
    if image is None or uv is None:
        return np.broadcast_to(np.asarray(material.main_color, float)[:3], (count, 3))
    if not np.isfinite(uv).all():
        raise ValueError("texture coordinates are not all numbers")
    factor = getattr(material, "baseColorFactor", None)  # the image of an OBJ has none
    tint = np.ones(3) if factor is None else np.asarray(factor, float)[:3] / 255
    return uv_to_interpolated_color(uv, image)[:, :3] * tint
