"""Detects from its metrics that a policy has forgotten how to grasp, or avoids contact."""

import collections

_WINDOW = 10  # updates over which metrics are averaged
_LEARNT = 0.3  # success from which on a collapse can be detected
_UNTOUCHED = 0.1  # links in contact below which the hand avoids the object


class CollapseWatch:
    """Counts consecutive updates that look like a collapse.

    There are two criteria: a success, averaged over ten updates, below half of its best, once that was 30 %; and less
    than 0.1 links in contact at table removal (the local optimum "never touch", if penalties outweigh contact).
    """

    def __init__(self, patience: int):
        """Reports after `patience` such updates in a row; never if it is 0."""
        self._patience = patience
        self._success: collections.deque[float] = collections.deque(maxlen=_WINDOW)
        self._best = 0.0
        self._fallen = self._untouched = 0

    def add(self, values: dict[str, float]) -> str | None:
        """Adds an update's metrics; returns a description of the collapse once it has lasted long enough."""
        success, links = (values.get(f"episode/{name}") for name in ("success", "links_at_removal"))
        if success is None or links is None or not self._patience:
            return None
        self._success.append(success)
        mean = sum(self._success) / len(self._success)
        if len(self._success) == _WINDOW:
            self._best = max(self._best, mean)
        self._fallen = self._fallen + 1 if self._best >= _LEARNT and mean < self._best / 2 else 0
        self._untouched = self._untouched + 1 if links < _UNTOUCHED else 0
        if self._fallen >= self._patience:
            return f"success fell from {self._best:.0%} to {mean:.0%} and stayed there for {self._patience} updates"
        if self._untouched >= self._patience:
            return f"for {self._patience} updates the hand has hardly touched the object"
        return None
