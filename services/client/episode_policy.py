"""Memory of one episode: turns the states of a control loop into queries; needs only NumPy."""

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from congrasp.common.errors import LayoutError, RefusedError
from congrasp.common.request import GraspRequest
from congrasp.common.runtime import forks
from congrasp.common.task.resting import resting_mean
from congrasp.common.wire.codec import Message
from congrasp.services.client.fields import RESTING_POSE, episode_fields, numbers
from congrasp.services.client.packer import HISTORY_FIELDS, PACKED, Packer
from congrasp.services.client.policy import Answer, Policy, State

_NUMPY_SETTINGS = np.errstate(all="ignore")
"""The library's settings of NumPy. Making a query needs no JAX; entering JAX's settings would take
as long as making the query.
"""
_OBJECT_POSE = ("object_position", "object_quaternion")
_MAX_HISTORY = 64  # largest history of a policy, control steps


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
        # Readings of earlier control steps, newest first
        self._past: list[Mapping[str, np.ndarray]] = []

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

    @_NUMPY_SETTINGS
    def metadata(self) -> dict[str, Any]:
        """See `Policy.metadata`."""
        forks.require_same_process(self._opened, "policy")
        return self._described()

    @_NUMPY_SETTINGS
    def reset(self, request: GraspRequest) -> None:
        """See `Policy.reset`."""
        forks.require_same_process(self._opened, "policy")
        self._fields = episode_fields(request)
        self._request = request
        self._packer = None
        self._time = 0
        self._rested = np.asarray(1)
        self._past = []

    @_NUMPY_SETTINGS
    def act(self, state: State) -> Answer:
        """See `Policy.act`."""
        forks.require_same_process(self._opened, "policy")
        began = time.perf_counter()
        packer = self._packing()
        rest, rested = self._resting(state, packer.settle)
        (answer,) = self._ask(began, [{**rest, **state}])
        fields = {**self._fields, **state}
        reading = {name: numbers(name, fields[name]) for name in HISTORY_FIELDS if name in fields}
        self._past = [reading, *self._past[: _MAX_HISTORY - 1]]
        # Copies, since the caller may change the answer
        targets = {"q_target": answer.q_target.copy(), "u_target": answer.u_target.copy()}
        self._fields.update(rest, **targets)
        self._time += 1
        self._rested = rested
        return answer

    @_NUMPY_SETTINGS
    def act_each(self, states: Sequence[State]) -> list[Answer]:
        """See `Policy.act_each`."""
        forks.require_same_process(self._opened, "policy")
        if not states:
            raise RefusedError("There is no state.", "Pass at least one state.")
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
        of readings in it.
        """
        is_measured = all(name in state for name in _OBJECT_POSE)
        if not settle or not self._time or not is_measured:
            return {}, self._rested
        mean = np.concatenate([self._fields[name] for name in RESTING_POSE])
        measured = [numbers(name, state[name]) for name in _OBJECT_POSE]
        reading = np.concatenate(measured, axis=None)
        if reading.shape != mean.shape or not np.isfinite(reading).all():
            return {}, self._rested  # the policy rejects the query
        table = np.all(state.get("table", True))
        mean, rested = resting_mean(np, mean, self._rested, reading, table, settle)
        position, quaternion = np.split(mean.astype(np.float32), [3])
        return dict(zip(RESTING_POSE, (position, quaternion), strict=True)), rested

    def _ask(self, began: float, states: Sequence[State]) -> list[Answer]:
        """Returns the answers to one query, which is repeated if the policy's layout has
        changed.
        """
        try:
            reply = self._query(self._packed(states))
        except LayoutError:  # another server has replaced the one with this layout
            self._layout = None
            self._packer = None
            reply = self._query(self._packed(states))
        version = int(reply.meta["version"])
        server_ms = float(reply.meta["total_ms"])
        round_trip_ms = 1e3 * (time.perf_counter() - began)
        fingers = len(self._fields["q_initial"])
        vectors = np.array(reply.arrays[PACKED])  # a copy, which the caller may change
        actions, q_targets, u_targets = np.split(vectors, [-fingers - 6, -6], 1)
        answers = []
        for row, active in zip(range(len(vectors)), reply.meta["active"], strict=True):
            answer = Answer(
                q_target=q_targets[row],
                u_target=u_targets[row],
                action=actions[row],
                version=version,
                active=tuple(active),
                round_trip_ms=round_trip_ms,
                server_ms=server_ms,
            )
            answers.append(answer)
        return answers

    def _packed(self, states: Sequence[State]) -> Message:
        """The query in each of several states."""
        packer = self._packing()
        now = {"time": np.asarray(self._time), "table": np.asarray(True)}
        for name in ("q_target", "u_target", *RESTING_POSE):
            if name in self._fields:
                now[name] = self._fields[name]
        complete = [{**now, **_with_own_normals(state, self._fields)} for state in states]
        return packer.pack(complete, self._past)


def _with_own_normals(state: State, episode: Mapping[str, np.ndarray]) -> State:
    """Returns a state without the normals of the episode's first points if it has new points. Their
    normals are zero, which requests that the server estimates them.
    """
    new_points = [state[name] for name in ("cloud", "surface_points") if name in state]
    if not new_points or "surface_normals" in state or "surface_normals" not in episode:
        return state
    return {**state, "surface_normals": np.zeros(np.shape(new_points[0]), np.float32)}
