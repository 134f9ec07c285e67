"""A relay between JAX's client in this process and the coordinator, so that the end of rank 0 reaches us before JAX.

JAX aborts a process (SIGABRT, pages of text) as soon as its connection to the coordinator ends. Through the relay, in
the process itself, that connection outlives rank 0: our own links notice its end at once, and end the process in order.
"""

import contextlib
import socket
import threading
import time

_PAUSE = 0.1  # s, between two attempts to reach the coordinator


def relay(host: str, port: int) -> int:
    """Forwards connections to a free port of the loopback interface, for as long as the process lives.

    Args:
      host: host of the coordinator.
      port: port of the coordinator, which need not listen yet.

    Returns:
      The free port.
    """
    server = socket.create_server(("127.0.0.1", 0))
    threading.Thread(target=_accept, args=(server, (host, port)), daemon=True, name="relay").start()
    return int(server.getsockname()[1])


def _accept(server: socket.socket, address: tuple[str, int]) -> None:
    """Accepts connections."""
    while True:
        near, _ = server.accept()
        threading.Thread(target=_forward, args=(near, address), daemon=True, name="relay-out").start()


def _forward(near: socket.socket, address: tuple[str, int]) -> None:
    """Forwards one connection until this end closes it; the other end's closing is not passed on."""
    while True:
        with contextlib.suppress(OSError):
            far = socket.create_connection(address)
            break
        time.sleep(_PAUSE)
    with near, far, contextlib.suppress(OSError):
        threading.Thread(target=_backward, args=(far, near), daemon=True, name="relay-in").start()
        while data := near.recv(1 << 16):
            with contextlib.suppress(OSError):
                far.sendall(data)


def _backward(far: socket.socket, near: socket.socket) -> None:
    """Forwards the data of the coordinator."""
    with contextlib.suppress(OSError):
        while data := far.recv(1 << 16):
            near.sendall(data)
