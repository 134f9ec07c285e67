"""Metrics of each role, collected for Prometheus (`metrics_endpoint` serves them)."""

import collections
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from prometheus_client import Histogram
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from congrasp.common.errors import TransportError

_TICKETS = ("granted", "redeemed", "returned", "expired")
"""Counters of tickets; the other counters are of rollouts, or in `_GAUGES`."""
_GAUGES = {
    "running": ("tickets_running", "Tickets in use."),
    "capacity": (
        "tickets_capacity",
        "Tickets that can be granted now; with the running ones, the number of actors that the "
        "learner can use.",
    ),
    "missing": ("rollouts_missing", "Gaps in the counts of actors' rollouts."),
    "rejected": (
        "requests_rejected",
        "Requests rejected because their actors had made too many useless ones.",
    ),
}
_LATENCY_BUCKETS_MS = (0.2, 0.5, 1, 2, 3, 5, 10, 20, 50, 100, 200, 500, 1000)


class LearnerMetrics:
    """Status of a learner at the time of the scrape, and the metrics of its last update."""

    def __init__(self, ask: Callable[[], Mapping[str, Any]]):
        """Uses `ask`, a function that returns the status as `services.ops.status.ask` does."""
        self._ask = ask
        self._values: Mapping[str, float] = {}

    def update(self, values: Mapping[str, float]) -> None:
        """Stores the metrics of an update."""
        self._values = values

    def collect(self) -> Iterator[Metric]:
        """Yields the metrics of the class."""
        try:
            status = self._ask()
        except TransportError:
            yield GaugeMetricFamily("congrasp_learner_ready", "Whether it takes rollouts.", 0.0)
            return
        yield GaugeMetricFamily(
            "congrasp_learner_ready", "Whether it takes rollouts.", float(status["version"] >= 0)
        )
        yield _gauge("version", "Newest policy version.", status["version"])
        yield _gauge("finished", "Whether the run is over.", status["finished"])
        yield _gauge("counters_balanced", "Whether the counters add up.", not status["warnings"])
        yield _gauge("queue_length", "Queued rollouts.", status["queue"]["length"])
        yield _gauge("queue_limit", "Limit of queued rollouts.", status["queue"]["limit"])
        for name, value in status["rates"].items():
            yield _gauge(name, "Over the last ten seconds.", value)
        yield from self._counters(status["counters"])
        yield _gauge(
            "roles_unlisted", "Live processes that the status does not list.", status["unlisted"]
        )
        yield from self._roles(status["roles"])
        update = _gauge(
            "update", "Metrics of the last update, by the names of the log.", labels=["figure"]
        )
        for name, value in self._values.items():
            update.add_metric([name], value)
        yield update

    @staticmethod
    def _counters(counters: Mapping[str, int]) -> Iterator[Metric]:
        """Counters of tickets and rollouts."""
        tickets = CounterMetricFamily(
            "congrasp_learner_tickets", "Tickets by outcome.", labels=["outcome"]
        )
        rollouts = CounterMetricFamily(
            "congrasp_learner_rollouts", "Rollouts by outcome.", labels=["outcome"]
        )
        for name, value in counters.items():
            if name in _GAUGES:
                yield _gauge(*_GAUGES[name], value)
            elif name in _TICKETS:
                tickets.add_metric([name], value)
            elif name != "queued":  # the gauge `queue_length`
                rollouts.add_metric([name], value)
        yield from (tickets, rollouts)

    @staticmethod
    def _roles(roles: Iterable[Mapping[str, Any]]) -> Iterator[Metric]:
        """Processes of the run, and the pace of its actors."""
        alive = _gauge("roles", "Processes of the run.", labels=["role"])
        for role, number in collections.Counter(role["role"] for role in roles).items():
            alive.add_metric([role], number)
        who = ["actor", "incarnation"]
        lag = _gauge(
            "actor_lag", "Versions by which an actor's last rollout was behind.", labels=who
        )
        steps = _gauge("actor_steps_per_second", "Over the last ten seconds.", labels=who)
        rollouts = CounterMetricFamily(
            "congrasp_learner_actor_rollouts", "Accepted rollouts of an actor.", labels=who
        )
        refused = CounterMetricFamily(
            "congrasp_learner_actor_refused", "Rejected requests of an actor.", labels=who
        )
        for role in roles:
            labels = [role["id"], role["incarnation"]]
            if "lag" in role:
                lag.add_metric(labels, role["lag"])
                rollouts.add_metric(labels, role["rollouts"])
            if "refused" in role:
                refused.add_metric(labels, role["refused"])
            if "steps_per_second" in role:
                steps.add_metric(labels, role["steps_per_second"])
        yield from (alive, lag, steps, rollouts, refused)


