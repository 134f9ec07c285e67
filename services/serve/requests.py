"""Queries of the live policy: their layout, validation, and completion.

A query is one array `packed` (n, S) of float32: a row for each of n states under the same
constraints. Its metadata have the names of the `constraints`, the digest of the `layout`, and the
`timeout` in seconds. One vector is transferred to the device at once, since the overhead of a
transfer equals that of thirty times its size. The layout is part of `Policy.metadata`.
`services.client.packer.Packer` writes and checks the fields; absent ones are zero.

The fields, without batch axis, are those of `common.task.types.SceneState`, the object's
`surface_points` with `surface_avoid`, and the goal arrays of the constraints.

For a policy with history (`TaskConfig.observation` "tracked") there are also `past_q`, `past_u`,
`past_q_target`, `past_u_target`, `past_object_position` and `past_object_quaternion` of earlier
control steps, newest first.

For a policy with a camera ("camera") `cloud` (N, 3) replaces `surface_points` and all fields of the
object's pose and velocity. Cloud and constraints are in the world frame.

For a policy that observes normals (`TaskConfig.surface_normals`) there are `surface_normals` (N,
3), outward unit vectors. Zeros are estimated from the points, those of a cloud toward
`camera_position` (3,), world frame.

The reply is one array `packed` with a row for each state: action, finger targets, wrist targets.
"""

import functools
import hashlib
import json
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common import rotations
from congrasp.common.errors import CongraspError, LayoutError
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.spec import Hand
from congrasp.common.io.inputs import LONGEST_NAME
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import Constraint, known, require_known
from congrasp.common.task.constraints.specs import GoalArray
from congrasp.common.task.normals import estimated_normals
from congrasp.common.task.readings import Readings
from congrasp.common.task.sensors import get_sensor
from congrasp.common.task.sensors.base import world_pose
from congrasp.common.task.types import CONTACTS_PER_LINK, Goal, SceneState, Surface
from congrasp.common.wire.codec import Message
from congrasp.services.client.fields import CAMERA, NORMALS
from congrasp.services.client.packer import PACKED_ARRAY

STATES_LIMIT = 64
"""Most states in one query."""
_UNIT_TOLERANCE = 0.02
_IDENTITY = np.array((1, 0, 0, 0), np.float32)
_UP = np.array((0, 0, 1), np.float32)


class Query(NamedTuple):
    """A complete query of n states."""

    vectors: np.ndarray
    """(n, S) float32, laid out by `Layout`; its values are checked by `Layout.complete`."""
    asked: tuple[str, ...]
    """Names of the requested constraints."""


class _GoalField(NamedTuple):
    """A field of the query that holds a goal array."""

    constraint: Constraint
    array: GoalArray


