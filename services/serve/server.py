"""The live policy server: answers queries on `policy/act` and `policy/health` with the newest
policy of a source (`sources`).
"""

import functools
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
from congrasp.common.policy.bundle import InferenceParameters, PolicyBundle, content_hash
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import Keys, below
from congrasp.common.transport.senders import sender
from congrasp.common.wire.codec import Message, encode
from congrasp.services.client.worker_endpoints import WORKER, WORKERS
from congrasp.services.ops.logs import log
from congrasp.services.serve.batching import Batcher, Splitting
from congrasp.services.serve.inference import BATCH_SIZES, Inference, PolicyFunction
from congrasp.services.serve.requests import Query
from congrasp.services.serve.sources import Source

QUEUE_LIMIT = 64
"""Limit of queued queries. When it is exceeded, the client with the most queued queries loses its
newest (`FairQueue`)."""
PEER_LIMIT = 16
"""Limit of queued queries of one peer."""
_BATCH_WINDOW_S = 0.001
"""Longest time that a query waits for others to join its batch."""
_SHARED_BATCH_LIMITS = BATCH_SIZES[1:]
"""Limits of a batch's states while several peers send queries (`Splitting.weight_limits`)."""
_DEFAULT_TIMEOUT_S = 1.0
"""Deadline of a query that states none."""
_MAX_TIMEOUT_S = 60.0
FOLLOW_PERIOD_S = 0.5
"""Time between two checks for a newer policy."""


class _ServedPolicy(NamedTuple):
    """A policy in use."""

    bundle: PolicyBundle
    digest: str
    """Hash of the bundle's content."""
    inference_parameters: InferenceParameters


