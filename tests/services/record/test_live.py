"""A viewer that connects gets channels, what came before it, and frames in their time."""

import collections
import contextlib
import itertools
import json
import pathlib
import socket
import struct
import time
from collections.abc import Sequence

import psutil
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from congrasp.common.errors import CongraspError
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.common.wire.codec import Message
from congrasp.services.record import live_gate
from congrasp.services.record.live import LiveServer
from congrasp.services.record.recorder import Recorder
from congrasp.services.record.writer import Entry, JsonChannels
from tests.children import python
from tests.episodes import CONTROL_DT, episode_message

MESSAGE_DATA = 1  # operation code of a binary frame with a message


class Viewer:
    """Subscribes to every channel it is told of, and keeps what comes."""

    def __init__(self, socket: ClientConnection):
        self._socket = socket
        self._topics: dict[int, str] = {}
        self.advertised: dict[str, dict[str, str]] = {}
        self.frames: dict[str, list[tuple[int, bytes]]] = collections.defaultdict(list)

    def listen(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (rest := end - time.monotonic()) > 0:
            try:
                frame = self._socket.recv(timeout=rest)
            except TimeoutError:
                return
            if isinstance(frame, bytes):
                operation, subscription, stamp = struct.unpack_from("<BIQ", frame)
                if operation == MESSAGE_DATA:
                    self.frames[self._topics[subscription]].append((stamp, frame[13:]))
                continue
            message = json.loads(frame)
            if message["op"] == "advertise":
                for channel in message["channels"]:
                    self._topics[channel["id"]] = channel["topic"]
                    self.advertised[channel["topic"]] = channel
                self._subscribe(message["channels"])
            elif message["op"] == "status" and "Unknown channel" in message["message"]:
                # The server tells viewers of a new channel a moment before it takes subscriptions
                # to it.
                self._subscribe(list(self.advertised.values()))

    def _subscribe(self, channels: list[dict[str, str]]) -> None:
        subscriptions = [{"id": channel["id"], "channelId": channel["id"]} for channel in channels]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))

    def latest(self, topic: str) -> int:
        """Value of the field `number` of the last message."""
        return int(json.loads(self.frames[topic][-1][1])["number"])

    def wait_for(self, topic: str, count: int) -> None:
        while len(self.frames[topic]) < count:
            self.listen(0.1)


def viewer(server: LiveServer, max_queue: int = 16) -> ClientConnection:
    """A connection that stops reading while `max_queue` frames wait for `recv`."""
    return connect(
        f"ws://127.0.0.1:{server.port}",
        subprotocols=["foxglove.sdk.v1"],
        max_size=1 << 24,
        max_queue=max_queue,
        close_timeout=0.1,
    )


def test_a_recorders_channels_reach_a_viewer_while_it_records(tmp_path: pathlib.Path) -> None:
    transport = MemoryTransport(MemoryHub())
    keys = Keys("r")
    with (
        LiveServer(0) as server,
        Recorder(transport, "r", tmp_path, sinks=[server]) as recorder,
        viewer(server) as socket,
    ):
        seen = Viewer(socket)
        for update in range(400):
            message = Message({}, {"update": update, "values": {"kl": 0.5}})
            transport.publish(keys.log("metrics", "learner", "0"), message)
            seen.listen(0.05)
            if len(seen.frames["/metrics/learner/0"]) >= 3:
                break
        while (
            len(seen.frames["/episode/a0/tf"]) < 6
        ):  # an episode of 1.5 s may be over before the viewer subscribes
            seen.frames["/episode/a0/tf"].clear()
            transport.publish(keys.log("episode", "actor", "a0"), episode_message(150))
            seen.listen(3.0)
        seen.wait_for("/episode/a0/scene", 1)
    assert recorder.error == ""
    assert recorder.files[0].suffix == ".mcap"
    payload = json.loads(seen.frames["/metrics/learner/0"][-1][1])
    assert payload["values"] == {"kl": 0.5}
    channel = seen.advertised["/metrics/learner/0"]
    assert channel["encoding"] == "json"
    assert channel["schemaEncoding"] == "jsonschema"
    assert seen.advertised["/episode/a0/tf"]["schemaName"] == "foxglove.FrameTransforms"
    stamps = [stamp for stamp, _ in seen.frames["/episode/a0/tf"]]
    assert {round((b - a) / 1e9 / CONTROL_DT) for a, b in itertools.pairwise(stamps)} == {1}


