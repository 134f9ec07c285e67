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
from congrasp.services.client.fields import (
    INITIAL_POSE,
    WRIST_DOF,
    as_numbers,
    episode_fields,
)
from congrasp.services.client.packer import HISTORY_FIELDS, PACKED_ARRAY, Packer
from congrasp.services.client.policy import Answer, Policy, State

_NUMPY_SETTINGS = np.errstate(all="ignore")
"""The library's settings of NumPy. Making a query needs no JAX; entering JAX's settings would take
as long as making the query.
"""
_OBJECT_POSE = ("object_position", "object_quaternion")
_MAX_HISTORY = 64  # largest history of a policy, control steps
_TABLE_DEFAULT = np.asarray(True)
"""Value of the field `table` in a state that lacks it: the table is present."""


class EpisodePolicy(Policy):
    """A `Policy` whose subclass answers one query at a time. The format of queries is in
    `services.serve.requests`.
    """

    def __init__(self) -> None:
        self._fork_generation = forks.generation()
        self._request: GraspRequest | None = None
        self._layout: Mapping[str, Any] | None = None
        self._packer: Packer | None = None
        # Fields of every query of the episode; those that change have their newest values
        self._episode_fields: dict[str, np.ndarray] = {}
        self._step = 0
        # Number of readings in the object's mean pose; 0 once the object has moved. An array, as
        # `resting_mean` requires.
        self._reading_count = np.asarray(1)
        # `HISTORY_FIELDS` of earlier control steps, newest first
        self._history: list[Mapping[str, np.ndarray]] = []

    def _query(self, query: Message) -> Message:
        """Returns the reply to a query.

        Raises:
          TransportError: see `Policy.act`.
        """
        raise NotImplementedError

    def _fetch_metadata(self) -> dict[str, Any]:
        """Returns the policy's metadata. Only the first call may wait until a server has started,
        since later calls are part of a control loop.

        Raises:
          TransportError: see `Policy.metadata`.
        """
        raise NotImplementedError

    @_NUMPY_SETTINGS
    def metadata(self) -> dict[str, Any]:
        """See `Policy.metadata`."""
        forks.require_same_process(self._fork_generation, "policy")
        return self._fetch_metadata()

    @_NUMPY_SETTINGS
    def reset(self, request: GraspRequest) -> None:
        """See `Policy.reset`."""
        forks.require_same_process(self._fork_generation, "policy")
        self._episode_fields = episode_fields(request)
        self._request = request
        self._packer = None
        self._step = 0
        self._reading_count = np.asarray(1)
        self._history = []

    @_NUMPY_SETTINGS
    def act(self, state: State) -> Answer:
        """See `Policy.act`."""
        forks.require_same_process(self._fork_generation, "policy")
        began_s = time.perf_counter()
        mean_pose, reading_count = self._average_pose(state)
        (answer,) = self._ask([{**mean_pose, **state}], began_s)
        # The episode changes only now: a failed query leaves it unchanged
        fields = {**self._episode_fields, **state}  # the state's values take precedence
        step = {name: as_numbers(name, fields[name]) for name in HISTORY_FIELDS if name in fields}
        self._history = [step, *self._history[: _MAX_HISTORY - 1]]
        # Copies, since the caller may change the answer
        targets = {"q_target": answer.q_target.copy(), "u_target": answer.u_target.copy()}
        self._episode_fields.update(mean_pose, **targets)
        self._reading_count = reading_count
        self._step += 1
        return answer

    @_NUMPY_SETTINGS
    def act_each(self, states: Sequence[State]) -> list[Answer]:
        """See `Policy.act_each`."""
        forks.require_same_process(self._fork_generation, "policy")
        if not states:
            raise RefusedError("There is no state.", "Pass at least one state.")
        return self._ask(states, began_s=time.perf_counter())

    def close(self) -> None:
        """See `Policy.close`."""

    def _get_packer(self) -> Packer:
        """Returns the packer of the episode's queries, which is made once an episode. It uses the
        layout in the policy's metadata, which is fetched at the first call.

        Raises:
          RefusedError: there is no episode yet, or its request is invalid.
          TransportError: see `Policy.metadata`.
        """
        if self._request is None:
            raise RefusedError("There is no episode yet.", "Begin one with reset.")
        if self._layout is None:
            self._layout = self._fetch_metadata()["query"]
        if self._packer is None:
            self._packer = Packer(self._layout, self._episode_fields, self._request.constraints)
        return self._packer

    def _average_pose(self, state: State) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Averages the object's pose over its readings, as long as it rests on the table.

        Returns:
          The mean pose with the reading of this state, as the fields `INITIAL_POSE`; no field if
          the state does not change the mean pose. The number of readings in the mean.
        """
        max_distance = self._get_packer().settle
        if not max_distance:  # the policy uses the request's pose instead of a mean
            return {}, self._reading_count
        if self._step == 0:  # the request's pose counts as the first reading
            return {}, self._reading_count
        if any(name not in state for name in _OBJECT_POSE):
            return {}, self._reading_count
        mean = np.concatenate([self._episode_fields[name] for name in INITIAL_POSE])
        pose = [as_numbers(name, state[name]) for name in _OBJECT_POSE]
        reading = np.concatenate(pose, axis=None)
        if reading.shape != mean.shape or not np.isfinite(reading).all():
            return {}, self._reading_count  # the query will be refused, with a better message
        table = np.all(state.get("table", _TABLE_DEFAULT))
        mean, reading_count = resting_mean(
            np, mean, self._reading_count, reading, table, max_distance
        )
        position, quaternion = np.split(mean.astype(np.float32), [3])
        return dict(zip(INITIAL_POSE, (position, quaternion), strict=True)), reading_count

    def _ask(self, states: Sequence[State], began_s: float) -> list[Answer]:
        """Returns the answers to one query. The query is repeated if the policy's layout has
        changed.

        Args:
          states: see `act_each`.
          began_s: `time.perf_counter()` at the begin of the round trip.
        """
        try:
            reply = self._query(self._build_query(states))
        except LayoutError:  # another server has replaced the one with this layout
            self._layout = None
            self._packer = None
            reply = self._query(self._build_query(states))
        version = int(reply.meta["version"])
        server_ms = float(reply.meta["total_ms"])
        round_trip_ms = 1e3 * (time.perf_counter() - began_s)
        finger_joints = len(self._episode_fields["q_initial"])
        # A row for each state: action, finger targets, wrist targets
        vectors = np.array(reply.arrays[PACKED_ARRAY])  # a copy, which the caller may change
        actions, q_targets, u_targets = np.split(
            vectors, [-finger_joints - WRIST_DOF, -WRIST_DOF], axis=1
        )
        rows = zip(actions, q_targets, u_targets, reply.meta["active"], strict=True)
        answers = []
        for action, q_target, u_target, active in rows:
            answer = Answer(
                q_target=q_target,
                u_target=u_target,
                action=action,
                version=version,
                active=tuple(active),
                round_trip_ms=round_trip_ms,
                server_ms=server_ms,
            )
            answers.append(answer)
        return answers

    def _build_query(self, states: Sequence[State]) -> Message:
        """Returns the query for the targets in each of several states."""
        packer = self._get_packer()
        defaults = {"time": np.asarray(self._step), "table": _TABLE_DEFAULT}
        for name in ("q_target", "u_target", *INITIAL_POSE):
            if name in self._episode_fields:
                defaults[name] = self._episode_fields[name]
        complete_states = [
            {**defaults, **_without_stale_normals(state, self._episode_fields)} for state in states
        ]
        return packer.pack(complete_states, self._history)


def _without_stale_normals(state: State, episode: Mapping[str, np.ndarray]) -> State:
    """Returns a state with zero normals if it has new points. The episode's normals do not belong
    to the new points, and zeros request that the server estimates normals.
    """
    new_points = [state[name] for name in ("cloud", "surface_points") if name in state]
    if not new_points or "surface_normals" in state or "surface_normals" not in episode:
        return state
    return {**state, "surface_normals": np.zeros(np.shape(new_points[0]), np.float32)}
