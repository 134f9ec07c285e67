"""Hostile peers, for benchmarks and tests: `python -m tests.benchmarks.attackers KIND ENDPOINT RUN [FILE]`.

Each does one thing without end, as fast as it can, over plain TCP and with Zenoh's own interface: nothing that the
project's own peers do to be polite holds it back. It prints a line when it has begun.
"""

import contextlib
import json
import pathlib
import socket
import sys
import threading
import time
from collections.abc import Callable

import zenoh
from zenoh.handlers import Callback, FifoChannel

from congrasp.common.transport.keys import Keys
from congrasp.common.transport.ports import shifted
from congrasp.common.wire.codec import Message, encode

_SILENT = 300
_HUGE = 60 << 20
_PULLS = 83.0  # a second
_FOREVER = 3600.0
_BURST = 0.001  # seconds of processor time


def unread(endpoint: str, run: str, query: bytes) -> None:
    """Asks a policy server and never reads an answer: the thread that should is asleep."""
    stopped: Callback[zenoh.Reply] = Callback(lambda reply: time.sleep(_FOREVER), indirect=False)
    with _session(endpoint, 0) as session:
        print("began", flush=True)
        while True:
            session.get(Keys(run).act_for("unread"), stopped, payload=query, timeout=_FOREVER)
            time.sleep(0.001)


def greedy(endpoint: str, run: str, query: bytes) -> None:
    """Asks a learner for all its weights, 83 times a second, and for every further piece that it is told of."""
    request = encode(Message(meta={"newer_than": -1}))
    with _session(endpoint, 1) as session:
        print("began", flush=True)

        def pull(name: str) -> None:
            key = Keys(run).weights_for("actor", name)
            while True:
                began = time.monotonic()
                _whole(session, key, request)
                time.sleep(max(0.0, 8 / _PULLS - (time.monotonic() - began)))

        for _ in range(8):
            threading.Thread(target=pull, args=("greedy",), daemon=True).start()
        time.sleep(_FOREVER)


def silent(endpoint: str, run: str, query: bytes) -> None:
    """Opens 300 TCP connections and says nothing; opens one anew for each that is closed."""
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
    payload, key = bytes(_HUGE), query.decode() or Keys(run).act_for("huge")
    sessions = [_session(endpoint, 0) for _ in range(4)]
    print("began", flush=True)

    def send(session: zenoh.Session) -> None:
        while True:
            for _ in session.get(key, FifoChannel(4), payload=payload, timeout=1.0):
                pass

    for session in sessions:
        threading.Thread(target=send, args=(session,), daemon=True).start()
    time.sleep(_FOREVER)


def burn(endpoint: str, run: str, query: bytes) -> None:
    """Harms nobody: takes the share of a processor that the file names, and talks to nobody."""
    share = float(query)
    print("began", flush=True)
    while True:
        began = time.thread_time()
        while (spent := time.thread_time() - began) < _BURST:
            pass
        time.sleep(spent / share - spent)


KINDS: dict[str, Callable[[str, str, bytes], None]] = {
    "unread": unread, "greedy": greedy, "silent": silent, "huge": huge, "burn": burn,
}  # fmt: skip


def _session(endpoint: str, flow: int) -> zenoh.Session:
    """A session with the port of a flow, of which Zenoh's own defaults bound nothing."""
    config = zenoh.Config()
    settings = {"mode": "client", "connect/endpoints": [shifted(endpoint, flow)], "scouting/multicast/enabled": False}
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def _whole(session: zenoh.Session, key: str, request: bytes) -> None:
    """Asks, and for four mebibytes more at a time while there is more to have."""
    offset, head = 0, b""
    while True:
        attachment = head[:8] + offset.to_bytes(8, "little") + (4 << 20).to_bytes(4, "little") if head else None
        replies = session.get(
            key, FifoChannel(4), payload=None if head else request, attachment=attachment, timeout=5.0
        )
        piece = next((reply.ok for reply in replies if reply.ok), None)
        if piece is None or piece.attachment is None:
            return
        head, offset = head or piece.attachment.to_bytes(), offset + len(piece.payload.to_bytes())
        if offset >= int.from_bytes(head[8:16], "little"):
            return


if __name__ == "__main__":
    kind, endpoint, run, file = (*sys.argv[1:5], "")[:4]
    KINDS[kind](endpoint, run, pathlib.Path(file).read_bytes() if file else b"")
