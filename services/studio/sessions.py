"""One session per browser, so that edits in one do not change the objects of others."""

import collections
import threading
from collections.abc import Callable

from congrasp.services.studio.server import Routes
from congrasp.services.studio.session import Session

MOST = 8
"""Maximum number of browsers; a further one ends the session that was used least recently."""


class Sessions:
    """Sessions by browser."""

    def __init__(self, new: Callable[[], Session]):
        """Opens the session of the first browser.

        Args:
          new: opens a session.

        Raises:
          CongraspError: `new` failed.
        """
        self._new, self._spare = new, [new()]
        self._open: collections.OrderedDict[str, Session] = collections.OrderedDict()
        self._lock = threading.Lock()

    def routes(self, browser: str) -> Routes:
        """Returns the routes of a browser's session, and opens one for a new browser."""
        with self._lock:
            if browser not in self._open:
                self._open[browser] = self._spare.pop() if self._spare else self._new()
            self._open.move_to_end(browser)
            if len(self._open) > MOST:
                self._open.popitem(last=False)[1].close()
            return self._open[browser].routes

    def close(self) -> None:
        """Closes all sessions."""
        with self._lock:
            for session in (*self._spare, *self._open.values()):
                session.close()
