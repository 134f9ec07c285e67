"""Ranks: the learner processes of one run, their agreement in rounds, and the mesh of their
devices.

Arrays are reduced by XLA (`collectives`) between one device of each rank. In addition the ranks
exchange messages over plain TCP through rank 0: an update begins when all of them have a batch,
they end together, and they receive each other's metrics. A rank that dies or stops responding ends
the others with one line, even inside a collective. The two ports of the coordinator have no
authentication, like JAX's own: keep them inside the cluster.
"""

import collections
import contextlib
import json
import os
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, NoReturn

import jax
import numpy as np
from jax.sharding import Mesh

from congrasp.common.errors import CongraspError, TransportError, os_errors_as
from congrasp.common.runtime.stages import stage
from congrasp.common.wire.codec import MAX_MESSAGE, Message, decode, encode
from congrasp.learner.distributed.collectives import AXIS
from congrasp.learner.distributed.relay import relay

JOIN_SECONDS = 300.0
"""Deadline for all ranks to join."""
ROUND_SECONDS = 300.0
"""Deadline of an update, or of an exchange between live ranks."""
SILENCE_SECONDS = 20.0
"""Time without a message after which a rank counts as dead."""
_HEARTBEAT_SECONDS = 2.0
RELAY_SECONDS = 2.0
"""Time that rank 0 stays alive, so that JAX does not abort the others before they print the
reason.
"""
_LENGTH = struct.Struct("!Q")
_META = "meta"


def end_process(text: str, code: int = TransportError.exit_code) -> NoReturn:
    """Prints the reason in one line and ends the process at once.

    The main thread may wait for a lost rank, and so would JAX at an orderly exit before it aborts.
    """
    with contextlib.suppress(OSError):  # the output may be on a full disk
        sys.stdout.flush()
        print(f"congrasp: error: {text}", file=sys.stderr, flush=True)
    os._exit(code)


