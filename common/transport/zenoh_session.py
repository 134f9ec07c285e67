"""Zenoh's sessions: how they are configured and limited, and the threads that work inside them.

A listener bounds what a stranger can hold: connections that say nothing, messages that are never whole, and answers
that nobody reads. An answer is dropped, and waited for no longer than some milliseconds, when its reader's link has no
room: Zenoh answers with the congestion control of the query, which everyone here overwrites on arrival.
"""

import contextlib
import json
import logging
import re
import resource
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import zenoh

from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.transport.base import join
from congrasp.common.transport.keys import FLOWS, Flow
from congrasp.common.transport.security import Credentials, limits, refusal

LONGEST: dict[Flow, int] = {"control": 2 << 20, "log": 32 << 20, "policy": 2 << 20}
"""Bytes of a message that is put together at all; every connection may have several in the making."""
_LEASE_MS: dict[Flow, int] = {"control": 2500, "bulk": 10000, "log": 10000, "policy": 2500}
_BLOCK_US: dict[Flow, int] = {"control": 2_000_000, "bulk": 5_000_000, "log": 1_000_000, "policy": 2_000_000}
_OVERHEAD = 64 << 10  # bytes that Zenoh may add to a message
_ATTEMPT = 1.0  # seconds of one attempt to connect; signals are seen between two
_CLOSE = 2.0  # seconds that closing may take: with thousands of tokens on a busy machine it takes more than one
_REOPEN = 10.0  # seconds that opening anew may take
_ROOM_US: dict[Flow, int] = {"control": 10_000, "bulk": 50_000, "log": 10_000, "policy": 5_000}
"""Microseconds that an answer waits for room in its reader's link; then all are dropped until there is some."""
_ROOM_LONG_US = 200_000  # that a piece of a long answer waits in all
_QUEUE = 8  # batches of 64 KiB that wait for a link: an acknowledgement finds room beside a piece of a long reply
_ACCEPT_MS = 5000  # that a connection has until it has shown who it is
_PENDING = 4096  # connections that may be at that, and no more than a quarter of the files that may be open
_FILES = 16384  # that the process may have open, if the system allows it: each connection is one
_SESSIONS = 1000  # and no more than a quarter of the files: Zenoh panics where there are none left
_log = logging.getLogger(__name__)


