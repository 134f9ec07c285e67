"""The binding `sapien`, imported without its warnings, and PhysX's settings.

The other modules of this room take `sapien` and `px` from here. sapien always imports its renderer,
which warns if it finds no Vulkan; nothing here renders.
"""

import functools
import warnings
from typing import Any

import numpy as np

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import sapien
    import sapien.physx as px

__all__ = ["configure", "px", "sapien"]

_SIZE = 0.1
"""Typical size of an object, m. PhysX scales with it the distances within which contacts share
friction.
"""
_SPEED = 1.0
"""Typical speed, m/s."""
_BOUNCE_SPEED = 2.0
"""Speed of an impact above which PhysX considers restitution, which is zero here, m/s."""
_CONTACT_OFFSET = 0.003
"""Distance from a shape at which PhysX begins to compute contacts, m."""
_POSITION_ITERATIONS = 32
_VELOCITY_ITERATIONS = 1


@functools.cache
def _engine(length: float) -> Any:
    """PhysX itself, one in a process. sapien would otherwise create one with other tolerances."""
    return px.PhysxEngine(length * _SIZE, length * _SPEED)


def configure(gravity: np.ndarray, length: float) -> None:
    """Sets what PhysX applies to everything that is created afterwards.

    The settings belong to the process, where another user of sapien may change them: call it before
    each scene.

    Args:
      gravity: (3,) m/s^2.
      length: lengths in PhysX per metre.
    """
    _engine(length)
    px.set_scene_config(
        gravity=length * gravity,
        bounce_threshold=length * _BOUNCE_SPEED,
        enable_pcm=True,
        enable_tgs=False,
        enable_ccd=False,
        enable_enhanced_determinism=True,
        enable_friction_every_iteration=True,
        cpu_workers=0,
    )
    px.set_body_config(
        solver_position_iterations=_POSITION_ITERATIONS,
        solver_velocity_iterations=_VELOCITY_ITERATIONS,
        sleep_threshold=0.0,
    )
    px.set_shape_config(contact_offset=length * _CONTACT_OFFSET, rest_offset=0.0)
