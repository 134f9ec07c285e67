"""Interface of policies for control loops, in this process or of a server; needs only NumPy."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from congrasp.common.request import GraspRequest
from congrasp.common.transport.base import Closing

State = Mapping[str, ArrayLike]
"""Current state of hand and object, by field; see `Policy.act`."""


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
          RefusedError: the request lacks a required field, or a field is not a numeric array.
        """
        ...

    def act(self, state: State) -> Answer:
        """Returns joint targets for the current state.

        Args:
          state: `q`, `u`, `object_position`, `object_quaternion`; optionally `table` (True by
            default) and, from sensors, `q_velocity`, `u_velocity`, `object_velocity`,
            `object_angular_velocity`, `contact_force`, `contact_position`, `contact_found` and
            `wrist_load`, by the names and shapes of `common.task.types.SceneState` without the
            batch axis. A policy with a camera takes no pose of the object but, from a newer image,
            `cloud` (N, 3) in the world frame. With an affordance, pass `surface_avoid` (N,) of the
            newer points, too: the labels of the request apply by the points' order.

        Raises:
          RefusedError: the request or the state is invalid. Its subclasses in `common.errors` are
            errors that a program can handle: an unknown constraint, a contradiction, an overloaded
            server, a deadline missed there.
          TransportError: there is no response from the server.
        """
        ...

    def act_each(self, states: Sequence[State]) -> list[Answer]:
        """Returns joint targets for each of several states, as `act` would return them now; the
        episode does not advance.

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
