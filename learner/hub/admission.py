"""Validates the values of rollouts: every number is compared with the task's range, and names are a closed set.

Values within these ranges are trusted. An actor whose rollout is refused must back off, longer each time
(`learner.hub.rate_limit.PutOff`).
"""

import collections
import threading
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.wire.codec import Message
from congrasp.learner.hub.rate_limit import PutOff

_DENSITY = (-100.0, 10.0)
"""Bounds of the log probability of each action, nats: the lower is reached 14 standard deviations from the mean, the
upper at the mean with a standard deviation of 2e-5."""
_ACTIONS = 256  # used if a rollout has a log probability but no action
_ROWS = 128
_NAMES = 1024  # actors for which refused rollouts are counted
_HALF_MAGNITUDE = 0x7FFF


class Ranges(NamedTuple):
    """Largest magnitudes that a task can produce (`learner.hub.ranges`)."""

    observation: np.ndarray
    """(D,)."""
    reward: float
    """Reward of a control step."""
    action: float
    """Action, in its units: targets are clipped far below."""
    episodes: dict[str, tuple[float, float]]
    """Least and largest value of each metric of an episode, by its name on the wire; other names are refused."""
    teacher_observation: np.ndarray = np.zeros(0)
    """(S,)."""
    privileged: np.ndarray = np.zeros(0)
    """(P,)."""


class Admission:
    """Compares the values of rollouts with a task's ranges, and defers offenders; thread-safe."""

    def __init__(self, ranges: Callable[[], Ranges] | None = None):
        """Gets the ranges from a function at the first rollout, whose reply waits for it; None accepts any values."""
        self._ranges = ranges
        self._lock = threading.Lock()
        self._put_off = PutOff()
        self._refused: collections.Counter[str] = collections.Counter()
        self.rejected = 0
        """Number of requests of deferred actors."""

    def check(self, message: Message) -> None:
        """Checks the values of a rollout of valid form; device arrays, which never left this process, are not checked.

        Raises:
          CongraspError: a value is out of range, or the task has no such metric; the message names it.
        """
        arrays = {name: array for name, array in message.arrays.items() if isinstance(array, np.ndarray)}
        if not arrays or self._ranges is None:
            return
        ranges = self._ranges()
        for name, array in arrays.items():
            if name.startswith(("episode/", "term/")):
                if name not in ranges.episodes:
                    raise CongraspError(f"The rollout names {ascii(name)[:60]}, which is not a metric of the task.")
                _within(name, array, *ranges.episodes[name])
            elif name in ("observation", "last_observation"):
                _check_observations(name, array, ranges.observation)
            elif name == "teacher_observation":
                _check_observations(name, array, ranges.teacher_observation)
            elif name in ("privileged", "last_privileged"):
                _check_observations(name, array, ranges.privileged)
            elif name == "reward":
                _within(name, array, -ranges.reward, ranges.reward)
            elif name == "action":
                _within(name, array, -ranges.action, ranges.action)
            elif name == "log_probability":
                actions = arrays["action"].shape[-1] if "action" in arrays else _ACTIONS
                _within(name, array, *(actions * bound for bound in _DENSITY))

    def accept(self, actor: str) -> None:
        """Records an accepted rollout of an actor."""
        with self._lock:
            self._put_off.forgive(actor)

    def refuse(self, actor: str) -> None:
        """Records a refused rollout, and defers the actor."""
        with self._lock:
            self._put_off.offend(actor)
            if actor in self._refused or len(self._refused) < _NAMES:
                self._refused[actor] += 1

    def retry_after(self, actor: str) -> float:
        """Seconds until the actor may send again, usually 0; counts earlier requests."""
        with self._lock:
            seconds = self._put_off.seconds(actor)
            self.rejected += seconds > 0
            return seconds

    def counts(self, actor: str) -> dict[str, int]:
        """Numbers of refused rollouts of an actor, for the status."""
        with self._lock:
            return {"refused": self._refused[actor]}


def _within(name: str, array: np.ndarray, least: float, most: float) -> None:
    """Raises a `CongraspError` for a number out of range."""
    if array.size and not (least <= (low := array.min()) and (high := array.max()) <= most):
        raise _outside(name, low if low < least else high, least, most)


def _check_observations(name: str, array: np.ndarray, most: np.ndarray) -> None:
    """Raises a `CongraspError` for an entry of observations (..., D) whose magnitude exceeds its bound (D,)."""
    for rows, bounds in _magnitudes(array, most):
        if (rows > bounds).any():
            entry = int((rows > bounds).any(0).argmax())
            worst = np.abs(array[..., entry]).max()
            raise _outside(f"{name}[{entry}]", worst, -most[entry], most[entry])


def _magnitudes(array: np.ndarray, most: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields blocks of rows (n, D) and bounds (D,), ordered like magnitudes; half precision by its bits."""
    flat = array.reshape(-1, array.shape[-1])
    if array.dtype != np.float16:
        yield np.abs(flat), most.astype(array.dtype)
        return
    bits, bounds = flat.view(np.uint16), most.astype(np.float16).view(np.uint16)
    for start in range(0, len(bits), _ROWS):  # blocks that fit into the processor's cache
        yield bits[start : start + _ROWS] & _HALF_MAGNITUDE, bounds


def _outside(name: str, value: Any, least: float, most: float) -> CongraspError:
    """Error for a number that the task cannot produce."""
    return CongraspError(
        f"The rollout's array '{name}' holds {value:.4g}; the task's are within {least:.4g} and {most:.4g}."
    )
