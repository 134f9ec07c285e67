"""Hostile and slow peers, for benchmarks and tests: `python -m tests.benchmarks.attackers KIND
ENDPOINT RUN [FILE]`.

Each attacker does one thing without end, as fast as it can, over plain TCP and with Zenoh's own
interface: nothing that the project's own peers do to be polite holds it back. It prints a line when
it has begun.
"""

import contextlib
import pathlib
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator

import zenoh
from zenoh.handlers import Callback, FifoChannel

from congrasp.common.errors import CongraspError
from congrasp.common.transport.keys import FLOWS, Keys
from congrasp.common.transport.ports import free_port, shifted
from congrasp.common.wire.codec import Message, encode
from congrasp.services.ops.lifetime import follow_parent
from tests.bare_zenoh import bare_session
from tests.children import following

_SILENT = 300  # connections
_HUGE = 60 << 20  # bytes
_PULLS = 83.0  # a second
_FOREVER = 3600.0


@contextlib.contextmanager
def attacked(
    kind: str, endpoint: str, run: str, query: pathlib.Path | None = None, count: int = 1
) -> Iterator[None]:
    """Attackers of a kind, in processes of their own, while the block runs."""
    command = [
        sys.executable,
        "-m",
        "tests.benchmarks.attackers",
        kind,
        endpoint,
        run,
        str(query or ""),
    ]
    processes = [
        subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=following()
        )
        for _ in range(count)
    ]
    try:
        for process in processes:
            assert process.stdout is not None
            if not process.stdout.readline():
                raise CongraspError(f"The attacker '{kind}' did not start.")
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


@contextlib.contextmanager
def throttled(endpoint: str, rate: float) -> Iterator[str]:
    """An endpoint through which another one, with all its flows, is reached at so many bytes a
    second each way.
    """
    port = free_port()
    ended = threading.Event()

    def pump(source: socket.socket, target: socket.socket) -> None:
        with contextlib.suppress(OSError), source, target:
            while not ended.is_set() and (data := source.recv(int(rate / 50))):
                target.sendall(data)
                time.sleep(len(data) / rate)

    def accept(listener: socket.socket, target: tuple[str, int]) -> None:
        with contextlib.suppress(OSError), listener:
            while True:
                near = listener.accept()[0]
                far = socket.create_connection(target, 5.0)
                for one in (near, far):
                    one.settimeout(None)
                    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 64 << 10)
                for pair in ((near, far), (far, near)):
                    threading.Thread(target=pump, args=pair, daemon=True).start()

    listeners = []
    for index in range(len(FLOWS)):
        host, _, number = shifted(endpoint, index).partition("/")[2].rpartition(":")
        listeners.append(socket.create_server(("127.0.0.1", port + index)))
        threading.Thread(
            target=accept, args=(listeners[-1], (host, int(number))), daemon=True
        ).start()
    try:
        yield f"tcp/127.0.0.1:{port}"
    finally:
        ended.set()
        for listener in listeners:
            listener.close()


def unread(endpoint: str, run: str, query: bytes) -> None:
    """Sends queries to a policy server and never reads an answer: the thread that should is
    asleep.
    """
    stopped: Callback[zenoh.Reply] = Callback(lambda reply: time.sleep(_FOREVER), indirect=False)
    with bare_session("client", connect=endpoint) as session:
        print("began", flush=True)
        while True:
            session.get(Keys(run).act_for("unread"), stopped, payload=query, timeout=_FOREVER)
            time.sleep(0.001)


def greedy(endpoint: str, run: str, query: bytes) -> None:
    """Pulls all the weights of a learner 83 times a second, and every further chunk that it
    announces.
    """
    request = encode(Message(meta={"newer_than": -1}))
    with bare_session("client", connect=shifted(endpoint, 1)) as session:
        print("began", flush=True)

        def pull() -> None:
            key = Keys(run).weights_for("actor", "greedy")
            while True:
                began = time.monotonic()
                _whole(session, key, request)
                time.sleep(max(0.0, 8 / _PULLS - (time.monotonic() - began)))

        for _ in range(8):
            threading.Thread(target=pull, daemon=True).start()
        time.sleep(_FOREVER)


def silent(endpoint: str, run: str, query: bytes) -> None:
    """Opens 300 TCP connections, sends nothing, and replaces each that is closed."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")

    def opened() -> socket.socket:
        connection = socket.create_connection((host, int(port)), 1.0)
        connection.setblocking(False)
        return connection

    connections = [opened() for _ in range(_SILENT)]
    print("began", flush=True)
    while True:
        time.sleep(0.05)
        for index, connection in enumerate(connections):
            with contextlib.suppress(BlockingIOError, OSError):
                try:
                    gone = not connection.recv(1)
                except ConnectionError:
                    gone = True
                if gone:
                    connections[index] = opened()


def huge(endpoint: str, run: str, query: bytes) -> None:
    """Sends 60 MB to a policy server, or to the key that the file holds, four at a time."""
    payload = bytes(_HUGE)
    key = query.decode() or Keys(run).act_for("huge")
    sessions = [bare_session("client", connect=endpoint) for _ in range(4)]
    print("began", flush=True)

    def send(session: zenoh.Session) -> None:
        while True:
            for _ in session.get(key, FifoChannel(4), payload=payload, timeout=1.0):
                pass

    for session in sessions:
        threading.Thread(target=send, args=(session,), daemon=True).start()
    time.sleep(_FOREVER)


KINDS: dict[str, Callable[[str, str, bytes], None]] = {
    kind.__name__: kind for kind in (unread, greedy, silent, huge)
}


def _whole(session: zenoh.Session, key: str, request: bytes) -> None:
    """Sends a query, and requests four mebibytes more at a time while the answer has more."""
    offset = 0
    head = b""
    while True:
        attachment = (
            head[:8] + offset.to_bytes(8, "little") + (4 << 20).to_bytes(4, "little")
            if head
            else None
        )
        replies = session.get(
            key,
            FifoChannel(4),
            payload=None if head else request,
            attachment=attachment,
            timeout=5.0,
        )
        piece = next((reply.ok for reply in replies if reply.ok), None)
        if piece is None or piece.attachment is None:
            return
        head, offset = head or piece.attachment.to_bytes(), offset + len(piece.payload.to_bytes())
        if offset >= int.from_bytes(head[8:16], "little"):
            return


if __name__ == "__main__":
    follow_parent()
    kind, endpoint, run, file = (*sys.argv[1:5], "")[:4]
    KINDS[kind](endpoint, run, pathlib.Path(file).read_bytes() if file else b"")
