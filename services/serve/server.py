"""The live policy server: follows a run or a policy file, and answers queries on `policy/act` and
`policy/health`.
"""

import functools
import pathlib
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, NamedTuple

import numpy as np

from congrasp.common.errors import (
    CongraspError,
    LateError,
    OverloadedError,
    StartingError,
    TransportError,
)
from congrasp.common.hands import get_hand
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.bundle import InferenceParameters, PolicyBundle, content_hash
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import Keys, below
from congrasp.common.transport.senders import sender
from congrasp.common.wire.codec import Message, encode
from congrasp.services.ops.logs import log
from congrasp.services.serve.batching import Batcher, Parts
from congrasp.services.serve.inference import BATCH_SIZES, Inference, PolicyFunction
from congrasp.services.serve.requests import Query

Source = Callable[[int], PolicyBundle | None]
"""(current version, -1 for none) -> a newer bundle, or None."""
WINDOW = 0.001
"""Longest time that a query waits for others to join its batch, s."""
DEPTH = 64
"""Limit of queued queries: in excess of it, the client with the most loses its newest."""
SHARE = 16
"""Limit of queued queries of one peer."""
SHARED = BATCH_SIZES[1:]
"""Limits of a batch's states while several peers share it, by their number."""
_TIMEOUT_S = 1.0
"""Deadline of a query by default."""
_MAX_TIMEOUT_S = 60.0
FOLLOW_SECONDS = 0.5
"""Time between two requests for newer weights."""


class _Held(NamedTuple):
    """A policy in use."""

    bundle: PolicyBundle
    hash: str
    inference_parameters: InferenceParameters


class Answer(NamedTuple):
    """An answer with its policy and times."""

    inference: Inference
    policy: _Held
    queue_s: float
    infer_s: float


