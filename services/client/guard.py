"""Guard between a policy and a robot: a command every tick, even if the policy fails.

A separate thread queries the policy, so that the network does not block the control loop. Needs
only NumPy.
"""

import collections
import dataclasses
import math
import threading
import time
from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError, RefusedError, TransportError
from congrasp.common.request import GraspRequest
from congrasp.common.runtime import forks
from congrasp.common.transport.base import Closing
from congrasp.services.client.limits import Floor, JointLimits, Limiter, Speeds, as_numbers
from congrasp.services.client.policy import Answer, Policy, State

Fallback = Literal["freeze", "open"]
Mode = Literal["follow", "hold", "freeze", "open"]
_END = 2.0  # deadline for the end of the querying thread, s
_LIFTED = 0.02  # m above its first height at which an object counts as held
# Measurements by a tracker and their sizes
_OBJECT = {
    "object_position": 3,
    "object_quaternion": 4,
}


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
    """Steps without an answer, to their own state or an earlier one."""
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
    measurement is missing; `open()` opens in any case. The policy continues from the commanded
    targets, not from those that it requested.

    An object may be held once it was 2 cm above its first height, or `table` of a state was false,
    until the next `reset`; a policy with a camera has no height, so that only `table` counts.

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
            limits, open_pose = _described(policy, limits, open_pose)
        fingers = len(limits.lower) - 6
        if fingers < 1 or not np.isfinite(as_numbers(open_pose, fingers)).all():
            raise CongraspError(
                "The open pose must have a finite angle for each finger joint of the limits.",
                "For a hand with fewer motors than joints, make limits of its joints by hand "
                "(docs/robots.md).",
            )
        if not (0.0 <= wait < period and 0.0 < stale <= hold):
            raise CongraspError("The times must be: 0 <= wait < period, and 0 < stale <= hold.")
        if fallback not in ("freeze", "open"):
            raise CongraspError(f"The fallback is {ascii(fallback)[:40]}.", "It is freeze or open.")
        self.counters, self.trouble = Counters(), ""
        self._limits, self._open = limits, as_numbers(open_pose, fingers)
        self._period, self._wait, self._stale, self._hold = period, wait, stale, hold
        self._fallback, self._clock, self._fingers = fallback, clock, fingers
        self._table = np.array(table, float)
        self._needed: dict[str, int] = {}
        self._limiter: Limiter | None = None
        self._speeds = Speeds(limits.speed, stale)
        self._wanted, self._fresh = np.zeros(fingers + 6), clock()
        self._answer: Answer | None = None
        self._latched: Fallback | None = None
        self._height, self._held = math.nan, False
        self._asker = _Asker(policy)

    def reset(self, request: GraspRequest, *, moved: bool = False) -> None:
        """Begins an episode; a pending query of the previous one is dropped.

        Args:
          request: see `Policy.reset`; the wrist's targets start from its `wrist`, where the hand
            must be, and those of the fingers continue from the last command. The first episode's
            start from its `q`.
          moved: True if the fingers were moved by other means since the last command: their targets
            also start from `q`.

        Raises:
          CongraspError: its `q` is not a finite angle for each finger joint, or its `wrist` no
            pose.
          ForkError: the guard was opened before this process was forked.
        """
        self._asker.require_same_process()
        start = np.append(as_numbers(request.q, self._fingers), np.zeros(6))
        if self._limiter is not None and not moved and np.isfinite(start).all():
            start[: self._fingers] = self._limiter.target[: self._fingers]
        floor = (
            Floor(self._table, request.wrist, self._limits.palm)
            if request.wrist is not None
            else None
        )
        self._limiter = Limiter(self._limits, start, period=self._period, floor=floor)
        self._speeds = Speeds(self._limits.speed, self._stale)
        self._wanted, self._fresh = self._limiter.target, self._clock()
        self._answer, self._latched, self._held = None, None, False
        self._height = as_numbers(request.object_pose and request.object_pose[0], 3)[2]
        self._needed = {"q": self._fingers, "u": 6, **(_OBJECT if request.cloud is None else {})}
        self._asker.begin(request)

    def open(self) -> None:
        """Opens the fingers from the next step on, until `reset` or `freeze`, even if they hold an
        object.
        """
        self._latched = "open"

    def freeze(self) -> None:
        """Keeps the targets and their torques from the next step on, until `reset` or `open`."""
        self._latched = "freeze"

    def step(self, state: State) -> Command:
        """The next command; returns after at most `wait` seconds, and accepts invalid states.

        Args:
          state: see `Policy.act`; missing fields count as not measured. Missing joint velocities
            are estimated from successive positions, for the limits and for the policy.

        Raises:
          RefusedError: there is no episode yet.
          ForkError: the guard was opened before this process was forked.
        """
        self._asker.require_same_process()
        if self._limiter is None:
            raise RefusedError("There is no episode yet.", "Begin one with reset.")
        now = self._clock()
        targets = dict(
            zip(
                ("q_target", "u_target"),
                np.split(self._limiter.target, [self._fingers]),
                strict=True,
            )
        )
        lacking = {
            name: np.full(size, np.nan) for name, size in self._needed.items() if name not in state
        }
        position, velocity = self._measured(state, now)
        speeds = dict(
            zip(("q_velocity", "u_velocity"), np.split(velocity, [self._fingers]), strict=True)
        )
        self._take(self._asker.exchange({**speeds, **state, **lacking, **targets}, now, self._wait))
        mode = self._mode(state, np.append(position, velocity))
        if mode == "open":
            self._wanted = np.append(self._open, self._limiter.target[self._fingers :])
        elif mode != "follow":
            self._wanted = self._limiter.target
        limited = self._limiter.limit(self._wanted, position, velocity, now)
        for name in ("steps", mode if mode in ("follow", "hold") else "fallback", *limited.by):
            setattr(self.counters, name, getattr(self.counters, name) + 1)
        (q_target, u_target), (q_torque, u_torque) = (
            np.split(x, [self._fingers]) for x in limited[:2]
        )
        answer = self._answer if mode == "follow" else None
        return Command(q_target, u_target, q_torque, u_torque, mode, answer)

    def close(self) -> None:
        """Ends the querying thread, and closes the policy."""
        self._asker.close()

    def _take(self, outcome: "_Outcome | None") -> None:
        """Accepts an answer if it is fresh and finite, and counts the outcome."""
        if outcome is None:
            self.counters.late += 1
            return
        answer, asked = outcome
        if isinstance(answer, TransportError):
            self.trouble = str(answer)
            self.counters.refused += isinstance(answer, RefusedError)
            self.counters.lost += not isinstance(answer, RefusedError)
            return
        wanted = np.append(
            as_numbers(answer.q_target, self._fingers), as_numbers(answer.u_target, 6)
        )
        if not np.isfinite(wanted).all():
            self.counters.invalid += 1
        elif not 0.0 <= self._clock() - asked <= self._stale:
            self.counters.stale += 1
        else:
            self._wanted, self._answer, self._fresh, self.trouble = wanted, answer, asked, ""
            self.counters.answers += 1

    def _mode(self, state: State, measured: np.ndarray) -> Mode:
        """Returns the mode of the next command; `measured` are positions and velocities."""
        height = as_numbers(state.get("object_position"), 3)[2]
        self._held |= not np.all(state.get("table", True)) or bool(height > self._height + _LIFTED)
        age = self._clock() - self._fresh
        if self._latched is None and not 0.0 <= age <= self._hold:
            heights = (self._height, height) if "object_position" in self._needed else ()
            complete = np.isfinite(np.append(heights, measured)).all()
            self._latched = self._fallback if complete and not self._held else "freeze"
        if self._latched is not None:
            return self._latched
        return "follow" if self._answer is not None and age <= self._stale else "hold"

    def _measured(self, state: State, now: float) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities (F + 6,) of a state; velocities that it lacks are estimated."""
        sizes = {"q": self._fingers, "u": 6}
        position = np.concatenate(
            [as_numbers(state.get(name), size) for name, size in sizes.items()]
        )
        estimated = dict(
            zip(sizes, np.split(self._speeds.of(position, now), [self._fingers]), strict=True)
        )
        velocity = [
            as_numbers(state.get(f"{name}_velocity", estimated[name]), size)
            for name, size in sizes.items()
        ]
        return position, np.concatenate(velocity)


def _described(
    policy: Policy, limits: JointLimits | None, open_pose: np.ndarray | None
) -> tuple[JointLimits, np.ndarray]:
    """Limits and open pose, by default those of the policy's metadata."""
    described = policy.metadata()
    if limits is None and described["limits"] is None:
        raise CongraspError(
            f"Joints of the hand '{described['hand']}' share motors.",
            "Make limits of its joints by hand (JointLimits).",
        )
    pose = described["open_pose"] if open_pose is None else open_pose
    return limits or JointLimits(**described["limits"]), np.asarray(pose, float)