def test_entries_wait_for_their_time_and_newcomers_get_the_scene(tmp_path: pathlib.Path) -> None:
    transport = MemoryTransport(MemoryHub())
    keys = Keys("r")
    with LiveServer(0) as server, Recorder(transport, "r", None, sinks=[server]):
        channel = JsonChannels()
        server.write(channel.entry("/late", time.time_ns() + 3600 * 10**9, {"a": 1}))
        transport.publish(keys.log("episode", "actor", "a0"), episode_message(3))
        with viewer(server) as first:
            one = Viewer(first)
            one.wait_for("/episode/a0/scene", 1)
        with viewer(server) as second:
            two = Viewer(second)
            two.wait_for("/episode/a0/scene", 1)
            two.wait_for("/episode/a0/surface", 1)
    assert "/late" not in two.advertised


def test_a_schema_that_grows_replaces_its_channel() -> None:
    with LiveServer(0) as server, viewer(server) as socket:
        seen = Viewer(socket)
        channels = JsonChannels()
        for fields in ({"a": 1}, {"a": 1, "b": 2}):
            for _ in range(400):
                server.write(channels.entry("/m", time.time_ns(), fields))
                seen.listen(0.05)
                if seen.frames["/m"] and json.loads(seen.frames["/m"][-1][1]) == fields:
                    break
            assert json.loads(seen.frames["/m"][-1][1]) == fields
        assert set(json.loads(seen.advertised["/m"]["schema"])["properties"]) == {"a", "b"}


@pytest.mark.parametrize(
    ("headers", "admitted"),
    [
        ({}, True),
        ({"Origin": "https://app.foxglove.dev"}, True),
        ({"Origin": "file://"}, True),
        ({"Origin": "http://localhost:8080"}, True),
        ({"Host": "localhost:9000"}, True),  # a tunnel
        ({"Origin": "https://evil.example"}, False),
        ({"Origin": "https://foxglove.dev.evil.example"}, False),
        ({"Origin": "null"}, False),
        ({"Host": "evil.example:80"}, False),
    ],
)
def test_other_sites_in_a_browser_cannot_watch(headers: dict[str, str], admitted: bool) -> None:
    with LiveServer(0) as server:
        address = f"127.0.0.1:{server.port}"
        lines = {
            "Host": address,
            "Connection": "Upgrade",
            "Upgrade": "websocket",
            "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": "x3JJHMbDL1EzLkh9GBhXDw==",
            "Sec-WebSocket-Protocol": "foxglove.sdk.v1",
            **headers,
        }
        with socket.create_connection(("127.0.0.1", server.port), timeout=10.0) as connection:
            text = "".join(f"{name}: {value}\r\n" for name, value in lines.items())
            connection.sendall(f"GET / HTTP/1.1\r\n{text}\r\n".encode())
            answer = connection.recv(1 << 12).decode("latin-1")
    assert answer.startswith("HTTP/1.1 101 " if admitted else "HTTP/1.1 403 ")


def test_a_busy_port_is_one_line() -> None:
    with (
        LiveServer(0) as server,
        pytest.raises(CongraspError, match=f"cannot listen on 127.0.0.1:{server.port}"),
    ):
        LiveServer(server.port)


