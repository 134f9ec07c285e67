"""Policies for control loops, local or remote: their interface, memory of one episode and queries;
needs only NumPy.

A left hand's policy is that of the right one, with mirrored states and targets.
"""

import dataclasses
import math
import re
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from congrasp.common import mirror
from congrasp.common.errors import LayoutError, RefusedError
from congrasp.common.request import GraspRequest, Pose
from congrasp.common.runtime import forks
from congrasp.common.runtime.settings import library_settings
from congrasp.common.task.resting import resting_mean
from congrasp.common.transport.base import Closing
from congrasp.common.wire.codec import Message

State = Mapping[str, np.ndarray]
"""Current state of hand and object, by field; see `Policy.act`."""
PACKED = "packed"
"""Name of the one array of a query or a reply."""
_REQUIRED = ("surface", "q", "wrist", "object_pose")
_WITH_CAMERA = ("cloud", "q", "wrist")
_MEASURED = ("q", "u", "object_position", "object_quaternion")
_FIRST = ("object_position_initial", "object_quaternion_initial")
_READ = (*_MEASURED, "q_target", "u_target")
_POINTS = ("cloud", "surface_points", "surface_avoid", "surface_normals")
NORMALS, CAMERA = "surface_normals", "camera_position"
"""Names of the normals at the points of a query, and of the position of the camera."""
_SIZE, _TURN = 1.0, 2 * math.pi  # m, median deviation of points; rad
_ANGLES = re.compile(r"(?:\w+_)?q(?:_initial|_target)?|u")  # of u, the last three
_LONGEST = 64  # largest history of a policy, control steps


class Answer(NamedTuple):
    """Targets of the policy."""

    q_target: np.ndarray
    """(F,) finger joint targets, rad."""
    u_target: np.ndarray
    """(6,) virtual wrist targets relative to the base: x, y, z in m, then intrinsic x-y-z angles in
    rad.
    """
    action: np.ndarray
    """(M + 6,) the policy's raw action."""
    version: int
    """Version of the policy that answered."""
    active: tuple[str, ...]
    """Active constraints and the reasons, in sentences."""
    round_trip_ms: float
    """Time from the query to the answer."""
    server_ms: float
    """Part of it that the policy's process took: checks, queue and inference."""


class Policy(Closing, Protocol):
    """Joint targets for one hand and object, one control step after the other.

    It remembers the start of the episode and the previous targets. `PolicyClient` queries a server,
    `LocalPolicy` computes in this process; checks, messages and answers are the same.

    Frames: the world frame, except for `u` (relative to the base, which is the wrist's pose at
    `reset`) and for constraints and surface points (object frame). Metres, radians, newtons;
    quaternions (w, x, y, z).
    """

    def reset(self, request: GraspRequest) -> None:
        """Begins an episode; constraints and arrays are checked by the first `act`.

        Args:
          request: with `surface`, `q`, `wrist` (the base from now on) and `object_pose`, the goal
            arrays of its constraints, and `avoid` if the affordance is among them. A policy with a
            camera takes `cloud` instead of `surface` and `object_pose`, and constraints in the
            world frame.

        Raises:
          RefusedError: the request lacks one of them, or a value is no array of numbers.
        """
        ...

    def act(self, state: State) -> Answer:
        """Joint targets for the current state.

        Args:
          state: `q`, `u`, `object_position`, `object_quaternion`; optionally `table` (True by
            default) and, from sensors, `q_velocity`, `u_velocity`, `object_velocity`,
            `object_angular_velocity`, `contact_force`, `contact_position`, `contact_found` and
            `wrist_load`, by the names and shapes of `common.task.types.SceneState` without the
            batch axis. A policy with a camera takes no pose of the object but, from a newer image,
            `cloud` (N, 3) in the world frame.

        Raises:
          RefusedError: the request or the state is invalid. Its subclasses in `common.errors` are
            errors that a program can handle: an unknown constraint, a contradiction, an overloaded
            server, a deadline missed there.
          TransportError: there is no response from the server.
        """
        ...

    def act_each(self, states: Sequence[State]) -> list[Answer]:
        """Joint targets for each of several states, as `act` would return them now; the episode
        does not advance.

        For planners that compare candidates: one query for all of them is much cheaper than one for
        each.

        Args:
          states: see `act`; 1 to 64. A state may also have `time` in control steps, and `q_target`
            and `u_target`, from which its targets continue.

        Raises:
          TransportError: see `act`; if one state is invalid, none gets an answer.
        """
        ...

    def metadata(self) -> dict[str, Any]:
        """Returns hand, limits and timing of the policy.

        Returns:
          `hand`, its `joints` (F names in the order of `q`), `open_pose` (F,) rad; `limits`, the
          fields of `JointLimits`, or None for a hand whose joints share motors; `period`, seconds
          of a control step; `approach_steps`, control steps before the table is removed in
          training; `observation` (`full`, `tracked` or `camera`), `constraints`, `surface_points`,
          `trajectory_points`; `query`, the layout of queries
          (`services.serve.requests.Layout.description`).

        Raises:
          TransportError: there is no response from the server, or it serves another hand.
        """
        ...

    def close(self) -> None:
        """Ends the connection, if there is one."""
        ...


