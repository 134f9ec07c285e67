"""TCP ports of this machine for those who need not know them beforehand."""

import contextlib
import secrets
import socket

from common.transport.keys import FLOWS

_LOWEST, _COUNT = 15000, 15000
"""Below the ports that systems give to outgoing connections (from 32768 on Linux): none of those gets in between."""
_TRIES = 1000


def free_port(count: int = len(FLOWS)) -> int:
    """A port of the loopback interface that is free together with the `count` - 1 after it.

    Raises:
      OSError: there seems to be none.
    """
    for _ in range(_TRIES):
        port = _LOWEST + secrets.randbelow(_COUNT - count)
        with contextlib.ExitStack() as stack, contextlib.suppress(OSError):
            for each in range(port, port + count):
                stack.enter_context(socket.socket()).bind(("127.0.0.1", each))
            return port
    raise OSError(f"No {count} neighbouring TCP ports are free on the loopback interface.")
