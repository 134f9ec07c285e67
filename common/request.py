"""Grasp request: constraints on one object, for a policy in this process, a server, `congrasp
grasp` and the studio.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from congrasp.common.errors import RefusedError

Pose = tuple[ArrayLike, ArrayLike]
"""Position (3,), m, and quaternion (4,), (w, x, y, z)."""


@dataclasses.dataclass(frozen=True, eq=False)
class GraspRequest:
    """Constraints on one object, and the initial state of the episode.

    Omitted fields are free: `congrasp grasp` then attempts several values. A control loop must set
    `surface`, `q`, `wrist` and `object_pose`; for a policy with a camera `cloud`, `q` and `wrist`,
    and constraints in the world frame.
    """

    constraints: Mapping[str, Mapping[str, ArrayLike]] = dataclasses.field(
        default_factory=lambda: {"heading": {}}
    )
    """Goal arrays of the requested constraints by constraint and field, object frame, metres and
    radians (`common.task.constraints`): `{"heading": {"direction": (0, 0, -1)}, "fingers":
    {"allowed": (1, 1, 0, 0, 0)}}`."""
    avoid: ArrayLike | None = None
    """(N,) bool: points of surface or cloud that must not be touched, for an affordance."""
    above: bool = False
    """Restricts the approach to 30 degrees around straight down, in any pose of the object."""
    rest: int | None = None
    """Index of the object's initial resting pose."""
    surface: ArrayLike | None = None
    """(N, 3) points of the object's surface, object frame, m."""
    q: ArrayLike | None = None
    """(F,) initial finger angles, rad."""
    wrist: Pose | None = None
    """Initial pose of the wrist in the world frame: the base of the virtual wrist joints."""
    object_pose: Pose | None = None
    """Initial pose of the object in the world frame."""
    cloud: ArrayLike | None = None
    """(N, 3) points of the visible part of the object's surface, world frame, m."""
    normals: ArrayLike | None = None
    """(N, 3) outward unit normals at the points of surface or cloud, in their frame, for a policy
    that observes normals (`TaskConfig.surface_normals`); without them, it estimates them."""
    camera: ArrayLike | None = None
    """(3,) position of the camera of the cloud, world frame, m, toward which estimated normals
    point.
    """

    def __post_init__(self) -> None:
        """Raises a `RefusedError` unless the constraints are a dict of dicts."""
        if not isinstance(self.constraints, Mapping):
            raise RefusedError(
                "The constraints must be a dict of dicts.",
                "Pass, for example, {'heading': {'direction': …}}.",
            )
        for name, fields in self.constraints.items():
            if not isinstance(fields, Mapping):
                raise RefusedError(
                    f"The constraint '{name}' must be a dict from its fields to arrays."
                )

    def goal(self, constraint: str) -> dict[str, np.ndarray]:
        """Returns the requested goal arrays of a constraint by field."""
        fields = self.constraints.get(constraint, {})
        return {name: np.asarray(value) for name, value in fields.items()}

    def given(self, constraint: str, field: str) -> np.ndarray | None:
        """Returns a goal array, or None if it is not requested."""
        return self.goal(constraint).get(field)
