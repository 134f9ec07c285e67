"""A policy's memory of one episode, and its queries; needs only NumPy."""

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from congrasp.common.errors import LayoutError, RefusedError
from congrasp.common.request import GraspRequest
from congrasp.common.task.resting import resting_mean
from congrasp.common.wire.codec import Message
from congrasp.services.client.policy import Answer, Policy, State

_REQUIRED = ("surface", "q", "wrist", "object_pose")
_WITH_CAMERA = ("cloud", "q", "wrist")
_MEASURED = ("q", "u", "object_position", "object_quaternion")
_FIRST = ("object_position_initial", "object_quaternion_initial")
_READ = (*_MEASURED, "q_target", "u_target")
_POINTS = ("surface_points", "cloud", "surface_avoid", "surface_normals")
_NORMALS = ("surface_normals", "camera_position")
_LONGEST = 64  # largest history of a policy, control steps


class EpisodePolicy(Policy):
    """A `Policy` whose subclass answers one query at a time (`services.serve.requests` has their form)."""

    def __init__(self) -> None:
        self._episode: dict[str, np.ndarray] | None = None
        self._constraints: list[str] = []
        self._time = 0
        self._packer: _Packer | None = None
        self._rested = np.asarray(1)  # number of readings in the mean of the object's pose; 0 once it has moved
        self._past: list[Mapping[str, np.ndarray]] = []  # readings of earlier control steps, newest first

    def _query(self, query: Message) -> Message:
        """The reply to a query.

        Raises:
          TransportError: see `Policy.act`.
        """
        raise NotImplementedError

    def reset(self, request: GraspRequest) -> None:
        """See `Policy.reset`."""
        self._episode, self._packer = _episode_fields(request), None
        self._constraints, self._time, self._past = list(request.constraints), 0, []
        self._rested = np.asarray(1)

    def act(self, state: State) -> Answer:
        """See `Policy.act`."""
        rest, rested = self._resting(state)
        (answer,) = self._ask({**self._begun(), **rest}, [state])
        known = {**self._begun(), **state}
        reading = {name: _numbers(name, known[name]) for name in _READ if name in known}
        self._past = [reading, *self._past[: _LONGEST - 1]]
        self._begun().update(rest, q_target=answer.q_target, u_target=answer.u_target)
        self._time, self._rested = self._time + 1, rested
        return answer

    def act_each(self, states: Sequence[State]) -> list[Answer]:
        """See `Policy.act_each`."""
        if not states:
            raise RefusedError("There is no state to act in.", "Give one or more.")
        if self._packer is None:
            self._ask(self._begun(), states[:1])
        most = self._packer.most if self._packer else 1
        if len(states) > most:
            raise RefusedError(f"These are {len(states)} states.", f"The policy takes {most} at a time.")
        return self._ask(self._begun(), states)

    def close(self) -> None:
        """See `Policy.close`."""

    def _resting(self, state: State) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Returns the resting pose with this reading, if the policy uses the mean, and the number of readings."""
        episode, settle = self._begun(), self._packer.settle if self._packer else 0.0
        if not (settle and self._time and {"object_position", "object_quaternion"} <= state.keys()):
            return {}, self._rested
        mean = np.concatenate([episode[name] for name in _FIRST])
        reading = np.concatenate([_numbers(name, state[name]) for name in _MEASURED[2:]], axis=None)
        if reading.shape != mean.shape or not np.isfinite(reading).all():
            return {}, self._rested  # the policy rejects the query
        table = np.all(state.get("table", True))
        mean, rested = resting_mean(np, mean, self._rested, reading, table, settle)
        return dict(zip(_FIRST, np.split(mean.astype(np.float32), [3]), strict=True)), rested

    def _begun(self) -> dict[str, np.ndarray]:
        """The fields of the episode."""
        if self._episode is None:
            raise RefusedError("There is no episode yet.", "Begin one with reset.")
        return self._episode

    def _ask(self, episode: Mapping[str, np.ndarray], states: Sequence[State]) -> list[Answer]:
        """Returns the answers to one query, which is repeated if the layout of packed ones has changed."""
        began = time.perf_counter()
        states = [_with_own_normals(state, episode) for state in states]
        try:
            reply, parts = self._exchange(episode, states)
        except LayoutError:
            if self._packer is None:
                raise
            self._packer = None  # another server has replaced the one with this layout
            reply, parts = self._exchange(episode, states)
        version, server_ms = int(reply.meta["version"]), float(reply.meta["total_ms"])
        spent = 1e3 * (time.perf_counter() - began)
        return [
            Answer(q_target, u_target, action, version, tuple(active), spent, server_ms)
            for action, q_target, u_target, active in zip(*parts, reply.meta["active"], strict=True)
        ]

    def _exchange(self, episode: Mapping[str, np.ndarray], states: Sequence[State]) -> tuple[Message, list[Any]]:
        """Sends a named query at an episode's start, which is checked field by field; packed ones from then on.

        A named query has no history: when a policy with history joins a running episode, it only provides the layout.

        Returns:
          The reply; the actions, finger targets and wrist targets.
        """
        meta = {"constraints": self._constraints}
        now = {"time": np.asarray(self._time, np.float32), "table": np.asarray(True)}
        if self._packer is None:
            arrays = {name: _numbers(name, value) for name, value in {**episode, **now, **states[0]}.items()}
            reply = self._query(Message(arrays, {**meta, "layout": True}))
            self._packer = _Packer(reply.meta, episode, len(reply.arrays["q_target"]))
            if len(states) == 1 and not (self._past and self._packer.looks_back):
                return reply, [[reply.arrays[name]] for name in ("action", "q_target", "u_target")]
        now |= {name: episode[name] for name in ("q_target", "u_target", *_FIRST) if name in episode}
        reply = self._query(self._packer.pack([{**now, **state} for state in states], self._past, meta))
        return reply, self._packer.unpack(reply)


class _Packer:
    """Queries as vectors, most of which stays the same for an episode.

    Attributes:
      most: largest number of states in one query.
      settle: m, see `SensingConfig`; 0 if the object's first pose is that of the request.
      looks_back: True if the policy observes earlier control steps.
    """

    def __init__(self, layout: Mapping[str, Any], episode: Mapping[str, np.ndarray], fingers: int):
        self._digest, self._fields, self._fingers = layout["layout"], layout["fields"], fingers
        self.most, self.settle = int(layout.get("states", 1)), float(layout.get("settle", 0.0))
        self._past = {name: self._fields[f"past_{name}"][1] for name in _READ if f"past_{name}" in self._fields}
        self._measured = [name for name in _MEASURED if name in self._fields]
        self.looks_back = bool(self._past)
        self._episode = np.zeros(layout["size"], np.float32)
        for name, value in episode.items():
            self._write(self._episode, name, value)

    def pack(self, states: Sequence[State], past: Sequence[State], meta: Mapping[str, Any]) -> Message:
        """The episode's query in each of several states, after the control steps of `past`, newest first.

        The oldest step is repeated where the history reaches back beyond the start of the episode.

        Raises:
          RefusedError: a state lacks a measured field.
        """
        vectors = np.tile(self._episode, (len(states), 1))
        for vector, state in zip(vectors, states, strict=True):
            if lacking := [name for name in self._measured if name not in state]:
                raise RefusedError(f"The query lacks the field '{lacking[0]}'.")
            for name, value in state.items():
                self._write(vector, name, _numbers(name, value))
            for name, steps in self._past.items():
                rows = [_numbers(name, reading[name]) for reading in (past or [state])[:steps]]
                self._write(vector, f"past_{name}", np.stack(rows + rows[-1:] * (steps - len(rows))))
        return Message({"packed": vectors}, {**meta, "layout": self._digest})

    def unpack(self, reply: Message) -> list[np.ndarray]:
        """Actions, finger targets and wrist targets, with a row for each state."""
        return np.split(reply.arrays["packed"], [-self._fingers - 6, -6], 1)

    def _write(self, vector: np.ndarray, name: str, value: np.ndarray) -> None:
        """Writes a field's numbers to their place in a vector."""
        if name not in self._fields and name in _NORMALS:  # the policy does not observe normals
            return
        if name not in self._fields:
            raise RefusedError(f"The query has an unknown field '{name}'.", f"Known: {', '.join(self._fields)}.")
        offset, *shape = self._fields[name]
        if name in _POINTS and value.ndim and len(value) and len(value) != shape[0]:
            value = value[np.arange(shape[0]) * len(value) // shape[0]]
        if list(value.shape) != shape:
            raise RefusedError(f"The field '{name}' has shape {value.shape}; it must be {tuple(shape)}.")
        vector[offset : offset + math.prod(shape)] = value.ravel()


def _episode_fields(request: GraspRequest) -> dict[str, np.ndarray]:
    """The constant fields of an episode's queries, and the first targets."""
    required = _REQUIRED if request.cloud is None else _WITH_CAMERA
    lacking = [f"'{name}'" for name in required if getattr(request, name) is None]
    if lacking or request.wrist is None:
        raise RefusedError(f"The request lacks {' and '.join(lacking)}.", "A control loop starts from measured poses.")
    if request.above:
        raise RefusedError("The request is for a hand from above.", "Give the heading's direction to a control loop.")
    given: dict[str, Any] = {
        "q_initial": request.q,
        "q_target": request.q,
        "u_target": np.zeros(6),
        "base_position": request.wrist[0],
        "base_quaternion": request.wrist[1],
        **({} if request.object_pose is None else dict(zip(_FIRST, request.object_pose, strict=True))),
        **{name: x for name, x in (("cloud", request.cloud), ("surface_points", request.surface)) if x is not None},
        **({} if request.avoid is None else {"surface_avoid": request.avoid}),
        **({} if request.normals is None else {"surface_normals": request.normals}),
        **({} if request.camera is None else {"camera_position": request.camera}),
        **{f"{name}_{field}": value for name, own in request.constraints.items() for field, value in own.items()},
    }
    return {name: _numbers(name, value) for name, value in given.items()}


def _with_own_normals(state: State, episode: Mapping[str, np.ndarray]) -> State:
    """Returns a state whose new points do not get the normals of the episode's first ones: zeros are estimated."""
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