class EpisodePolicy(Policy):
    """A `Policy` whose subclass answers one query at a time (`services.serve.requests` has their
    form).
    """

    def __init__(self) -> None:
        self._opened = forks.generation()
        self._request: GraspRequest | None = None
        self._fields: dict[str, np.ndarray] = {}  # of all queries of the episode
        self._layout: Mapping[str, Any] | None = None
        self._packer: Packer | None = None
        self._time = 0
        # Number of readings in the mean of the object's pose; 0 once it has moved
        self._rested = np.asarray(1)
        self._past: list[
            Mapping[str, np.ndarray]
        ] = []  # readings of earlier control steps, newest first

    def _query(self, query: Message) -> Message:
        """The reply to a query.

        Raises:
          TransportError: see `Policy.act`.
        """
        raise NotImplementedError

    def _described(self) -> dict[str, Any]:
        """The policy's metadata, without waiting for a server.

        Raises:
          TransportError: see `Policy.metadata`.
        """
        raise NotImplementedError

    @library_settings()
    def metadata(self) -> dict[str, Any]:
        """See `Policy.metadata`."""
        forks.require_same_process(self._opened, "policy")
        return self._described()

    @library_settings()
    def reset(self, request: GraspRequest) -> None:
        """See `Policy.reset`."""
        forks.require_same_process(self._opened, "policy")
        self._fields = _episode_fields(request)
        self._request = request
        self._packer = None
        self._time = 0
        self._rested = np.asarray(1)
        self._past = []

    @library_settings()
    def act(self, state: State) -> Answer:
        """See `Policy.act`."""
        forks.require_same_process(self._opened, "policy")
        began = time.perf_counter()
        packer = self._packing()
        rest, rested = self._resting(state, packer.settle)
        (answer,) = self._ask(began, [{**rest, **state}])
        known = {**self._fields, **state}
        reading = {name: _numbers(name, known[name]) for name in _READ if name in known}
        self._past = [reading, *self._past[: _LONGEST - 1]]
        # Copies, since the caller may change the answer
        targets = {"q_target": answer.q_target.copy(), "u_target": answer.u_target.copy()}
        self._fields.update(rest, **targets)
        self._time += 1
        self._rested = rested
        return answer

    @library_settings()
    def act_each(self, states: Sequence[State]) -> list[Answer]:
        """See `Policy.act_each`."""
        forks.require_same_process(self._opened, "policy")
        if not states:
            raise RefusedError("There is no state to act in.", "Give one or more.")
        return self._ask(time.perf_counter(), states)

    def close(self) -> None:
        """See `Policy.close`."""

    def _packing(self) -> "Packer":
        """The form of the episode's queries, in the layout that the policy's metadata has had since
        the connection.
        """
        if self._request is None:
            raise RefusedError("There is no episode yet.", "Begin one with reset.")
        if self._layout is None:
            self._layout = self._described()["query"]
        if self._packer is None:
            self._packer = Packer(self._layout, self._fields, self._request.constraints)
        return self._packer

    def _resting(self, state: State, settle: float) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Returns the resting pose with this reading, if the policy uses the mean, and the number
        of readings.
        """
        if not (settle and self._time and {"object_position", "object_quaternion"} <= state.keys()):
            return {}, self._rested
        mean = np.concatenate([self._fields[name] for name in _FIRST])
        reading = np.concatenate([_numbers(name, state[name]) for name in _MEASURED[2:]], axis=None)
        if reading.shape != mean.shape or not np.isfinite(reading).all():
            return {}, self._rested  # the policy rejects the query
        table = np.all(state.get("table", True))
        mean, rested = resting_mean(np, mean, self._rested, reading, table, settle)
        return dict(zip(_FIRST, np.split(mean.astype(np.float32), [3]), strict=True)), rested

    def _ask(self, began: float, states: Sequence[State]) -> list[Answer]:
        """Returns the answers to one query, which is repeated if the policy's layout has
        changed.
        """
        try:
            reply = self._query(self._packed(states))
        except LayoutError:  # another server has replaced the one with this layout
            self._layout = self._packer = None
            reply = self._query(self._packed(states))
        version, server_ms = int(reply.meta["version"]), float(reply.meta["total_ms"])
        spent, fingers = 1e3 * (time.perf_counter() - began), len(self._fields["q_initial"])
        vectors = np.array(reply.arrays[PACKED])  # a copy, which the caller may change
        parts = np.split(vectors, [-fingers - 6, -6], 1)
        return [
            Answer(q_target, u_target, action, version, tuple(active), spent, server_ms)
            for action, q_target, u_target, active in zip(*parts, reply.meta["active"], strict=True)
        ]

    def _packed(self, states: Sequence[State]) -> Message:
        """The query in each of several states."""
        packer, fields = self._packing(), self._fields
        now = {"time": np.asarray(self._time), "table": np.asarray(True)}
        now |= {name: fields[name] for name in ("q_target", "u_target", *_FIRST) if name in fields}
        return packer.pack(
            [{**now, **_with_own_normals(state, fields)} for state in states], self._past
        )


class Packer:
    """An episode's queries as vectors, most of which stays the same.

    Attributes:
      settle: m, see `SensingConfig`; 0 if the object's first pose is that of the request.
    """

    def __init__(
        self,
        layout: Mapping[str, Any],
        episode: Mapping[str, np.ndarray],
        constraints: Mapping[str, Mapping[str, np.ndarray]],
    ):
        """Begins an episode.

        Args:
          layout: `query` of the policy's metadata.
          episode: fields that stay the same.
          constraints: goal arrays of each constraint. Those of a constraint that the policy lacks
            are not packed: the policy refuses its name.

        Raises:
          RefusedError: a field is unknown, absent, of the wrong shape or in another unit.
        """
        self._layout, self._fields, self.settle = layout, layout["fields"], float(layout["settle"])
        self._past = {
            name: self._fields[f"past_{name}"][1]
            for name in _READ
            if f"past_{name}" in self._fields
        }
        needs = layout["constraints"]
        known = {name: own for name, own in constraints.items() if name in needs}
        goals = {
            f"{name}_{field}": value for name, own in known.items() for field, value in own.items()
        }
        fields = {
            **episode,
            **_checked({name: _numbers(name, value) for name, value in goals.items()}),
        }
        _require([field for name in known for field in needs[name]], fields)
        self._meta = {"constraints": list(constraints), "layout": layout["digest"]}
        self._vector = np.zeros(layout["size"], np.float32)
        self._write(self._vector, fields)

    def pack(self, states: Sequence[State], past: Sequence[State] = ()) -> Message:
        """The query in each of several states, after the control steps of `past`, newest first.

        The oldest step is repeated where the history reaches back beyond the start of the episode.

        Raises:
          RefusedError: there are too many states, or a field is unknown, absent, of the wrong shape
            or in another unit.
        """
        if len(states) > self._layout["states"]:
            raise RefusedError(
                f"These are {len(states)} states.",
                f"The policy takes {self._layout['states']} at a time.",
            )
        vectors = np.tile(self._vector, (len(states), 1))
        for vector, state in zip(vectors, states, strict=True):
            _require([name for name in _MEASURED if name in self._fields], state)
            self._write(
                vector, _checked({name: _numbers(name, value) for name, value in state.items()})
            )
            for name, steps in self._past.items():
                rows = [_numbers(name, reading[name]) for reading in (past or [state])[:steps]]
                self._write(
                    vector, {f"past_{name}": np.stack(rows + rows[-1:] * (steps - len(rows)))}
                )
        return Message({PACKED: vectors}, self._meta)

    def _write(self, vector: np.ndarray, fields: Mapping[str, np.ndarray]) -> None:
        """Writes fields to their places in a vector; points are spread over as many as the policy
        observes.
        """
        points = [fields[name].shape[:1] for name in _POINTS if name in fields]
        for name, value in fields.items():
            if name not in self._fields and name in (
                NORMALS,
                CAMERA,
            ):  # the policy does not observe normals
                continue
            if name not in self._fields:
                raise RefusedError(
                    f"The query has an unknown field '{name}'.",
                    f"Known: {', '.join(self._fields)}.",
                )
            offset, *shape = self._fields[name]
            given = (
                (max(*points[0], 1), *shape[1:]) if name in _POINTS and points[0] else tuple(shape)
            )
            if value.shape != given:
                raise RefusedError(
                    f"The field '{name}' has shape {value.shape}; it must be {given}."
                )
            if given != tuple(shape):
                value = value[np.arange(shape[0]) * len(value) // shape[0]]
            vector[offset : offset + math.prod(shape)] = value.ravel()


def _require(names: Sequence[str], fields: Mapping[str, Any]) -> None:
    """Raises a RefusedError for the first field that is absent."""
    if lacking := [name for name in names if name not in fields]:
        raise RefusedError(f"The query lacks the field '{lacking[0]}'.")


def _episode_fields(request: GraspRequest) -> dict[str, np.ndarray]:
    """The constant fields of an episode's queries, and the first targets."""
    required = _REQUIRED if request.cloud is None else _WITH_CAMERA
    lacking = [f"'{name}'" for name in required if getattr(request, name) is None]
    if lacking or request.wrist is None:
        raise RefusedError(
            f"The request lacks {' and '.join(lacking)}.",
            "A control loop starts from measured poses.",
        )
    if request.above:
        raise RefusedError(
            "The request is for a hand from above.",
            "Give the heading's direction to a control loop.",
        )
    wrist, turn = _pair("wrist", request.wrist)
    position, quaternion = _pair("object_pose", request.object_pose)
    given = {
        "q_initial": request.q,
        "q_target": request.q,
        "u_target": np.zeros(6),
        "base_position": wrist,
        "base_quaternion": turn,
        "object_position_initial": position,
        "object_quaternion_initial": quaternion,
        "cloud": request.cloud,
        "surface_points": request.surface,
        "surface_avoid": request.avoid,
        "surface_normals": request.normals,
        "camera_position": request.camera,
    }
    return _checked(
        {name: _numbers(name, value) for name, value in given.items() if value is not None}
    )


