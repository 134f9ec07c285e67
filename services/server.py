"""The live policy server: follows a run or a policy file, and answers queries on `policy/act` and `policy/health`."""

import pathlib
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from common.errors import CongraspError, TransportError
from common.hands import get_hand
from common.policy import bundle as bundles
from common.policy.bundle import PolicyBundle, content_hash
from common.transport.base import Transport
from common.transport.keys import Keys
from common.wire.codec import Message, encode
from services.batching import Batcher
from services.inference import BATCH_SIZES, Answer, PolicyFunction, Weights
from services.requests import Query

Source = Callable[[int], PolicyBundle | None]
"""(version that is held, -1 for none) -> a newer bundle, or None."""
WINDOW = 0.001
DEPTH = 256
_FOLLOW_SECONDS = 0.5


class _Held(NamedTuple):
    """A policy in use."""

    bundle: PolicyBundle
    hash: str
    weights: Weights


class PolicyServer:
    """Answers queries with the newest policy; weights are swapped between two batches."""

    def __init__(self, transport: Transport, run: str, source: Source, *, timeout: float = 1.0):
        """Loads the first policy, compiles, and begins to serve.

        Args:
          transport: the server's own endpoint.
          run: name under which it serves.
          source: where policies come from.
          timeout: seconds that a query may wait when it names no deadline.

        Raises:
          CongraspError: there is no policy yet.
        """
        first = source(-1)
        if first is None:
            raise CongraspError("There is no policy to serve yet.", "Start the server when the run has published one.")
        self._source, self._timeout = source, timeout
        self._function = PolicyFunction(get_hand(first.spec.hand), first.task)
        self._held = _hold(first)
        self._function.warm_up(self._held.weights)
        self._answered = 0
        self._closed = threading.Event()
        self._batcher: Batcher[Query, tuple[Answer, _Held, float, float]] = Batcher(
            self._infer, size=BATCH_SIZES[-1], window=WINDOW, depth=DEPTH
        )
        keys = Keys(run)
        transport.serve(keys.health, lambda key, request: Message({}, self.health()))
        transport.serve(keys.act, self._act, workers=BATCH_SIZES[-1], depth=DEPTH)
        self._follower = threading.Thread(target=self._follow, daemon=True, name="follow")
        self._follower.start()

    def health(self) -> dict[str, Any]:
        """Readiness, version, hand and queue, as JSON."""
        held = self._held
        return {
            "ready": True,
            "version": held.bundle.version,
            "hash": held.hash,
            "hand": held.bundle.spec.hand,
            "surface_points": held.bundle.task.surface_points,
            "trajectory_points": held.bundle.task.trajectory_points,
            "queue": len(self._batcher),
            "answered": self._answered,
        }

    def close(self) -> None:
        """Refuses what waits, and stops following."""
        self._closed.set()
        self._batcher.close()
        self._follower.join(2 * _FOLLOW_SECONDS)

    def _act(self, key: str, request: Message) -> Message:
        began = time.monotonic()
        query = self._function.layout.parse(request)
        timeout = float(request.meta.get("timeout", self._timeout))
        future = self._batcher.submit(query, timeout)
        try:
            answer, held, queued, inferred = future.result(timeout + 1.0)
        except TimeoutError:
            raise CongraspError(f"The policy did not answer within {timeout:g} s.", "Ask again later.") from None
        self._answered += 1
        meta = {
            "version": held.bundle.version,
            "hash": held.hash,
            "active": list(answer.words),
            "queue_ms": round(1e3 * queued, 3),
            "infer_ms": round(1e3 * inferred, 3),
            "total_ms": round(1e3 * (time.monotonic() - began), 3),
        }
        return Message({"action": answer.action, "q_target": answer.q_target, "u_target": answer.u_target}, meta)

    def _infer(
        self, queries: Sequence[Query], queued: Sequence[float]
    ) -> list[tuple[Answer, _Held, float, float] | Exception]:
        held, began = self._held, time.monotonic()
        answers = self._function(held.weights, queries)
        spent = time.monotonic() - began
        return [
            answer if isinstance(answer, Exception) else (answer, held, waited, spent)
            for answer, waited in zip(answers, queued, strict=True)
        ]

    def _follow(self) -> None:
        """Swaps in newer policies; one that does not fit is refused and the old one stays."""
        while not self._closed.wait(_FOLLOW_SECONDS):
            try:
                newer = self._source(self._held.bundle.version)
                if newer is None:
                    continue
                self._held.bundle.spec.require(newer.spec, "that the server was to change to")
                self._held = _hold(newer)
            except TransportError:
                continue
            except CongraspError as error:
                print(f"congrasp: {error}", flush=True)


def _hold(bundle: PolicyBundle) -> _Held:
    acting = bundle.acting
    return _Held(bundle, content_hash(encode(bundle.to_message())), Weights(acting.params, acting.normalization))


def follow_file(path: pathlib.Path) -> Source:
    """A source that reads a policy file again whenever it changes."""
    seen: list[float] = []

    def read(version: int) -> PolicyBundle | None:
        try:
            changed = path.stat().st_mtime
        except OSError:
            raise CongraspError(f"The policy {path} cannot be read.", "Name a file made by 'congrasp train'.") from None
        if version >= 0 and seen and seen[-1] == changed:
            return None
        seen[:] = [changed]
        return bundles.load(path)

    return read


def follow_run(transport: Transport, run: str) -> Source:
    """A source that pulls the newest policy from a learner."""

    def pull(version: int) -> PolicyBundle | None:
        reply = transport.query(Keys(run).weights, Message({}, {"newer_than": version, "life": life[-1]}), timeout=5.0)
        if not reply.arrays:
            life[:] = [str(reply.meta.get("life", ""))]
            return None
        return PolicyBundle.from_message(reply, "of the learner")

    life = [""]
    return pull