class Link:
    """Messages over a TCP connection; a silence beyond the limit raises `OSError`, like its end."""

    def __init__(self, connection: socket.socket):
        """Wraps an open connection."""
        connection.settimeout(SILENCE_SECONDS)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket = connection
        self._file = connection.makefile("rb")
        self._lock = threading.Lock()

    def send(self, message: Message) -> None:
        """Sends a message; an `OSError` if the connection ended."""
        # Meta data as an array: a header's length is limited.
        meta = np.frombuffer(json.dumps(message.meta).encode(), np.uint8)
        data = encode(Message({**message.arrays, _META: meta}))
        with self._lock:
            self._socket.sendall(_LENGTH.pack(len(data)) + data)

    def receive(self) -> Message:
        """Waits for the next message.

        Raises:
          OSError: the connection ended, is silent, or its message is too long.
          CongraspError: the message is damaged.
        """
        (length,) = _LENGTH.unpack(self._read(_LENGTH.size))
        if length > MAX_MESSAGE:
            raise ConnectionError(f"a message of {length} bytes")
        arrays = dict(decode(self._read(length)).arrays)
        return Message(arrays, json.loads(arrays.pop(_META).tobytes()))

    def close(self) -> None:
        """Closes the connection, also while another thread receives."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _read(self, length: int) -> bytes:
        data = self._file.read(length)
        if len(data) < length:
            raise ConnectionError("the connection ended")
        return data


class Ranks:
    """This process among the learner's ranks; by default the only one.

    They agree in rounds. Each posts an entry, and all receive the list of entries, in rank order,
    once all are posted, or at once after an urgent one (missing entries are then None).

    Attributes:
      rank: number of this process.
      count: number of ranks.
      mesh: a device of every rank along `learner.distributed.collectives.AXIS`; None if this
        process is alone.
    """

    def __init__(
        self,
        rank: int = 0,
        count: int = 1,
        links: Mapping[int, Link] | None = None,
        on_lost: Callable[[str], object] = end_process,
    ):
        """Monitors the links: rank 0 to every other rank, any other to rank 0."""
        self.rank = rank
        self.count = count
        self.mesh: Mesh | None = None
        self._links = dict(links or {})
        self._on_lost = on_lost
        self._changed = threading.Condition()
        self._round = self._deciding = 0
        self._entries: dict[int, Message] = {}
        self._decisions: collections.deque[Message] = collections.deque()
        self._leaving = threading.Event()
        self._lost = threading.Event()
        for peer, link in self._links.items():
            threading.Thread(
                target=self._listen, args=(peer, link), daemon=True, name=f"rank-{peer}"
            ).start()
        if self._links:
            threading.Thread(target=self._beat, daemon=True, name="rank-heartbeat").start()

    @classmethod
    @stage("join of the ranks")
    def join(
        cls, rank: int, count: int, coordinator: str, on_lost: Callable[[str], object] = end_process
    ) -> "Ranks":
        """Joins the other ranks; must be called before anything else initialises JAX.

        Args:
          rank: number of this process.
          count: number of ranks.
          coordinator: `host:port` of rank 0, which listens there (JAX) and at the next port (the
            ranks).
          on_lost: called with the reason when another rank is lost; it should not return.

        Raises:
          CongraspError: the rank, the count or the address is invalid, or the port is in use.
          TransportError: not all ranks joined in time.
        """
        if not 0 <= rank < count:
            raise CongraspError(
                f"There is no rank {rank} of {count}.", "Ranks are numbered from 0."
            )
        if count == 1:
            return cls()
        host, _, port = coordinator.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 65535:
            raise CongraspError(
                f"'{coordinator}' is not a valid address of rank 0.",
                "Pass --coordinator HOST:PORT.",
            )
        # All interfaces unless it is the loopback: rank 0 may not resolve the name by which others
        # reach it.
        bind = host if host in ("localhost", "127.0.0.1") else ""
        deadline = time.monotonic() + JOIN_SECONDS
        if rank == 0:
            links = accept_links(count, bind, int(port) + 1, deadline)
        else:
            links = {0: open_link(rank, count, host, int(port) + 1, deadline)}
        ranks = cls(rank, count, links, on_lost)
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.config.update("jax_enable_preemption_service", False)  # it would intercept SIGTERM
        jax.distributed.initialize(
            f"127.0.0.1:{relay(host, int(port))}" if rank else coordinator,
            count,
            rank,
            local_device_ids=[0],
            initialization_timeout=int(JOIN_SECONDS),
            coordinator_bind_address=f"{bind or '[::]'}:{port}",
            shutdown_timeout_seconds=int(SILENCE_SECONDS),
        )
        first = {device.process_index: device for device in reversed(jax.devices())}
        ranks.mesh = Mesh(np.array([first[number] for number in range(count)]), (AXIS,))
        return ranks

    def post(
        self,
        entry: Mapping[str, Any],
        arrays: Mapping[str, np.ndarray] | None = None,
        *,
        urgent: bool = False,
    ) -> None:
        """Posts this rank's entry (JSON) to the round.

        A second entry replaces the first. An entry after the end of the round is ignored.
        """
        frame = Message(arrays or {}, {"round": self._round, "urgent": urgent, "entry": entry})
        if self.rank == 0:
            self._collect(0, frame)
        else:
            with contextlib.suppress(
                OSError
            ):  # the thread that listens to the link notices its end
                self._links[0].send(frame)

    def poll(self, timeout: float) -> Message | None:
        """Returns the round's decision: `entries` in its metadata and the arrays of rank 0; None on
        a timeout.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._decisions, timeout):
                return None
            self._round += 1
            return self._decisions.popleft()

    def exchange(
        self, entry: Mapping[str, Any], arrays: Mapping[str, np.ndarray] | None = None
    ) -> Message:
        """Runs a whole round: every rank calls this, and all receive all entries and the arrays of
        rank 0.
        """
        self.post(entry, arrays)
        decision = self.poll(ROUND_SECONDS)
        if decision is None:
            raise TransportError(
                f"The {self.count} ranks did not synchronise within {ROUND_SECONDS:.0f} s."
            )
        return decision

    @contextlib.contextmanager
    def watchdog(self) -> Iterator[None]:
        """Context with a deadline for code with collectives, which would otherwise wait forever for
        a missing rank.
        """
        if self.count == 1:
            yield
            return
        text = (
            f"The ranks did not complete an update within {ROUND_SECONDS:.0f} s; rank "
            f"{self.rank} stops."
        )
        timer = threading.Timer(ROUND_SECONDS, self._on_lost, (text,))
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            timer.cancel()

    def close(self) -> None:
        """Leaves the run cleanly: all ranks call this, after which the end of another rank is not a
        failure.
        """
        if self.count == 1 or self._leaving.is_set():
            return
        self.exchange({"bye": True})
        self.leave()
        jax.distributed.shutdown()

    def leave(self) -> None:
        """Leaves the run without a message; another rank's end is no failure from now on."""
        self._leaving.set()

    def fail(self, error: BaseException) -> None:
        """Reports to the others why this rank ends, unless all leave cleanly or the cause is
        another rank's end.
        """
        if self.count == 1 or self._leaving.is_set():
            return
        if not isinstance(error, CongraspError) and self._lost.wait(RELAY_SECONDS):
            # A collective broke because a peer is gone, which is being reported right
            # now
            time.sleep(SILENCE_SECONDS)
        self.leave()
        reason = str(error) or type(error).__name__
        for link in self._links.values():
            with contextlib.suppress(OSError):
                link.send(Message(meta={"lost": f"Rank {self.rank} ended: {reason}"}))

    def _collect(self, rank: int, frame: Message) -> None:
        """On rank 0: adds an entry, and broadcasts the decision when it is made."""
        with self._changed:
            if frame.meta["round"] != self._deciding:
                return
            self._entries[rank] = frame
            if len(self._entries) < self.count and not frame.meta["urgent"]:
                return
            entries = [
                self._entries[r].meta["entry"] if r in self._entries else None
                for r in range(self.count)
            ]
            arrays = self._entries[0].arrays if 0 in self._entries else {}
            decision = Message(arrays, {"round": self._deciding, "entries": entries})
            self._deciding += 1
            self._entries = {}
            for link in self._links.values():
                with contextlib.suppress(OSError):
                    link.send(decision)
            self._decide(decision)

    def _decide(self, decision: Message) -> None:
        with self._changed:
            if all(entry and entry.get("bye") for entry in decision.meta["entries"]):
                self.leave()
            self._decisions.append(decision)
            self._changed.notify_all()

    def _listen(self, peer: int, link: Link) -> None:
        """Receives messages of a peer until it is gone."""
        try:
            while True:
                message = link.receive()
                if "lost" in message.meta:
                    return self._lose(message.meta["lost"], peer)
                if "entry" in message.meta:
                    self._collect(peer, message)
                elif "entries" in message.meta:
                    self._decide(message)
        except TimeoutError:
            self._lose(f"Rank {peer} has been silent for {SILENCE_SECONDS:.0f} s", peer)
        except (OSError, CongraspError, KeyError, ValueError):
            self._lose(f"Rank {peer} ended", peer)

    def _lose(self, what: str, peer: int) -> None:
        if self._leaving.is_set() or self._lost.is_set():
            return
        self._lost.set()
        others = [link for number, link in self._links.items() if number != peer]
        for link in others:
            with contextlib.suppress(OSError):
                link.send(Message(meta={"lost": what}))
        if self.rank == 0:
            time.sleep(RELAY_SECONDS)
        self._on_lost(
            f"{what.rstrip('.')}. Rank {self.rank} cannot continue alone: start all ranks with "
            f"--resume."
        )

    def _beat(self) -> None:
        while not self._leaving.wait(_HEARTBEAT_SECONDS):
            for link in self._links.values():
                with contextlib.suppress(OSError):
                    link.send(Message())


