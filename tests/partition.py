"""A link that can be cut: its connections stay open, and nothing passes."""

import contextlib
import socket
import threading
from collections.abc import Iterator

from congrasp.common.transport.keys import FLOWS
from congrasp.common.transport.ports import free_port, shifted

_CHUNK = 64 << 10
_CONNECT_SECONDS = 5.0


class Link:
    """An endpoint through which another one, with all its flows, is reached."""

    def __init__(self) -> None:
        self.port = free_port()
        self._open = threading.Event()
        self._open.set()
        self._ended = threading.Event()

    @property
    def endpoint(self) -> str:
        return f"tcp/127.0.0.1:{self.port}"

    def cut(self) -> None:
        """Lets nothing pass, either way."""
        self._open.clear()

    def heal(self) -> None:
        """Lets everything pass again."""
        self._open.set()

    def close(self) -> None:
        self._ended.set()
        self._open.set()

    def serve(self, listener: socket.socket, target: tuple[str, int]) -> None:
        """Forwards connections until the listener is closed."""
        with contextlib.suppress(OSError), listener:
            while True:
                near, _ = listener.accept()
                threading.Thread(target=self._join, args=(near, target), daemon=True).start()

    def _join(self, near: socket.socket, target: tuple[str, int]) -> None:
        self._open.wait()
        try:
            far = socket.create_connection(target, _CONNECT_SECONDS)
        except OSError:
            near.close()
            return
        far.settimeout(None)
        for source, sink in ((near, far), (far, near)):
            threading.Thread(target=self._pump, args=(source, sink), daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError), source, sink:
            while not self._ended.is_set():
                data = source.recv(_CHUNK)
                self._open.wait()
                if not data:
                    return
                sink.sendall(data)


@contextlib.contextmanager
def cuttable(endpoint: str) -> Iterator[Link]:
    """A link to an endpoint while the block runs."""
    link = Link()
    listeners: list[socket.socket] = []
    for index in range(len(FLOWS)):
        host, _, number = shifted(endpoint, index).partition("/")[2].rpartition(":")
        listener = socket.create_server(("127.0.0.1", link.port + index))
        listeners.append(listener)
        target = host, int(number)
        threading.Thread(target=link.serve, args=(listener, target), daemon=True).start()
    try:
        yield link
    finally:
        link.close()
        for listener in listeners:
            listener.close()