class PolicyServer:
    """Answers queries with the newest policy; weights are swapped between two batches."""

    def __init__(
        self,
        transport: Transport,
        run: str,
        source: Source,
        *,
        on_answer: Callable[[str, float], None] = lambda outcome, seconds: None,
        on_batch: Callable[[int], None] = lambda size: None,
    ):
        """Loads the first policy, and compiles; meanwhile queries get a `StartingError`.

        Args:
          transport: endpoint of the server.
          run: name of the served run.
          source: source of policies.
          on_answer: called with the outcome of every query (answered, refused, overloaded, late),
            and its duration.
          on_batch: called with the number of states of every batch.

        Raises:
          CongraspError: there is no policy yet, or the name is not valid.
        """
        keys = Keys(run)
        first = source(-1)
        if first is None:
            raise CongraspError(
                "There is no policy to serve yet.",
                "Start the server after the run has published a policy.",
            )
        self._source = source
        self._on_answer = on_answer
        self._on_batch = on_batch
        self._function = PolicyFunction(get_hand(first.spec.hand), first.task)
        self._held = _hold(first)
        self._seconds: dict[int, float] = {}
        self._answered = 0
        self._trouble = ""
        self._closed = threading.Event()
        self._ready = threading.Event()
        self._began = time.monotonic()
        self._batcher: Batcher[Query, Answer] = Batcher(
            self._infer,
            weigh=lambda query: len(query.vectors),
            size=BATCH_SIZES[-1],
            window=WINDOW,
            depth=DEPTH,
            share=SHARE,
            parts=Parts(SHARED, _cut, self._join),
        )
        transport.serve(keys.health, self._describe)
        # One may infer while the other receives
        transport.serve(
            below(keys.act),
            self._act,
            workers=2,
            depth=DEPTH,
            admission=self._reject,
            fair=True,
        )
        self._seconds = self._function.warm_up(self._held.inference_parameters)
        self._ready.set()
        self._follower = threading.Thread(target=self._follow, daemon=True, name="follow")
        self._follower.start()

    def health(self) -> dict[str, Any]:
        """Readiness, version, hand, queue, and the reason why a newer policy was rejected
        (`trouble`), as JSON.

        `queue_limit` and `peer_limit` bound the queued queries of all peers and of one.
        `states_per_second` is the highest throughput, measured at the start. While the server
        compiles, it is not ready, and `state` tells for how long.
        """
        if not self._ready.is_set():
            return {"ready": False, "state": f"compiling, {time.monotonic() - self._began:.0f} s"}
        held = self._held
        rates = [size / seconds for size, seconds in self._seconds.items()]
        return {
            "ready": True,
            "version": held.bundle.version,
            "hash": held.hash,
            "hand": held.bundle.spec.hand_name,
            "surface_points": held.bundle.task.surface_points,
            "trajectory_points": held.bundle.task.trajectory_points,
            "queue": len(self._batcher),
            "queue_limit": DEPTH,
            "peer_limit": SHARE,
            "states_per_second": round(max(rates)),
            "answered": self._answered,
            "trouble": self._trouble,
        }

    def _describe(self, key: str, request: Message) -> Message:
        """The health, or the policy's metadata if the query requests them."""
        if not request.meta.get("metadata"):
            return Message({}, self.health())
        self._check_ready()
        return Message({}, self._function.metadata())

    def _check_ready(self) -> None:
        """Raises a `StartingError` until all programs are compiled."""
        if not self._ready.is_set():
            raise StartingError(f"The policy server is {self.health()['state']}.", "Wait for it.")

    def close(self) -> None:
        """Refuses queued queries, and stops following."""
        self._closed.set()
        self._batcher.close()
        self._follower.join(2 * FOLLOW_SECONDS)

    def _reject(self, key: str) -> None:
        """Refuses a query for which the queue has no room, before decoding it."""
        began = time.monotonic()
        self._check_ready()
        try:
            self._batcher.check_room(sender(key))
        except CongraspError as error:
            self._count(error, began)
            raise

    def _act(self, key: str, request: Message) -> "Future[Message]":
        """Queues a query; returns a future of the reply."""
        began = time.monotonic()
        try:
            query = self._function.layout.parse(request)
            timeout = checked_timeout(request.meta.get("timeout", _TIMEOUT_S))
            future = self._batcher.submit(query, timeout, peer=sender(key))
        except CongraspError as error:
            self._count(error, began)
            raise
        answer: Future[Message] = Future()
        future.add_done_callback(functools.partial(self._finish, began, answer))
        return answer

    def _finish(self, began: float, answer: "Future[Message]", done: "Future[Answer]") -> None:
        """Resolves a query with the outcome of its batch."""
        error = done.exception()
        self._count(error, began)
        if error is None:
            answer.set_result(_message(done.result(), time.monotonic() - began))
        else:
            answer.set_exception(error)

    def _count(self, error: BaseException | None, began: float) -> None:
        """Counts the outcome of a query."""
        if error is None:
            self._answered += 1
            outcome = "answered"
        elif isinstance(error, OverloadedError | LateError):
            outcome = error.code
        else:
            outcome = "refused"
        self._on_answer(outcome, time.monotonic() - began)

    def _infer(self, queries: Sequence[Query], queued: Sequence[float]) -> list[Answer | Exception]:
        """Answers a batch."""
        held = self._held
        began = time.monotonic()
        self._on_batch(sum(len(query.vectors) for query in queries))
        replies = self._function(held.inference_parameters, queries)
        infer_s = time.monotonic() - began
        answers: list[Answer | Exception] = []
        for reply, queue_s in zip(replies, queued, strict=True):
            if isinstance(reply, Exception):
                answers.append(reply)
            else:
                answers.append(Answer(reply, held, queue_s, infer_s))
        return answers

    def _join(self, query: Query, answers: list[Answer]) -> Answer | Exception:
        """Joins the parts of a query; repeats it if the policy was swapped, so that one policy
        answers all.
        """
        return join_parts(answers, lambda: self._infer([query], [answers[0].queue_s])[0])

    def _follow(self) -> None:
        """Swaps in newer policies; one that does not match is refused, and the current one
        stays.
        """
        while not self._closed.wait(FOLLOW_SECONDS):
            try:
                newer = self._source(self._held.bundle.version)
                if newer is not None:
                    self._swap(newer)
            except TransportError:
                continue  # the learner is disconnected and may return
            except CongraspError as error:
                if str(error) != self._trouble:
                    log("warning", str(error))
                self._trouble = str(error)

    def _swap(self, newer: PolicyBundle) -> None:
        """Serves a newer policy.

        Raises:
          CongraspError: it has another hand, task or network than the served policy.
        """
        old = self._held.bundle
        old.spec.require(newer.spec, "that should replace the served one")
        if newer.task != old.task:
            raise CongraspError(
                "The newer policy was trained on another task.", "Restart the server to serve it."
            )
        self._held = _hold(newer)
        self._trouble = ""