def configuration(
    name: Flow, endpoints: list[str], listens: bool, max_message: int, credentials: Credentials | None
) -> zenoh.Config:
    """Zenoh's configuration of one flow's session."""
    longest = min(max_message, LONGEST.get(name, max_message))
    files = _open_files() if listens else _FILES
    answers = {"id": "patience", "messages": ["query"], "key_exprs": ["**"], "flows": ["ingress"]}
    settings = {
        "mode": "peer" if listens else "client",
        "listen/endpoints": endpoints if listens else [],
        "connect/endpoints": [] if listens else endpoints,
        "connect/timeout_ms": int(1000 * _ATTEMPT),
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,  # leaks in the receiver (zenoh #2787)
        "transport/unicast/accept_timeout": _ACCEPT_MS,
        "transport/unicast/accept_pending": min(_PENDING, files // 4),
        "transport/unicast/max_sessions": min(_SESSIONS, files // 4),
        "transport/link/tx/lease": _LEASE_MS[name],
        "transport/link/tx/queue/size/data": _QUEUE,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": _BLOCK_US[name],
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": _ROOM_US[name],
        "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": _ROOM_LONG_US,
        "transport/link/rx/max_message_size": longest + _OVERHEAD,
        "qos/network": [{**answers, "overwrite": {"congestion_control": "drop"}}],
        **(limits(name, rates=credentials is not None) if listens else {}),
        **(credentials.settings(name, listens=listens) if credentials else {}),
    }
    config = zenoh.Config()
    for key, value in settings.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise CongraspError(f"Zenoh does not take the setting {key}: {first_line(error)}.") from None
    return config


def _open_files() -> int:
    """Files that this process may have open; raises the limit to `_FILES` where the system allows it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = _FILES if hard == resource.RLIM_INFINITY else min(hard, _FILES)
    if soft != resource.RLIM_INFINITY and soft < most:
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
    return most


def listen(config: zenoh.Config, endpoints: list[str]) -> zenoh.Session:
    """A session that listens; a CongraspError if its port is in use."""
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = ", ".join(endpoints)
        if "in use" in str(error):
            raise CongraspError(
                f"The port of {where} is in use.",
                f"Stop what listens there, or choose another ({', '.join(FLOWS)} take a port each, from it on).",
            ) from None
        raise CongraspError(f"Cannot listen on {where}: {first_line(error)}.") from None


def connect(
    config: zenoh.Config, endpoints: list[str], deadline: float, name: Flow, credentials: Credentials | None
) -> zenoh.Session:
    """A session that is connected.

    Raises:
      TransportError: there is no response until the deadline.
      CongraspError: who listens does not take our certificate, or has one that is not for listening to this run.
    """
    while True:
        try:
            session = zenoh.open(config)
            break
        except zenoh.ZError as error:
            refusals = [refusal(one, credentials) for one in endpoints]
            if all(refusals) and refusals[0]:
                raise refusals[0] from None
            if time.monotonic() >= deadline:
                where = ", ".join(endpoints)
                remedy = "Start the learner or the server there, or correct the address."
                if "Unable to connect" in str(error):
                    raise TransportError(f"No response from {where}.", remedy) from None
                raise TransportError(f"Cannot connect to {where}: {first_line(error)}.", remedy) from None
    shown = [link.auth_identifier for link in session.info.links()] if credentials else []
    if credentials and shown and not any(credentials.expects(name, one) for one in shown):
        session.close()
        raise CongraspError(
            f"{', '.join(endpoints)} shows the certificate {ascii(shown[0])[:90]}, which may not listen to "
            f"{credentials.identity}.",
            "Connect to a learner or server of the same run, and see that its certificate is not revoked.",
        )
    return session


def first_line(error: Exception) -> str:
    """Zenoh's words without the places in its source."""
    return re.split(r" at /|\n", str(error))[0][:200].rstrip(". ")


class _Declaration:
    """What was declared in a flow, and again whenever its session is opened anew."""

    def __init__(self, name: Flow, declare: Callable[[zenoh.Session], Any], works: tuple[Callable[[Any], None], ...]):
        self.name, self.declare, self.works = name, declare, works
        self.entity: Any = None


class Sessions:
    """The sessions of a transport, what was declared in them, and the threads that are inside them.

    A thread that is inside Zenoh when the interpreter ends aborts the process, so closing waits for all of them.

    Attributes:
      closed: set once they are closed.
      failure: why, if nobody asked for it.
    """

    def __init__(self) -> None:
        self._open: dict[Flow, zenoh.Session] = {}
        self._openers: dict[Flow, Callable[[], zenoh.Session]] = {}
        self._declarations: list[_Declaration] = []
        self._threads: list[threading.Thread] = []
        self._inside = 0
        self._changed = threading.Condition()
        self._reopening = threading.RLock()
        self.closed = threading.Event()
        self.failure: CongraspError | None = None

    def open(self, name: Flow, opener: Callable[[], zenoh.Session]) -> None:
        """Opens a flow's session."""
        self._openers[name] = opener
        self._open[name] = opener()

    def get(self, name: Flow) -> zenoh.Session | None:
        """A flow's session; None if there is none, or they are closed or being opened anew."""
        return self._open.get(name)

    def declare(
        self, name: Flow, declare: Callable[[zenoh.Session], Any], *works: Callable[[Any], None]
    ) -> Callable[[], None]:
        """Declares something in a session; `works` run with its channel, in a daemon thread each.

        Returns:
          What takes it back.
        """
        declaration = _Declaration(name, declare, works)
        with self._reopening:
            self._start_all(declaration)
            self._declarations.append(declaration)

        def undeclare() -> None:
            with self._reopening, contextlib.suppress(zenoh.ZError, ValueError):
                self._declarations.remove(declaration)
                declaration.entity.undeclare()

        return undeclare

    def reopen(self) -> None:
        """Opens all sessions anew, with everything that was declared; peers connect again by themselves.

        Raises:
          CongraspError: one cannot be opened.
        """
        with self._reopening:
            sessions = list(self._open.values())
            self._open.clear()
            for session in sessions:
                session.close()
            join(self._threads, time.monotonic() + _REOPEN)
            for name, opener in self._openers.items():
                if not self.closed.is_set():
                    self._open[name] = opener()
            if self.closed.is_set():  # by another thread, which saw no more than the sessions that were open then
                self.close()
                return
            for declaration in self._declarations:
                self._start_all(declaration)

    def start(self, function: Callable[..., None], *arguments: Any) -> None:
        """Runs a function in a daemon thread of its own; it returns when the sessions are closed."""
        what = getattr(function, "func", function).__name__
        thread = threading.Thread(target=function, args=arguments, daemon=True, name=f"zenoh-{what}")
        thread.start()
        self._threads = [*(one for one in self._threads if one.is_alive()), thread]

    @contextlib.contextmanager
    def inside(self) -> Iterator[None]:
        """Around a call that a thread of the caller makes."""
        with self._changed:
            self._inside += 1
        try:
            yield
        finally:
            with self._changed:
                self._inside -= 1
                self._changed.notify_all()

    def close(self) -> None:
        """Closes the sessions, and waits a moment for the threads."""
        self.closed.set()
        deadline = time.monotonic() + _CLOSE
        if self._reopening.acquire(timeout=_CLOSE):
            self._reopening.release()
        sessions = list(self._open.values())
        self._open.clear()
        for session in sessions:
            try:
                self.start(session.close)
            except RuntimeError:  # the interpreter is ending and starts no threads
                session.close()
        join(self._threads, deadline)
        with self._changed:
            self._changed.wait_for(lambda: not self._inside, max(0.0, deadline - time.monotonic()))

    def peers(self) -> set[str]:
        """Common names of the certificates that those at the other ends show."""
        return {str(link.auth_identifier) for session in list(self._open.values()) for link in session.info.links()}

    def _start_all(self, declaration: _Declaration) -> None:
        """Declares in the present session, and starts the threads; a TransportError if there is no session."""
        session = self._open.get(declaration.name)
        if session is None:
            raise TransportError("The transport is closed." if self.closed.is_set() else "There is no such flow.")
        declaration.entity = declaration.declare(session)
        for work in declaration.works:
            self.start(work, declaration.entity.handler)


def follow_revocations(sessions: Sessions, credentials: Credentials, known: frozenset[str], period: float) -> None:
    """Opens a listener's sessions anew whenever the list of revoked certificates changes, until they are closed.

    Args:
      sessions: of the listener.
      credentials: the listener's.
      known: the list with which they were opened.
      period: seconds between two looks.
    """
    while not sessions.closed.wait(period):
        try:
            listed = credentials.revoked()
            if listed == known:
                continue
            _log.warning("The list of revoked certificates has changed: all connections are made anew.")
            sessions.reopen()
            known = listed
        except CongraspError as error:  # tried again at the next look
            _log.error("The list of revoked certificates is not in effect: %s", error)


def heed_revocations(sessions: Sessions, credentials: Credentials, period: float) -> None:
    """Closes the sessions of one that connects once who listens there shows a revoked certificate.

    Args:
      sessions: of the one that connects.
      credentials: its own.
      period: seconds between two looks.
    """
    while not sessions.closed.wait(period):
        try:
            with sessions.inside(), contextlib.suppress(zenoh.ZError):
                if found := sorted(sessions.peers() & credentials.revoked()):
                    sessions.failure = CongraspError(
                        f"The certificate {found[0]} of who listens there is revoked.",
                        "Connect anew once it has another one (congrasp certs issue).",
                    )
        except CongraspError as error:  # tried again at the next look
            _log.error("Whether the other end is revoked cannot be seen: %s", error)
        if sessions.failure:
            _log.error("%s", sessions.failure)
            sessions.close()