class Layout:
    """Names, shapes and offsets of a query's fields for one hand and task.

    Attributes:
      shapes: shapes by field name: state, earlier control steps if the policy observes them, goal,
        surface, and flags of the requested constraints.
      size: length S of the flat vector.
      digest: identifies the layout.
    """

    def __init__(self, hand: Hand, task: TaskConfig):
        self.hand = hand
        self.task = task
        self.known = known(task)
        self._goal_fields: dict[str, _GoalField] = {}
        self._neutral: dict[str, np.ndarray] = {}
        for constraint in self.known:
            for name, array in constraint.arrays.items():
                self._goal_fields[f"{constraint.name}_{name}"] = _GoalField(constraint, array)
            for name, value in constraint.neutral(hand, task)._asdict().items():
                self._neutral[f"{constraint.name}_{name}"] = value
        self._sensor = get_sensor(task)
        self.points = self._sensor.points
        self._measured = self._sensor.query(hand, task)
        self._state = self._state_fields()
        self._past = self._past_fields()
        self.shapes = self._field_shapes()
        self.offsets: dict[str, int] = {}
        self.size = 0
        for name, shape in self.shapes.items():
            self.offsets[name] = self.size
            self.size += math.prod(shape)
        self._flags = self._goal_fields_of_kinds("flag")
        self._directions = [name for name in (*self._state, *self._past) if "quaternion" in name]
        self._directions += self._goal_fields_of_kinds("direction", "quaternion")
        self._unit = list(self._directions)
        if NORMALS in self.shapes:
            self._unit.append(NORMALS)
        contents = json.dumps([hand.name, self.description()])
        self.digest = hashlib.sha256(contents.encode()).hexdigest()[:16]

    def _state_fields(self) -> list[str]:
        """Names of the fields of `SceneState` that a query has."""
        if self._sensor.shows_pose:
            return list(SceneState._fields)
        return [name for name in SceneState._fields if not name.startswith("object_")]

    def _past_fields(self) -> list[str]:
        """Names of the fields of earlier control steps; empty if the policy observes none."""
        if self._sensor.privileged:
            return []
        return [f"past_{name}" for name in Readings._fields if name in self._state]

    def _field_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of all fields, in the order of the vector."""
        state_shapes = _state_shapes(self.hand)
        shapes = {name: state_shapes[name] for name in self._state}
        for name in self._past:
            shapes[name] = (self.task.history - 1, *shapes[name.removeprefix("past_")])
        for name, value in self._neutral.items():
            shapes[name] = np.shape(value)
        points = self.task.surface_points
        shapes[self.points] = (points, 3)
        shapes["surface_avoid"] = (points,)
        if self.task.surface_normals:
            shapes[NORMALS] = (points, 3)
        shapes |= self._measured
        shapes["asked"] = (len(self.known),)
        return shapes

    def _goal_fields_of_kinds(self, *kinds: str) -> list[str]:
        """Names of the goal fields of some kinds (see `GoalArray`)."""
        return [name for name, field in self._goal_fields.items() if field.array.kind in kinds]

    def description(self) -> dict[str, Any]:
        """Layout for clients, as JSON.

        Returns:
          `size` of the vector; `fields`, offset and shape of each; `constraints`, the fields that
          each one needs; `states`, the most in one query; `settle`, m, see `SensingConfig`.
        """
        needs: dict[str, list[str]] = {}
        for constraint in self.known:
            required = [name for name, array in constraint.arrays.items() if array.required]
            goal_fields = [f"{constraint.name}_{name}" for name in required]
            needs[constraint.name] = [*goal_fields, *constraint.needs]
        fields = {name: [self.offsets[name], *shape] for name, shape in self.shapes.items()}
        del fields["asked"]  # `parse` sets it
        return {
            "size": self.size,
            "fields": fields,
            "constraints": needs,
            "states": STATES_LIMIT,
            "settle": self.task.sensing.settle,
        }

    def unpack(self, vectors: Any) -> dict[str, Any]:
        """Returns the fields (B, ...) of flat vectors (B, S), for NumPy and traced arrays."""
        return {
            name: self._field(vectors, name).reshape(-1, *shape)
            for name, shape in self.shapes.items()
        }

    def _field(self, vectors: Any, name: str) -> Any:
        """Numbers (..., n) of a field in flat vectors (..., S)."""
        return vectors[..., self._places(name)]

    def _places(self, name: str) -> slice:
        """Slice of a field in a vector."""
        start = self.offsets[name]
        return slice(start, start + math.prod(self.shapes[name]))

    def parse(self, message: Message) -> Query:
        """Returns a query, whose values `complete` checks.

        Raises:
          LayoutError: it is not in this layout.
          CongraspError: it names no valid constraints, or has too many states.
        """
        vectors = message.arrays.get(PACKED_ARRAY)
        fits = (
            vectors is not None
            and vectors.ndim == 2
            and vectors.shape[1] == self.size
            and len(message.arrays) == 1
        )
        if vectors is None or not fits or message.meta.get("layout") != self.digest:
            raise LayoutError(
                "The query does not match the policy's layout.",
                "Read the layout from the policy's metadata.",
            )
        if not 1 <= len(vectors) <= STATES_LIMIT:
            raise CongraspError(
                f"The query has {len(vectors)} states.", f"Send 1 to {STATES_LIMIT} at a time."
            )
        requested = self._requested(message.meta.get("constraints", ["heading"]))
        vectors = np.array(vectors, np.float32)
        vectors[:, self._places("asked")] = [
            constraint.name in requested for constraint in self.known
        ]
        return Query(vectors, requested)

    def complete(self, vectors: jax.Array) -> tuple[dict[str, jax.Array], jax.Array]:
        """Normalises quaternions and directions of queries, and fills in omitted fields; traced
        with the policy.

        Args:
          vectors: (B, S) flat vectors.

        Returns:
          Fields (B, ...) by name, zero where a query is not finite, and checks (B, C) for
          `find_error`: finite and each constraint valid, as 1 or 0, and norms that must be 1.
        """
        finite = jnp.isfinite(vectors).all(1)
        fields = self.unpack(jnp.where(finite[:, None], vectors, 0.0))
        requested = fields["asked"] > 0.5
        for name in ("contact_found", "table", "surface_avoid", *self._flags):
            fields[name] = fields[name] > 0.5
        always = jnp.ones_like(finite)
        lengths = []
        for name in self._directions:
            needed = always
            if name in self._goal_fields:
                needed = requested[:, self.known.index(self._goal_fields[name].constraint)]
            default = self._neutral.get(name, _IDENTITY)
            fields[name], length = _unit(fields[name], needed, default)
            lengths.append(length)
        self._add_object_frame(fields)
        self._make_cross_orthogonal(fields)
        if NORMALS in fields:
            fields[NORMALS], length = _unit(fields[NORMALS], always, _UP)
            lengths.append(length)
        surface = self.surface(fields)
        goal = self.goal(fields)
        fitting = []
        for index, constraint in enumerate(self.known):
            is_valid = constraint.valid(surface, goal[constraint.name])
            fitting.append(~requested[:, index] | is_valid)
        return fields, jnp.stack([finite, *fitting, *lengths], 1)

    def _add_object_frame(self, fields: dict[str, jax.Array]) -> None:
        """Adds the object's pose and velocity to the fields of a policy that does not observe them:
        the object frame is the world frame, at rest.
        """
        states = len(fields["asked"])
        pose = world_pose(states)
        velocity = jnp.zeros((states, 3))
        for name in SceneState._fields:
            if name in self._state:
                continue
            fields[name] = pose[:, 3:] if "quaternion" in name else velocity
            if name in Readings._fields:
                now = fields[name][:, None]
                fields[f"past_{name}"] = jnp.repeat(now, self.task.history - 1, 1)

    def _make_cross_orthogonal(self, fields: dict[str, jax.Array]) -> None:
        """Makes the heading's cross-finger direction orthogonal to the heading (`_orthogonal`)."""
        to_object = rotations.conjugate(fields["object_quaternion_initial"])
        wrist = rotations.multiply(to_object, fields["base_quaternion"])
        at_start = rotations.rotate(wrist, jnp.array(grasp_frame(self.hand).cross))
        fields["heading_cross"] = _orthogonal(
            fields["heading_cross"], fields["heading_direction"], at_start
        )

    def surface(self, fields: Mapping[str, Any]) -> Surface:
        """Returns the labelled surface points, or the cloud, of completed fields."""
        return Surface(fields[self.points], fields["surface_avoid"], fields.get(NORMALS))

    def estimate_normals(self, vectors: np.ndarray) -> None:
        """Writes normals into queries (B, S) that have none, if the policy observes them; those of
        a surface are kept.

        An estimate costs ten times an action, and an episode's points stay the same.
        """
        if NORMALS not in self.shapes:
            return
        normals = self._places(NORMALS)
        for index in np.flatnonzero(~vectors[:, normals].any(1)):
            row = vectors[index]
            eye = b""
            if CAMERA in self.shapes and self._field(row, CAMERA).any():
                eye = self._field(row, CAMERA).tobytes()
            row[normals] = _estimated(self._field(row, self.points).tobytes(), eye)

    def goal(self, fields: Mapping[str, Any]) -> Goal:
        """Returns the goal arrays of completed fields, before the priority rules."""
        goals = {}
        for constraint in self.known:
            arrays = {name: fields[f"{constraint.name}_{name}"] for name in constraint.arrays}
            goals[constraint.name] = constraint.goal(**arrays)
        return Goal(goals, {})

    def measured(self, fields: Mapping[str, Any]) -> dict[str, Any]:
        """Returns the further measurements (B, ...) of the policy's sensor (`Sensor.query`)."""
        return {name: fields[name] for name in self._measured}

    def readings(self, fields: Mapping[str, Any]) -> Readings | None:
        """Returns the earlier control steps of completed fields, if the policy observes them."""
        if not self._past:
            return None
        steps = {}
        for name in Readings._fields:
            now = fields[name][:, None]
            steps[name] = jnp.concatenate([now, fields[f"past_{name}"]], 1)
        return Readings(**steps)

    def pass_all(self, checks: np.ndarray) -> bool:
        """True if no state of a batch fails a check (n, C) of `complete`."""
        return bool((np.abs(checks - 1.0) <= _UNIT_TOLERANCE).all())

    def find_error(self, query: Query, checks: np.ndarray) -> CongraspError | None:
        """Returns the error of a query's first invalid state, by the checks (n, C) of `complete`;
        None without one.
        """
        passed = np.abs(checks - 1.0) <= _UNIT_TOLERANCE
        if passed.all():
            return None
        state = int((~passed).any(1).argmax())
        which = f" of state {state}" if len(checks) > 1 else ""
        finite = passed[state, 0]
        if not finite:
            fields = self.unpack(query.vectors[state, None])
            field = next(name for name, value in fields.items() if not np.isfinite(value).all())
            return CongraspError(
                f"The field '{field}'{which} is not finite.", "Send finite numbers."
            )
        first_length = 1 + len(self.known)
        fitting = passed[state, 1:first_length].tolist()
        if not all(fitting):
            return CongraspError(*self.known[fitting.index(False)].invalid)
        index = passed[state, first_length:].tolist().index(False)
        length = checks[state, first_length + index]
        return CongraspError(
            f"The field '{self._unit[index]}'{which} has length {length:.3f}, not 1."
        )

    def _requested(self, names: Any) -> tuple[str, ...]:
        """Names of the requested constraints of a query, weakest first."""
        if not isinstance(names, list) or not all(map(_is_name, names)):
            raise CongraspError("The query's 'constraints' must be a list of names.")
        require_known(names, self.task)
        leading = [constraint.name for constraint in self.known if constraint.guides]
        if not set(leading) & set(names):
            raise CongraspError(
                "The query has no constraint that guides the wrist.",
                f"Add one of: {', '.join(leading)}.",
            )
        return tuple(constraint.name for constraint in self.known if constraint.name in names)


