"""TCP ports: defaults of the roles, neighbouring ports, and free ports of this machine."""

import contextlib
import functools
import logging
import os
import pathlib
import re
import secrets
import socket
import tempfile
import threading

from congrasp.common.errors import CongraspError
from congrasp.common.io.locks import NoLocksError, try_lock
from congrasp.common.transport.keys import FLOWS

LEARNER_URL = "tcp/127.0.0.1:7447"
"""Default address of a learner: only this machine, on one port for each flow from this one on."""
SERVER_URL = "tcp/127.0.0.1:7457"
"""Default address of a policy server."""
_URL = re.compile(r"(?P<address>[a-z]+/[^/]+):(?P<port>\d{1,5})(?P<rest>[?#].*)?")
_LOWEST, _COUNT = 15000, 15000
"""First port for free ports: below the system's range for outgoing connections (from 32768 on
Linux), which cannot take them."""
_ATTEMPTS = 1000
_lock, _reserved = threading.Lock(), set[int]()
_log = logging.getLogger(__name__)


def shifted(url: str, offset: int) -> str:
    """Returns the URL with its port increased by `offset`.

    Raises:
      CongraspError: the URL has no port, or the resulting port does not exist.
    """
    match = _URL.fullmatch(url)
    if not match or not 0 < int(match["port"]) + offset < 1 << 16:
        raise CongraspError(f"'{url}' is not an endpoint.", f"Write it like {LEARNER_URL}.")
    return f"{match['address']}:{int(match['port']) + offset}{match['rest'] or ''}"


def rank_url(url: str, rank: int) -> str:
    """Address of a learner rank if rank 0 listens at `url`: each rank takes one port per flow."""
    return shifted(url, rank * len(FLOWS)) if rank else url


def local_url(listeners: int = 1) -> str:
    """Returns a loopback URL with free ports for `listeners` learners or servers."""
    return f"tcp/127.0.0.1:{free_port(listeners * len(FLOWS))}"


def reachable_url(url: str) -> str:
    """Returns the address at which this machine reaches a listener on all its interfaces."""
    for everywhere in ("/0.0.0.0:", "/[::]:"):
        if everywhere in url:
            return url.replace(everywhere, "/127.0.0.1:")
    return url


def free_port(count: int = len(FLOWS)) -> int:
    """Returns a free loopback port such that the `count` - 1 following ones are free as well.

    While this process lives, none of them is returned again, neither here nor in another process of
    this user.

    Raises:
      OSError: no such ports are free.
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
    """Locks a byte of the file for each port; the system releases the locks when the process ends.

    Raises:
      OSError: a port is already reserved.
    """
    with _lock:
        if not _reserved.isdisjoint(ports):
            raise OSError("A port is reserved by this process.")
        try:
            if not try_lock(file, ports):
                raise OSError("A port is reserved by another process.")
        except NoLocksError:
            _report_no_locks()
        _reserved.update(ports)


@functools.cache
def _report_no_locks() -> None:
    """Logs once that other processes do not see which ports this one will use.

    Two that choose the same port at the same moment are then get the error of a port in use.
    """
    _log.warning(
        "%s is on a file system without locks: ports are not reserved. Set TMPDIR to a local one.",
        tempfile.gettempdir(),
    )


@functools.cache
def _reservations() -> int:
    """Descriptor of this user's lock file, open until the process ends: closing it would release
    every lock.

    Where no such file can be opened, that of a file of this process alone.
    """
    for folder in filter(None, (os.environ.get("XDG_RUNTIME_DIR"), tempfile.gettempdir())):
        path = pathlib.Path(folder) / f"congrasp-ports-{os.getuid()}"
        with contextlib.suppress(OSError):
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
            if os.fstat(file).st_uid == os.getuid():
                return file
            os.close(file)  # of another user, who could lock all of it
    with tempfile.TemporaryFile() as own:
        return os.dup(own.fileno())
