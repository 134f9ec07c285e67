"""Relay between JAX's client in this process and the coordinator in rank 0."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable

_RETRY_INTERVAL_S = 0.1
"""Time between two attempts to reach the coordinator."""
_CHUNK_BYTES = 1 << 16


def relay(host: str, port: int) -> int:
    """Forwards connections to a free port of the loopback interface, for as long as the process
    lives.

    JAX aborts a process (SIGABRT, pages of text) as soon as its connection to the coordinator ends.
    Through the relay, in the process itself, that connection outlives rank 0: the links of `Ranks`
    notice its end at once, and end the process in order.

    Args:
      host: host of the coordinator.
      port: port of the coordinator, which need not listen yet.

    Returns:
      The free port.
    """
    server = socket.create_server(("127.0.0.1", 0))
    _start_thread("relay", _accept, server, (host, port))
    return int(server.getsockname()[1])


def _start_thread(name: str, function: Callable[..., None], *arguments: object) -> None:
    """Starts a thread that ends with the process."""
    threading.Thread(target=function, args=arguments, daemon=True, name=name).start()


def _accept(server: socket.socket, address: tuple[str, int]) -> None:
    """Accepts connections."""
    while True:
        near, _ = server.accept()
        _start_thread("relay-out", _forward, near, address)


def _forward(near: socket.socket, address: tuple[str, int]) -> None:
    """Forwards one connection until the near end closes it.

    A far end that closes is not reported to the near end.
    """
    while True:
        with contextlib.suppress(OSError):
            far = socket.create_connection(address)
            break
        time.sleep(_RETRY_INTERVAL_S)
    with near, far, contextlib.suppress(OSError):
        _start_thread("relay-in", _backward, far, near)
        while data := near.recv(_CHUNK_BYTES):
            with contextlib.suppress(OSError):
                far.sendall(data)


def _backward(far: socket.socket, near: socket.socket) -> None:
    """Forwards the data of the coordinator."""
    with contextlib.suppress(OSError):
        while data := far.recv(_CHUNK_BYTES):
            near.sendall(data)
