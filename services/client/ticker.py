"""Ticks of a control loop at a steady rate; needs only NumPy."""

import collections
import time

import numpy as np

from congrasp.common.errors import CongraspError

_MAX_DELAYS = 6000  # ticks whose delay is remembered: a minute at 100 Hz


class Ticker:
    """Ticks at multiples of a period.

    If a tick is late by one or more periods, that many of the following ticks are skipped, so that
    there is no burst.

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

        Raises:
          CongraspError: the rate is not valid.
        """
        if not 0.0 < rate <= 100.0:
            raise CongraspError(f"The rate is {rate:g} Hz.", "The policies act at up to 100 Hz.")
        self.period = 1.0 / rate
        self.ticks = 0
        self.missed = 0
        self.longest_ms = 0.0
        self._due = time.monotonic()
        self._delays_ms: collections.deque[float] = collections.deque(maxlen=_MAX_DELAYS)

    def wait(self) -> float:
        """Waits until the next tick; returns its time, of `time.monotonic`."""
        while (remaining_s := self._due - time.monotonic()) > 0:
            time.sleep(remaining_s)
        now = time.monotonic()
        delay_s = now - self._due
        skipped = int(delay_s / self.period)
        self.ticks += 1
        self.missed += skipped
        self._due += (1 + skipped) * self.period
        self._delays_ms.append(1e3 * delay_s)
        self.longest_ms = max(self.longest_ms, 1e3 * delay_s)
        return now

    def jitter_ms(self, percentile: float) -> float:
        """Returns a percentile (0 to 100) of the delays of the last `_MAX_DELAYS` ticks, ms."""
        if not self._delays_ms:
            return 0.0
        return float(np.percentile(self._delays_ms, percentile))
