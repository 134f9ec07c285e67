"""Number of an actor's requests that overlap, so that a slow network does not delay rollouts."""

import math
import threading

_NEGLIGIBLE_SHARE = 0.05
"""Share of a rollout's duration below which a request is simply waited for."""
_SMOOTHING = 0.3
"""Weight of the latest duration in a mean."""
_UNQUEUED_FACTOR = 1.5
"""Multiple of the shortest upload up to which uploads do not delay each other."""
_QUEUED_FACTOR = 3.0
"""Multiple of the shortest upload above which they do."""


class Pace:
    """Mean durations of an actor's rollouts and of its requests to the learner; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._seconds: dict[str, float] = {}

    def record(self, what: str, seconds: float) -> None:
        """Records a duration of a rollout or of one kind of request."""
        with self._lock:
            mean = self._seconds.get(what, seconds)
            self._seconds[what] = mean + _SMOOTHING * (seconds - mean)

    def overlap_count(self, what: str, most: int) -> int:
        """Returns the number of requests that must be under way so that none delays a rollout.

        That is the request's duration in rollouts, rounded up; 0 while the request takes a
        negligible share of a rollout, and before both were measured.

        Args:
          what: kind of the request.
          most: limit of the number.
        """
        with self._lock:
            request_s = self._seconds.get(what, 0.0)
            rollout_s = self._seconds.get("rollout", math.inf)
        if request_s <= _NEGLIGIBLE_SHARE * rollout_s:
            return 0
        if request_s >= most * rollout_s:
            return most
        return math.ceil(request_s / rollout_s)


class UploadWindow:
    """Number of rollouts that may be in transit at a time: as many as bandwidth x delay holds.

    The rule is that of TCP Vegas (Brakmo et al., 1994). The window grows while the actor has to
    wait for it and uploads still take about as long as the shortest one, so that they do not queue
    on the link. It shrinks when they take several times as long. Thread-safe.

    Attributes:
      size: number of rollouts.
      most: limit of the number.
    """

    def __init__(self, least: int, most: int):
        """Starts with `least` rollouts; the window never exceeds `most`."""
        self.size = least
        self.most = most
        self._least = least
        self._shortest_s = math.inf
        self._changed = threading.Condition()
        self._in_transit = 0
        self._was_full = False

    def enter(self, timeout: float) -> bool:
        """Waits until another rollout may be sent; False if that takes longer than `timeout`
        seconds.
        """
        with self._changed:
            if self._in_transit >= self.size:
                self._was_full = True
            if not self._changed.wait_for(lambda: self._in_transit < self.size, timeout):
                return False
            self._in_transit += 1
            return True

    def leave(self) -> None:
        """Records that a rollout has its outcome."""
        with self._changed:
            self._in_transit -= 1
            self._changed.notify()

    def record(self, seconds: float) -> None:
        """Records the duration of an answered upload, and adapts the window."""
        with self._changed:
            self._shortest_s = min(self._shortest_s, seconds)
            if seconds > _QUEUED_FACTOR * self._shortest_s:
                self.size = max(self._least, self.size - 1)
            elif self._was_full and seconds < _UNQUEUED_FACTOR * self._shortest_s:
                self.size = min(self.most, self.size + 1)
                self._changed.notify()
            self._was_full = False