def accept_links(count: int, bind: str, port: int, deadline: float) -> dict[int, Link]:
    """Accepts the links of all other ranks, on rank 0.

    Args:
      count: number of ranks.
      bind: address of the interface, "" for all.
      port: port to listen at.
      deadline: end of the wait, by `time.monotonic`.

    Returns:
      Links by rank.

    Raises:
      CongraspError: the port is in use.
      TransportError: not all ranks joined before the deadline.
    """
    with os_errors_as(
        f"Rank 0 cannot listen at port {port}", "Choose another --coordinator HOST:PORT."
    ):
        server = socket.create_server((bind, port))
    links: dict[int, Link] = {}
    with server:
        while len(links) < count - 1:
            server.settimeout(max(0.1, deadline - time.monotonic()))
            try:
                link = Link(server.accept()[0])
                hello = link.receive().meta
            except TimeoutError:
                if time.monotonic() < deadline:
                    continue
                missing = sorted(set(range(1, count)) - links.keys())
                raise TransportError(
                    f"Ranks {missing} of {count} did not join within {JOIN_SECONDS:.0f} s."
                ) from None
            except (OSError, CongraspError, KeyError, ValueError):
                continue
            if hello.get("ranks") == count and hello.get("rank") in range(1, count):
                links[hello["rank"]] = link
            else:
                _reject(link, f"Rank 0 expects {count} ranks, and no {dict(hello)}")
    return links


def _reject(link: Link, reason: str) -> None:
    """Sends the reason to the other end, and closes the link."""
    with contextlib.suppress(OSError):
        link.send(Message(meta={"lost": reason}))
    link.close()


def open_link(rank: int, count: int, host: str, port: int, deadline: float) -> Link:
    """Opens the link to rank 0, on other ranks.

    Args:
      rank: number of this process.
      count: number of ranks.
      host: address of rank 0.
      port: port at which it accepts links.
      deadline: end of the attempts, by `time.monotonic`.

    Raises:
      TransportError: rank 0 does not answer before the deadline.
    """
    while True:
        try:
            link = Link(socket.create_connection((host, port), timeout=5.0))
            link.send(Message(meta={"rank": rank, "ranks": count}))
            return link
        except OSError as error:
            if time.monotonic() > deadline:
                raise TransportError(
                    f"Rank 0 does not answer at {host}:{port}: {error}.",
                    "Pass its host and port with --coordinator.",
                ) from None
            time.sleep(0.5)


class Ending(NamedTuple):
    """End of training that one rank has requested."""

    rank: int
    reason: str


def first_ending(entries: Sequence[Mapping[str, Any] | None]) -> Ending | None:
    """Returns the end that the first rank requests; None if none does."""
    for rank, entry in enumerate(entries):
        if entry and entry.get("end"):
            return Ending(rank, entry["end"])
    return None
