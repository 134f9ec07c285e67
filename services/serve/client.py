"""The client of a policy server, for a robot's control loop: needs nothing but numpy and zenoh."""

import math
import os
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from common.errors import CongraspError
from common.transport import urls
from common.transport.base import RefusedError
from common.transport.keys import Keys
from common.wire.codec import Message


class Answer(NamedTuple):
    """What the policy wants next."""

    q_target: np.ndarray
    """(F,) finger joint targets, rad."""
    u_target: np.ndarray
    """(6,) virtual wrist targets relative to the base: x, y, z in m, then intrinsic x-y-z angles in rad."""
    action: np.ndarray
    """(F + 6,) the policy's raw action."""
    version: int
    """Version of the policy that answered."""
    active: tuple[str, ...]
    """Which constraints are active, in words."""
    round_trip_ms: float
    """From asking to the answer."""
    server_ms: float
    """The server's share of it."""


class _Packer:
    """Queries as vectors, most of which stays the same for an episode.

    Attributes:
      most: states that the server takes in one query.
    """

    def __init__(self, layout: Mapping[str, Any], episode: Mapping[str, np.ndarray], fingers: int):
        self._digest, self._fields, self._fingers = layout["layout"], layout["fields"], fingers
        self.most = int(layout.get("states", 1))
        self._episode = np.zeros(layout["size"], np.float32)
        points = self._fields["surface_points"][1]
        for name, value in episode.items():
            if name in ("surface_points", "surface_minus") and len(value) != points:
                value = np.asarray(value)[np.arange(points) * len(value) // points]
            self._write(self._episode, name, value)

    def pack(self, moments: Sequence[Mapping[str, np.ndarray]], meta: Mapping[str, Any]) -> Message:
        """The episode's query at each of several moments."""
        vectors = np.tile(self._episode, (len(moments), 1))
        for vector, moment in zip(vectors, moments, strict=True):
            for name, value in moment.items():
                self._write(vector, name, value)
        return Message({"packed": vectors}, {**meta, "layout": self._digest})

    def unpack(self, reply: Message) -> list[np.ndarray]:
        """Action, finger targets and wrist targets, of each moment."""
        return np.split(reply.arrays["packed"], [self._fingers + 6, 2 * self._fingers + 6], 1)

    def _write(self, vector: np.ndarray, name: str, value: np.ndarray) -> None:
        if name not in self._fields:
            raise CongraspError(f"The query has an unknown field '{name}'.", f"Known: {', '.join(self._fields)}.")
        offset, *shape = self._fields[name]
        if list(np.shape(value)) != shape:
            raise CongraspError(f"The field '{name}' has shape {np.shape(value)}; it must be {tuple(shape)}.")
        vector[offset : offset + math.prod(shape)] = np.ravel(value)


class PolicyClient:
    """Asks a policy server for joint targets; remembers what an episode started from and the previous targets.

    Frames: everything in the world frame but `u` (relative to the base, which is the wrist's pose at `reset`) and the
    constraints and surface points (object frame). Metres, radians, newtons; quaternions (w, x, y, z).
    """

    def __init__(
        self,
        connect: str,
        run: str = "policy",
        *,
        hand: str = "human",
        timeout: float = 1.0,
        wait: float = 10.0,
        certs: str | os.PathLike[str] | None = None,
    ):
        """Connects; when the server goes away and comes back, so does the connection.

        Args:
          connect: the server's endpoint, such as tcp/10.0.0.7:7457.
          run: name under which the server serves.
          hand: name of the hand that is to be controlled; a server with another hand's policy refuses.
          timeout: seconds that one call may take.
          wait: seconds to wait for the server to appear.
          certs: folder of a client's certificate, for a server that asks for one.

        Raises:
          TransportError: nobody is there.
        """
        self._transport = urls.connect(connect, "client", certs=certs, wait=wait)
        self._keys, self._hand, self._timeout = Keys(run), hand, timeout
        self._episode: dict[str, np.ndarray] = {}
        self._constraints: list[str] = []
        self._time = 0
        self._packer: _Packer | None = None

    def health(self) -> dict[str, object]:
        """Readiness, version, hand and queue of the server."""
        return dict(self._transport.query(self._keys.health, Message({}, {}), timeout=self._timeout).meta)

    def reset(
        self,
        *,
        q: np.ndarray,
        wrist: tuple[np.ndarray, np.ndarray],
        obj: tuple[np.ndarray, np.ndarray],
        surface: np.ndarray,
        minus: np.ndarray | None = None,
        constraints: Sequence[str] = ("heading",),
        **goal: np.ndarray,
    ) -> None:
        """Begins an episode.

        Args:
          q: (F,) finger angles.
          wrist: position (3,) and quaternion (4,) of the wrist; the base from now on.
          obj: position and quaternion of the object.
          surface: (N, 3) points of the object's surface, object frame.
          minus: (N,) bool, which of them must not be touched (affordance).
          constraints: names among heading, affordance, pose and trajectory.
          **goal: their values by the field names of `common.task.types.Goal`, object frame.
        """
        self._constraints = list(constraints)
        self._episode = {
            "q_initial": q,
            "q_target": q,
            "u_target": np.zeros(6),
            "base_position": wrist[0],
            "base_quaternion": wrist[1],
            "object_position_initial": obj[0],
            "object_quaternion_initial": obj[1],
            "surface_points": surface,
            **({} if minus is None else {"surface_minus": minus}),
            **goal,
        }
        self._time = 0
        self._packer = None

    def act(self, state: Mapping[str, np.ndarray]) -> Answer:
        """Joint targets for the present moment.

        Args:
          state: `q`, `u`, `object_position`, `object_quaternion`, `table`; where there are sensors also `q_velocity`,
            `u_velocity`, `object_velocity`, `object_angular_velocity`, `contact_force`, `contact_position` and
            `contact_found`, by the names and shapes of `common.task.types.SceneState` without the batch axis.

        Raises:
          TransportError: the server is away, overloaded, or refuses the query; its words say why.
        """
        (answer,) = self._ask([state])
        self._episode["q_target"], self._episode["u_target"] = answer.q_target, answer.u_target
        self._time += 1
        return answer

    def act_each(self, states: Sequence[Mapping[str, np.ndarray]]) -> list[Answer]:
        """Joint targets for each of several states, as `act` would give them now; the episode does not go on.

        For planners that weigh candidates: one query for all of them costs a small part of one for each.

        Args:
          states: see `act`; 1 to 64. One may also have its own `time` in control steps, and `q_target` and `u_target`,
            from which its targets go on.

        Raises:
          TransportError: see `act`; if one state is bad, none gets an answer.
        """
        if not states:
            raise CongraspError("There is no state to act in.", "Give one or more.")
        if self._packer is None:
            self._ask(states[:1])
        most = self._packer.most if self._packer else 1
        if len(states) > most:
            raise CongraspError(f"These are {len(states)} states.", f"The server takes {most} at a time.")
        return self._ask(states)

    def _ask(self, states: Sequence[Mapping[str, np.ndarray]]) -> list[Answer]:
        began = time.perf_counter()
        try:
            reply, parts = self._exchange(states)
        except RefusedError as error:
            if self._packer is None or "layout" not in str(error):
                raise
            self._packer = None  # another server has taken the place of the one that this layout was of
            reply, parts = self._exchange(states)
        version, server_ms = int(reply.meta["version"]), float(reply.meta["total_ms"])
        spent = 1e3 * (time.perf_counter() - began)
        return [
            Answer(q_target, u_target, action, version, tuple(active), spent, server_ms)
            for action, q_target, u_target, active in zip(*parts, reply.meta["active"], strict=True)
        ]

    def _exchange(self, states: Sequence[Mapping[str, np.ndarray]]) -> tuple[Message, list[Any]]:
        """A query of names at an episode's begin, which is checked field by field; packed ones from then on.

        Returns:
          The reply; the actions, finger targets and wrist targets.
        """
        meta = {"hand": self._hand, "constraints": self._constraints, "timeout": self._timeout}
        now = {"time": np.asarray(self._time, np.float32), "table": np.asarray(True)}
        if self._packer is None:
            arrays = {**self._episode, **now, **states[0]}
            dtypes = {name: bool if np.asarray(value).dtype == bool else np.float32 for name, value in arrays.items()}
            named = {name: np.asarray(value, dtypes[name]) for name, value in arrays.items()}
            reply = self._query(Message(named, {**meta, "layout": True}))
            self._packer = _Packer(reply.meta, self._episode, len(reply.arrays["q_target"]))
            if len(states) == 1:
                return reply, [[reply.arrays[name]] for name in ("action", "q_target", "u_target")]
        now |= {name: self._episode[name] for name in ("q_target", "u_target")}
        reply = self._query(self._packer.pack([{**now, **state} for state in states], meta))
        return reply, self._packer.unpack(reply)

    def _query(self, request: Message) -> Message:
        return self._transport.query(self._keys.act, request, timeout=self._timeout)

    def close(self) -> None:
        """Disconnects."""
        self._transport.close()

    def __enter__(self) -> "PolicyClient":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
