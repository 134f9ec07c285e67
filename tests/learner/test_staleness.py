"""Admission never lets too much on its way, and its capacity never leaks."""

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from learner.staleness import StalenessManager

ETA, BATCH, SECONDS = 1, 3, 10.0


class Admission(RuleBasedStateMachine):
    """Any order of grants, acceptances, deaths, expiries and consumption."""

    def __init__(self):
        super().__init__()
        self.now = 0.0
        self.manager = StalenessManager(max_staleness=ETA, batch=BATCH, ticket_seconds=SECONDS, clock=lambda: self.now)
        self.out: dict[str, tuple[tuple[str, str], float]] = {}
        self.queued = 0

    @rule(actor=st.sampled_from("abc"))
    def grant(self, actor):
        room = (ETA + 1) * BATCH - self.queued - sum(deadline >= self.now for _, deadline in self.out.values())
        ticket = self.manager.grant((actor, "1"))
        assert (ticket is not None) == (room > 0)
        if ticket is not None:
            self.out[ticket] = ((actor, "1"), self.now + SECONDS)

    @rule()
    def accept(self):
        if self.out:
            ticket = next(iter(self.out))
            del self.out[ticket]
            self.manager.accept(ticket)
            self.queued += 1

    @rule(actor=st.sampled_from("abc"))
    def die(self, actor):
        mine = [t for t, (owner, deadline) in self.out.items() if owner[0] == actor and deadline >= self.now]
        assert self.manager.running >= 0  # expires what is late first
        assert self.manager.forget((actor, "1")) == len(mine)
        self.out = {t: v for t, v in self.out.items() if v[0][0] != actor}

    @rule(seconds=st.floats(0.5, 8.0))
    def wait(self, seconds):
        self.now += seconds

    @rule(stale=st.booleans())
    def consume(self, stale):
        if self.queued:
            self.manager.leave_queue(stale=stale)
            self.queued -= 1

    @invariant()
    def accounts_balance(self):
        ledger = self.manager.ledger
        assert ledger.accepted == ledger.consumed + ledger.stale + self.manager.queued
        assert self.manager.queued == self.queued
        assert self.manager.running == sum(deadline >= self.now for _, deadline in self.out.values())


TestAdmission = Admission.TestCase
TestAdmission.settings = settings(max_examples=60, deadline=None)


def test_bound_by_hand():
    manager = StalenessManager(max_staleness=1, batch=2)
    tickets = [manager.grant(("a", "1")) for _ in range(5)]
    assert [ticket is not None for ticket in tickets] == [True, True, True, True, False]  # (1 + 1) * 2
    manager.accept(tickets[0])
    assert manager.grant(("a", "1")) is None  # accepted, not yet consumed
    manager.leave_queue(stale=False)
    assert manager.grant(("a", "1")) is not None
