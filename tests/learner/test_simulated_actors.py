"""Tickets of simulated actors that share a link: their pace, and what is learnt from."""

import heapq
import itertools

import pytest

from congrasp.learner.hub.staleness import StalenessManager

_RETRY = 0.05  # seconds until an actor that got no ticket asks again


class Simulation:
    """Actors that ask for tickets, make rollouts one after another and send them, at most two at a
    time.
    """

    def __init__(self, eta, batch, update=0.01):
        """A learner that needs so many seconds for an update."""
        self.now = 0.0
        self.batch = batch
        self.update = update
        self.staleness = StalenessManager(eta, batch, clock=lambda: self.now)
        self.arrived = {}
        self.queue = []
        self.updating = False
        self._events = []
        self._count = itertools.count()

    def actor(self, name, *, make, send, at=0.0):
        """Adds an actor: seconds in which it makes a rollout, and in which its link carries it."""
        self.arrived[name] = []
        self._at(at, self._ask, name, make, send, [0])

    def run(self, seconds):
        """Goes on until so many seconds later."""
        end = self.now + seconds
        while self._events and self._events[0][0] <= end:
            self.now, _, act, arguments = heapq.heappop(self._events)
            act(*arguments)
        self.now = end

    def _at(self, when, act, *arguments):
        heapq.heappush(self._events, (when, next(self._count), act, arguments))

    def _ask(self, name, make, send, sending):
        ticket = (
            self.staleness.grant((name, "1"), f"t{next(self._count)}") if sending[0] < 2 else None
        )
        if ticket is None:
            self._at(
                self.now + (_RETRY if sending[0] < 2 else 0.001),
                self._ask,
                name,
                make,
                send,
                sending,
            )
        else:
            self._at(self.now + make, self._made, ticket, name, make, send, sending)

    def _made(self, ticket, name, make, send, sending):
        sending[0] += 1
        self._at(self.now + send * sending[0], self._arrive, ticket, sending)  # they share the link
        self._at(self.now, self._ask, name, make, send, sending)

    def _arrive(self, ticket, sending):
        sending[0] -= 1
        if self.staleness.arrive(ticket.owner, ticket.id, ticket.version) == "accepted":
            self.arrived[ticket.owner[0]].append(self.now)
            self.queue.append(ticket.version)
            self._learn()

    def _learn(self):
        for version in filter(self.staleness.is_stale, self.queue):
            assert not self.staleness.take(version)
        self.queue = [version for version in self.queue if not self.staleness.is_stale(version)]
        if len(self.queue) >= self.batch and not self.updating:
            for version in self.queue[: self.batch]:
                assert self.staleness.take(version)
            self.queue, self.updating = self.queue[self.batch :], True
            self._at(self.now + self.update, self._publish)

    def _publish(self):
        self.staleness.publish(self.staleness.version + 1)
        self.updating = False
        self._learn()


FAST = {"make": 0.05, "send": 0.01}  # 20 rollouts a second


def among(eta, batch, *others, seconds=20.0):
    """A simulation with a fast actor that has been there for some seconds, and others; and the
    paces of all.
    """
    simulation = Simulation(eta, batch)
    simulation.actor("fast", **FAST)
    simulation.run(5.0)
    for number, other in enumerate(others):
        simulation.actor(f"other{number}", **other, at=simulation.now)
    before = {name: len(came) for name, came in simulation.arrived.items()}
    simulation.run(seconds)
    return [(len(came) - before[name]) / seconds for name, came in simulation.arrived.items()]


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize(
    "send", [0.1, 10.0, *(pytest.param(send, marks=pytest.mark.slow) for send in (0.3, 2.0))]
)
@pytest.mark.parametrize(("eta", "batch"), [(0, 2), (0, 8), (1, 1), (1, 2), (1, 4), (2, 2)])
def test_an_actor_keeps_its_pace_beside_slow_links(eta, batch, send, count):
    """0.8 MB over links of 8 MB/s to 80 kB/s. Where an update waited for every ticket, the least of
    these was 0.03.
    """
    (alone,) = among(eta, batch)
    assert among(eta, batch, *[{"make": 0.05, "send": send}] * count)[0] > 0.9 * alone


@pytest.mark.parametrize(("batch", "least"), [(2, 1.0), (8, 6.0)])
def test_rollouts_of_slower_actors_are_used(batch, least):
    """Nobody waits for a rollout of 0.15 s, which is three times as slow; all of them are fresh
    enough where updates of eight take 0.4 s, and some where those of two take 0.1 s."""
    _, *others = among(1, batch, *[{"make": 0.15, "send": 0.01}] * 2)
    assert min(others) > least


def test_actors_that_are_alike_share_alike():
    paces = among(1, 4, FAST, FAST, FAST)
    assert max(paces) < 1.2 * min(paces)
    assert sum(paces) > 60.0
