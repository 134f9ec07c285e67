"""Bodies of known measures, and mass properties of pieces as MuJoCo computes them."""

import itertools
from collections.abc import Sequence

import mujoco
import numpy as np
import trimesh

from congrasp.common.objects import shapes
from congrasp.common.objects.mjcf import GEOM_TYPES
from congrasp.common.objects.spec import Piece


def mujoco_mass_properties(
    pieces: Sequence[Piece], densities: Sequence[float]
) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass (3,) and inertia (3, 3) of a body of geoms with these densities."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    body.add_freejoint()
    for i, (piece, density) in enumerate(zip(pieces, densities, strict=True)):
        geom = body.add_geom(
            type=GEOM_TYPES[piece.kind], pos=piece.pos, quat=piece.quat, density=density
        )
        if piece.vertices is None:
            geom.size = piece.size
        else:
            spec.add_mesh(name=str(i), uservert=np.asarray(piece.vertices).ravel())
            geom.meshname = str(i)
    model = spec.compile()
    turn = shapes.matrix(model.body_iquat[1])
    return model.body_mass[1], model.body_ipos[1], turn @ np.diag(model.body_inertia[1]) @ turn.T


def block(sides: Sequence[float], center: Sequence[float] = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    """A block with sides (3,) around a centre (3,)."""
    return trimesh.creation.box(sides).apply_translation(center)


def ell() -> trimesh.Trimesh:
    """An L of two legs of 2 x 2 cm, 8 cm long, as one closed body of 56 cm^3."""
    outline = np.array([[0, 0], [0.08, 0], [0.08, 0.02], [0.02, 0.02], [0.02, 0.08], [0, 0.08]])
    caps = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    faces = [face[::-1] for face in caps]
    for face in caps:
        faces.append([6 + i for i in face])
    for i in range(6):
        j = (i + 1) % 6
        faces += [[i, j, 6 + j], [i, 6 + j, 6 + i]]
    mesh = trimesh.Trimesh([[*xy, z] for z, xy in itertools.product((0.0, 0.02), outline)], faces)
    assert mesh.is_volume
    return mesh
