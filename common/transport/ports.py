"""TCP ports: defaults of the roles, neighbouring ports, and free ports of this machine."""

import contextlib
import errno
import re
import secrets
import socket

from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.runtime.platforms import reserve_for_listener
from congrasp.common.transport.keys import FLOWS

LEARNER_URL = "tcp/127.0.0.1:7447"
"""Default address of a learner: only this machine, on one port for each flow from this one on."""
SERVER_URL = "tcp/127.0.0.1:7457"
"""Default address of a policy server."""
LOOPBACK_REMEDY = "Start the interface, as root: ip link set lo up."
"""Remedy for a fault of the loopback interface."""
_LOOPBACK_S = 2.0
"""Longest wait for a connection of this process to itself, s."""
_URL = re.compile(r"(?P<address>[a-z]+/[^/]+):(?P<port>\d{1,5})(?P<rest>[?#].*)?")
_FIRST_FREE_PORT = 15000
"""First port of the range for `free_port`."""
_FREE_PORTS = 15000
"""Length of that range: it ends below the system's range for outgoing connections (from 32768 on
Linux), which cannot take these ports."""
_MAX_ATTEMPTS = 1000
LAST_PORT = 65535
"""Largest number of a port."""
_reservations: list[socket.socket] = []
"""Sockets that reserve ports, see `free_port`."""


def shifted(url: str, offset: int) -> str:
    """Returns the URL with its port increased by `offset`.

    Raises:
      CongraspError: the URL has no port, or the resulting port does not exist.
    """
    match = _URL.fullmatch(url)
    if not match or not 0 < int(match["port"]) <= LAST_PORT:
        raise CongraspError(f"'{url}' is not an endpoint.", f"Write it like {LEARNER_URL}.")
    scheme, _, host = match["address"].partition("/")
    if ":" in host and not host.startswith("["):
        raise CongraspError(
            f"'{url}' has an IPv6 address without brackets.",
            f"Write it like {scheme}/[{host}]:{match['port']}.",
        )
    port = int(match["port"]) + offset
    if port > LAST_PORT:
        raise CongraspError(
            f"'{url}' leaves no room for the four ports that a learner takes from this one on.",
            f"Pass a port up to {LAST_PORT - len(FLOWS) + 1}; each further rank takes four more.",
        )
    return f"{match['address']}:{port}{match['rest'] or ''}"


def host_of(url: str) -> tuple[str, int] | None:
    """Returns host and port of a URL, without the brackets of an IPv6 address; None for others."""
    match = _URL.fullmatch(url)
    if match is None:
        return None
    host = match["address"].partition("/")[2]
    return host.strip("[]"), int(match["port"])


def check_host(url: str) -> None:
    """Raises a `TransportError` if the name of a URL's host cannot be resolved, on which Zenoh
    would wait in silence.
    """
    address = host_of(url)
    if address is None:
        return
    host, port = address
    try:
        socket.getaddrinfo(host, port)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise TransportError(
            f"The host name '{host}' of {url} cannot be resolved: {reason}.",
            "Correct the name, or pass the host's address.",
        ) from None


def check_ports(url: str, count: int = len(FLOWS)) -> None:
    """Checks that a listener can take its ports on this machine.

    Args:
      url: address of the listener.
      count: number of its ports, from the URL's on.

    Raises:
      CongraspError: the URL is malformed, a port is in use, or the address is not of this machine.
    """
    shifted(url, count - 1)
    address = host_of(url)
    if address is None:
        return
    host, first = address
    for port in range(first, first + count):
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with socket.socket(family) as probe:
            reserve_for_listener(probe)
            try:
                probe.bind((host, port))
            except OSError as error:
                if error.errno == errno.EADDRINUSE:
                    raise port_in_use(url, port) from None
                reason = error.strerror or str(error)
                raise CongraspError(
                    f"Cannot listen at {url}: {reason}.", "Pass an address of this machine."
                ) from None


def check_loopback() -> None:
    """Raises a CongraspError if processes of this machine cannot connect to each other."""
    fault = loopback_fault()
    if fault:
        raise CongraspError(f"The loopback interface does not work: {fault}.", LOOPBACK_REMEDY)


def loopback_fault() -> str:
    """Returns why processes of this machine cannot connect to each other by its loopback interface,
    as in a new network namespace; empty if they can.
    """
    try:
        with socket.socket() as listener, socket.socket() as client:
            listener.bind(("127.0.0.1", 0))
            listener.listen(1)
            client.settimeout(_LOOPBACK_S)
            client.connect(listener.getsockname())
    except OSError as error:
        return error.strerror or str(error)
    return ""


def port_in_use(url: str, port: int | None = None) -> CongraspError:
    """Error for a port of a listener that another process has.

    Args:
      url: address of the listener.
      port: the port, if it is known.
    """
    flows = ", ".join(FLOWS)
    which = f"Port {port} of {url}" if port else f"The port of {url}"
    return CongraspError(
        f"{which} is in use.",
        f"Stop the process that listens there, or pass another one with --listen: a learner takes "
        f"four ports from it on ({flows}).",
    )


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

    While this process runs, none of them is returned again, neither here nor in another process:
    each is reserved by a UDP socket of the same number, which the system closes with the process.

    Raises:
      OSError: no such ports are free.
    """
    for _ in range(_MAX_ATTEMPTS):
        start = _FIRST_FREE_PORT + secrets.randbelow(_FREE_PORTS - count)
        ports = range(start, start + count)
        with contextlib.ExitStack() as probes, contextlib.suppress(OSError):
            for port in ports:
                probes.enter_context(socket.socket()).bind(_loopback(port))
            _reserve(ports)
            return start
    raise OSError(f"No {count} neighbouring TCP ports are free on the loopback interface.")


def _reserve(ports: range) -> None:
    """Reserves ports until this process ends.

    Raises:
      OSError: a port is already reserved.
    """
    with contextlib.ExitStack() as sockets:
        reservations: list[socket.socket] = []
        for port in ports:
            reservation = sockets.enter_context(socket.socket(type=socket.SOCK_DGRAM))
            reservation.bind(_loopback(port))
            reservations.append(reservation)
        _reservations.extend(reservations)
        sockets.pop_all()


def _loopback(port: int) -> tuple[str, int]:
    """Address of a port on the loopback interface."""
    return "127.0.0.1", port
