"""Limit of the learner's silence, and delays between attempts to reach it."""

import itertools
import logging
import math
import threading
import time
from collections.abc import Iterator

from congrasp.common.errors import TransportError

_FIRST_DELAY_S = 0.1
"""Delay after the first failed attempt."""
_LONGEST_DELAY_S = 0.5
"""Longest delay between two attempts."""
_LONGEST_TICK_S = 1.0
"""Longest interval between two readings that counts in full."""
NOTICED_S = 2.0
"""Silence after which a line is logged."""
_NOTICE_AGAIN_S = 60.0
"""Time between two lines."""
_log = logging.getLogger(__name__)


class Patience:
    """Limit of the learner's silence, in seconds during which this process ran.

    An interval in which the process was frozen or starved counts as one second. `now` must
    therefore be called at least once a second.

    Attributes:
      limit: longest silence, s.
    """

    def __init__(self, limit: float):
        """Starts to count."""
        self.limit = limit
        self._lock = threading.Lock()
        self._seconds = 0.0
        self._read = time.monotonic()
        self._noticed = -math.inf

    def now(self) -> float:
        """Returns the seconds so far."""
        with self._lock:
            now = time.monotonic()
            self._seconds += min(now - self._read, _LONGEST_TICK_S)
            self._read = now
            return self._seconds

    def check(
        self,
        answered: float,
        error: TransportError,
        situation: str = "The learner does not answer",
    ) -> None:
        """Logs a silence of the learner, at most once a minute.

        Args:
          answered: time of its last reply, by `now`.
          error: error of the latest query.
          situation: beginning of the line.

        Raises:
          TransportError: the silence exceeds the limit.
        """
        now = self.now()
        silence = now - answered
        if silence > self.limit:
            raise TransportError(
                f"The learner has not answered for {self.limit:g} s: {error}",
                "Start the actor again later.",
            ) from None
        if silence > NOTICED_S and now - self._noticed > _NOTICE_AGAIN_S:
            self._noticed = now
            limit = "" if math.isinf(self.limit) else f" for up to {self.limit:g} s"
            _log.warning("%s; waiting%s: %s", situation, limit, error)


def backoff() -> Iterator[float]:
    """Seconds to wait after the first, second, ... failed attempt."""
    for doublings in range(10):
        yield min(_LONGEST_DELAY_S, _FIRST_DELAY_S * 2**doublings)
    yield from itertools.repeat(_LONGEST_DELAY_S)
