"""Zenoh sessions: their configuration and limits, and the threads that work inside them.

A listener bounds the resources of untrusted peers: silent connections, incomplete messages, and
replies that are not read. If a reader's link is full, a reply waits a few milliseconds and is then
dropped: Zenoh replies with the congestion control of the query, which every process here overwrites
on arrival.

Zenoh closes a connection in the thread that waits for the data of all of them, and closing lasts
until the peer has acknowledged it (zenoh #1101). A listener therefore has many such threads.
"""

import collections
import contextlib
import functools
import json
import logging
import os
import re
import struct
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import zenoh

from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.runtime import forks, platforms
from congrasp.common.transport.base import Subscription, join
from congrasp.common.transport.keys import Flow
from congrasp.common.transport.ports import check_host, port_in_use
from congrasp.common.transport.security import Credentials, limits, refusal
from congrasp.common.wire.codec import Message, decode

LONGEST: dict[Flow, int] = {"control": 2 << 20, "log": 32 << 20, "policy": 2 << 20}
"""Largest message that is reassembled, in bytes; each connection may reassemble several at once."""
_LEASE_MS: dict[Flow, int] = {"control": 2500, "bulk": 10000, "log": 10000, "policy": 2500}
_BLOCK_US: dict[Flow, int] = {
    "control": 2_000_000,
    "bulk": 5_000_000,
    "log": 1_000_000,
    "policy": 2_000_000,
}
_OVERHEAD_BYTES = 64 << 10  # of Zenoh for a message
_ATTEMPT_S = 1.0  # of one attempt to connect; signals are handled between two
_CLOSE_TIMEOUT_S = 2.0
"""Time for closing; with thousands of tokens on a busy machine it takes more than a second."""
_EXIT_TIMEOUT_S = 12.0
"""Longest wait of the interpreter's exit for sessions that still close. A connection without a
handshake delays a listener's closing by 5 s (`_ACCEPT_TIMEOUT_MS`); after 10 s Zenoh gives up.
"""
_REOPEN_TIMEOUT_S = 10.0
_ROOM_US: dict[Flow, int] = {"control": 10_000, "bulk": 50_000, "log": 10_000, "policy": 5_000}
"""Microseconds that a reply waits for room in its reader's link; then replies are dropped until
there is room.
"""
_ROOM_LONG_US = 200_000  # total wait of a chunk's fragments, microseconds
_MAX_QUEUED_BATCHES = 8
"""Batches of 64 KiB queued for a link: an acknowledgement fits in addition to a chunk of a long
reply.
"""
_ACCEPT_TIMEOUT_MS = 5000  # of a connection's handshake
_MAX_HANDSHAKES = 4096  # at a time, but at most a quarter of the open files
_MAX_FILES = 16384
"""Limit of the process's open files, if the system allows it: each connection is one."""
CLOSERS = 64
"""Threads of a listener that accept and close connections and wait for their data."""
# Of the user; read at the first session
_RUNTIME = os.environ.get("ZENOH_RUNTIME", "").strip() or "()"
if not re.search(
    r"\bacc\s*:", _RUNTIME
):  # other values than of the form (…) or Name(…) are the user's alone
    os.environ["ZENOH_RUNTIME"] = re.sub(
        r"^\w*\s*\(", rf"\g<0>acc: (worker_threads: {CLOSERS}), ", _RUNTIME
    )
_POOL = "(?:app|acc|tx|rx|net)"
_THREADS = r"worker_threads:\+?\d[\d_]{0,3}|max_blocking_threads:\+?[1-9][\d_]{0,3}"
_SETTINGS = rf"\((?:(?:{_THREADS}|handover:(?:{_POOL}|None|Some\({_POOL}\)))(?:,|(?=\))))*\)"
_FORM = re.compile(
    rf"(?:#!\[enable\(\w+\)\])*(?:AbstractRuntimeParam)?"
    rf"\((?!.*\b(\w+):\(.*\b\1:\()(?:{_POOL}:(?:RuntimeParamHelper)?{_SETTINGS}(?:,|(?=\))))*\)"
)
_FILLING = re.compile(r"/\*.*?\*/|//[^\n]*|\s+", re.DOTALL)
_MAX_PEERS = 1000
"""Limit of the connected peers, but at most a quarter of the open files: Zenoh panics if none is
left.
"""
STAMP = struct.Struct("<8sQ")
"""Sender and count of a sample, by which a subscriber detects gaps."""
_MAX_KEYS = 4096
"""Keys of a subscription whose last sample is known."""
_log = logging.getLogger(__name__)