def _gauge(
    name: str, help: str, value: float | None = None, labels: Sequence[str] | None = None
) -> GaugeMetricFamily:
    """Returns a gauge of the learner, with its prefix; either with a value or with labels."""
    number = None
    if value is not None:
        number = float(value)
    return GaugeMetricFamily(f"congrasp_learner_{name}", help, number, labels)


class ActorMetrics:
    """Metrics of an actor's last rollout."""

    def __init__(self) -> None:
        self._last: Mapping[str, float] = {}

    def rollout(self, values: Mapping[str, float]) -> None:
        """Stores the metrics of a rollout, including `rollouts` and `version`."""
        self._last = values

    def collect(self) -> Iterator[Metric]:
        """Yields the metrics of the class."""
        last = dict(self._last)
        yield CounterMetricFamily(
            "congrasp_actor_rollouts", "Rollouts of this actor.", last.pop("rollouts", 0.0)
        )
        yield GaugeMetricFamily(
            "congrasp_actor_version", "Version of the acting policy.", last.pop("version", -1.0)
        )
        for name, value in last.items():
            yield GaugeMetricFamily(f"congrasp_actor_{name}", "Of the last rollout.", value)


class ServerMetrics:
    """Replies and batches of a policy server, and its health at the time of the scrape."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.outcomes: collections.Counter[str] = collections.Counter()
        """Queries by outcome."""
        self._seconds = Histogram(
            "congrasp_policy_seconds",
            "Time from the arrival of a query to its reply.",
            registry=None,
            buckets=[1e-3 * bound for bound in _LATENCY_BUCKETS_MS],
        )
        self._batch = Histogram(
            "congrasp_policy_batch",
            "States in a batch.",
            registry=None,
            buckets=[1, 2, 4, 8, 16, 32, 64, 128],
        )
        self.health: Callable[[], Mapping[str, Any]] = dict
        """Health of the server, once there is one."""

    def answer(self, outcome: str, seconds: float) -> None:
        """Counts a reply: answered, refused, overloaded or late."""
        with self._lock:
            self.outcomes[outcome] += 1
        if outcome == "answered":
            self._seconds.observe(seconds)

    def batch(self, size: int) -> None:
        """Counts a batch."""
        self._batch.observe(size)

    def collect(self) -> Iterator[Metric]:
        """Yields the metrics of the class."""
        health = self.health()
        for name, help in (
            ("ready", "Whether it answers."),
            ("version", "Version of the policy."),
            ("queue", "Queued queries."),
        ):
            if name in health:
                yield GaugeMetricFamily(f"congrasp_policy_{name}", help, float(health[name]))
        outcomes = CounterMetricFamily(
            "congrasp_policy_queries", "Queries by outcome.", labels=["outcome"]
        )
        with self._lock:
            counts = dict.fromkeys(("answered", "refused", "overloaded", "late"), 0) | self.outcomes
        for outcome, count in counts.items():
            outcomes.add_metric([outcome], count)
        yield outcomes
        yield from self._seconds.collect()
        yield from self._batch.collect()
