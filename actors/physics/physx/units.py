"""Units of PhysX's scenes: centimetres, kilograms and seconds.

PhysX compares products of lengths with fixed numbers. In metres it takes capsules as short as a
finger's bone for parallel, and their contacts are wrong by millimetres.
"""

from typing import Any

import numpy as np

from congrasp.actors.physics.physx.library import sapien

LENGTH_SCALE = 100.0
"""Lengths, speeds and forces in PhysX per SI unit."""
INERTIA_SCALE = LENGTH_SCALE**2
"""Moments of inertia, torques, and gains of hinges in PhysX per SI unit."""


def scaled_pose(position: Any = (0.0, 0.0, 0.0), quaternion: Any = (1.0, 0.0, 0.0, 0.0)) -> Any:
    """Returns a pose for PhysX of a position (3,) in m and a quaternion (4,)."""
    return sapien.Pose(LENGTH_SCALE * np.asarray(position, float), quaternion)
