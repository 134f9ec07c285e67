"""The client of a policy server, for a robot's control loop: needs nothing but numpy and zenoh."""

import math
import os
import pathlib
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from common.errors import CongraspError
from common.transport.base import RefusedError
from common.transport.keys import Keys
from common.transport.security import Credentials
from common.transport.zenoh_transport import ZenohTransport
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
    """Queries as one vector, most of which stays the same for an episode."""

    def __init__(self, layout: Mapping[str, Any], episode: Mapping[str, np.ndarray], fingers: int):
        self._digest, self._fields, self._fingers = layout["layout"], layout["fields"], fingers
        self._episode = np.zeros(layout["size"], np.float32)
        points = self._fields["surface_points"][1]
        for name, value in episode.items():
            if name in ("surface_points", "surface_minus") and len(value) != points:
                value = np.asarray(value)[np.arange(points) * len(value) // points]
            self._write(self._episode, name, value)

    def pack(self, moment: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> Message:
        """The episode's query at a moment."""
        vector = self._episode.copy()
        for name, value in moment.items():
            self._write(vector, name, value)
        return Message({"packed": vector}, {**meta, "layout": self._digest})

    def unpack(self, reply: Message) -> list[np.ndarray]:
        """Action, finger targets and wrist targets."""
        return np.split(reply.arrays["packed"], [self._fingers + 6, 2 * self._fingers + 6])

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
        credentials = None if certs is None else Credentials(pathlib.Path(certs), "client")
        self._transport = ZenohTransport(connect=[connect], flows=("policy",), wait=wait, credentials=credentials)
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
        began = time.perf_counter()
        meta = {"hand": self._hand, "constraints": self._constraints, "timeout": self._timeout}
        moment = {"time": np.asarray(self._time, np.float32), "table": np.asarray(True), **state}
        try:
            reply = self._ask(meta, moment)
        except RefusedError as error:
            if self._packer is None or "layout" not in str(error):
                raise
            self._packer = None  # another server has taken the place of the one that this layout was of
            reply = self._ask(meta, moment)
        if self._packer is None:
            fingers = len(reply.arrays["q_target"])
            self._packer = _Packer(reply.meta, self._episode, fingers)
            action, q_target, u_target = (reply.arrays[name] for name in ("action", "q_target", "u_target"))
        else:
            action, q_target, u_target = self._packer.unpack(reply)
        self._episode["q_target"], self._episode["u_target"] = q_target, u_target
        self._time += 1
        spent = 1e3 * (time.perf_counter() - began)
        return Answer(
            q_target,
            u_target,
            action,
            int(reply.meta["version"]),
            tuple(reply.meta["active"]),
            spent,
            float(reply.meta["total_ms"]),
        )

    def _ask(self, meta: dict[str, Any], moment: Mapping[str, np.ndarray]) -> Message:
        """A query of names at an episode's begin, which is checked field by field; packed ones from then on."""
        if self._packer is None:
            arrays = {**self._episode, **moment}
            dtypes = {name: bool if np.asarray(value).dtype == bool else np.float32 for name, value in arrays.items()}
            named = {name: np.asarray(value, dtypes[name]) for name, value in arrays.items()}
            request = Message(named, {**meta, "layout": True})
        else:
            targets = {name: self._episode[name] for name in ("q_target", "u_target")}
            request = self._packer.pack({**targets, **moment}, meta)
        return self._transport.query(self._keys.act, request, timeout=self._timeout)

    def close(self) -> None:
        """Disconnects."""
        self._transport.close()

    def __enter__(self) -> "PolicyClient":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