_Outcome = tuple[Answer | TransportError, float]
"""An answer or its error, and the time of its state."""


class _Asker:
    """Queries a policy in a thread: one query at a time, without outcomes of earlier episodes."""

    def __init__(self, policy: Policy):
        self._policy = policy
        self._opened = forks.generation()
        self._changed = threading.Condition()
        self._request: GraspRequest | None = None
        self._question: tuple[State, float] | None = None
        self._outcome: _Outcome | None = None
        self._episode, self._busy, self._closed = 0, False, False
        self._thread = threading.Thread(target=self._work, daemon=True, name="guard")
        self._thread.start()

    def require_same_process(self) -> None:
        """Raises a ForkError in a fork of this process, where the thread does not run."""
        forks.require_same_process(self._opened, "guard")

    def begin(self, request: GraspRequest) -> None:
        """Begins an episode."""
        with self._changed:
            self._episode += 1
            self._busy = self._busy and self._question is None
            self._request, self._question, self._outcome = request, None, None

    def exchange(self, state: State, now: float, timeout: float) -> _Outcome | None:
        """Queries with a state, unless a query is pending, and returns the newest outcome within
        the timeout.

        Args:
          state: the state.
          now: time of the state.
          timeout: seconds to wait.

        Returns:
          An outcome that was not returned before, of this state or of an earlier one; None without
          one.
        """
        with self._changed:
            earlier, self._outcome = self._outcome, None
            if not self._busy:
                self._question, self._busy = (state, now), True
                self._changed.notify_all()
            self._changed.wait_for(lambda: self._outcome is not None, timeout)
            outcome, self._outcome = self._outcome or earlier, None
            return outcome

    def close(self) -> None:
        """Ends the thread, unless a query blocks it, and closes the policy; a fork leaves both to
        the process that opened them.
        """
        if self._opened != forks.generation():
            return
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(_END)
        self._policy.close()

    def _work(self) -> None:
        """Answers queries until closed; runs in the thread."""
        begun = 0  # the last episode with an answer
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._question is not None or self._closed)
                if self._closed or self._question is None:
                    return
                (state, asked), episode, request = self._question, self._episode, self._request
                self._question = None
            answer = self._answer(request if episode != begun else None, state)
            begun = begun if isinstance(answer, TransportError) else episode
            with self._changed:
                self._busy = False
                if episode == self._episode:
                    self._outcome = answer, asked
                self._changed.notify_all()

    def _answer(self, request: GraspRequest | None, state: State) -> Answer | TransportError:
        """The policy's answer, or a TransportError for any failure."""
        try:
            if request is not None:
                self._policy.reset(request)
            answer = self._policy.act(state)
            return (
                answer
                if isinstance(answer, Answer)
                else TransportError("The policy's answer is none.")
            )
        except TransportError as error:
            return error
        except Exception as error:
            return TransportError(f"The policy failed: {type(error).__name__}: {error}")


