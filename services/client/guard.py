"""Guard between a policy and a robot: a command every tick, even if the policy fails.

A separate thread queries the policy (`query_thread`), so that the network does not block the
control loop. Needs only NumPy.
"""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError, RefusedError, TransportError
from congrasp.common.request import GraspRequest
from congrasp.common.transport.base import Closing
from congrasp.services.client.arrays import as_numbers
from congrasp.services.client.fields import position_and_quaternion
from congrasp.services.client.floor import Floor
from congrasp.services.client.limiter import Limiter
from congrasp.services.client.limits import JointLimits
from congrasp.services.client.policy import Answer, Policy, State
from congrasp.services.client.query_thread import Outcome, QueryThread
from congrasp.services.client.speeds import Speeds

Fallback = Literal["freeze", "open"]
Mode = Literal["follow", "hold", "freeze", "open"]
_LIFTED_M = 0.02  # rise above its first height from which an object counts as held
_TRACKED_SIZES = {"object_position": 3, "object_quaternion": 4}
"""Measurements by a tracker and their sizes."""


@dataclasses.dataclass
class Counters:
    """Counters since the guard was created."""

    steps: int = 0
    """Commands."""
    follow: int = 0
    """Commands that followed a fresh answer."""
    hold: int = 0
    """Commands that held the last target without a fresh answer."""
    fallback: int = 0
    """Commands of the fallback."""
    answers: int = 0
    """Accepted answers."""
    late: int = 0
    """Steps in which no answer arrived, neither to their own state nor to an earlier one."""
    stale: int = 0
    """Answers discarded because their state was too old."""
    invalid: int = 0
    """Answers discarded because they were not finite, or had a wrong shape."""
    lost: int = 0
    """Queries without an answer."""
    refused: int = 0
    """Queries that the policy rejected."""
    not_finite: int = 0
    """Commands with a measurement or target that was not finite, or had a wrong shape."""
    torque: int = 0
    """Commands changed by the torque limits."""
    acceleration: int = 0
    """Commands changed by the acceleration limits."""
    speed: int = 0
    """Commands changed by the speed limits."""
    position: int = 0
    """Commands changed by the position limits."""
    table: int = 0
    """Commands that kept the palm above the table."""


class Command(NamedTuple):
    """Command for the robot until the next one, within all limits."""

    q_target: np.ndarray
    """(F,) finger joint targets, rad."""
    u_target: np.ndarray
    """(6,) wrist targets relative to the base: x, y, z in m, intrinsic x-y-z angles in rad."""
    q_torque: np.ndarray
    """(F,) finger joint torques that correspond to the targets, for a torque-controlled robot,
    N.m.
    """
    u_torque: np.ndarray
    """(6,) wrist forces and torques, likewise, N and N.m."""
    mode: Mode
    """`follow`: targets of the policy; `hold`: the last targets, until the policy answers again;
    `freeze` and `open`: the fallback, until `reset`."""
    answer: Answer | None
    """The answer that it follows; None in the other modes."""


