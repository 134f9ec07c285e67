"""Cost of mutual TLS, access control and a hostile actor, as ratios against a run without them."""

import contextlib
import multiprocessing
import pathlib
import statistics
import tempfile
import time
from collections.abc import Iterator

import numpy as np

from congrasp.common.errors import TransportError
from congrasp.common.transport import urls
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.ports import local_url
from congrasp.common.wire.codec import Message
from congrasp.learner.hub.rate_limit import RateLimit
from congrasp.services.ops.certificates import create_authority, issue

_KEYS = Keys("bench")
_ACTOR, _EVIL = "0.a", "1.b"
_MEGABYTES = 8
_SMALL = Message(meta={"actor": _ACTOR, "incarnation": "01", "ticket": "t"})
_LARGE = Message({"x": np.zeros(_MEGABYTES * 10**6, np.uint8)})


def bench_security(repeats: int) -> None:
    """Prints what is secured beside what is not, and an actor's throughput in a flood; medians of `repeats`."""
    found = _measure(repeats)
    plain, secure, flooded = (found[f"{name}_mb_per_s"] for name in ("plain", "secure", "flood"))
    print(
        f"a request of 100 bytes: {found['secure_query_ms']:.2f} ms secured, {found['plain_query_ms']:.2f} ms plain\n"
        f"a rollout of 8 MB:      {secure:.0f} MB/s secured, {plain:.0f} MB/s plain (ratio {secure / plain:.2f})\n"
        f"the same in a flood:    {flooded:.0f} MB/s (ratio {flooded / secure:.2f}), while "
        f"{found['flood_rejected']:.0f} requests were rejected\n"
        f"opening the learner:    {found['secure_open_ms']:.0f} ms secured, {found['plain_open_ms']:.0f} ms plain"
    )


def _measure(repeats: int) -> dict[str, float]:
    """Medians of `repeats` alternating measurements: times in ms, and rates in MB/s, one of them beside a flood."""
    with tempfile.TemporaryDirectory() as folder:
        create_authority(pathlib.Path(folder), run=_KEYS.run)
        for role in ("learner", "actor", "actor"):
            issue(pathlib.Path(folder), role)
        found: dict[str, list[float]] = {}

        def note(name: str, value: float) -> None:
            found.setdefault(name, []).append(value)

        for _ in range(repeats):
            for name, certs in (("plain", None), ("secure", pathlib.Path(folder))):
                began = time.perf_counter()
                with _learner(certs) as (endpoint, limit):
                    note(f"{name}_open_ms", 1e3 * (time.perf_counter() - began))
                    with _connected(endpoint, certs, 0) as actor:
                        note(f"{name}_query_ms", 1e3 * _seconds(actor, _KEYS.ticket(_ACTOR), _SMALL, 300))
                        note(f"{name}_mb_per_s", _MEGABYTES / _seconds(actor, _KEYS.rollout(_ACTOR), _LARGE, 10))
                        if certs is not None:
                            with _flood(endpoint, certs, limit):
                                before = limit.rejected
                                note("flood_mb_per_s", _MEGABYTES / _seconds(actor, _KEYS.rollout(_ACTOR), _LARGE, 10))
                                note("flood_rejected", limit.rejected - before)
        return {name: statistics.median(values) for name, values in found.items()}


@contextlib.contextmanager
def _learner(certs: pathlib.Path | None) -> Iterator[tuple[str, RateLimit]]:
    """What answers tickets and rollouts as a learner's hub does, without looking into them."""
    endpoint, limit = local_url(), RateLimit()

    def accept(key: str, request: Message) -> Message:
        return Message(meta={"outcome": "refused" if key.endswith(_EVIL) else "accepted"})

    def admission(key: str) -> Message | None:
        return None if limit.admits(key) else Message(meta={"outcome": "retry"})

    with urls.listen(endpoint, "learner", certs=certs) as transport:
        for keys in (_KEYS.tickets, _KEYS.rollouts):
            transport.serve(keys, limit.charging(accept), workers=2, depth=8, admission=admission)
        yield endpoint, limit


def _connected(endpoint: str, certs: pathlib.Path | None, number: int) -> Transport:
    """An actor's connection, with the certificate of this number where there are certificates."""
    return urls.connect(endpoint, "actor", certs=None if certs is None else certs / f"actor.{number}")


def _seconds(transport: Transport, key: str, message: Message, count: int) -> float:
    """The median of the times that a request takes."""
    times = []
    for _ in range(count + 1):
        began = time.perf_counter()
        transport.query(key, message, timeout=30.0)
        times.append(time.perf_counter() - began)
    return statistics.median(times[1:])


@contextlib.contextmanager
def _flood(endpoint: str, certs: pathlib.Path, limit: RateLimit) -> Iterator[None]:
    """Another process, with an actor's certificate of its own, sends rubbish while the block runs."""
    hostile = multiprocessing.get_context("spawn").Process(target=_send_rubbish, args=(endpoint, certs), daemon=True)
    hostile.start()
    try:
        deadline = time.monotonic() + 60.0
        while not limit.rejected and time.monotonic() < deadline:
            time.sleep(0.1)
        yield
    finally:
        hostile.kill()
        hostile.join()


def _send_rubbish(endpoint: str, certs: pathlib.Path) -> None:
    """1 MB at a time, as fast as it is answered."""
    rubbish = Message({"x": np.zeros(10**6, np.uint8)})
    with _connected(endpoint, certs, 1) as transport:
        while True:
            with contextlib.suppress(TransportError):
                transport.query(_KEYS.rollout(_EVIL), rubbish, timeout=5.0)