_KEPT = 6000  # ticks whose jitter is kept: a minute at 100 Hz


class Ticker:
    """Ticks at multiples of a period.

    A tick that is late by a period or more has missed its deadline. Missed ticks are skipped to
    avoid a burst.

    Attributes:
      period: s.
      ticks: number of ticks.
      missed: number of skipped ticks.
      longest_ms: greatest delay of a tick.
    """

    def __init__(self, rate: float):
        """Begins with a tick that is due at once.

        Args:
          rate: Hz, at most 100: the policies act every 10 ms.
        """
        if not 0.0 < rate <= 100.0:
            raise CongraspError(f"The rate is {rate:g} Hz.", "The policies act at up to 100 Hz.")
        self.period = 1.0 / rate
        self.ticks = self.missed = 0
        self.longest_ms = 0.0
        self._due = time.monotonic()
        self._late: collections.deque[float] = collections.deque(maxlen=_KEPT)

    def wait(self) -> float:
        """Waits until the next tick; returns its time, of `time.monotonic`."""
        while (rest := self._due - time.monotonic()) > 0:
            time.sleep(rest)
        now = time.monotonic()
        late = now - self._due
        skipped = int(late / self.period)
        self.ticks += 1
        self.missed += skipped
        self._due += (1 + skipped) * self.period
        self._late.append(1e3 * late)
        self.longest_ms = max(self.longest_ms, 1e3 * late)
        return now

    def jitter_ms(self, percentile: float) -> float:
        """A percentile of the delays of the last `_KEPT` ticks, ms."""
        return float(np.percentile(self._late, percentile)) if self._late else 0.0