def _state_shapes(hand: Hand) -> dict[str, tuple[int, ...]]:
    """Shapes of the fields of `SceneState`, without batch axis."""
    fingers = len(hand.joints)
    contacts = (len(hand.links), CONTACTS_PER_LINK)
    shapes: dict[str, tuple[int, ...]] = {}
    for name in SceneState._fields:
        shapes[name] = (4,) if "quaternion" in name else (3,)
    shapes |= dict.fromkeys(("q", "q_velocity", "q_target", "q_initial"), (fingers,))
    shapes |= dict.fromkeys(("u", "u_velocity", "u_target", "wrist_load"), (6,))
    shapes |= dict.fromkeys(("contact_force", "contact_position"), (*contacts, 3))
    shapes |= dict.fromkeys(("time", "table"), ())
    shapes["contact_found"] = contacts
    return shapes


def _is_name(value: Any) -> bool:
    """True for a string that is short enough for the name of a constraint."""
    return isinstance(value, str) and len(value) <= LONGEST_NAME


@functools.lru_cache(maxsize=1024)
def _estimated(points: bytes, eye: bytes) -> np.ndarray:
    """Normals (3 N) at points (N, 3), float32, toward an eye (3,) unless that is empty."""
    cloud = np.frombuffer(points, np.float32).reshape(1, -1, 3)
    if not eye:
        return np.asarray(estimated_normals(cloud)).reshape(-1)
    camera_position = np.frombuffer(eye, np.float32).reshape(1, 3)
    return np.asarray(estimated_normals(cloud, camera_position)).reshape(-1)


