"""Admission: the bound holds, capacity returns, and every rollout is accounted for."""

import collections
import itertools
import math
import statistics

import hypothesis.strategies as st
from hypothesis import given, settings
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from congrasp.learner.hub.staleness import StalenessManager
from tests.waits import together

A = ("a", "1")
B = ("b", "1")


def manager(max_staleness=1, batch=2, clock=lambda: 0.0, **options):
    """A manager whose clock stands still: real durations of microseconds would decide on places."""
    return StalenessManager(max_staleness, batch, clock=clock, **options)


def test_tickets_worked_out_by_hand():
    """Batch 2, eta 1: (1 + 0 + 1) * 2 = 4 may be under way at version 0, and 2 more with every
    version.
    """
    staleness = manager()
    assert staleness.capacity == 4
    assert all(staleness.grant(owner, i) for owner, i in itertools.product((A, B), "xy"))
    assert staleness.grant(("c", "1"), "z") is None
    for owner in (A, B):
        assert staleness.arrive(owner, "x", 0) == "accepted"
    assert staleness.capacity == 0  # what arrived still counts
    assert staleness.take(0)
    assert staleness.take(0)
    assert staleness.capacity == 0  # and what is being learnt from
    staleness.publish(1)
    assert staleness.capacity == 2
    assert staleness.counters() == {
        "granted": 4,
        "redeemed": 2,
        "returned": 0,
        "expired": 0,
        "accepted": 2,
        "consumed": 2,
        "dropped": 0,
        "stale": 0,
        "duplicate": 0,
        "damaged": 0,
        "undone": 0,
        "running": 2,
        "queued": 0,
        "capacity": 2,
    }


def test_required_versions_worked_out_by_hand():
    """Batch 2, eta 1: version 0 uses two rollouts, version 1 the next two."""
    staleness = manager()
    required = []
    for owner, ticket in itertools.product((A, B), "xy"):
        assert staleness.grant(owner, ticket)
        required.append(staleness.required_version)
    assert required == [-1, -1, 0, 0]
    for ticket in "xy":
        staleness.arrive(A, ticket, 0)
        staleness.take(0)
    staleness.publish(1)
    assert staleness.grant(A, "z")
    assert staleness.required_version == 1


@given(
    eta=st.integers(0, 3),
    batch=st.integers(1, 4),
    waits=st.lists(st.integers(0, 6), min_size=1, max_size=60),
)
def test_rollouts_with_the_oldest_policy_that_their_tickets_require_are_never_too_old(
    eta, batch, waits
):
    """Tickets are taken as early as possible, and rollouts arrive in the order of their tickets."""
    staleness = manager(eta, batch, tickets_per_owner=100)
    produced = collections.deque()
    for number, wait in enumerate(waits):
        while (ticket := staleness.grant(A, str(number))) is None:
            assert produced, "no ticket although nothing is awaited"
            _use(staleness, produced, 1, batch)
        oldest = max(0, staleness.required_version)
        assert oldest <= ticket.version
        produced.append((ticket.id, oldest))
        _use(staleness, produced, min(wait, len(produced)), batch)
    _use(staleness, produced, len(produced), batch)
    counters = staleness.counters()
    assert counters["accepted"] == len(waits)
    assert counters["stale"] == 0
    assert counters["dropped"] == 0


def _use(staleness, produced, count, batch):
    """Lets some rollouts arrive, and the learner use every whole batch."""
    for _ in range(count):
        ticket_id, version = produced.popleft()
        assert staleness.arrive(A, ticket_id, version) == "accepted"
        assert staleness.take(version)
        if staleness.counters()["consumed"] % batch == 0:
            staleness.publish(staleness.version + 1)


def test_without_staleness_nothing_starts_during_an_update():
    staleness = manager(max_staleness=0, batch=1)
    assert staleness.grant(A, "x").version == 0
    assert staleness.grant(A, "y") is None
    assert staleness.arrive(A, "x", 0) == "accepted"
    assert staleness.take(0)
    assert staleness.grant(A, "y") is None
    staleness.publish(1)
    assert staleness.grant(A, "y").version == 1


