"""What a rollout may say: every number is compared with what the task can produce, and names are a closed set.

A peer that lies within these ranges is believed. One whose rollout is refused is put off, longer each time
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

_DENSITY = (-100.0, 10.0)  # nats of a log probability for each action; 14 standard deviations, and one of 2e-5
_ACTIONS = 256  # where a rollout has a log probability and no action
_ROWS = 128
_NAMES = 1024  # of actors whose refused rollouts are counted
_HALF_MAGNITUDE = 0x7FFF


class Ranges(NamedTuple):
    """Largest magnitudes that a task can produce (`learner.hub.ranges`)."""

    observation: np.ndarray
    """(D,)."""
    reward: float
    """Of a control step."""
    action: float
    """In units of action: targets are clipped long before."""
    episodes: dict[str, tuple[float, float]]
    """Least and largest value of each metric of an episode, by its name on the wire: no others are known."""
    teacher_observation: np.ndarray = np.zeros(0)
    """(S,)."""
    privileged: np.ndarray = np.zeros(0)
    """(P,)."""


class Admission:
    """Compares the values of rollouts with a task's ranges, and puts offenders off; for any number of threads."""

    def __init__(self, ranges: Callable[[], Ranges] | None = None):
        """The function is called with the first rollout, whose answer waits for it; without one, values may be any."""
        self._ranges = ranges
        self._lock = threading.Lock()
        self._put_off = PutOff()
        self._refused: collections.Counter[str] = collections.Counter()
        self.turned_away = 0
        """Requests of actors that are put off."""

    def check(self, message: Message) -> None:
        """Checks the values of a rollout of the right form; those on a device never left this process and are not.

        Raises:
          CongraspError: naming the array and the range that it leaves, or a name that the task does not know.
        """
        arrays = {name: array for name, array in message.arrays.items() if isinstance(array, np.ndarray)}
        if not arrays or self._ranges is None:
            return
        ranges = self._ranges()
        for name, array in arrays.items():
            if name.startswith(("episode/", "term/")):
                if name not in ranges.episodes:
                    raise CongraspError(f"The rollout names {ascii(name)[:60]}, which is no metric of the task.")
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
        """Notes that a rollout of an actor was accepted."""
        with self._lock:
            self._put_off.forgive(actor)

    def refuse(self, actor: str) -> None:
        """Notes that one was refused, and puts the actor off."""
        with self._lock:
            self._put_off.offend(actor)
            if actor in self._refused or len(self._refused) < _NAMES:
                self._refused[actor] += 1

    def turn_away(self, actor: str) -> float:
        """Seconds until the actor may come again, 0 for most; counts a request that comes before."""
        with self._lock:
            seconds = self._put_off.seconds(actor)
            self.turned_away += seconds > 0
            return seconds

    def counts(self, actor: str) -> dict[str, int]:
        """Rollouts of an actor that were refused, for the status."""
        with self._lock:
            return {"refused": self._refused[actor]}


def _within(name: str, array: np.ndarray, least: float, most: float) -> None:
    """Raises `CongraspError` for a number outside of a range."""
    if array.size and not (least <= (low := array.min()) and (high := array.max()) <= most):
        raise _outside(name, low if low < least else high, least, most)


def _check_observations(name: str, array: np.ndarray, most: np.ndarray) -> None:
    """Raises `CongraspError` for an entry of observations (..., D) whose magnitude is beyond its bound (D,)."""
    for rows, bounds in _magnitudes(array, most):
        if (rows > bounds).any():
            entry = int((rows > bounds).any(0).argmax())
            worst = np.abs(array[..., entry]).max()
            raise _outside(f"{name}[{entry}]", worst, -most[entry], most[entry])


def _magnitudes(array: np.ndarray, most: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Blocks of rows (n, D) and bounds (D,) that are ordered as magnitudes are; half precision by its bits."""
    flat = array.reshape(-1, array.shape[-1])
    if array.dtype != np.float16:
        yield np.abs(flat), most.astype(array.dtype)
        return
    bits, bounds = flat.view(np.uint16), most.astype(np.float16).view(np.uint16)
    for start in range(0, len(bits), _ROWS):  # blocks that stay in the processor's cache
        yield bits[start : start + _ROWS] & _HALF_MAGNITUDE, bounds


def _outside(name: str, value: Any, least: float, most: float) -> CongraspError:
    """The error of a number that the task cannot produce."""
    return CongraspError(
        f"The rollout's array '{name}' holds {value:.4g}; the task's are within {least:.4g} and {most:.4g}."
    )
