"""TCP ports: where roles listen by default, the ports after a given one, and free ones of this machine."""

import contextlib
import fcntl
import functools
import os
import pathlib
import re
import secrets
import socket
import tempfile
import threading

from congrasp.common.errors import CongraspError
from congrasp.common.transport.keys import FLOWS

LEARNER_URL = "tcp/127.0.0.1:7447"
"""Where a learner listens unless told otherwise: on this machine only, and on as many ports from this one on as there
are flows."""
SERVER_URL = "tcp/127.0.0.1:7457"
"""Where a policy server listens unless told otherwise."""
_URL = re.compile(r"(?P<address>[a-z]+/[^/]+):(?P<port>\d{1,5})(?P<rest>[?#].*)?")
_LOWEST, _COUNT = 15000, 15000
"""Below the ports that systems give to outgoing connections (from 32768 on Linux): none of those gets in between."""
_ATTEMPTS = 1000
_lock, _reserved = threading.Lock(), set[int]()


def shifted(url: str, offset: int) -> str:
    """The URL with a port `offset` above.

    Raises:
      CongraspError: it has no port, or there is none so far above.
    """
    match = _URL.fullmatch(url)
    if not match or not 0 < int(match["port"]) + offset < 1 << 16:
        raise CongraspError(f"'{url}' is not an endpoint.", f"Write it like {LEARNER_URL}.")
    return f"{match['address']}:{int(match['port']) + offset}{match['rest'] or ''}"


def rank_url(url: str, rank: int) -> str:
    """Where a learner rank listens, if rank 0 listens at `url`: each takes one port a flow."""
    return shifted(url, rank * len(FLOWS)) if rank else url


def local_url(listeners: int = 1) -> str:
    """A URL of the loopback interface where so many learners or servers, one after another, can listen."""
    return f"tcp/127.0.0.1:{free_port(listeners * len(FLOWS))}"


def reachable_url(url: str) -> str:
    """Where this machine reaches what listens on a URL that names all its interfaces."""
    for everywhere in ("/0.0.0.0:", "/[::]:"):
        if everywhere in url:
            return url.replace(everywhere, "/127.0.0.1:")
    return url


def free_port(count: int = len(FLOWS)) -> int:
    """A port of the loopback interface that is free together with the `count` - 1 after it.

    As long as this process lives, none of them is returned again: not here, and not to another process of this user.

    Raises:
      OSError: there seems to be none, or reservations cannot be kept in the folder for temporary files.
    """
    file = _reservations()
    for _ in range(_ATTEMPTS):
        ports = range(start := _LOWEST + secrets.randbelow(_COUNT - count), start + count)
        with contextlib.ExitStack() as stack, contextlib.suppress(OSError):
            for port in ports:
                stack.enter_context(socket.socket()).bind(("127.0.0.1", port))
            _reserve(file, ports)
            return start
    raise OSError(f"No {count} neighbouring TCP ports are free on the loopback interface.")


def _reserve(file: int, ports: range) -> None:
    """Locks a byte of the file for each port; the system takes the locks back when the process ends.

    Raises:
      OSError: one is reserved already.
    """
    with _lock:
        if not _reserved.isdisjoint(ports):
            raise OSError("A port is reserved by this process.")
        fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, len(ports), ports.start)
        _reserved.update(ports)


@functools.cache
def _reservations() -> int:
    """Descriptor of this user's file of locks, open until the process ends: closing it would give up every lock."""
    path = pathlib.Path(tempfile.gettempdir()) / f"congrasp-ports-{os.getuid()}"
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