def test_the_33rd_connection_is_refused() -> None:
    """Connections are admitted in their order, before they send anything."""
    with LiveServer(0) as server, contextlib.ExitStack() as stack:
        address = ("127.0.0.1", server.port)
        for _ in range(32):
            stack.enter_context(socket.create_connection(address, timeout=10.0))
        newest = stack.enter_context(socket.create_connection(address, timeout=10.0))
        assert newest.recv(1 << 12).startswith(b"HTTP/1.1 503 ")


def handshake(server: LiveServer) -> bytes:
    """Head of a viewer's request."""
    lines = {
        "Host": f"127.0.0.1:{server.port}",
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "x3JJHMbDL1EzLkh9GBhXDw==",
        "Sec-WebSocket-Protocol": "foxglove.sdk.v1",
    }
    text = "".join(f"{name}: {value}\r\n" for name, value in lines.items())
    return f"GET / HTTP/1.1\r\n{text}\r\n".encode()


def test_viewer_of_another_address_is_admitted_when_full() -> None:
    with LiveServer(0) as server, contextlib.ExitStack() as stack:
        address = ("127.0.0.1", server.port)
        crowd = [
            stack.enter_context(socket.create_connection(address, timeout=10.0)) for _ in range(32)
        ]
        other = socket.create_connection(address, 10.0, source_address=("127.0.0.2", 0))
        stack.enter_context(other)
        other.sendall(handshake(server))
        assert other.recv(1 << 12).startswith(b"HTTP/1.1 101 ")
        with contextlib.suppress(ConnectionResetError):
            assert crowd[-1].recv(1) == b""
        crowd[0].sendall(handshake(server))
        assert crowd[0].recv(1 << 12).startswith(b"HTTP/1.1 101 ")


def number_entry(channels: JsonChannels, number: int, size: int) -> Entry:
    """Entry of the topic `/m` with a number and `size` further bytes, due now."""
    fields = {"number": number, "text": "x" * size}
    return channels.entry("/m", time.time_ns(), fields)


def subscribe_all(server: LiveServer, channels: JsonChannels, viewers: Sequence[Viewer]) -> None:
    """Sends small entries until each viewer has received one."""
    while not all(viewer.frames["/m"] for viewer in viewers):
        server.write(number_entry(channels, -1, 0))
        for viewer in viewers:
            viewer.listen(0.05)


def test_viewer_that_does_not_read_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another viewer misses nothing."""
    monkeypatch.setattr("congrasp.services.record.live_gate.UNREAD_BYTES", 8 << 20)
    entries = 48
    channels = JsonChannels()
    with LiveServer(0) as server, viewer(server) as reading, viewer(server, 1) as stuck:
        seen = Viewer(reading)
        unread = Viewer(stuck)
        subscribe_all(server, channels, [seen, unread])
        for number in range(entries):
            server.write(number_entry(channels, number, 1 << 20))
            while seen.latest("/m") < number:
                seen.listen(0.05)
        numbers = [json.loads(data)["number"] for _, data in seen.frames["/m"]]
        assert numbers[-entries:] == list(range(entries))
        with pytest.raises(ConnectionClosed):
            while unread.latest("/m") < entries - 1:
                unread.listen(1.0)


def memory_of_unread_messages() -> int:
    """Bytes by which this process grows while six viewers do not read 100 MB each."""
    live_gate.UNREAD_BYTES = 16 << 20
    process = psutil.Process()
    channels = JsonChannels()
    with LiveServer(0) as server, contextlib.ExitStack() as stack:
        viewers = [Viewer(stack.enter_context(viewer(server, 1))) for _ in range(6)]
        subscribe_all(server, channels, viewers)
        before = process.memory_info().rss
        most = before
        for number in range(100):
            server.write(number_entry(channels, number, 1 << 20))
            while server.queued_bytes:
                time.sleep(0.001)
            most = max(most, process.memory_info().rss)
    return most - before


def test_memory_of_unread_messages_is_bounded() -> None:
    """At most a fifth of all is held; in a process where nothing else takes memory."""
    program = f"import {__name__} as live; print(live.memory_of_unread_messages())"
    done = python("-c", program)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 120e6