def test_a_resumed_learner_measures_from_its_checkpoint():
    """Checkpoint at version 3, killed at 6, resumed as 7: that is the policy of 3, so 3 lags by 0,
    4 and 2 by 1.
    """
    staleness = manager(max_staleness=1)
    staleness.restore(manager().durable(), 3)
    staleness.publish(7)
    assert [staleness.lag(version) for version in (7, 6, 5, 4, 3, 2, 1)] == [0, 3, 2, 1, 0, 1, 2]
    assert [staleness.arrive(A, "", version) for version in (5, 3)] == ["stale", "accepted"]
    staleness.publish(8)
    assert [staleness.lag(version) for version in (8, 7, 4, 3)] == [0, 1, 2, 1]
    staleness.publish(9)
    assert staleness.lag(3) == 2


def test_a_rollout_of_an_earlier_session_uses_its_owners_ticket():
    """An actor with one upload at a time would wait for the very place that its next ticket
    holds.
    """
    staleness = manager(batch=1, max_staleness=0)  # room for 1
    assert staleness.grant(A, "new")
    assert staleness.arrive(B, "old", 0) == "full"
    assert staleness.arrive(A, "old", 0) == "accepted"
    assert staleness.counters()["redeemed"] == 1
    assert staleness.arrive(A, "new", 0) == "full"  # until the next version


def test_a_checkpoint_keeps_settled_counters():
    staleness = manager()
    staleness.grant(A, "x")
    staleness.grant(A, "y")
    staleness.grant(A, "z")
    for i in "xy":
        staleness.arrive(A, i, 0)
    assert staleness.take(0)
    staleness.refuse_duplicate(A, "x")
    staleness.refuse_damaged(A, "none")
    staleness.refuse_damaged()
    durable = staleness.durable()
    resumed = manager()
    resumed.restore(durable, 7)
    assert resumed.version == 7
    assert resumed.capacity == 4  # (1 + 7 + 1) * 2 - 7 * 2
    counters = resumed.counters()
    assert counters["accepted"] == 1
    assert counters["consumed"] == 1
    assert counters["queued"] == 0
    assert counters["running"] == 0
    assert counters["granted"] == 2
    assert counters["redeemed"] == 2
    assert counters["duplicate"] == 1
    assert counters["damaged"] == 2