@np.errstate(invalid="ignore")  # of numbers that are not finite, which the first `act` refuses
def _checked(fields: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Returns the fields; raises a RefusedError for points in mm or cm, by their median, and for
    angles in degrees.
    """
    for name in ("surface_points", "cloud"):
        points = fields.get(name)
        if points is None or points.ndim != 2 or not points.size:
            continue
        if (size := np.median(np.abs(points - np.median(points, 0)))) > _SIZE:
            raise RefusedError(
                f"The field '{name}' has half of its points beyond {size:.3g} m.",
                "Give it in metres.",
            )
    for name in filter(_ANGLES.fullmatch, fields):
        if (
            _TURN
            < (turn := np.abs(fields[name].ravel()[3 * (name == "u") :]).max(initial=0.0))
            < math.inf
        ):
            raise RefusedError(
                f"The field '{name}' has an angle of {turn:.4g}.", "Give it in radians."
            )
    return fields


def _pair(name: str, pose: Pose | None) -> tuple[Any, Any]:
    """Position and quaternion of a pose; None for both without one."""
    try:
        position, quaternion = (None, None) if pose is None else pose
    except (TypeError, ValueError):
        raise RefusedError(f"'{name}' is no pair of a position and a quaternion.") from None
    return position, quaternion


def _with_own_normals(state: State, episode: Mapping[str, np.ndarray]) -> State:
    """Returns a state whose new points do not get the normals of the episode's first ones: zeros
    are estimated.
    """
    new = [state[name] for name in ("cloud", "surface_points") if name in state]
    if not new or "surface_normals" in state or "surface_normals" not in episode:
        return state
    return {**state, "surface_normals": np.zeros(np.shape(new[0]), np.float32)}


def _numbers(name: str, value: Any) -> np.ndarray:
    """A field's value, unchanged if it is bool, else as float32."""
    try:
        array = np.asarray(value)
        return array if array.dtype == bool else array.astype(np.float32)
    except (TypeError, ValueError):
        raise RefusedError(f"The field '{name}' is no array of numbers.") from None


class LeftPolicy(Policy):
    """A `Policy` for the left hand, whose states and targets are mirrored for a policy of the right
    one.
    """

    def __init__(self, right: Policy):
        """Wraps a policy, and takes over its connection.

        Args:
          right: the policy, in this process or of a server.
        """
        self._right = right

    def reset(self, request: GraspRequest) -> None:
        """See `Policy.reset`."""
        self._right.reset(mirrored_request(request))

    def act(self, state: State) -> Answer:
        """See `Policy.act`."""
        return _answer(self._right.act(mirror.fields(state)))

    def act_each(self, states: Sequence[State]) -> list[Answer]:
        """See `Policy.act_each`."""
        return [
            _answer(answer)
            for answer in self._right.act_each([mirror.fields(state) for state in states])
        ]

    def metadata(self) -> dict[str, Any]:
        """See `Policy.metadata`; the limits are those of the left hand."""
        found = self._right.metadata()
        limits = found["limits"] and dict(found["limits"])
        if limits:
            ends = np.array([mirror.wrist(limits[name]) for name in ("lower", "upper")])
            limits["lower"], limits["upper"] = ends.min(0).tolist(), ends.max(0).tolist()
            limits["palm"] = [[-x, *rest] for x, *rest in limits["palm"]]
        return {**found, "hand": f"{found['hand']}:left", "limits": limits}

    def close(self) -> None:
        """See `Policy.close`."""
        self._right.close()


def mirrored_request(request: GraspRequest) -> GraspRequest:
    """The request for the mirror image of its object and hand."""
    return dataclasses.replace(
        request,
        constraints={name: mirror.fields(own) for name, own in request.constraints.items()},
        surface=_vectors(request.surface),
        cloud=_vectors(request.cloud),
        normals=_vectors(request.normals),
        camera=_vectors(request.camera),
        wrist=_pose("wrist", request.wrist),
        object_pose=_pose("object_pose", request.object_pose),
    )


def _vectors(array: np.ndarray | None) -> np.ndarray | None:
    """Mirrored points or directions, if there are any."""
    return None if array is None else mirror.vector(array)


def _answer(answer: Answer) -> Answer:
    """The mirrored answer."""
    return answer._replace(
        u_target=mirror.wrist(answer.u_target), action=mirror.wrist(answer.action)
    )


def _pose(name: str, pose: Pose | None) -> Pose | None:
    """A mirrored pose, if there is one."""
    position, quaternion = _pair(name, pose)
    return None if pose is None else (mirror.vector(position), mirror.quaternion(quaternion))