class Answer(NamedTuple):
    """Result of a query, the policy that computed it, and times."""

    inference: Inference
    policy: _ServedPolicy
    queue_s: float
    """Time from the query's arrival to the start of its inference."""
    infer_s: float
    """Duration of the inference of its batch, or the sum over its parts' batches."""


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
        workers: int = 1,
        worker: int = 0,
    ):
        """Loads the first policy and compiles; meanwhile queries get a `StartingError`.

        Args:
          transport: endpoint of the server.
          run: name of the served run.
          source: source of policies.
          on_answer: called with the outcome (answered, refused, overloaded, late) of every query
            that the transport hands over, and its duration in seconds.
          on_batch: called with the number of states of every batch. A query whose parts are
            inferred again, since the policy was swapped between them, does not count twice.
          workers: number of servers of this policy on neighbouring ports, of which this is one
            (`services.serve.workers`).
          worker: its number, from 0 on.

        Raises:
          CongraspError: there is no policy yet, or the name is not valid.
        """
        keys = Keys(run)
        self._source = source
        self._on_answer = on_answer
        self._on_batch = on_batch
        self._workers: dict[str, int] = {}  # entries of health and metadata, if there are several
        if workers > 1:
            self._workers = {WORKERS: workers, WORKER: worker}
        self._batch_seconds: dict[int, float] = {}
        self._answered = 0
        self._answered_lock = threading.Lock()
        self._rejection = ""  # why the newest policy was rejected; empty after a swap
        self._source_failure = ""  # why the source failed the last time; empty if it did not
        self._closed = threading.Event()
        self._ready = threading.Event()
        self._start_time = time.monotonic()
        self._follower = threading.Thread(target=self._follow, daemon=True, name="follow")
        self._batcher: Batcher[Query, Answer] = Batcher(
            self._run_batch,
            weigh=lambda query: len(query.vectors),
            size=BATCH_SIZES[-1],
            window=_BATCH_WINDOW_S,
            depth=QUEUE_LIMIT,
            peer_limit=PEER_LIMIT,
            splitting=Splitting(_SHARED_BATCH_LIMITS, _cut, join_parts, self._infer_again),
        )
        try:
            self._register(transport, keys)
            self._load()
        except BaseException:
            self.close()
            raise
        self._ready.set()
        self._follower.start()

    def _register(self, transport: Transport, keys: Keys) -> None:
        """Registers the handlers: before the policy is loaded, since clients of a listening server
        would get no response.
        """
        transport.serve(keys.health, self._describe)
        transport.serve(
            below(keys.act),
            self._act,
            workers=2,  # one may infer while the other receives
            depth=QUEUE_LIMIT,
            admission=self._admit,
            fair=True,
        )

    def _load(self) -> None:
        """Loads the first policy and compiles its programs.

        Raises:
          CongraspError: there is no policy yet.
        """
        first = self._source(-1)
        if first is None:
            raise CongraspError(
                "There is no policy to serve yet.",
                "Start the server after the run has published a policy.",
            )
        self._function = PolicyFunction(get_hand(first.spec.hand), first.task)
        self._served = _prepare(first)
        self._batch_seconds = self._function.warm_up(self._served.inference_parameters)

    def health(self) -> dict[str, Any]:
        """Readiness, version, hand, queue, and the reason why a newer policy was rejected or cannot
        be read (`trouble`), as JSON.

        `queue_limit` and `peer_limit` bound the queued queries of all peers and of one.
        `states_per_second` is the highest throughput, measured at the start. Until the server has
        compiled, it is not ready, and `state` describes it. If there are several workers, `workers`
        is their number and `worker` the number of the one with this health.
        """
        not_ready = self._not_ready_state()
        if not_ready:
            return {"ready": False, "state": not_ready, **self._workers}
        served = self._served
        rates = [states / seconds for states, seconds in self._batch_seconds.items()]
        return {
            "ready": True,
            "version": served.bundle.version,
            "hash": served.digest,
            "hand": served.bundle.spec.hand_name,
            "surface_points": served.bundle.task.surface_points,
            "trajectory_points": served.bundle.task.trajectory_points,
            "queue": len(self._batcher),
            "queue_limit": QUEUE_LIMIT,
            "peer_limit": PEER_LIMIT,
            "states_per_second": round(max(rates)),
            "answered": self._answered,
            "trouble": self._source_failure or self._rejection,
            **self._workers,
        }

    def _describe(self, key: str, request: Message) -> Message:
        """The health, or the policy's metadata if the query requests them."""
        if not request.meta.get("metadata"):
            return Message({}, self.health())
        self._check_ready()
        return Message({}, {**self._function.metadata(), **self._workers})

    def _not_ready_state(self) -> str:
        """State of a server that cannot answer queries yet; empty once it can."""
        if self._ready.is_set():
            return ""
        if self._closed.is_set():
            return "closed"
        return f"compiling, {time.monotonic() - self._start_time:.0f} s"

    def _check_ready(self) -> None:
        """Raises a `StartingError` until all programs are compiled.

        Raises:
          CongraspError: compiling failed, so that the server will not become ready.
        """
        not_ready = self._not_ready_state()
        if not not_ready:
            return
        if self._closed.is_set():
            raise CongraspError("The policy server is closed.", "Start it again.")
        raise StartingError(f"The policy server is {not_ready}.", "Wait for it.")

    def close(self) -> None:
        """Refuses queued queries, and stops following."""
        self._closed.set()
        self._batcher.close()
        if self._follower.is_alive():
            self._follower.join(2 * FOLLOW_PERIOD_S)

    def _admit(self, key: str) -> None:
        """Refuses a query before it is decoded, if the server compiles or has no room for it."""
        arrival = time.monotonic()
        try:
            self._check_ready()
            self._batcher.check_room(sender(key))
        except CongraspError as error:
            self._count(error, arrival)
            raise

    def _act(self, key: str, request: Message) -> "Future[Message]":
        """Queues a query; returns a future of the reply."""
        arrival = time.monotonic()
        try:
            query = self._function.layout.parse(request)
            timeout_s = parse_timeout(request.meta.get("timeout", _DEFAULT_TIMEOUT_S))
            answer = self._batcher.submit(query, timeout_s, peer=sender(key))
        except CongraspError as error:
            self._count(error, arrival)
            raise
        reply: Future[Message] = Future()
        answer.add_done_callback(functools.partial(self._resolve, arrival, reply))
        return reply

    def _resolve(self, arrival: float, reply: "Future[Message]", answer: "Future[Answer]") -> None:
        """Resolves the reply to a query with its answer or error.

        An error here becomes the reply: it would otherwise be lost, and the query never answered.
        """
        error = answer.exception()
        try:
            self._count(error, arrival)
            if error is None:
                reply.set_result(_reply(answer.result(), time.monotonic() - arrival))
        except Exception as failure:
            error = failure
        if error is not None:
            reply.set_exception(error)

    def _count(self, error: BaseException | None, arrival: float) -> None:
        """Counts the outcome of a query."""
        if error is None:
            with self._answered_lock:
                self._answered += 1
            outcome = "answered"
        elif isinstance(error, OverloadedError | LateError):
            outcome = error.code
        else:
            outcome = "refused"
        self._on_answer(outcome, time.monotonic() - arrival)

    def _run_batch(
        self, queries: Sequence[Query], queue_s: Sequence[float]
    ) -> list[Answer | Exception]:
        """Counts and answers a batch of queries that were queued for some seconds."""
        self._on_batch(sum(len(query.vectors) for query in queries))
        return self._infer(queries, queue_s)

    def _infer_again(self, query: Query, queue_s: float) -> Answer | Exception:
        """Answers a query whose parts were answered by different policies."""
        (answer,) = self._infer([query], [queue_s])
        return answer

    def _infer(
        self, queries: Sequence[Query], queue_s: Sequence[float]
    ) -> list[Answer | Exception]:
        """Answers queries that were queued for some seconds."""
        served = self._served
        start = time.monotonic()
        inferences = self._function(served.inference_parameters, queries)
        infer_s = time.monotonic() - start
        answers: list[Answer | Exception] = []
        for inference, queue_s_of_query in zip(inferences, queue_s, strict=True):
            if isinstance(inference, Exception):
                answers.append(inference)
            else:
                answers.append(Answer(inference, served, queue_s_of_query, infer_s))
        return answers

    def _follow(self) -> None:
        """Swaps in newer policies until the server is closed; runs in a thread.

        Whatever fails, the current policy stays in use and the server tries again.
        """
        while not self._closed.wait(FOLLOW_PERIOD_S):
            try:
                newer = self._source(self._served.bundle.version)
            except TransportError:
                continue  # the learner is disconnected and may return
            except CongraspError as error:
                self._source_failure = _warn_if_new(str(error), self._source_failure)
                continue
            except Exception as error:
                failure = f"A newer policy could not be read: {type(error).__name__}: {error}."
                self._source_failure = _warn_if_new(failure, self._source_failure)
                continue
            self._source_failure = ""
            if newer is not None:
                self._try_swap(newer)

    def _try_swap(self, newer: PolicyBundle) -> None:
        """Serves a newer policy, or notes why it is rejected."""
        try:
            self._swap(newer)
        except CongraspError as error:
            self._rejection = _warn_if_new(str(error), self._rejection)
        except Exception as error:
            rejection = f"A newer policy could not be served: {type(error).__name__}: {error}."
            self._rejection = _warn_if_new(rejection, self._rejection)

    def _swap(self, newer: PolicyBundle) -> None:
        """Serves a newer policy.

        Raises:
          CongraspError: it has another hand, task or network than the served policy.
        """
        old = self._served.bundle
        old.spec.require(newer.spec, "that should replace the served one")
        if newer.task != old.task:
            raise CongraspError(
                "The newer policy was trained on another task.", "Restart the server to serve it."
            )
        self._served = _prepare(newer)
        self._rejection = ""


