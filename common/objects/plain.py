"""Objects made only of convex pieces: one part, no resting poses."""

import numpy as np

from congrasp.common.objects import shapes
from congrasp.common.objects.spec import GraspObject, Piece
from congrasp.common.objects.surface import mass_properties, sample_union


def plain_object(name: str, pieces: tuple[Piece, ...], density: float) -> GraspObject:
    """Returns an object of convex pieces.

    Args:
      name: name of the object.
      pieces: convex pieces in the object frame; its origin is assumed to be the centre of mass.
      density: density, kg/m^3.
    """
    mass, _, inertia = mass_properties(pieces, np.full(len(pieces), density))
    points, normals, _ = sample_union(pieces, np.random.default_rng(0))
    vertices, faces = shapes.mesh_of(pieces)
    return GraspObject(
        name=name,
        family=name,
        pieces=pieces,
        part_names=("all",),
        graspable=np.array([True]),
        mass=mass,
        inertia=inertia,
        points=points.astype(np.float32),
        normals=normals.astype(np.float32),
        labels=np.zeros(len(points), np.int32),
        rest_poses=np.zeros((0, 7)),
        visual_vertices=vertices,
        visual_faces=faces,
    )
