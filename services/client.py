"""The client of a policy server, for a robot's control loop: needs nothing but numpy and zenoh."""

import os
import pathlib
import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

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

    def act(self, state: Mapping[str, np.ndarray]) -> Answer:
        """Joint targets for the present moment.

        Args:
          state: `q`, `u`, `object_position`, `object_quaternion`, `table`; where there are sensors also `q_velocity`,
            `u_velocity`, `object_velocity`, `object_angular_velocity`, `contact_force`, `contact_position` and
            `contact_found`, by the names and shapes of `common.task.types.SceneState` without the batch axis.

        Raises:
          TransportError: the server is away, overloaded, or refuses the query; its words say why.
        """
        arrays = {**self._episode, "time": np.float32(self._time), "table": np.bool_(True), **state}
        request = Message(
            {
                name: np.asarray(value, bool if np.asarray(value).dtype == bool else np.float32)
                for name, value in arrays.items()
            },
            {"hand": self._hand, "constraints": self._constraints, "timeout": self._timeout},
        )
        began = time.perf_counter()
        reply = self._transport.query(self._keys.act, request, timeout=self._timeout)
        spent = 1e3 * (time.perf_counter() - began)
        answer = Answer(
            reply.arrays["q_target"],
            reply.arrays["u_target"],
            reply.arrays["action"],
            int(reply.meta["version"]),
            tuple(reply.meta["active"]),
            spent,
            float(reply.meta["total_ms"]),
        )
        self._episode["q_target"], self._episode["u_target"] = answer.q_target, answer.u_target
        self._time += 1
        return answer

    def close(self) -> None:
        """Disconnects."""
        self._transport.close()

    def __enter__(self) -> "PolicyClient":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