class Admission(RuleBasedStateMachine):
    """Actors, a learner and a clock in any order, checked against a model that keeps every rollout
    by name.
    """

    def __init__(self):
        super().__init__()
        self.now = 0.0
        self.eta = 1
        self.batch = 3
        self.staleness = StalenessManager(
            self.eta, self.batch, ticket_seconds=10, tickets_per_owner=4, clock=lambda: self.now
        )
        self.tickets = {}  # (owner, id) -> version
        self.deadlines = {}
        self.queue = []  # versions of accepted rollouts
        self.in_update = 0
        self.fates = {"accepted": 0, "consumed": 0, "dropped": 0, "stale": 0}
        self.next_id = 0
        self.delivered = []  # whose rollouts came in under a ticket
        self.granted = {}  # (owner, id) -> when
        # Seconds of every rollout that came under a ticket
        self.needed = {name: [] for name in "abc"}
        self.useful = []  # seconds of those that were accepted
        self.passed_over = set()  # tickets that were not waited for at some time
        self.late = set()  # whose tickets have expired: they may be put off

    owners = st.sampled_from([A, B, ("c", "2")])

    @rule(owner=owners)
    def ask(self, owner):
        self.next_id += 1
        had = self.staleness.capacity
        held = sum(key[0] == owner for key in self.tickets)
        ticket = self.staleness.grant(owner, str(self.next_id))
        share = math.ceil(6 * self.delivered.count(owner) / max(1, len(self.delivered)))
        fits = had > 0 and held < min(4, max(3, share))
        assert fits if ticket else not fits or owner in self.late
        if ticket:
            assert ticket.version == self.staleness.version
            assert self.now + 5 <= ticket.deadline <= self.now + 10
            self.tickets[owner, ticket.id] = ticket.version
            self.deadlines[owner, ticket.id] = ticket.deadline
            self.granted[owner, ticket.id] = self.now
            # Sent again, it is the same request
            assert self.staleness.grant(owner, ticket.id) is ticket

    @precondition(lambda self: self.tickets)
    @rule(data=st.data())
    def give_back(self, data):
        """Twice, and by others, which changes nothing."""
        owner, ticket = key = data.draw(st.sampled_from(sorted(self.tickets)))
        self.staleness.give_back(("d", "1"), ticket)
        self.staleness.give_back((owner[0], "other"), ticket)
        assert self.staleness.counters()["running"] == len(self.tickets)
        for _ in range(2):
            self.staleness.give_back(*key)
        del self.tickets[key]

    @precondition(lambda self: self.tickets)
    @rule(data=st.data())
    def upload(self, data):
        key = data.draw(st.sampled_from(sorted(self.tickets)))
        version = self.tickets.pop(key)
        self._arrive(key, version, must_fit=True)

    @rule(owner=owners, age=st.integers(-1, 3))
    def upload_without_a_ticket(self, owner, age):
        self._arrive((owner, "none"), max(0, self.staleness.version - age), must_fit=False)

    def _arrive(self, key, version, *, must_fit):
        capacity = self.staleness.capacity
        verdict = self.staleness.arrive(*key, version)
        if not 0 <= self.staleness.version - version <= self.eta:
            assert verdict == "stale"
            self.fates["stale"] += 1
            self.needed[key[0][0]] += [self.now - self.granted[key]] if must_fit else []
        elif (
            must_fit
            or capacity > 0
            or (tickets := [held for held in self.tickets if held[0] == key[0]])
        ):
            assert verdict == "accepted"
            if not must_fit and capacity <= 0:  # under the oldest of its owner's tickets
                del self.tickets[tickets[0]]
                key = tickets[0]
                must_fit = True
            if must_fit:
                self.delivered.append(key[0])
                self.needed[key[0][0]].append(self.now - self.granted[key])
                self.useful.append(self.now - self.granted[key])
            self.fates["accepted"] += 1
            self.queue.append(version)
        else:
            assert verdict == "full"

    @precondition(lambda self: len(self.queue) + self.in_update >= self.batch)
    @rule()
    def update(self):
        while self.queue and self.in_update < self.batch:
            version = self.queue.pop(0)
            fresh = self.staleness.take(version)
            assert fresh == (self.staleness.version - version <= self.eta)
            self.fates["consumed" if fresh else "dropped"] += 1
            self.in_update += fresh
        if self.in_update == self.batch:
            self.staleness.publish(self.staleness.version + 1)
            self.in_update = 0

    @rule(owner=owners)
    def die(self, owner):
        tickets = [key for key in self.tickets if key[0] == owner]
        assert self.staleness.forget(owner) == len(tickets)
        for key in tickets:
            del self.tickets[key]

    @rule(seconds=st.floats(0, 6))
    def wait(self, seconds):
        self.now += seconds
        self.late |= {key[0] for key in self.tickets if self.deadlines[key] <= self.now}
        self.tickets = {
            key: version for key, version in self.tickets.items() if self.deadlines[key] > self.now
        }

    @rule()
    def restart(self):
        durable = self.staleness.durable()
        version = self.staleness.version
        self.staleness.restore(durable, version)
        self.staleness.publish(version)  # as a learner does before anything else
        self.fates["accepted"] -= len(self.queue)
        self.tickets = {}
        self.queue = []
        self.in_update = 0

    def awaited(self, key):
        """Nobody waits for one that takes four times as long as usual, nor for an actor that needs
        twice as long.
        """
        usual = statistics.median(self.useful) if self.useful else math.inf
        duration = statistics.median(self.needed[key[0][0]][-16:] or [0.0])
        return self.now - self.granted[key] <= 4 * usual and duration <= 2 * usual

    @invariant()
    def bound_and_books(self):
        counts = self.staleness.counters()
        version = self.staleness.version
        awaited = sum(map(self.awaited, self.tickets))
        self.passed_over |= {key for key in self.tickets if not self.awaited(key)}
        assert version * self.batch + self.in_update + len(self.queue) + len(self.tickets) <= (
            self.eta + version + 1
        ) * self.batch + len(self.passed_over)
        assert counts["running"] == len(self.tickets)
        assert counts["queued"] == len(self.queue)
        assert (
            counts["capacity"]
            == (self.eta + 1) * self.batch - self.in_update - len(self.queue) - awaited
        )
        assert (
            counts["granted"]
            == counts["running"] + counts["redeemed"] + counts["returned"] + counts["expired"]
        )
        assert {name: counts[name] for name in self.fates} == self.fates


