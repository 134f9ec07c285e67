"""Constraint bank: source of the constraints of episodes, stacked over a pool of objects."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import numpy as np

from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array, Surface


class ConstraintBank(NamedTuple):
    """N objects with R resting poses, H headings and M reference poses each; object frame unless
    stated otherwise.

    A compiled reset gathers from it by object index. The axis V has two regions: 0 for the whole
    surface, 1 for the graspable region of an affordance.
    """

    points: Array
    """(N, P, 3) surface points."""
    avoid: Array
    """(N, P) bool, the avoid region."""
    normals: Array
    """(N, P, 3) outward unit normals at the points."""
    rest: Array
    """(N, R, 7) resting poses in the world frame; unused rows repeat earlier ones."""
    heading_position: Array
    """(N, V, H, 3)."""
    heading_direction: Array
    """(N, V, H, 3)."""
    heading_cross: Array
    """(N, V, H, 3)."""
    heading_index: Array
    """(N, V, R, H) feasible headings of each resting pose, repeated to fill the row."""
    heading_back: Array
    """(N, V, R, H) distances by which the position of `heading_index` moves back to clear the
    table, m.
    """
    pose_q: Array
    """(N, V, M, F)."""
    pose_position: Array
    """(N, V, M, 3)."""
    pose_quaternion: Array
    """(N, V, M, 4)."""
    trajectory_position: Array
    """(N, V, M, K, 3); trajectory m ends at pose m."""
    trajectory_quaternion: Array
    """(N, V, M, K, 4)."""
    pose_valid: Array
    """(N, V, R, M) bool: pose and trajectory stay above the table in the resting pose."""
    has_affordance: Array
    """(N, R) bool: the object has an avoid region, and its graspable one can be approached in the
    resting pose.
    """
    weight: Array
    """(N,) relative frequency of the object; 0 if it lies too flat to be grasped."""
    mass: Array
    """(N,) mass before the factor of the episode, kg."""
    renewable: Array
    """(N,) bool: grasps of the policy in training may replace the object's references."""
    grasps: Array
    """(N, V) int, number of such grasps so far."""
    own: Any = {}  # noqa: RUF012 - never changed
    """Columns (N, ...) of single constraints by name (`Constraint.columns`)."""


_AXES = {
    **{name: "VRH" for name in ("heading_index", "heading_back")},
    **{name: "VH" for name in ("heading_position", "heading_direction", "heading_cross")},
    **{f"pose_{name}": "VM" for name in ("q", "position", "quaternion")},
    **{f"trajectory_{name}": "VM" for name in ("position", "quaternion")},
    "rest": "R",
    "has_affordance": "R",
    "pose_valid": "VRM",
}
"""Leading axes of an object's arrays whose sizes may differ between objects."""


SHARED = ConstraintBank._fields[:-1]
"""Fields of the bank that do not belong to a single constraint."""


def surface_of(task: TaskSettings, bank: ConstraintBank, objects: Array) -> Surface:
    """Surfaces (B, P, ...) of the objects (B,), with normals if the task's policy observes them."""
    normals = bank.normals[objects] if task.surface_normals else None
    return Surface(bank.points[objects], bank.avoid[objects], normals)


def rows_of(bank: ConstraintBank) -> list[ConstraintBank]:
    """Splits a bank into objects, without the leading axis N and columns of single constraints."""
    shared = bank[: len(SHARED)]
    return [
        ConstraintBank(*(np.asarray(field)[n] for field in shared)) for n in range(len(bank.points))
    ]


def stacked(rows: Sequence[ConstraintBank]) -> ConstraintBank:
    """Stacks the rows of objects into a bank; resting poses, headings and references are repeated
    up to the longest.
    """
    most = {
        axis: max(getattr(row, name).shape[_AXES[name].index(axis)] for row in rows)
        for axis, name in (("R", "rest"), ("H", "heading_position"), ("M", "pose_q"))
    }

    def repeated(name: str, value: np.ndarray) -> np.ndarray:
        """Repeats the rows of an array along these axes up to the longest of any object."""
        for place, axis in enumerate(_AXES.get(name, "")):
            if axis in most:
                value = np.take(value, np.resize(np.arange(value.shape[place]), most[axis]), place)
        return value

    return ConstraintBank(
        **{name: np.stack([repeated(name, getattr(row, name)) for row in rows]) for name in SHARED}
    )


class Draw(NamedTuple):
    """Draws from a bank for B episodes, before their constraints are sampled."""

    bank: ConstraintBank
    objects: Array
    """(B,) int."""
    rests: Array
    """(B,) int, index of the resting pose."""
    region: Array = 0
    """(B,) int, index along the axis V: the region of the constraints requested so far."""
    reference: Mapping[str, Array] = MappingProxyType({})
    """(B,) int by constraint, for those drawn from references: index of an allowed reference, if
    there is any.
    """
    mass: Array = 0.0
    """(B,) mass of the episode's object, kg."""
    friction: Array = 1.0
    """(B,) sliding friction between hand and object."""
    disturbance: Array | None = None
    """(B,) in [0, 1], scale of the references' errors (`common.task.constraints.pose`); None for no
    errors.
    """

    def own(self, constraint: str) -> Any:
        """Columns (B, ...) of a constraint for the drawn objects (`Constraint.columns`)."""
        return jax.tree.map(lambda column: column[self.objects], self.bank.own[constraint])

    @property
    def allowed(self) -> Array:
        """(B, M) bool: references that clear the table."""
        return self.bank.pose_valid[self.objects, self.region, self.rests]