def _unit(
    vectors: jax.Array, needed: jax.Array, default: np.ndarray
) -> tuple[jax.Array, jax.Array]:
    """Normalises vectors (B, ..., n) where needed (B,) and replaces others by the default.

    Returns:
      The vectors, and the norm (B,) farthest from 1 among the needed ones, else 1.
    """
    lengths = jnp.linalg.norm(vectors, axis=-1, keepdims=True)
    usable = needed.reshape(-1, *[1] * (vectors.ndim - 1)) & (lengths > 0.5)
    units = jnp.where(usable, vectors / jnp.where(usable, lengths, 1.0), default)
    lengths_by_state = lengths.reshape(len(vectors), -1)
    longest = lengths_by_state.max(1)
    shortest = lengths_by_state.min(1)
    worst = jnp.where(longest - 1.0 > 1.0 - shortest, longest, shortest)
    return units, jnp.where(needed, worst, 1.0)


def _orthogonal(cross: jax.Array, direction: jax.Array, at_start: jax.Array) -> jax.Array:
    """Unit cross-finger directions (B, 3) orthogonal to the heading.

    If `cross` is absent or parallel to the heading, the hand's direction `at_start` replaces it, so
    that the hand does not roll; if that is parallel as well, an arbitrary one.
    """

    def across(vector: jax.Array) -> jax.Array:
        """Component orthogonal to the heading."""
        return vector - jnp.sum(vector * direction, -1, keepdims=True) * direction

    def unit(vector: jax.Array) -> jax.Array:
        """Vector of length 1."""
        return vector / jnp.linalg.norm(vector, axis=-1, keepdims=True)

    def preferred(vector: jax.Array, shortest: float, otherwise: jax.Array) -> jax.Array:
        """Orthogonal component of a vector, or `otherwise` where it is too short."""
        component = across(vector)
        length = jnp.linalg.norm(component, axis=-1, keepdims=True)
        return jnp.where(length < shortest, otherwise, component)

    arbitrary = across(jnp.eye(3)[jnp.abs(direction).argmin(-1)])
    start_component = preferred(at_start, 0.3, arbitrary)
    result = preferred(cross, 1e-3, start_component)
    # Repeated, because a nearly parallel one leaves mostly rounding error
    return unit(across(unit(result)))
