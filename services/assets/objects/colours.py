"""Colours of an imported object: textures, materials and colours of its files at points of its surface."""

import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from trimesh.visual.color import uv_to_interpolated_color

from congrasp.common.errors import CongraspError
from congrasp.common.objects.spec import COLOUR_POINTS, Colours
from congrasp.services.assets.objects.mesh_files import load_geometry, up_of, upright
from congrasp.services.assets.objects.options import Up

_UNSAID = (102, 102, 102)  # default colour of a material in trimesh


def sample_colours(
    paths: Sequence[pathlib.Path], seed: int, up: Up = "auto", notes: list[str] | None = None
) -> Colours | None:
    """Samples points evenly over the surfaces of mesh files, with their colours.

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
        meshes = [mesh for path in paths for mesh in _meshes(path, up, notes)]
        if not any(_has_colours(mesh.visual) for mesh in meshes):
            return None
        rng = np.random.default_rng(seed)
        areas = np.array([mesh.area for mesh in meshes])
        counts = rng.multinomial(COLOUR_POINTS, areas / areas.sum())
        sampled = [_sampled(mesh, int(count), rng) for mesh, count in zip(meshes, counts, strict=True) if count]
    except Exception as error:  # pictures and texture coordinates of files raise whatever they hold
        reason = (str(error) or type(error).__name__).splitlines()[0][:100].rstrip(" .!")
        raise CongraspError(f"The colours of {paths[0]} cannot be read: {reason}.") from None
    points, colours = (np.concatenate(parts) for parts in zip(*sampled, strict=True))
    return Colours(points.astype(np.float32), colours)


def _meshes(path: pathlib.Path, up: Up, notes: list[str] | None) -> list[trimesh.Trimesh]:
    """Meshes of a file's scene, placed as in the scene, with z up."""
    loaded = load_geometry(path, "Export it without textures.", notes=notes)
    parts = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
    meshes = [part for part in parts if isinstance(part, trimesh.Trimesh) and part.area > 0]
    for mesh in meshes:
        mesh.vertices = upright(mesh.vertices, up_of(loaded, up))
    return meshes


def _has_colours(visual: Any) -> bool:
    """True if a file specifies the look of a mesh; an unreadable image does not count."""
    if visual is None or visual.kind != "texture":
        return visual is not None and visual.defined
    return _image(visual.material) is not None or tuple(visual.material.main_color[:3]) != _UNSAID


def _image(material: Any) -> Any:
    """Image of a material's colour, if it has one."""
    return getattr(material, "baseColorTexture", None) or getattr(material, "image", None)


def _sampled(mesh: trimesh.Trimesh, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Samples points (count, 3) on a mesh, and their colours (count, 3)."""
    points, faces, weights = trimesh.sample.sample_surface(mesh, count, return_barycentric=True, seed=rng)
    corners = mesh.faces[faces]
    visual: Any = mesh.visual
    if visual.kind == "texture":
        uv = None if visual.uv is None else np.einsum("nk,nkd->nd", weights, visual.uv[corners])
        colours = _material(visual.material, uv, count)
    elif visual.kind == "vertex":
        colours = np.einsum("nk,nkd->nd", weights, visual.vertex_colors[corners])
    else:
        colours = visual.face_colors[faces]
    return points, np.clip(np.round(colours[:, :3]), 0, 255).astype(np.uint8)


def _material(material: Any, uv: np.ndarray | None, count: int) -> np.ndarray:
    """(count, 3) colours from 0 to 255 of a material at texture coordinates (count, 2): its image times its colour."""
    image = _image(material)
    if image is None or uv is None:
        return np.broadcast_to(np.asarray(material.main_color, float)[:3], (count, 3))
    tint = getattr(material, "baseColorFactor", None)  # an OBJ's image has no tint
    if not np.isfinite(uv).all():
        raise ValueError("texture coordinates are not all numbers")
    whole = np.ones(3) if tint is None else np.asarray(tint, float)[:3] / 255
    return uv_to_interpolated_color(uv, image)[:, :3] * whole