def checked_timeout(seconds: Any) -> float:
    """Returns the deadline of a query in seconds.

    Raises:
      CongraspError: it is not a number above 0 and at most 60.
    """
    if not isinstance(seconds, int | float) or not 0.0 < seconds <= _MAX_TIMEOUT_S:
        raise CongraspError(
            f"The query's 'timeout' is {ascii(seconds)[:40]}.",
            f"It must be seconds, at most {_MAX_TIMEOUT_S:g}.",
        )
    return float(seconds)


def join_parts(
    answers: Sequence[Answer], repeat: Callable[[], Answer | Exception]
) -> Answer | Exception:
    """Joins the answers to the parts of a query, in their order.

    Args:
      answers: answers to the parts.
      repeat: answers the whole query again, for parts that several policies answered.
    """
    first = answers[0]
    last = answers[-1]
    if any(answer.policy is not last.policy for answer in answers):
        return repeat()
    vectors = np.concatenate([answer.inference.vectors for answer in answers])
    active: list[list[str]] = []
    for answer in answers:
        active += answer.inference.active
    infer_s = sum(answer.infer_s for answer in answers)
    return Answer(Inference(vectors, active), last.policy, first.queue_s, infer_s)


def _message(answer: Answer, seconds: float) -> Message:
    """Returns the reply: targets, version, times."""
    bundle = answer.policy.bundle
    times = {
        "queue_ms": answer.queue_s,
        "infer_ms": answer.infer_s,
        "total_ms": seconds,
    }
    meta: dict[str, Any] = {"version": bundle.version, "hash": answer.policy.hash}
    for name, duration in times.items():
        meta[name] = round(1e3 * duration, 3)
    return answer.inference.reply(meta)


def _cut(query: Query, first: int, end: int) -> Query:
    """Returns some states of a query."""
    return query._replace(vectors=query.vectors[first:end])


def _hold(bundle: PolicyBundle) -> _Held:
    """Prepares a policy for use."""
    return _Held(bundle, content_hash(encode(bundle.to_message())), bundle.inference_parameters)


def follow_file(path: pathlib.Path) -> Source:
    """Returns a source that rereads a policy file whenever it changes."""
    loaded_at: float | None = None
    """Time of the file's last change when it was read."""

    def read(version: int) -> PolicyBundle | None:
        nonlocal loaded_at
        try:
            changed = path.stat().st_mtime
        except OSError:
            raise CongraspError(
                f"The policy {path} cannot be read.", "Pass a file created by 'congrasp train'."
            ) from None
        if version >= 0 and loaded_at == changed:
            return None
        loaded_at = changed
        return bundles.load(path)

    return read


def follow_run(transport: Transport, run: str, name: str) -> Source:
    """Returns a source that pulls the newest policy from a learner, under the server's name on the
    wire.
    """
    key = Keys(run).weights_for("server", name)

    def pull(version: int) -> PolicyBundle | None:
        reply = transport.query(key, Message({}, {"newer_than": version}), timeout=5.0)
        return PolicyBundle.from_message(reply, "of the learner") if reply.arrays else None

    return pull
