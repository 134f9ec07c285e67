"""Validates the values of rollouts: every number is compared with the task's range
(`learner.hub.task_ranges`), and names are a closed set.

Values within these ranges are trusted. An actor whose rollout is refused must back off, longer each
time (`learner.hub.limits.PutOff`).
"""

import collections
import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.wire.codec import Message
from congrasp.learner.hub.limits import PutOff

if TYPE_CHECKING:
    from congrasp.learner.hub.task_ranges import Ranges

_LOG_DENSITY = (-100.0, 10.0)
"""Bounds of the log probability of each action, nats: the lower is reached 14 standard deviations
from the mean, the upper at the mean with a standard deviation of 2e-5."""
_DEFAULT_ACTIONS = 256
"""Number of actions if a rollout has a log probability but no action."""
_BLOCK_ROWS = 128
"""Rows of half-precision observations that fit into the processor's cache."""
_MAX_ACTORS = 1024
"""Actors for which refused rollouts are counted."""
_HALF_MAGNITUDE = 0x7FFF
"""Bits of a half-precision number's magnitude."""
_OBSERVATIONS = {
    "observation": "observation",
    "last_observation": "observation",
    "teacher_observation": "teacher_observation",
    "privileged": "privileged",
    "last_privileged": "privileged",
}
"""Names of the ranges (`Ranges`) of arrays of observations."""


class Admission:
    """Compares the values of rollouts with a task's ranges, and defers offenders; thread-safe."""

    def __init__(self, ranges: "Callable[[], Ranges] | None" = None):
        """Gets the ranges from a function at the first rollout, whose reply waits for it; None
        accepts any values.
        """
        self._ranges = ranges
        self._lock = threading.Lock()
        self._put_off = PutOff()
        self._refused: collections.Counter[str] = collections.Counter()
        self.rejected = 0
        """Number of requests of deferred actors."""

    def check(self, message: Message) -> None:
        """Checks the values of a rollout of valid form; device arrays, which never left this
        process, are not checked.

        Raises:
          CongraspError: a value is out of range, or the task has no such metric; the message names
            it.
        """
        arrays = {
            name: array for name, array in message.arrays.items() if isinstance(array, np.ndarray)
        }
        if not arrays or self._ranges is None:
            return
        ranges = self._ranges()
        for name, array in arrays.items():
            if name.startswith(("episode/", "term/")):
                _check_metric(name, array, ranges)
            elif name in _OBSERVATIONS:
                _check_observations(name, array, getattr(ranges, _OBSERVATIONS[name]))
            elif name in ("reward", "action"):
                largest = getattr(ranges, name)
                _check_within(name, array, -largest, largest)
            elif name == "log_probability":
                _check_log_probability(array, arrays.get("action"))

    def accept(self, actor: str) -> None:
        """Records an accepted rollout of an actor."""
        with self._lock:
            self._put_off.forgive(actor)

    def refuse(self, actor: str) -> None:
        """Records a refused rollout, and defers the actor."""
        with self._lock:
            self._put_off.offend(actor)
            if actor in self._refused or len(self._refused) < _MAX_ACTORS:
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


def _check_metric(name: str, array: np.ndarray, ranges: "Ranges") -> None:
    """Raises a `CongraspError` for a metric that the task lacks, or a value out of its range."""
    if name not in ranges.episodes:
        raise CongraspError(
            f"The rollout has {ascii(name)[:60]}, which is not a metric of the task."
        )
    least, most = ranges.episodes[name]
    _check_within(name, array, least, most)


def _check_log_probability(array: np.ndarray, action: np.ndarray | None) -> None:
    """Raises a `CongraspError` for a log probability out of range."""
    actions = _DEFAULT_ACTIONS
    if action is not None:
        actions = action.shape[-1]
    least, most = _LOG_DENSITY
    _check_within("log_probability", array, actions * least, actions * most)


def _check_within(name: str, array: np.ndarray, least: float, most: float) -> None:
    """Raises a `CongraspError` for a number out of range."""
    if not array.size:
        return
    low = array.min()
    if not least <= low:  # also for NaN
        raise _outside(name, low if low < least else array.max(), least, most)
    high = array.max()
    if not high <= most:
        raise _outside(name, high, least, most)


def _check_observations(name: str, array: np.ndarray, most: np.ndarray) -> None:
    """Raises a `CongraspError` for an entry of observations (..., D) whose magnitude exceeds its
    bound (D,).
    """
    for rows, bounds in _magnitudes(array, most):
        is_beyond = rows > bounds
        if is_beyond.any():
            entry = int(is_beyond.any(0).argmax())
            worst = np.abs(array[..., entry]).max()
            raise _outside(f"{name}[{entry}]", worst, -most[entry], most[entry])


def _magnitudes(array: np.ndarray, most: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields blocks of rows (n, D) and bounds (D,), ordered like magnitudes; half precision by its
    bits.
    """
    flat = array.reshape(-1, array.shape[-1])
    if array.dtype != np.float16:
        yield np.abs(flat), most.astype(array.dtype)
        return
    bits = flat.view(np.uint16)
    bounds = most.astype(np.float16).view(np.uint16)
    for start in range(0, len(bits), _BLOCK_ROWS):
        yield bits[start : start + _BLOCK_ROWS] & _HALF_MAGNITUDE, bounds


def _outside(name: str, value: Any, least: float, most: float) -> CongraspError:
    """Error for a number that the task cannot produce."""
    return CongraspError(
        f"The rollout's array '{name}' holds {value:.4g}, which is not within the task's limits "
        f"{least:.4g} and {most:.4g}."
    )
