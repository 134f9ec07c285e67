"""Sessions of a studio, one for each browser."""

import collections
import threading
import time
from collections.abc import Callable
from typing import Protocol

from congrasp.common.errors import CongraspError
from congrasp.services.studio.routes import Routes

MAX_SESSIONS = 16
"""Maximum number of browsers; a further one ends the session that was used least recently, if it is
idle.
"""
IDLE_S = 1800.0
"""Seconds without a request after which a session is idle."""


class Session(Protocol):
    """Everything behind the page of one browser."""

    routes: Routes

    def close(self) -> None:
        """Ends the session."""


class Sessions:
    """One session per browser, so that edits in one do not change the objects of others."""

    def __init__(self, new: Callable[[], Session]):
        """Opens the session of the first browser.

        Args:
          new: opens a session.

        Raises:
          CongraspError: `new` failed.
        """
        self._new = new
        self._spare = [new()]
        self._open: collections.OrderedDict[str, tuple[Session, float]] = collections.OrderedDict()
        self._lock = threading.Lock()

    def routes(self, browser: str) -> Routes:
        """Returns the routes of a browser's session, and opens one for a new browser.

        Raises:
          CongraspError: too many browsers use the studio.
        """
        with self._lock:
            now = time.monotonic()
            session, _ = self._open.pop(browser, (None, now))
            if session is None and len(self._open) >= MAX_SESSIONS:
                oldest, used = next(iter(self._open.values()))
                if now - used < IDLE_S:
                    raise CongraspError(
                        f"{MAX_SESSIONS} browsers, the maximum, use this studio.",
                        f"Try again after one of them has been idle for {IDLE_S / 60:.0f} minutes, "
                        f"or start another studio.",
                    )
                self._open.popitem(last=False)
                oldest.close()
            if session is None:
                session = self._spare.pop() if self._spare else self._new()
            self._open[browser] = (session, now)
            return session.routes

    def close(self) -> None:
        """Closes all sessions."""
        with self._lock:
            for session in self._spare:
                session.close()
            for session, _ in self._open.values():
                session.close()
