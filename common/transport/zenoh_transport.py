"""The transport over Zenoh: one session for bulk messages and one for everything else.

Large rollouts on a shared link would hold up small queries behind them (head-of-line blocking), so bulk keys have a
session and a port of their own: the port after the one that the user names. Publications use DROP; whatever must not
be lost is a query, because a Zenoh `put` never says that it failed.
"""

import json
import re
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import zenoh
from zenoh.handlers import FifoChannel, RingChannel

from common.errors import CongraspError, TransportError
from common.transport.base import Handler, Subscription
from common.transport.keys import BULK, relative
from common.wire.codec import MAX_MESSAGE, Message, decode, encode

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
"""Loopback only: without certificates nobody outside this machine is let in."""
_LEASE_MS = {"control": 3000, "bulk": 10000}


def _next_port(endpoint: str) -> str:
    match = re.fullmatch(r"(\w+/.*:)(\d+)", endpoint)
    if not match or not 0 < int(match[2]) < 65535:
        raise CongraspError(f"'{endpoint}' is not an endpoint.", "Write it as tcp/HOST:PORT, for example tcp/10.0.0.5:7447.")
    return f"{match[1]}{int(match[2]) + 1}"


def _config(flow: str, listen: list[str], connect: list[str], extra: Mapping[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "peer" if listen else "client",
        "listen/endpoints": listen,
        "connect/endpoints": connect,
        "connect/timeout_ms": 1000,
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": _LEASE_MS[flow],
        "transport/link/rx/max_message_size": MAX_MESSAGE,
        **extra,
    }
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return config


class ZenohTransport:
    """An endpoint on the network; see `common.transport.base.Transport`."""

    def __init__(
        self,
        *,
        listen: str | None = None,
        connect: str | None = None,
        patience: float = 10.0,
        bulk: bool = True,
        extra: Mapping[str, Any] | None = None,
    ):
        """Listens or connects.

        Args:
          listen: endpoint to listen on, such as tcp/127.0.0.1:7447 (bulk messages use the next port).
          connect: endpoint to connect to; exactly one of the two is given.
          patience: seconds to wait for the other side to appear.
          bulk: whether this endpoint carries bulk messages at all.
          extra: further Zenoh settings by their configuration key (certificates, access control).

        Raises:
          CongraspError: the port is busy, or the endpoint is malformed.
          TransportError: nobody listens at `connect` within `patience`.
        """
        endpoint = listen or connect
        if endpoint is None or (listen and connect):
            raise CongraspError("An endpoint needs either 'listen' or 'connect'.")
        self._closed = threading.Event()
        self._kept: list[Any] = []
        self._threads: list[threading.Thread] = []
        self._sessions: dict[str, zenoh.Session] = {}
        flows = {"control": endpoint} | ({"bulk": _next_port(endpoint)} if bulk else {})
        try:
            for flow, where in flows.items():
                self._sessions[flow] = self._open(flow, where, bool(listen), patience, extra or {})
        except BaseException:
            self.close()
            raise

    def _open(
        self, flow: str, endpoint: str, listen: bool, patience: float, extra: Mapping[str, Any]
    ) -> zenoh.Session:
        deadline = time.monotonic() + patience
        while True:
            try:
                ends = ([endpoint], []) if listen else ([], [endpoint])
                return zenoh.open(_config(flow, *ends, extra))
            except zenoh.ZError as error:
                if listen:
                    raise CongraspError(
                        f"Cannot listen on {endpoint}: the port is busy or not this machine's.",
                        "Choose another with --listen, or stop what uses it.",
                    ) from error
                if time.monotonic() > deadline:
                    raise TransportError(
                        f"Nobody listens at {endpoint} (waited {patience:.0f} s).",
                        "Start the learner there, or correct --connect.",
                    ) from error
                time.sleep(0.1)

    def _session(self, key: str) -> zenoh.Session:
        flow = "bulk" if "bulk" in self._sessions and relative(key) in BULK else "control"
        return self._sessions[flow]

    def serve(self, key: str, handler: Handler, *, workers: int = 1, depth: int = 4) -> None:
        """See `Transport.serve`."""
        queryable = self._session(key).declare_queryable(key, FifoChannel(depth))
        self._kept.append(queryable)
        for _ in range(workers):
            self._thread(lambda: self._answer(queryable, handler), f"serve {key}")

    def _answer(self, queryable: Any, handler: Handler) -> None:
        while not self._closed.is_set():
            try:
                query = queryable.recv()
            except zenoh.ZError:
                return
            with query:
                try:
                    request = decode(query.payload.to_bytes()) if query.payload is not None else Message({}, {})
                    query.reply(str(query.key_expr), encode(handler(str(query.key_expr), request)))
                except CongraspError as error:
                    self._reply_error(query, str(error))
                except zenoh.ZError:
                    continue  # the asker has gone

    @staticmethod
    def _reply_error(query: Any, text: str) -> None:
        try:
            query.reply_err(text)
        except zenoh.ZError:
            return

    def query(self, key: str, request: Message, *, timeout: float) -> Message:
        """See `Transport.query`."""
        try:
            replies = list(self._session(key).get(key, payload=encode(request), timeout=timeout))
        except zenoh.ZError as error:
            raise TransportError(f"The query on '{key}' could not be sent ({error}).") from None
        for reply in replies:
            if reply.ok is not None:
                return decode(reply.ok.payload.to_bytes())
        if replies:
            text = replies[0].err.payload.to_string()
            raise TransportError(f"No answer on '{key}' within {timeout:g} s." if text == "Timeout" else text)
        raise TransportError(f"Nobody answers on '{key}'.")

    def publish(self, key: str, message: Message) -> None:
        """See `Transport.publish`."""
        if not self._closed.is_set():
            self._session(key).put(key, encode(message), congestion_control=zenoh.CongestionControl.DROP)

    def subscribe(self, key_expression: str, *, depth: int = 64) -> Subscription:
        """See `Transport.subscribe`."""
        subscription = Subscription(depth)
        subscriber = self._sessions["control"].declare_subscriber(key_expression, RingChannel(depth))
        self._kept.append(subscriber)
        self._thread(lambda: self._collect(subscriber, subscription), f"subscribe {key_expression}")
        return subscription

    def _collect(self, subscriber: Any, subscription: Subscription) -> None:
        while not self._closed.is_set():
            try:
                sample = subscriber.recv()
            except zenoh.ZError:
                return
            try:
                subscription.deliver(str(sample.key_expr), decode(sample.payload.to_bytes()))
            except CongraspError:
                subscription.dropped += 1

    def declare_alive(self, key: str) -> None:
        """See `Transport.declare_alive`."""
        self._kept.append(self._sessions["control"].liveliness().declare_token(key))

    def watch_alive(self, key_expression: str, on_change: Callable[[str, bool], None]) -> None:
        """See `Transport.watch_alive`."""
        subscriber = (
            self._sessions["control"]
            .liveliness()
            .declare_subscriber(key_expression, FifoChannel(256), history=True)
        )
        self._kept.append(subscriber)

        def watch() -> None:
            while not self._closed.is_set():
                try:
                    sample = subscriber.recv()
                except zenoh.ZError:
                    return
                on_change(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        self._thread(watch, f"alive {key_expression}")

    def _thread(self, target: Callable[[], None], name: str) -> None:
        thread = threading.Thread(target=target, name=name, daemon=True)
        thread.start()
        self._threads.append(thread)

    def close(self) -> None:
        """See `Transport.close`."""
        if self._closed.is_set():
            return
        self._closed.set()
        for session in self._sessions.values():
            session.close()

    def __enter__(self) -> "ZenohTransport":
        """The endpoint itself."""
        return self

    def __exit__(self, *exc: object) -> None:
        """Closes."""
        self.close()