class Guard(Closing):
    """A policy whose answers reach a robot only within limits and while they are fresh.

    An answer is fresh if the state of its query is at most `stale` seconds old. While there is
    none, the last targets are held; after `hold` seconds without one, the fallback applies until
    the next `reset`: `freeze` keeps the targets and their torques, `open` opens the fingers as fast
    as the limits allow and keeps the wrist. `open` becomes `freeze` if the object may be held or a
    measurement is missing; the method `open` opens in any case. The policy continues from the
    commanded targets, not from those that it requested.

    An object may be held, until the next `reset`, once it was 2 cm above its first height or
    `table` of a state was false. A policy with a camera does not know the height: only `table`
    counts.

    Attributes:
      counters: counters of commands and answers.
      trouble: cause of the last query without an answer; empty while there are answers, also during
        a fallback.
    """

    def __init__(  # noqa: PLR0913
        self,
        policy: Policy,
        limits: JointLimits | None = None,
        open_pose: np.ndarray | None = None,
        *,
        period: float = 0.01,
        wait: float = 0.006,
        stale: float = 0.05,
        hold: float = 0.5,
        fallback: Fallback = "freeze",
        table: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 0.0),
        clock: Callable[[], float] = time.monotonic,
    ):
        """Starts the thread that queries the policy, which then belongs to the guard alone.

        Args:
          policy: the policy.
          limits: limits of the F finger joints, each of which has a motor, then the six wrist
            joints; by default those of the policy's `metadata`.
          open_pose: (F,) rad, finger angles of `open`; by default those of the metadata.
          period: seconds between two steps.
          wait: seconds that a step waits for its answer, which may also arrive in a later step.
          stale: largest age of the state of a fresh answer, s.
          hold: seconds without a fresh answer until the fallback.
          fallback: `freeze` or `open`.
          table: a, b, c, d in the world frame: the palm stays where a x + b y + c z >= d; (a, b, c)
            of length 1.
          clock: clock in seconds, such as `time.monotonic`.

        Raises:
          CongraspError: limits and open pose do not match, the times are not 0 <= wait < period and
            0 < stale <= hold, or there is no such fallback.
          TransportError: the policy's metadata is needed, and there is no response.
        """
        if limits is None or open_pose is None:
            limits, open_pose = _completed(policy, limits, open_pose)
        fingers = len(limits.lower) - 6
        if fingers < 1 or not np.isfinite(as_numbers(open_pose, fingers)).all():
            raise CongraspError(
                "The open pose must have a finite angle for each finger joint of the limits.",
                "For a hand with fewer motors than joints, construct JointLimits yourself "
                "(docs/robots.md).",
            )
        if not (0.0 <= wait < period and 0.0 < stale <= hold):
            raise CongraspError(
                f"wait is {wait}, period {period}, stale {stale} and hold {hold}.",
                "Choose 0 <= wait < period, and 0 < stale <= hold.",
            )
        if fallback not in ("freeze", "open"):
            raise CongraspError(f"The fallback is {ascii(fallback)[:40]}.", "It is freeze or open.")
        self.counters = Counters()
        self.trouble = ""
        self._limits = limits
        self._open_pose = as_numbers(open_pose, fingers)
        self._period_s = period
        self._wait_s = wait
        self._stale_s = stale
        self._hold_s = hold
        self._fallback = fallback
        self._clock = clock
        self._fingers = fingers
        self._table = np.array(table, float)
        self._sizes: dict[str, int] = {}  # of the measurements that the policy needs
        self._limiter: Limiter | None = None  # None before the first episode
        self._speeds = Speeds(limits.speed, stale)
        self._target = np.zeros(fingers + 6)  # requested, before the limits
        self._fresh_time = clock()  # of the state of the last accepted answer, s
        self._answer: Answer | None = None  # the last accepted one
        self._latched_mode: Fallback | None = None  # until `reset`, `open` or `freeze`
        self._first_height = math.nan
        self._holds_object = False
        self._queries = QueryThread(policy)

    def reset(self, request: GraspRequest, *, moved: bool = False) -> None:
        """Begins an episode; a pending query of the previous one is dropped.

        Args:
          request: see `Policy.reset`; the wrist's targets start from its `wrist`, where the hand
            must be, and those of the fingers continue from the last command. The first episode's
            start from its `q`.
          moved: True if the fingers were moved by other means since the last command: their targets
            also start from `q`.

        Raises:
          CongraspError: its `q` is not a finite angle for each finger joint, or its `wrist` or
            `object_pose` is not a pose. The earlier episode then continues.
          ForkError: the guard was opened before this process was forked.
        """
        self._queries.require_same_process()
        object_position, _ = position_and_quaternion("object_pose", request.object_pose)
        start = np.append(as_numbers(request.q, self._fingers), np.zeros(6))
        if self._limiter is not None and not moved and np.isfinite(start).all():
            start[: self._fingers] = self._limiter.target[: self._fingers]
        floor = None
        if request.wrist is not None:
            floor = Floor(self._table, request.wrist, self._limits.palm)
        self._limiter = Limiter(self._limits, start, period=self._period_s, floor=floor)
        self._speeds = Speeds(self._limits.speed, self._stale_s)
        self._target = self._limiter.target
        self._fresh_time = self._clock()
        self._answer = None
        self._latched_mode = None
        self._holds_object = False
        self._first_height = as_numbers(object_position, 3)[2]
        self._sizes = {"q": self._fingers, "u": 6}
        if request.cloud is None:
            self._sizes |= _TRACKED_SIZES
        self._queries.begin(request)

    def open(self) -> None:
        """Opens the fingers from the next step on, until `reset` or `freeze`, even if they hold an
        object.
        """
        self._latched_mode = "open"

    def freeze(self) -> None:
        """Keeps the targets and their torques from the next step on, until `reset` or `open`."""
        self._latched_mode = "freeze"

    def step(self, state: State) -> Command:
        """Returns the next command, after at most `wait` seconds; accepts invalid states.

        Args:
          state: see `Policy.act`; missing fields count as not measured. Missing joint velocities
            are estimated from successive positions, for the limits and for the policy.

        Raises:
          RefusedError: there is no episode yet.
          ForkError: the guard was opened before this process was forked.
        """
        self._queries.require_same_process()
        if self._limiter is None:
            raise RefusedError("There is no episode yet.", "Begin one with reset.")
        now = self._clock()
        position, velocity = self._measured(state, now)
        query = self._query(state, velocity, self._limiter.target)
        self._accept(self._queries.exchange(query, now, self._wait_s))
        mode = self._next_mode(state, np.append(position, velocity))
        if mode == "open":
            self._target = np.append(self._open_pose, self._limiter.target[self._fingers :])
        elif mode != "follow":
            self._target = self._limiter.target
        limited = self._limiter.limit(self._target, position, velocity, now)
        self._count(mode, limited.by)
        followed = None
        if mode == "follow":
            followed = self._answer
        q_target, u_target = np.split(limited.target, [self._fingers])
        q_torque, u_torque = np.split(limited.torque, [self._fingers])
        return Command(
            q_target=q_target,
            u_target=u_target,
            q_torque=q_torque,
            u_torque=u_torque,
            mode=mode,
            answer=followed,
        )

    def close(self) -> None:
        """Ends the querying thread, and closes the policy."""
        self._queries.close()

    def _query(self, state: State, velocity: np.ndarray, target: np.ndarray) -> State:
        """Returns the state of a query: the given state with estimated velocities, if it has none,
        with NaN for other missing measurements, and with the commanded targets.
        """
        q_velocity, u_velocity = np.split(velocity, [self._fingers])
        q_target, u_target = np.split(target, [self._fingers])
        missing = {}
        for name, size in self._sizes.items():
            if name not in state:
                missing[name] = np.full(size, np.nan)
        return {
            "q_velocity": q_velocity,
            "u_velocity": u_velocity,
            **state,
            **missing,
            "q_target": q_target,
            "u_target": u_target,
        }

    def _count(self, mode: Mode, limits: Sequence[str]) -> None:
        """Counts a command, and the limits that changed it."""
        kind = mode if mode in ("follow", "hold") else "fallback"
        # The counters have the names of the limits.
        for name in ("steps", kind, *limits):
            setattr(self.counters, name, getattr(self.counters, name) + 1)

    def _accept(self, outcome: Outcome | None) -> None:
        """Follows an answer from now on if it is fresh and finite, and counts the outcome."""
        if outcome is None:
            self.counters.late += 1
            return
        answer = outcome.answer
        if isinstance(answer, TransportError):
            self.trouble = str(answer)
            if isinstance(answer, RefusedError):
                self.counters.refused += 1
            else:
                self.counters.lost += 1
            return
        q_target = as_numbers(answer.q_target, self._fingers)
        u_target = as_numbers(answer.u_target, 6)
        target = np.append(q_target, u_target)
        if not np.isfinite(target).all():
            self.counters.invalid += 1
            return
        age = self._clock() - outcome.state_time
        if not 0.0 <= age <= self._stale_s:
            self.counters.stale += 1
            return
        self._target = target
        self._answer = answer
        self._fresh_time = outcome.state_time
        self.trouble = ""
        self.counters.answers += 1

    def _next_mode(self, state: State, measured: np.ndarray) -> Mode:
        """Returns the mode of the next command.

        Args:
          state: the current state.
          measured: its positions and velocities, NaN where they are missing.
        """
        height = as_numbers(state.get("object_position"), 3)[2]
        is_off_table = not np.all(state.get("table", True))
        is_lifted = bool(height > self._first_height + _LIFTED_M)
        self._holds_object = self._holds_object or is_off_table or is_lifted
        age = self._clock() - self._fresh_time
        # Without an answer for too long, or with a clock that was set back
        if self._latched_mode is None and not 0.0 <= age <= self._hold_s:
            if "object_position" in self._sizes:
                measured = np.append(measured, [self._first_height, height])
            may_open = np.isfinite(measured).all() and not self._holds_object
            self._latched_mode = self._fallback if may_open else "freeze"
        if self._latched_mode is not None:
            return self._latched_mode
        is_fresh = self._answer is not None and age <= self._stale_s
        return "follow" if is_fresh else "hold"

    def _measured(self, state: State, now: float) -> tuple[np.ndarray, np.ndarray]:
        """Returns positions and velocities (F + 6,) of a state, NaN where a value is invalid.

        Velocities that the state lacks are estimated.
        """
        q = as_numbers(state.get("q"), self._fingers)
        u = as_numbers(state.get("u"), 6)
        position = np.append(q, u)
        q_estimate, u_estimate = np.split(self._speeds.of(position, now), [self._fingers])
        q_velocity = as_numbers(state.get("q_velocity", q_estimate), self._fingers)
        u_velocity = as_numbers(state.get("u_velocity", u_estimate), 6)
        return position, np.append(q_velocity, u_velocity)


def _completed(
    policy: Policy, limits: JointLimits | None, open_pose: np.ndarray | None
) -> tuple[JointLimits, np.ndarray]:
    """Returns limits and open pose, by default those of the policy's metadata.

    Raises:
      CongraspError: see `Guard`.
      TransportError: see `Guard`.
    """
    metadata = policy.metadata()
    if limits is None:
        if metadata["limits"] is None:
            raise CongraspError(
                f"Joints of the hand '{metadata['hand']}' share motors.",
                "Construct JointLimits yourself and pass them as `limits`.",
            )
        limits = JointLimits(**metadata["limits"])
    if open_pose is None:
        open_pose = metadata["open_pose"]
    return limits, np.asarray(open_pose, float)
