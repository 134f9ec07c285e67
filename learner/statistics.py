"""Figures of a batch of rollouts that are not part of the update: episodes, staleness, pace and
signs of collapse.
"""

import collections
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.wire.codec import Message

_EPISODE = ("episode/", "term/")
_WINDOW = 10
"""Updates over which success is averaged."""
_LEARNT_SUCCESS = 0.3
"""Success from which on a collapse can be detected."""
_FEW_LINKS = 0.1
"""Links in contact below which the hand avoids the object."""
_OPTIONAL = tuple(constraint for constraint in CONSTRAINTS if constraint.optional)


def summary(messages: Sequence[Message], lags: Sequence[int]) -> dict[str, Any]:
    """Summary of one rank's batch as JSON, from which `overall` computes means over all ranks.

    Args:
      messages: the rollouts of the batch.
      lags: versions between the policy of each rollout and the current one.
    """
    sums, episodes = _episode_sums(messages)
    steps = [int(message.meta["steps"]) for message in messages]
    sums["staleness_mean"] = [float(np.dot(lags, steps)), float(sum(steps))]
    return {"sums": sums, "episodes": episodes, "steps": sum(steps), "staleness_max": max(lags)}


def overall(summaries: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Means over all episodes that ended in the batches of all ranks, their number, and the
    transitions' lag.

    `episode/…` metrics and `term/…` sums are means over all of them, but errors of a constraint
    only over episodes in which it was active (`Constraint.among`, or the block without which an
    error is undefined). `success/heading` covers episodes with only the heading; `success/pose` and
    so on those with that constraint active, alone or with others. A rollout without a finished
    episode contributes nothing; a figure without any episode is absent.
    """
    totals: dict[str, list[float]] = {}
    for part in summaries:
        for name, (value, weight) in part["sums"].items():
            total = totals.setdefault(name, [0.0, 0.0])
            total[0] += value
            total[1] += weight
    means = {name: value / weight for name, (value, weight) in totals.items()}
    return {
        **means,
        "episodes": float(sum(part["episodes"] for part in summaries)),
        "staleness_max": float(max(part["staleness_max"] for part in summaries)),
    }


def _episode_sums(messages: Sequence[Message]) -> tuple[dict[str, list[float]], int]:
    """Sum and number of each figure's values, and the number of episodes; rollouts may have
    different figures.
    """
    sums: dict[str, list[float]] = {}
    episodes = 0
    for message in messages:
        columns = {
            name: np.asarray(values, np.float64).ravel()
            for name, values in message.arrays.items()
            if name.startswith(_EPISODE) and name != "episode/object_index"
        }
        count = max((len(values) for values in columns.values()), default=0)
        episodes += count
        for name, values in _figures(columns, count).items():
            total = sums.setdefault(name, [0.0, 0.0])
            total[0] += float(np.nansum(values))
            total[1] += float(np.sum(~np.isnan(values)))
    return {name: total for name, total in sums.items() if total[1]}, episodes


def _figures(columns: Mapping[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
    """Figures (E,) of one rollout, NaN for episodes to which they do not apply."""
    none = np.zeros(count)
    blocks: dict[str, np.ndarray] = {}
    for constraint in _OPTIONAL:
        for block in constraint.blocks:
            blocks[block] = columns.get(f"episode/mask_{block}", none) > 0
    active = {constraint.name: constraint.among(blocks) for constraint in _OPTIONAL}
    active["heading"] = ~np.any(list(active.values()), 0)
    success = columns.get("episode/success", np.full(count, np.nan))
    figures = dict(columns)
    for name, rows in active.items():
        figures[f"success/{name}"] = np.where(rows, success, np.nan)
    for constraint in CONSTRAINTS:
        for spec in constraint.errors:
            name = f"episode/{spec.name}"
            if name not in columns:
                continue
            rows = blocks[spec.block] if spec.block else active[constraint.name]
            figures[name] = np.where(rows, columns[name], np.nan)
    return figures


class Pace:
    """Environment steps per second over the last updates."""

    def __init__(self, window: int = 20, clock: Callable[[], float] = time.monotonic):
        """Averages over at most `window` updates."""
        self._clock = clock
        self._marks = collections.deque([(clock(), 0)], maxlen=window + 1)

    def steps_per_second(self, steps: int) -> float:
        """Pace after `steps` more environment steps."""
        now = self._clock()
        _, total_before = self._marks[-1]
        total = total_before + steps
        self._marks.append((now, total))
        start, total_at_start = self._marks[0]
        return (total - total_at_start) / max(now - start, 1e-9)


class CollapseWatch:
    """Counts consecutive updates that look like a collapse.

    There are two criteria: a success, averaged over ten updates, below half of its best, once that
    was 30 %; and less than 0.1 links in contact at table removal (the local optimum "never touch",
    if penalties outweigh contact).
    """

    def __init__(self, patience: int):
        """Reports after `patience` such updates in a row; never if it is 0."""
        self._patience = patience
        self._success: collections.deque[float] = collections.deque(maxlen=_WINDOW)
        self._best = 0.0
        self._fallen = 0
        self._untouched = 0

    def add(self, values: dict[str, float]) -> str | None:
        """Adds an update's metrics; returns a description of the collapse once it has lasted long
        enough.
        """
        success = values.get("episode/success")
        links = values.get("episode/links_at_removal")
        if success is None or links is None or not self._patience:
            return None
        self._success.append(success)
        mean = sum(self._success) / len(self._success)
        if len(self._success) == _WINDOW:
            self._best = max(self._best, mean)
        has_fallen = self._best >= _LEARNT_SUCCESS and mean < self._best / 2
        self._fallen = self._fallen + 1 if has_fallen else 0
        self._untouched = self._untouched + 1 if links < _FEW_LINKS else 0
        if self._fallen >= self._patience:
            return (
                f"success fell from {self._best:.0%} to {mean:.0%} and stayed there for "
                f"{self._patience} updates"
            )
        if self._untouched >= self._patience:
            return f"for {self._patience} updates the hand has hardly touched the object"
        return None
