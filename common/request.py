"""Constraints on one object: the same for a policy in this process, a server, `congrasp grasp` and the studio."""

import dataclasses
from collections.abc import Mapping

import numpy as np

Pose = tuple[np.ndarray, np.ndarray]
"""Position (3,), m, and quaternion (4,), (w, x, y, z)."""


@dataclasses.dataclass(frozen=True, eq=False)
class GraspRequest:
    """Constraints on one object, and where the episode begins.

    What is left out is free: `congrasp grasp` then attempts several. A control loop must give `surface`, `q`, `wrist`
    and `object_pose`.
    """

    constraints: Mapping[str, Mapping[str, np.ndarray]] = dataclasses.field(default_factory=lambda: {"heading": {}})
    """By the name of each constraint that is asked for, its goal arrays by field, object frame, metres and radians
    (`common.task.constraints`): `{"heading": {"direction": (0, 0, -1)}, "fingers": {"allowed": (1, 1, 0, 0, 0)}}`."""
    avoid: np.ndarray | None = None
    """(N,) bool: points of the surface that must not be touched, where an affordance is asked for."""
    above: bool = False
    """The hand comes within 30 degrees of straight down, however the object lies."""
    rest: int | None = None
    """Which of the object's resting poses it starts from."""
    surface: np.ndarray | None = None
    """(N, 3) m, object frame: points of the object's surface."""
    q: np.ndarray | None = None
    """(F,) rad: finger angles at the start."""
    wrist: Pose | None = None
    """The wrist's pose in the world at the start: the base of the virtual wrist joints."""
    object_pose: Pose | None = None
    """The object's pose in the world at the start."""

    def given(self, constraint: str, field: str) -> np.ndarray | None:
        """One goal array, if it is asked for."""
        return self.constraints.get(constraint, {}).get(field)
