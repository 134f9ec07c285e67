"""TCP ports: where roles listen by default, the ports after a given one, and free ones of this machine."""

import contextlib
import re
import secrets
import socket

from common.errors import CongraspError
from common.transport.keys import FLOWS

LEARNER_URL = "tcp/127.0.0.1:7447"
"""Where a learner listens unless told otherwise: on this machine only, and on as many ports from this one on as there
are flows."""
SERVER_URL = "tcp/127.0.0.1:7457"
"""Where a policy server listens unless told otherwise."""
_URL = re.compile(r"(?P<address>[a-z]+/[^/]+):(?P<port>\d{1,5})(?P<rest>[?#].*)?")
_LOWEST, _COUNT = 15000, 15000
"""Below the ports that systems give to outgoing connections (from 32768 on Linux): none of those gets in between."""
_ATTEMPTS = 1000


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

    Raises:
      OSError: there seems to be none.
    """
    for _ in range(_ATTEMPTS):
        port = _LOWEST + secrets.randbelow(_COUNT - count)
        with contextlib.ExitStack() as stack, contextlib.suppress(OSError):
            for each in range(port, port + count):
                stack.enter_context(socket.socket()).bind(("127.0.0.1", each))
            return port
    raise OSError(f"No {count} neighbouring TCP ports are free on the loopback interface.")
