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
from congrasp.common.task.constraints import known, require_known
from congrasp.common.task.normals import estimated_normals
from congrasp.common.task.readings import Readings
from congrasp.common.task.sensors import get_sensor
from congrasp.common.task.sensors.base import world_pose
from congrasp.common.task.types import CONTACTS_PER_LINK, Goal, SceneState, Surface
from congrasp.common.wire.codec import Message
from congrasp.services.client.fields import CAMERA, NORMALS
from congrasp.services.client.packer import PACKED

STATES_LIMIT = 64
"""Most states in one query."""
_UNIT_TOLERANCE = 0.02


class Query(NamedTuple):
    """A complete query of n states."""

    vectors: np.ndarray
    """(n, S) float32, laid out by `Layout`; its values are checked by `Layout.complete`."""
    asked: tuple[str, ...]
    """Names of the requested constraints."""


class Layout:
    """Names, shapes and offsets of a query's fields for one hand and task.

    Attributes:
      shapes: shapes by field name: state, earlier control steps if the policy observes them, goal,
        surface, and flags of the requested constraints.
      size: length S of the flat vector.
      digest: identifies the layout.
    """

    def __init__(self, hand: Hand, task: TaskConfig):
        fingers, links, points = len(hand.joints), len(hand.links), task.surface_points
        contacts = (links, CONTACTS_PER_LINK)
        special: dict[str, tuple[int, ...]] = {
            **dict.fromkeys(("q", "q_velocity", "q_target", "q_initial"), (fingers,)),
            **dict.fromkeys(("u", "u_velocity", "u_target", "wrist_load"), (6,)),
            **dict.fromkeys(("contact_force", "contact_position"), (*contacts, 3)),
            **dict.fromkeys(("time", "table"), ()),
            "contact_found": contacts,
        }
        self.hand = hand
        self.task = task
        self.known = known(task)
        self._arrays = {
            f"{c.name}_{name}": (c, name, array)
            for c in self.known
            for name, array in c.arrays.items()
        }
        self._neutral = {
            f"{c.name}_{name}": value
            for c in self.known
            for name, value in c.neutral(hand, task)._asdict().items()
        }
        self._sensor = get_sensor(task)
        self.points = self._sensor.points
        self._state = [
            n for n in SceneState._fields if self._sensor.shows_pose or not n.startswith("object_")
        ]
        self.shapes = {
            name: special.get(name, (4,) if "quaternion" in name else (3,)) for name in self._state
        }
        self._past = (
            [f"past_{n}" for n in Readings._fields if n in self._state]
            if not self._sensor.privileged
            else []
        )
        steps = (task.history - 1,)
        self.shapes |= {
            name: (*steps, *self.shapes[name.removeprefix("past_")]) for name in self._past
        }
        self.shapes |= {name: np.shape(value) for name, value in self._neutral.items()}
        self.shapes |= {self.points: (points, 3), "surface_avoid": (points,)}
        if task.surface_normals:
            self.shapes[NORMALS] = (points, 3)
        self._measured = self._sensor.query(hand, task)
        self.shapes |= self._measured
        self.shapes["asked"] = (len(self.known),)
        self.offsets = {}
        self.size = 0
        for name, shape in self.shapes.items():
            self.offsets[name] = self.size
            self.size += math.prod(shape)
        own = [
            name
            for name, (_, _, array) in self._arrays.items()
            if array.kind in ("direction", "quaternion")
        ]
        self._flags = [name for name, (_, _, array) in self._arrays.items() if array.kind == "flag"]
        past = [name for name in self._past if "quaternion" in name]
        self._directions = [*(name for name in self._state if "quaternion" in name), *past, *own]
        self._unit = [*self._directions, *([NORMALS] if NORMALS in self.shapes else [])]
        described = json.dumps([hand.name, self.description()])
        self.digest = hashlib.sha256(described.encode()).hexdigest()[:16]

    def description(self) -> dict[str, Any]:
        """Layout for clients, as JSON.

        Returns:
          `size` of the vector; `fields`, offset and shape of each; `constraints`, the fields that
          each one needs; `states`, the most in one query; `settle`, m, see `SensingConfig`.
        """
        needs = {
            c.name: [
                *(f"{c.name}_{name}" for name, array in c.arrays.items() if array.required),
                *c.needs,
            ]
            for c in self.known
        }
        return {
            "size": self.size,
            "fields": {
                name: [self.offsets[name], *shape]
                for name, shape in self.shapes.items()
                if name != "asked"
            },
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
        return slice(self.offsets[name], self.offsets[name] + math.prod(self.shapes[name]))

    def parse(self, message: Message) -> Query:
        """Returns a query, whose values `complete` checks.

        Raises:
          LayoutError: it is not in this layout.
          CongraspError: it names no valid constraints, or has too many states.
        """
        vectors = message.arrays.get(PACKED)
        fits = (
            vectors is not None
            and vectors.ndim == 2
            and vectors.shape[1] == self.size
            and len(message.arrays) == 1
        )
        if vectors is None or not fits or message.meta.get("layout") != self.digest:
            raise LayoutError(
                "The query does not match the policy's layout.",
                "Take it from the policy's metadata.",
            )
        if not 1 <= len(vectors) <= STATES_LIMIT:
            raise CongraspError(
                f"The query has {len(vectors)} states.", f"Send 1 to {STATES_LIMIT} at a time."
            )
        asked = self._asked(message.meta.get("constraints", ["heading"]))
        vectors = np.array(vectors, np.float32)
        vectors[:, self._places("asked")] = [constraint.name in asked for constraint in self.known]
        return Query(vectors, asked)

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
        asked = fields["asked"] > 0.5
        for name in ("contact_found", "table", "surface_avoid", *self._flags):
            fields[name] = fields[name] > 0.5
        lengths = []
        for name in self._directions:
            constraint = self._arrays[name][0] if name in self._arrays else None
            wanted = (
                jnp.ones_like(finite)
                if constraint is None
                else asked[:, self.known.index(constraint)]
            )
            default = self._neutral.get(name, np.array((1, 0, 0, 0), np.float32))
            fields[name], length = _unit(fields[name], wanted, default)
            lengths.append(length)
        frame, still = world_pose(len(vectors)), jnp.zeros((len(vectors), 3))
        for name in (
            name for name in SceneState._fields if name not in self._state
        ):  # the object frame is the world's
            fields[name] = frame[:, 3:] if "quaternion" in name else still
            if name in Readings._fields:
                fields[f"past_{name}"] = jnp.repeat(fields[name][:, None], self.task.history - 1, 1)
        start = rotations.conjugate(fields["object_quaternion_initial"]), fields["base_quaternion"]
        held = rotations.rotate(rotations.multiply(*start), jnp.array(grasp_frame(self.hand).cross))
        fields["heading_cross"] = _orthogonal(
            fields["heading_cross"], fields["heading_direction"], held
        )
        if NORMALS in fields:
            fields[NORMALS], length = _unit(
                fields[NORMALS], jnp.ones_like(finite), np.array((0, 0, 1), np.float32)
            )
            lengths.append(length)
        surface, goal = self.surface(fields), self.goal(fields)
        fitting = [~asked[:, i] | c.valid(surface, goal[c.name]) for i, c in enumerate(self.known)]
        return fields, jnp.stack([finite, *fitting, *lengths], 1)

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
        own = self._places(NORMALS)
        for index in np.flatnonzero(~vectors[:, own].any(1)):
            row = vectors[index]
            eye = self._field(row, CAMERA) if CAMERA in self.shapes else np.zeros(0, np.float32)
            row[own] = _estimated(
                self._field(row, self.points).tobytes(), eye.tobytes() if eye.any() else b""
            )

    def goal(self, fields: Mapping[str, Any]) -> Goal:
        """Returns the goal arrays of completed fields, before the priority rules."""
        return Goal(
            {
                c.name: c.goal(**{name: fields[f"{c.name}_{name}"] for name in c.arrays})
                for c in self.known
            },
            {},
        )

    def measured(self, fields: Mapping[str, Any]) -> dict[str, Any]:
        """Returns the further measurements (B, ...) of the policy's sensor (`Sensor.query`)."""
        return {name: fields[name] for name in self._measured}

    def readings(self, fields: Mapping[str, Any]) -> Readings | None:
        """Returns the earlier control steps of completed fields, if the policy observes them."""
        if not self._past:
            return None
        return Readings(
            *(
                jnp.concatenate([fields[name][:, None], fields[f"past_{name}"]], 1)
                for name in Readings._fields
            )
        )

    def pass_all(self, checks: np.ndarray) -> bool:
        """True if no state of a batch fails a check (n, C) of `complete`."""
        return bool((np.abs(checks - 1.0) <= _UNIT_TOLERANCE).all())

    def find_error(self, query: Query, checks: np.ndarray) -> CongraspError | None:
        """Returns the error of a query's first invalid state, by the checks (n, C) of `complete`;
        None without one.
        """
        wrong = ~(np.abs(checks - 1.0) <= _UNIT_TOLERANCE)
        if not wrong.any():
            return None
        state = int(wrong.any(1).argmax())
        which = f" of state {state}" if len(checks) > 1 else ""
        finite, rest = not wrong[state, 0], ~wrong[state, 1:]
        fitting, lengths = rest[: len(self.known)].tolist(), rest[len(self.known) :].tolist()
        if not finite:
            fields = self.unpack(query.vectors[state, None])
            bad = next(name for name, value in fields.items() if not np.isfinite(value).all())
            return CongraspError(f"The field '{bad}'{which} is not finite.")
        if not all(fitting):
            return CongraspError(*self.known[fitting.index(False)].invalid)
        bad = lengths.index(False)
        name, length = self._unit[bad], checks[state, 1 + len(self.known) + bad]
        return CongraspError(f"The field '{name}'{which} has length {length:.3f}, not 1.")

    def _asked(self, names: Any) -> tuple[str, ...]:
        """Names of the requested constraints of a query, weakest first."""
        if not isinstance(names, list) or not all(
            isinstance(n, str) and len(n) <= LONGEST_NAME for n in names
        ):
            raise CongraspError("The query's 'constraints' must be a list of names.")
        require_known(names, self.task)
        leading = [constraint.name for constraint in self.known if constraint.guides]
        if not set(leading) & set(names):
            raise CongraspError(
                "The query has no constraint that guides the wrist.",
                f"Add one of: {', '.join(leading)}.",
            )
        return tuple(constraint.name for constraint in self.known if constraint.name in names)


@functools.lru_cache(maxsize=1024)
def _estimated(points: bytes, eye: bytes) -> np.ndarray:
    """Normals (3 N) at points (N, 3), float32, toward an eye if there is one."""
    cloud, *camera = (
        np.frombuffer(data, np.float32).reshape(1, -1, 3) for data in (points, eye) if data
    )
    return np.asarray(estimated_normals(cloud, *(position[:, 0] for position in camera))).reshape(
        -1
    )


def _unit(
    vectors: jax.Array, wanted: jax.Array, default: np.ndarray
) -> tuple[jax.Array, jax.Array]:
    """Normalises vectors (B, ..., n) where wanted (B,) and replaces others by the default.

    Returns:
      The vectors, and the norm (B,) farthest from 1 among the wanted ones, else 1.
    """
    lengths = jnp.linalg.norm(vectors, axis=-1, keepdims=True)
    usable = wanted.reshape(-1, *[1] * (vectors.ndim - 1)) & (lengths > 0.5)
    every = lengths.reshape(len(vectors), -1)
    worst = jnp.where(every.max(1) - 1.0 > 1.0 - every.min(1), every.max(1), every.min(1))
    return jnp.where(usable, vectors / jnp.where(usable, lengths, 1.0), default), jnp.where(
        wanted, worst, 1.0
    )


def _orthogonal(cross: jax.Array, direction: jax.Array, held: jax.Array) -> jax.Array:
    """Unit cross-finger directions (B, 3) orthogonal to the heading.

    If absent or parallel to it, that of the hand at the start, `held`, so that the hand does not
    roll; if that is parallel as well, an arbitrary one.
    """

    def across(vector: jax.Array) -> jax.Array:
        """Component orthogonal to the heading."""
        return vector - jnp.sum(vector * direction, -1, keepdims=True) * direction

    def unit(vector: jax.Array) -> jax.Array:
        return vector / jnp.linalg.norm(vector, axis=-1, keepdims=True)

    rest = across(jnp.eye(3)[jnp.abs(direction).argmin(-1)])
    for wanted, least in ((held, 0.3), (cross, 1e-3)):
        wanted = across(wanted)
        rest = jnp.where(jnp.linalg.norm(wanted, axis=-1, keepdims=True) < least, rest, wanted)
    # Repeated, because a nearly parallel one leaves mostly rounding error
    return unit(across(unit(rest)))
