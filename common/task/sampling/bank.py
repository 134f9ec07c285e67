"""Constraint bank: source of the constraints of episodes, stacked over a pool of objects."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from congrasp.common.runtime.lazy_jax import jax
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
    columns: Any = {}  # noqa: RUF012 - never changed
    """Columns (N, ...) of single constraints by name (`Constraint.columns`)."""


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
    """(B,) in [0, 1], scale of the references' errors (`common.task.constraints.disturbance`); None
    for no errors.
    """

    def columns(self, constraint: str) -> Any:
        """Columns (B, ...) of a constraint for the drawn objects (`Constraint.columns`)."""
        return jax.tree.map(lambda column: column[self.objects], self.bank.columns[constraint])

    @property
    def allowed(self) -> Array:
        """(B, M) bool: references that clear the table."""
        return self.bank.pose_valid[self.objects, self.region, self.rests]


_LEADING_AXES = {
    "rest": "R",
    "heading_position": "VH",
    "heading_direction": "VH",
    "heading_cross": "VH",
    "heading_index": "VRH",
    "heading_back": "VRH",
    "pose_q": "VM",
    "pose_position": "VM",
    "pose_quaternion": "VM",
    "trajectory_position": "VM",
    "trajectory_quaternion": "VM",
    "pose_valid": "VRM",
    "has_affordance": "R",
}
"""Leading axes of an object's arrays whose sizes may differ between objects."""
_SIZED_BY = {"R": "rest", "H": "heading_position", "M": "pose_q"}
"""Field of the bank that gives the size of an axis."""
SHARED = ConstraintBank._fields[:-1]
"""Fields of the bank that do not belong to a single constraint."""


def surface_of(task: TaskSettings, bank: ConstraintBank, objects: Array) -> Surface:
    """Surfaces (B, P, ...) of the objects (B,), with normals if the task's policy observes them."""
    normals = bank.normals[objects] if task.surface_normals else None
    return Surface(bank.points[objects], bank.avoid[objects], normals)


def rows_of(bank: ConstraintBank) -> list[ConstraintBank]:
    """Splits a bank into objects, without the leading axis N and columns of single constraints."""
    shared = [np.asarray(field) for field in bank[: len(SHARED)]]
    rows = []
    for n in range(len(bank.points)):
        rows.append(ConstraintBank(*[field[n] for field in shared]))
    return rows


def stacked(rows: Sequence[ConstraintBank]) -> ConstraintBank:
    """Stacks the rows of objects into a bank; resting poses, headings and references are repeated
    up to the longest.
    """
    lengths = {}
    for axis, name in _SIZED_BY.items():
        place = _LEADING_AXES[name].index(axis)
        lengths[axis] = max(getattr(row, name).shape[place] for row in rows)
    columns = {}
    for name in SHARED:
        axes = _LEADING_AXES.get(name, "")
        columns[name] = np.stack([_repeated(getattr(row, name), axes, lengths) for row in rows])
    return ConstraintBank(**columns)


def _repeated(array: np.ndarray, axes: str, lengths: Mapping[str, int]) -> np.ndarray:
    """Repeats the rows of an array along its leading `axes` up to the length of each axis."""
    for place, axis in enumerate(axes):
        if axis in lengths:
            index = np.resize(np.arange(array.shape[place]), lengths[axis])
            array = np.take(array, index, place)
    return array


def feasible_indices(feasible: np.ndarray) -> np.ndarray:
    """Indices (V, R, H) of the true entries of masks (V, R, H), repeated to fill each row; zeros
    without any.
    """
    index = np.zeros(feasible.shape, int)
    for region, rest in np.ndindex(feasible.shape[:2]):
        entries = np.flatnonzero(feasible[region, rest])
        if len(entries):
            index[region, rest] = np.resize(entries, feasible.shape[-1])
    return index
