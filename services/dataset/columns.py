"""Columns of a dataset, with shapes, units and frames, and the rows of a batch of episodes.

Arrays are lists of one length in row-major order; their shape, unit and frame are in the schema.
Values of constraints that were not requested are NaN. Poses are position (m) and quaternion (w, x,
y, z).
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from congrasp.actors.stress import ASSESSED_NAMES, SURVIVAL_NAMES
from congrasp.common import rotations
from congrasp.common.hands.spec import Hand
from congrasp.common.objects import store
from congrasp.common.objects.spec import SURFACE_POINTS, GraspObject
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import known
from congrasp.common.task.metrics import FORCES
from congrasp.services.evaluate.episodes import Batch
from congrasp.services.evaluate.plan import ALIGNED

VERDICTS = {
    "success": (
        "bool, the object is up a quarter of a second after the table's removal (the paper's)"
    ),
    "held": "bool, and two seconds after it",
    "clean": "bool, held, and no penetration is deeper than 2 mm (3 mm of hand and object)",
    "lifted": "bool, held, then carried 15 cm upwards",
    "pushed_weight": "bool, lifted, then pushed six times with half of the object's weight",
    "pushed": "bool, and six times with 1 N",
}
"""Outcomes of an episode, with their meanings."""
_SURVIVED = dict(zip(SURVIVAL_NAMES, ("lifted", "pushed_weight", "pushed"), strict=True))
_MEASURES = (*(name for name in ASSESSED_NAMES if name not in (*SURVIVAL_NAMES, "clean")), *FORCES)
_MEASURES += ("links_at_removal", "moved_at_removal")
_WIDE = {
    np.dtype(np.float32): pa.float32(),
    np.dtype(bool): pa.bool_(),
    np.dtype(np.int32): pa.int32(),
}


class Column(NamedTuple):
    """One column of a table."""

    name: str
    meaning: str
    shape: tuple[int, ...] = ()
    """Shape of a row's array."""
    kind: type = np.float32
    """`np.float32`, `bool`, `np.int32` or `str`."""


def grasp_columns(hand: Hand, task: TaskConfig) -> list[Column]:
    """Columns of a grasp: episode, constraints, hand and object at the start and after the hold,
    outcome.
    """
    joints = (len(hand.joints),)
    goals: list[Column] = []
    errors: list[Column] = []
    for constraint in known(task):
        neutral = constraint.neutral(hand, task)
        for name, array in constraint.arrays.items():
            shape = np.shape(getattr(neutral, name))
            goals.append(Column(f"goal_{constraint.name}_{name}", array.meaning, shape))
        for spec in constraint.errors:
            unit = spec.unit or "ratio"
            errors.append(Column(spec.name, f"{unit}, mean error in the {spec.window}"))
    return [
        Column("object", "name, as in the table of objects", kind=str),
        Column("constraints", "requested ones, with + between them", kind=str),
        Column(
            "episode",
            "number among the episodes of this object and these constraints",
            kind=np.int32,
        ),
        Column("mass", "kg"),
        *goals,
        Column("start_q", "rad, finger joints at the start", joints),
        Column("start_wrist", "pose in the object frame at the start", (7,)),
        Column("start_object", "pose on the table, whose top is at z = 0", (7,)),
        Column("q", "rad, finger joints after the hold", joints),
        Column("q_target", "rad, targets of the finger servos after the hold", joints),
        Column("wrist", "pose in the object frame after the hold", (7,)),
        Column("object_pose", "pose in the world after the hold", (7,)),
        *(Column(name, meaning, kind=bool) for name, meaning in VERDICTS.items()),
        *errors,
        *(Column(name, "see docs/reference/metrics.md") for name in _MEASURES),
    ]


def object_columns() -> list[Column]:
    """Columns of an object, in the size in which the hand grasps it."""
    surface = (SURFACE_POINTS, 3)
    return [
        Column("object", "name", kind=str),
        Column("family", "of the generator, or empty", kind=str),
        Column("sha256", "first 16 digits, of the object's content", kind=str),
        Column("mass", "kg"),
        Column("points", "m, object frame: surface points", surface),
        Column("normals", "unit, object frame", surface),
        Column("graspable", "surface points that an affordance allows", (SURFACE_POINTS,), bool),
        Column("file_scale", "metres per unit of the imported file"),
        Column("file_origin", "m, object frame: origin of that file", (3,)),
        Column("shape_reliable", "the simulated shape is that of the file", kind=bool),
    ]