def configuration(
    name: Flow,
    endpoints: list[str],
    listens: bool,
    max_message: int,
    credentials: Credentials | None,
) -> zenoh.Config:
    """Returns the Zenoh configuration of one flow's session.

    Raises:
      CongraspError: Zenoh rejects a setting, or would panic at the user's `ZENOH_RUNTIME`.
    """
    if not _FORM.fullmatch(_FILLING.sub("", _RUNTIME)):
        what = f"ZENOH_RUNTIME is {ascii(_RUNTIME)[:80]}, which Zenoh cannot read."
        raise CongraspError(what, "Unset it, or write for example '(tx: (worker_threads: 2))'.")
    longest = min(max_message, LONGEST.get(name, max_message))
    max_files = _open_files() if listens else _MAX_FILES
    answers = {"id": "patience", "messages": ["query"], "key_exprs": ["**"], "flows": ["ingress"]}
    settings = {
        "mode": "peer" if listens else "client",
        "listen/endpoints": endpoints if listens else [],
        "connect/endpoints": [] if listens else endpoints,
        "connect/timeout_ms": int(1000 * _ATTEMPT_S),
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,  # leaks in the receiver (zenoh #2787)
        "transport/unicast/accept_timeout": _ACCEPT_TIMEOUT_MS,
        "transport/unicast/accept_pending": min(_MAX_HANDSHAKES, max_files // 4),
        "transport/unicast/max_sessions": max_peers() if listens else _MAX_PEERS,
        "transport/link/tx/lease": _LEASE_MS[name],
        "transport/link/tx/queue/size/data": _MAX_QUEUED_BATCHES,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": _BLOCK_US[name],
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": _ROOM_US[name],
        "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": (
            _ROOM_LONG_US
        ),
        "transport/link/rx/max_message_size": longest + _OVERHEAD_BYTES,
        "qos/network": [{**answers, "overwrite": {"congestion_control": "drop"}}],
        **(limits(name, rates=credentials is not None) if listens else {}),
        **(credentials.settings(name, listens=listens) if credentials else {}),
    }
    config = zenoh.Config()
    for key, value in settings.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise CongraspError(f"Zenoh rejects the setting {key}: {first_line(error)}.") from None
    return config


@functools.cache
def _open_files() -> int:
    """Files that this process may have open; raises the limit to `_MAX_FILES` where the system
    allows it, else warns.
    """
    limit = platforms.raise_open_files(_MAX_FILES)
    if limit < _MAX_FILES:
        _log.warning(
            "This process may open %d files: above %d idle connections, new peers cannot connect. "
            "Raise the hard limit to %d (ulimit -n, LimitNOFILE=).",
            limit,
            limit // 4,
            _MAX_FILES,
        )
    return limit


def max_peers() -> int:
    """Limit of the connected peers of each flow of a listener."""
    return min(_MAX_PEERS, _open_files() // 4)


def listen(config: zenoh.Config, endpoints: list[str]) -> zenoh.Session:
    """Opens a listening session; raises a CongraspError if it cannot listen, such as on a port in
    use.
    """
    try:
        return _open(config)
    except zenoh.ZError as error:
        where = ", ".join(endpoints)
        if "in use" in str(error):
            raise port_in_use(where) from None
        raise CongraspError(f"Cannot listen on {where}: {first_line(error)}.") from None


def connect(
    config: zenoh.Config,
    endpoints: list[str],
    deadline: float,
    name: Flow,
    credentials: Credentials | None,
) -> zenoh.Session:
    """Opens a connected session.

    Raises:
      TransportError: there is no response before the deadline, or a host name is unknown.
      CongraspError: the listener rejects our certificate, or its certificate does not allow it to
        listen for this run.
    """
    for endpoint in endpoints:
        check_host(endpoint)
    while True:
        try:
            session = _open(config)
            break
        except zenoh.ZError as error:
            first_refusal = refusal(endpoints[0], credentials)
            others = endpoints[1:]
            if first_refusal and all(refusal(other, credentials) for other in others):
                raise first_refusal from None
            if time.monotonic() >= deadline:
                where = ", ".join(endpoints)
                remedy = "Start the learner or the server there, or correct the address."
                if "Unable to connect" in str(error):
                    raise TransportError(f"No response from {where}.", remedy) from None
                raise TransportError(
                    f"Cannot connect to {where}: {first_line(error)}.", remedy
                ) from None
    if credentials:
        _check_listener(session, endpoints, name, credentials)
    return session


def _check_listener(
    session: zenoh.Session, endpoints: list[str], name: Flow, credentials: Credentials
) -> None:
    """Closes a session and raises a CongraspError if no connected certificate may listen to us."""
    common_names = [link.auth_identifier for link in session.info.links()]
    if not common_names:
        return
    if any(credentials.expects(name, common_name) for common_name in common_names):
        return
    session.close()
    raise CongraspError(
        f"{', '.join(endpoints)} presents the certificate {ascii(common_names[0])[:90]}, which may "
        f"not listen for {credentials.identity}.",
        "Connect to a learner or server of the same run whose certificate is not revoked.",
    )


def _open(config: zenoh.Config) -> zenoh.Session:
    """Opens a session, and with the first one Zenoh's threads."""
    forks.note_started("Zenoh")
    return zenoh.open(config)


def first_line(error: Exception) -> str:
    """First line of a Zenoh error, without positions in its source."""
    return re.split(r" at /|\n", str(error))[0][:200].rstrip(".! ")


class _Declaration:
    """A declaration in a flow, repeated whenever its session is reopened."""

    def __init__(
        self,
        name: Flow,
        declare: Callable[[zenoh.Session], Any],
        works: tuple[Callable[[Any], None], ...],
    ):
        self.name = name
        self.declare = declare
        self.works = works
        self.entity: Any = None


_all_sessions: "weakref.WeakSet[Sessions]" = weakref.WeakSet()


class Sessions:
    """Sessions of a transport, their declarations, and the threads inside them.

    A thread that is inside Zenoh when the interpreter exits aborts the process, so closing waits
    for all threads.

    Attributes:
      closed: set once the sessions are closed.
      failure: the reason, if they were not closed on request.
    """

    def __init__(self) -> None:
        self._fork_generation = forks.generation()
        self._open: dict[Flow, zenoh.Session] = {}
        self._openers: dict[Flow, Callable[[], zenoh.Session]] = {}
        self._declarations: list[_Declaration] = []
        self._threads: list[threading.Thread] = []
        self._inside = 0
        self._changed = threading.Condition()
        self._reopening = threading.RLock()
        self.closed = threading.Event()
        self.failure: CongraspError | None = None
        _all_sessions.add(self)

    def open(self, name: Flow, opener: Callable[[], zenoh.Session]) -> None:
        """Opens a flow's session."""
        self._openers[name] = opener
        self._open[name] = opener()

    def get(self, name: Flow) -> zenoh.Session | None:
        """Returns a flow's session; None if there is none, or while it is closed or being
        reopened.
        """
        self._require_same_process()
        return self._open.get(name)

    def declare(
        self, name: Flow, declare: Callable[[zenoh.Session], Any], *works: Callable[[Any], None]
    ) -> Callable[[], None]:
        """Declares something in a session; each of `works` runs with its channel in a daemon
        thread.

        Returns:
          A function that undeclares it.
        """
        self._require_same_process()
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
        """Reopens all sessions with all declarations; peers reconnect by themselves.

        Raises:
          CongraspError: a session cannot be opened.
        """
        with self._reopening:
            sessions = list(self._open.values())
            self._open.clear()
            for session in sessions:
                close_session(session)
            join(self._threads, time.monotonic() + _REOPEN_TIMEOUT_S)
            for name, opener in self._openers.items():
                if not self.closed.is_set():
                    self._open[name] = opener()
            # Another thread that closed them only saw the sessions open at that time.
            if self.closed.is_set():
                self.close()
                return
            for declaration in self._declarations:
                self._start_all(declaration)

    def start(self, function: Callable[..., None], *arguments: Any) -> None:
        """Runs a function in a separate daemon thread; it must return when the sessions are
        closed.
        """
        what = getattr(function, "func", function).__name__
        thread = threading.Thread(
            target=function, args=arguments, daemon=True, name=f"zenoh-{what}"
        )
        thread.start()
        alive = [other for other in self._threads if other.is_alive()]
        self._threads = [*alive, thread]

    @contextlib.contextmanager
    def inside(self) -> Iterator[None]:
        """Context of a call into Zenoh by a thread of the caller."""
        self._require_same_process()
        with self._changed:
            self._inside += 1
        try:
            yield
        finally:
            with self._changed:
                self._inside -= 1
                self._changed.notify_all()

    def close(self) -> None:
        """Closes the sessions, and waits briefly for the threads; the interpreter's exit waits for
        late ones. A fork leaves the sessions to the process that opened them.
        """
        if self._fork_generation != forks.generation():
            return
        self.closed.set()
        deadline = time.monotonic() + _CLOSE_TIMEOUT_S
        if self._reopening.acquire(timeout=_CLOSE_TIMEOUT_S):
            self._reopening.release()
        sessions = list(self._open.values())
        self._open.clear()
        for session in sessions:
            try:
                self.start(close_session, session)
            except RuntimeError:  # the interpreter is shutting down and starts no threads
                close_session(session)
        if not self.wait_for_threads(deadline):
            _note_closing(self)

    def wait_for_threads(self, deadline: float) -> bool:
        """Waits until no other thread is inside Zenoh once the sessions are closed.

        Args:
          deadline: longest wait, by `time.monotonic`.

        Returns:
          False if a thread is still inside.
        """
        join(self._threads, deadline)
        current = threading.current_thread()
        if any(thread.is_alive() for thread in self._threads if thread is not current):
            return False
        with self._changed:
            rest = max(0.0, deadline - time.monotonic())
            return self._changed.wait_for(lambda: not self._inside, rest)

    def watch_revocations(
        self, credentials: Credentials, period: float, revoked: frozenset[str] | None
    ) -> None:
        """Checks for revoked certificates in a thread, until the sessions are closed.

        Args:
          credentials: credentials of this process.
          period: seconds between two checks.
          revoked: the certificates that were revoked when a listener's sessions were opened; None
            if they connect.
        """
        if revoked is None:
            self.start(heed_revocations, self, credentials, period)
        else:
            self.start(follow_revocations, self, credentials, revoked, period)

    def open_sessions(self) -> list[tuple[Flow, zenoh.Session]]:
        """The open sessions with their flows."""
        return list(self._open.items())

    def peers(self) -> set[str]:
        """Common names of the certificates of connected peers."""
        common_names: set[str] = set()
        for session in list(self._open.values()):
            common_names |= {str(link.auth_identifier) for link in session.info.links()}
        return common_names

    def abandon(self) -> None:
        """Keeps all of Zenoh's objects alive to the end of a fork: the destructor of a session
        waits for threads that do not run there.
        """
        entities = [declaration.entity for declaration in self._declarations]
        for entity in (*self._open.values(), *entities):
            forks.keep_to_the_end(entity)

    def _require_same_process(self) -> None:
        """Raises a ForkError in a fork of the process that opened the sessions."""
        forks.require_same_process(self._fork_generation, "connection")

    def _start_all(self, declaration: _Declaration) -> None:
        """Declares in the current session, and starts the threads; raises a TransportError if there
        is no session.
        """
        session = self._open.get(declaration.name)
        if session is None:
            raise TransportError(
                "The transport is closed." if self.closed.is_set() else "There is no such flow."
            )
        declaration.entity = declaration.declare(session)
        for work in declaration.works:
            self.start(work, declaration.entity.handler)


def close_session(session: zenoh.Session) -> None:
    """Closes a session; one whose peers do not react stays open until the process ends."""
    try:
        session.close()
    except zenoh.ZError as error:
        _log.info("A session is not closed: %s.", first_line(error))


_closing: list[Sessions] = []
"""Sessions whose closing takes longer than their transport waited."""


def _note_closing(late: Sessions) -> None:
    """Adds sessions to those that still close, and removes those that have closed since."""
    now = time.monotonic()
    still_closing = [sessions for sessions in _closing if not sessions.wait_for_threads(now)]
    _closing[:] = [*still_closing, late]


def _wait_for_closing() -> None:
    """Waits for sessions that still close; runs in the interpreter's exit.

    A thread that returns from Zenoh while the interpreter shuts down aborts the process.
    """
    deadline = time.monotonic() + _EXIT_TIMEOUT_S
    for sessions in list(_closing):
        sessions.wait_for_threads(deadline)


# Finalizers run in the reverse order of their creation: this one after those of all transports.
weakref.finalize(Sessions, _wait_for_closing)


def _abandon_all() -> None:
    """Abandons all sessions; runs in forks."""
    for sessions in list(_all_sessions):
        sessions.abandon()
    _closing.clear()


platforms.after_fork(_abandon_all)


def follow_revocations(
    sessions: Sessions, credentials: Credentials, revoked: frozenset[str], period: float
) -> None:
    """Reopens a listener's sessions whenever the list of revoked certificates changes, until they
    are closed.

    Args:
      sessions: sessions of the listener.
      credentials: credentials of the listener.
      revoked: the list when they were opened.
      period: seconds between two checks.
    """
    while not sessions.closed.wait(period):
        try:
            current = credentials.revoked()
            if current == revoked:
                continue
            _log.warning(
                "The list of revoked certificates has changed: all connections are reopened."
            )
            sessions.reopen()
            revoked = current
        except CongraspError as error:  # retried at the next check
            _log.error("The list of revoked certificates is not in effect: %s", error)


def heed_revocations(sessions: Sessions, credentials: Credentials, period: float) -> None:
    """Closes the sessions of a connecting process once its listener presents a revoked certificate.

    Args:
      sessions: sessions of the connecting process.
      credentials: credentials of the connecting process.
      period: seconds between two checks.
    """
    while not sessions.closed.wait(period):
        try:
            with sessions.inside(), contextlib.suppress(zenoh.ZError):
                revoked_peers = sorted(sessions.peers() & credentials.revoked())
                if revoked_peers:
                    sessions.failure = CongraspError(
                        f"The listener's certificate {revoked_peers[0]} is revoked.",
                        "Connect again once it has a new one (congrasp certs issue).",
                    )
        except CongraspError as error:  # retried at the next check
            _log.error("Cannot check whether the listener's certificate is revoked: %s", error)
        if sessions.failure:
            _log.error("%s", sessions.failure)
            sessions.close()


def received(channel: Any) -> Iterator[Any]:
    """Yields the items of a channel until it is closed."""
    with contextlib.suppress(zenoh.ZError):
        while True:
            yield channel.recv()


class LostSamples:
    """Numbers of lost samples, by the stamps of the received ones.

    Keys are names that publishers invent for free: those from which nothing came for longest are
    forgotten.
    """

    def __init__(self) -> None:
        self._last: collections.OrderedDict[str, tuple[bytes, int]] = collections.OrderedDict()

    def before(self, key: str, stamp: bytes) -> int:
        """Returns the number of samples lost between the last one of a key and this one."""
        if len(stamp) != STAMP.size:
            return 0
        sender, count = STAMP.unpack(stamp)
        last_sender, last_count = self._last.get(key, (sender, count - 1))
        self._last[key] = sender, count
        self._last.move_to_end(key)
        if len(self._last) > _MAX_KEYS:
            self._last.popitem(last=False)
        if sender != last_sender:
            return 0
        return int(max(0, count - last_count - 1))


def listen_to(samples: Any, subscription: Subscription, max_message: int) -> None:
    """Moves samples to a subscription, with the number of lost ones before each."""
    lost_samples = LostSamples()
    for sample in received(samples):
        key = str(sample.key_expr)
        stamp = sample.attachment.to_bytes() if sample.attachment else b""
        lost = lost_samples.before(key, stamp)
        subscription.push(key, functools.partial(_decoded, sample.payload, max_message), lost)


def _decoded(payload: zenoh.ZBytes, max_message: int) -> Message:
    """Decodes the message of a payload."""
    return decode(payload.to_bytes(), max_bytes=max_message)


def watch_tokens(
    samples: Any, on_change: Callable[[str, bool], None], closed: threading.Event
) -> None:
    """Reports liveliness tokens until the session closes; runs in a separate thread.

    When the session is reopened, all known tokens are reported as gone first; otherwise peers that
    left meanwhile would not be noticed.
    """
    tokens: set[str] = set()

    def report(key: str, alive: bool) -> None:
        if alive:
            tokens.add(key)
        else:
            tokens.discard(key)
        try:
            on_change(key, alive)
        except Exception:
            _log.exception("Handling the token %s failed.", key)

    for sample in received(samples):
        report(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)
    if not closed.is_set():
        for key in sorted(tokens):
            report(key, False)
