"""Figures about a batch of rollouts that are no part of the update: episodes, staleness and pace."""

import collections
import time
from collections.abc import Callable, Sequence

import numpy as np

from common.wire.codec import Message

_EPISODE = ("episode/", "term/")
_CONSTRAINTS = {"affordance": "affordance", "pose": "pose_wrist", "trajectory": "trajectory"}
"""Mask bit that says whether an episode had the constraint; without any of them it had the heading alone."""


def episode_means(messages: Sequence[Message]) -> dict[str, float]:
    """Means over all episodes that ended in the batch, and their number.

    `episode/…` metrics and `term/…` sums over all of them, but errors of a constraint over those that had it; and
    `success/heading` over episodes with the heading alone, `success/pose` and so on over those with that constraint,
    whatever others they had. A rollout in which no episode ended contributes nothing; what no episode has is absent.
    """
    columns: dict[str, list[np.ndarray]] = collections.defaultdict(list)
    for message in messages:
        for name, values in message.arrays.items():
            if name.startswith(_EPISODE):
                columns[name].append(np.asarray(values, np.float64).ravel())
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    count = max((len(values) for values in joined.values()), default=0)
    active = {name: joined.get(f"episode/mask_{bit}", np.zeros(count)) > 0 for name, bit in _CONSTRAINTS.items()}
    active["heading"] = ~np.any(list(active.values()), 0)
    success = joined.get("episode/success", np.full(count, np.nan))
    joined |= {f"success/{name}": np.where(rows, success, np.nan) for name, rows in active.items()}
    for name, values in joined.items():
        constraint = name.removeprefix("episode/").partition("_")[0]
        if constraint in active:
            joined[name] = np.where(active[constraint], values, np.nan)
    means = {name: float(np.nanmean(values)) for name, values in joined.items() if not np.isnan(values).all()}
    return {**means, "episodes": float(count)}


def staleness(messages: Sequence[Message], lag: Callable[[int], int]) -> dict[str, float]:
    """Lag of each transition of the batch, mean and maximum; `lag` gives that of a policy version."""
    lags = np.array([lag(int(message.meta["version"])) for message in messages], np.float64)
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
