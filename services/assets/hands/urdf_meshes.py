"""Meshes of a URDF file: searched as ROS does, and converted to formats that MuJoCo reads."""

import pathlib
import re
import urllib.parse
from typing import Any

import numpy as np
import trimesh

from congrasp.services.assets.hands.reading import MAX_FILE
from congrasp.services.assets.objects.file_kinds import SUFFIXES
from congrasp.services.assets.objects.mesh_files import load_geometry

_SEARCHED_PARENTS = 3
"""Parent folders of the URDF file's folder in which meshes are searched."""
_MIN_FLATNESS = 1e-6
"""Thickness relative to its length below which a mesh has no hull."""
_MAX_FACES = 50_000
"""Triangles of a mesh; MuJoCo's limit is 200,000, but two arms must fit into the memory."""
_REDUCED_FACES = 20_000
"""Triangles of a mesh that had more than that."""


def find_mesh(path: pathlib.Path, name: str) -> pathlib.Path | None:
    """Returns the file of a mesh; None if there is none.

    Args:
      path: the URDF file.
      name: name in it, relative to its folder or to a parent folder; leading folders of the name
        may be missing.
    """
    without_scheme = re.sub(r"^(?:file|package|model)://", "", name.strip())
    relative = urllib.parse.unquote(without_scheme).replace("\\", "/")
    parts = pathlib.PurePosixPath(relative).parts
    if not parts:
        return None
    candidates = [relative]
    candidates += ["/".join(parts[i:]) for i in range(1, len(parts))]
    for folder in (path.parent, *path.parent.parents[:_SEARCHED_PARENTS]):
        for candidate in candidates:
            file = _existing(folder / candidate)
            if file is not None:
                return file
    return None


def read_as_mujoco_does(file: pathlib.Path) -> tuple[bytes, str]:
    """Reads a mesh, in a format that MuJoCo reads.

    Returns:
      The content and its suffix; or nothing, and the reason.
    """
    suffix = file.suffix.lower()
    if file.stat().st_size > MAX_FILE:
        return b"", f"larger than {MAX_FILE >> 20} MB"
    if suffix == ".msh":
        return file.read_bytes(), "msh"
    try:
        return _as_stl(file, suffix)
    except Exception:  # readers of many formats raise arbitrary errors
        return b"", "not readable"


def _existing(path: pathlib.Path) -> pathlib.Path | None:
    """The file at a path, or one whose name differs in case alone; None if there is none."""
    if path.is_file():
        return path
    for file in path.parent.glob("*"):
        if file.name.lower() == path.name.lower() and file.is_file():
            return file
    return None


def _as_stl(file: pathlib.Path, suffix: str) -> tuple[bytes, str]:
    """A mesh as STL, m; or nothing, and the reason."""
    geometry: Any
    if suffix in SUFFIXES:
        geometry = load_geometry(file, "", skip_materials=True)
    else:
        geometry = trimesh.load_scene(file)
    is_cloud = isinstance(geometry, trimesh.PointCloud)
    if is_cloud:
        mesh = trimesh.Trimesh(geometry.vertices, process=False)
    elif suffix == ".dae":  # COLLADA states its unit. Its upward axis is ignored, as in ROS.
        mesh = geometry.convert_units("meters").to_mesh()
    else:
        mesh = trimesh.Scene(geometry).to_mesh()
    if not is_cloud and not len(mesh.faces):
        return b"", "without faces"
    if len(mesh.faces) > _MAX_FACES:
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        mesh = mesh.simplify_quadric_decimation(face_count=_REDUCED_FACES)
    spread = np.linalg.svd(mesh.vertices - mesh.vertices.mean(0), compute_uv=False)
    if spread[-1] <= _MIN_FLATNESS * spread[0]:  # MuJoCo would refuse the whole file
        return b"", "flat"
    if is_cloud:
        mesh = mesh.convex_hull
    return trimesh.exchange.stl.export_stl(mesh), "stl"