def _warn_if_new(trouble: str, earlier: str) -> str:
    """Logs a warning unless it repeats the earlier one; returns it."""
    if trouble != earlier:
        log("warning", trouble)
    return trouble


def parse_timeout(seconds: Any) -> float:
    """Returns a query's timeout in seconds.

    Raises:
      CongraspError: it is not a number, or out of range.
    """
    is_number = isinstance(seconds, int | float) and not isinstance(seconds, bool)
    if not is_number or not 0.0 < seconds <= _MAX_TIMEOUT_S:
        raise CongraspError(
            f"The query's 'timeout' is {ascii(seconds)[:40]}.",
            f"It must be seconds, at most {_MAX_TIMEOUT_S:g}.",
        )
    return float(seconds)


def _reply(answer: Answer, total_s: float) -> Message:
    """Returns the reply to a query: targets, version, times."""
    return answer.inference.reply(
        {
            "version": answer.policy.bundle.version,
            "hash": answer.policy.digest,
            "queue_ms": _milliseconds(answer.queue_s),
            "infer_ms": _milliseconds(answer.infer_s),
            "total_ms": _milliseconds(total_s),
        }
    )


def _milliseconds(seconds: float) -> float:
    """Returns a duration in milliseconds, to the microsecond."""
    return round(1e3 * seconds, 3)


def _cut(query: Query, first: int, end: int) -> Query:
    """Returns the query of some of its states."""
    return query._replace(vectors=query.vectors[first:end])


def join_parts(answers: list[Answer]) -> Answer | None:
    """Joins the answers to the parts of a query; None if several policies answered them."""
    first = answers[0]
    if any(answer.policy is not first.policy for answer in answers):
        return None
    vectors = np.concatenate([answer.inference.vectors for answer in answers])
    active: list[list[str]] = []
    for answer in answers:
        active += answer.inference.active
    infer_s = sum(answer.infer_s for answer in answers)
    return Answer(Inference(vectors, active), first.policy, first.queue_s, infer_s)


def _prepare(bundle: PolicyBundle) -> _ServedPolicy:
    """Prepares a policy for use."""
    digest = content_hash(encode(bundle.to_message()))
    return _ServedPolicy(bundle, digest, bundle.inference_parameters)
