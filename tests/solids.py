"""Mass properties of pieces as MuJoCo computes them: a reference for the project's own."""

from collections.abc import Sequence

import mujoco
import numpy as np

from congrasp.common.objects import shapes
from congrasp.common.objects.mjcf import GEOM_TYPES
from congrasp.common.objects.spec import Piece


def mujoco_mass_properties(pieces: Sequence[Piece], densities: Sequence[float]) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass (3,) and inertia (3, 3) of a body of geoms with these densities."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    body.add_freejoint()
    for i, (piece, density) in enumerate(zip(pieces, densities, strict=True)):
        geom = body.add_geom(type=GEOM_TYPES[piece.kind], pos=piece.pos, quat=piece.quat, density=density)
        if piece.vertices is None:
            geom.size = piece.size
        else:
            spec.add_mesh(name=str(i), uservert=np.asarray(piece.vertices).ravel())
            geom.meshname = str(i)
    model = spec.compile()
    turn = shapes.matrix(model.body_iquat[1])
    return model.body_mass[1], model.body_ipos[1], turn @ np.diag(model.body_inertia[1]) @ turn.T
