"""Hollows that no finger enters, which the collision shape of an object fills."""

import numpy as np
import trimesh
from scipy.ndimage import binary_propagation, distance_transform_edt, label
from trimesh.graph import connected_component_labels

from congrasp.services.assets.objects.holes import fill, hole_loops
from congrasp.services.assets.objects.repair import encloses
from congrasp.services.assets.objects.voxels import voxels

MAX_OPENING_M = 0.01
"""Width of an opening that no finger enters."""
_PROBE_STEPS = (1.0, 1.5, 2.0)
"""Steps from a triangle to the cubes before it, in sides of a cube."""
_VOLUME_RATIOS = (0.8, 1.2)
"""Volume added by filling relative to that of the hollow by cubes."""

_CRUMB_SHARE = 1e-5
"""Volume of a negligible body relative to that of the mesh."""


def without_hollows(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """Returns a closed mesh without the walls of hollows, whose openings are closed.

    A hollow is a space in which a ball as wide as `MAX_OPENING_M` fits but cannot leave it; it ends
    where a ball from outside can get to. The mesh is returned unchanged if its openings cannot be
    closed.
    """
    cubes = voxels(np.asarray(mesh.triangles), MAX_OPENING_M)
    outside = ~cubes.inside
    fits_ball = distance_transform_edt(outside, cubes.spacing) > MAX_OPENING_M / 2
    spaces, count = label(fits_ball)
    if count < 2:
        return mesh
    outer = spaces == spaces[0, 0, 0]
    reached = distance_transform_edt(~outer, cubes.spacing) < MAX_OPENING_M / 2 + cubes.spacing
    hollow = binary_propagation((spaces > 0) & ~outer, mask=outside & ~reached)
    centers = np.asarray(mesh.triangles_center)
    normals = np.asarray(mesh.face_normals)
    is_wall = np.zeros(len(centers), bool)
    for step in _PROBE_STEPS:
        is_wall |= hollow[cubes.at(centers + step * cubes.spacing * normals)]
    filled = trimesh.Trimesh(mesh.vertices, mesh.faces[~is_wall], process=False)
    loops = hole_loops(filled)
    if loops:
        filled = fill(filled, loops)
    if not encloses(filled):
        return mesh
    filled = _without_crumbs(filled)
    volume = float(hollow.sum()) * cubes.spacing**3
    low, high = _VOLUME_RATIOS
    if not low < (filled.volume - mesh.volume) / volume < high:
        return mesh
    notes.append(
        f"its hollow of {1e6 * volume:.0f} cm^3, which no finger enters, is filled in its "
        f"collision shape"
    )
    return filled


def _without_crumbs(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A closed mesh without bodies of negligible volume, such as remains of a hollow's wall."""
    mesh.merge_vertices()
    labels = connected_component_labels(mesh.face_adjacency, len(mesh.faces))
    volumes = np.bincount(labels, np.linalg.det(mesh.triangles) / 6)
    is_solid = np.abs(volumes) > _CRUMB_SHARE * mesh.volume
    mesh.update_faces(is_solid[labels])
    mesh.remove_unreferenced_vertices()
    return mesh
