"""Figures about a batch of rollouts that are no part of the update: episodes, staleness and pace."""

import collections
import time
from collections.abc import Callable, Sequence

import numpy as np

from common.wire.codec import Message

_EPISODE = ("episode/", "term/")


def episode_means(messages: Sequence[Message]) -> dict[str, float]:
    """Mean of every `episode/…` metric and `term/…` sum over all episodes that ended in the batch, and their number.

    A rollout in which no episode ended contributes nothing; metrics that no episode has are absent. Episodes without a
    value (NaN: the constraint was not active) are left out of that metric's mean.
    """
    columns: dict[str, list[np.ndarray]] = collections.defaultdict(list)
    for message in messages:
        for name, values in message.arrays.items():
            if name.startswith(_EPISODE):
                columns[name].append(np.asarray(values, np.float64).ravel())
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    means = {name: float(np.nanmean(values)) for name, values in joined.items() if not np.isnan(values).all()}
    return {**means, "episodes": float(max((len(values) for values in joined.values()), default=0))}


def staleness(messages: Sequence[Message], version: int) -> dict[str, float]:
    """Versions by which each transition of the batch lags behind the learner's `version`: mean and maximum."""
    lags = np.array([version - int(message.meta["version"]) for message in messages], np.float64)
    weights = np.array([int(message.meta["steps"]) for message in messages], np.float64)
    return {"staleness_mean": float(np.average(lags, weights=weights)), "staleness_max": float(lags.max())}


class Pace:
    """Environment steps a second over the last updates."""

    def __init__(self, window: int = 20, clock: Callable[[], float] = time.monotonic):
        """Averages over at most `window` updates."""
        self._clock = clock
        self._marks = collections.deque([(clock(), 0)], maxlen=window + 1)

    def steps_per_second(self, steps: int) -> float:
        """The pace after `steps` more environment steps."""
        now, total = self._clock(), self._marks[-1][1] + steps
        self._marks.append((now, total))
        first, before = self._marks[0]
        return (total - before) / max(now - first, 1e-9)
