"""Waits of actors and policy servers for a learner that is not there yet, or not any more."""

import math
import time
from collections.abc import Callable
from typing import TypeVar

from congrasp.common.errors import RefusedError, TransportError
from congrasp.common.transport import urls
from congrasp.common.transport.base import Transport
from congrasp.services.ops.lifetime import Stop
from congrasp.services.ops.logs import log

T = TypeVar("T")
_FIRST_LINE_AFTER_S = 2.0
"""Time until the first line about a wait."""
_LINE_PERIOD_S = 60.0
"""Time between two lines."""
_ATTEMPT_S = 1.0
"""Longest time of one attempt, after which a signal is noticed, and least time between the starts
of two attempts."""


def connect_when_up(
    url: str,
    role: urls.Peer,
    *,
    certs: urls.Certs,
    run: str,
    patience: float | None,
    stop: Stop,
) -> Transport | None:
    """Connects to a learner and waits for it; reports the wait after two seconds, then once a
    minute.

    Args:
      url: address of the learner.
      role: role of this process.
      certs: folder of its certificate.
      run: name of the run.
      patience: seconds after which it gives up; None waits without end.
      stop: ends the wait.

    Returns:
      The transport; None if the wait was stopped.

    Raises:
      TransportError: the learner did not respond in time.
      CongraspError: see `urls.connect`.
    """

    def connect() -> Transport:
        return urls.connect(url, role, certs=certs, wait=_ATTEMPT_S, run=run)

    return when_up(connect, f"the learner at {url}", patience=patience, stop=stop)


def when_up(
    attempt: Callable[[], T | None], what: str, *, patience: float | None, stop: Stop
) -> T | None:
    """Repeats an attempt until it succeeds; reports the wait after two seconds, then once a minute.

    Args:
      attempt: returns a result, None for none yet, or raises a TransportError.
      what: name of the awaited thing.
      patience: seconds after which it gives up; None waits without end.
      stop: ends the wait.

    Returns:
      The result; None if the wait was stopped.

    Raises:
      TransportError: the attempts did not succeed in time.
      RefusedError: the peer refuses this process.
    """
    start = time.monotonic()
    limit_s = math.inf if patience is None else patience
    next_line = start + _FIRST_LINE_AFTER_S
    while not stop.is_set():
        attempt_start = time.monotonic()
        try:
            result = attempt()
        except RefusedError:  # a TransportError that a further attempt would not change
            raise
        except TransportError as error:
            reason = str(error)
        else:
            if result is not None:
                return result
            reason = "There is no policy yet."
        now = time.monotonic()
        if now - start >= limit_s:
            raise TransportError(
                f"No response from {what} for {limit_s:g} s: {reason}",
                "Start it, or pass a longer --patience.",
            )
        if now >= next_line:
            end = "" if patience is None else f", up to {limit_s:g} s"
            log("info", f"Waiting for {what}, {now - start:.0f} s so far{end}. {reason}")
            next_line = now + _LINE_PERIOD_S
        until_next_attempt = max(0.0, attempt_start + _ATTEMPT_S - now)
        until_limit = start + limit_s - now
        stop.wait(min(until_next_attempt, until_limit))
    return None