TestAdmission = Admission.TestCase
TestAdmission.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)


def test_undelivered_tickets_do_not_block_other_actors():
    """Batch 2 and eta 1 make four tickets. One certificate asks for all it can get, under ever new
    names, for ever.
    """
    now = [0.0]
    staleness = manager(clock=lambda: now[0])
    updates = 0
    waited = []
    last = 0.0
    for step in range(3000):  # tenths of a second; the honest one makes a rollout in half a second
        now[0] = step / 10
        for name in ("9.x", "9.y", f"9.{step}"):
            staleness.grant((name, str(step)), "held")
        if step % 5 == 0:
            for i in range(2):
                if staleness.grant(("0.a", "1"), f"{step}.{i}"):
                    now[0] += 0.01
                    assert (
                        staleness.arrive(("0.a", "1"), f"{step}.{i}", staleness.version)
                        == "accepted"
                    )
        if staleness.queued >= 2:
            for _ in range(2):
                assert staleness.take(staleness.version)
            staleness.publish(staleness.version + 1)
            updates += 1
            waited.append(now[0] - last)
            last = now[0]
    assert updates > 500
    assert max(waited) < 1.0
    # Expired tickets put the certificate off, longer each time: it held few of what it asked 9,000
    # times for.
    assert 4 < staleness.counters()["expired"] < 40


def test_shares_follow_deliveries_and_expiry_follows_durations():
    now = [0.0]
    # Eight tickets
    staleness = manager(batch=4, ticket_seconds=120.0, tickets_per_owner=10, clock=lambda: now[0])

    def held(name):
        tickets = [staleness.grant((name, "1"), str(i)) for i in range(8)]
        for ticket in tickets:
            if ticket:
                staleness.give_back(*ticket[:2])
        return sum(ticket is not None for ticket in tickets)

    assert held("0.a") == held("1.b") == 4
    assert staleness.grant(("0.a", "1"), "z").deadline == 120.0  # nothing is known yet
    for i in range(8):
        name = "0.a" if i < 6 else "1.b"
        ticket = staleness.grant((name, "1"), f"r{i}")
        now[0] += 2.0
        assert staleness.arrive(*ticket[:2], staleness.version) == "accepted"
        staleness.take(staleness.version)
        if i % 4 == 3:
            staleness.publish(staleness.version + 1)
    # Six of eight are 0.a's, whose share is six; 1.b keeps what leaves a batch to the others.
    staleness.forget(("0.a", "1"))
    assert held("0.a") == 6
    assert held("1.b") == 4
    assert staleness.grant(("0.a", "1"), "z").deadline == now[0] + 4 * 2.0
    assert staleness.grant(("2.new", "1"), "z").deadline == now[0] + 4 * 2.0  # as the others need
    now[0] += 8.0
    assert staleness.counters()["running"] == 0
    assert staleness.counters()["expired"] == 2
    # One that comes after all teaches how long its actor needs.
    assert staleness.arrive(("0.a", "1"), "z", staleness.version) == "accepted"
    assert staleness.grant(("0.a", "1"), "y").deadline == now[0] + 4 * 8.0


def test_threads_cannot_overdraw():
    staleness = manager(batch=25, tickets_per_owner=1000)  # 50 tickets
    granted = []

    def ask(name):
        for i in range(40):
            if staleness.grant((name, "1"), str(i)):
                granted.append(i)

    together(ask, map(str, range(8)))
    assert len(granted) == 50 == staleness.counters()["running"]