def grasp_rows(task: TaskConfig, asked: np.ndarray, batch: Batch) -> dict[str, np.ndarray]:
    """Columns (B, ...) of a batch of episodes under the constraints `asked` (B,), without those
    that a plan knows.
    """
    start = batch.conditions.reset_state
    state, features = batch.final
    values = batch.sample.values
    names = [one.removesuffix(ALIGNED).split("+") for one in asked.tolist()]
    rows: dict[str, Any] = {
        "mass": values["mass_kg"],
        "start_q": start.q,
        "start_wrist": _in_object(
            start.object_position,
            start.object_quaternion,
            start.base_position,
            start.base_quaternion,
        ),
        "start_object": _pose(start.object_position, start.object_quaternion),
        "q": state.q,
        "q_target": state.q_target,
        "wrist": _in_object(
            state.object_position,
            state.object_quaternion,
            features.wrist_position,
            features.wrist_quaternion,
        ),
        "object_pose": _pose(state.object_position, state.object_quaternion),
        **{name: values[name] > 0 for name in ("success", "held", "clean")},
        **{short: values[name] > 0 for name, short in _SURVIVED.items()},
        **{name: values.get(name, np.full(len(start.q), np.nan)) for name in _MEASURES},
    }
    for constraint in known(task):
        requests = [1.0 if constraint.name in request else np.nan for request in names]
        requested = np.array(requests, np.float32)
        for name, array in batch.conditions.goal[constraint.name]._asdict().items():
            goal = np.asarray(array, np.float32)
            rows[f"goal_{constraint.name}_{name}"] = (requested * goal.T).T
        for spec in constraint.errors:
            rows[spec.name] = requested * values[spec.name]
    return {name: np.asarray(column) for name, column in rows.items()}


def object_rows(objects: Sequence[GraspObject]) -> dict[str, np.ndarray]:
    """Columns (N, ...) of objects."""
    rows = {
        "object": [obj.name for obj in objects],
        "family": [obj.family for obj in objects],
        "sha256": [store.digest(obj) for obj in objects],
        "mass": [obj.mass for obj in objects],
        "points": [obj.points for obj in objects],
        "normals": [obj.normals for obj in objects],
        "graspable": [~obj.non_graspable_points for obj in objects],
        "file_scale": [obj.file_scale for obj in objects],
        "file_origin": [obj.origin for obj in objects],
        "shape_reliable": [obj.shape_reliable for obj in objects],
    }
    return {name: np.asarray(column) for name, column in rows.items()}


def table(
    columns: Sequence[Column], rows: Mapping[str, np.ndarray], about: Mapping[str, Any]
) -> pa.Table:
    """A Parquet table of these columns; `about` is in its metadata, as JSON under the key
    `congrasp`.
    """
    arrays = [_array(column, rows[column.name]) for column in columns]
    fields = [field(column) for column in columns]
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields, {"congrasp": json.dumps(about)}))


def field(column: Column) -> pa.Field:
    """Arrow field of a column, with its meaning and shape as metadata."""
    facts = {"meaning": column.meaning, "shape": json.dumps(column.shape)}
    return pa.field(column.name, _arrow_type(column), nullable=False, metadata=facts)


def _arrow_type(column: Column) -> pa.DataType:
    """Arrow type of a column."""
    if column.kind is str:
        return pa.string()
    value = _WIDE[np.dtype(column.kind)]
    if not column.shape:
        return value
    return pa.list_(value, int(np.prod(column.shape)))


def _array(column: Column, values: np.ndarray) -> pa.Array:
    """A column (B, ...) as an Arrow array."""
    if column.kind is str:
        return pa.array(values.tolist(), pa.string())
    flat: np.ndarray = np.asarray(values, column.kind).ravel()
    array = pa.array(flat, _WIDE[flat.dtype])
    if not column.shape:
        return array
    return pa.FixedSizeListArray.from_arrays(array, int(np.prod(column.shape)))


def _pose(position: Any, quaternion: Any) -> np.ndarray:
    """(B, 7) of positions (B, 3) and quaternions (B, 4)."""
    return np.concatenate([position, quaternion], -1, dtype=np.float32)


def _in_object(
    position: Any, quaternion: Any, wrist_position: Any, wrist_quaternion: Any
) -> np.ndarray:
    """(B, 7) wrist poses in the object frames, from poses of objects and wrists in the world
    frame.
    """
    return _pose(*rotations.relative_pose(position, quaternion, wrist_position, wrist_quaternion))
