"""The actor's end, against a learner that a test scripts."""

import threading
import time

import numpy as np
import pytest

from congrasp.actors import patience as patience_module
from congrasp.actors.link import ActorLink, RunFinished, RunRestarted, Ticket
from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.transport.keys import Keys, below
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.common.wire.codec import Message, encode
from tests.waits import eventually

KEYS = Keys("test")
TICKET = Ticket("t", 0)


class Learner:
    """Answers as told, and remembers what it was asked."""

    def __init__(self, hub, *, run_id="e", session_id="1"):
        self.hub = hub
        self.transport = MemoryTransport(hub)
        self.state = {"version": 0, "run_id": run_id, "session_id": session_id, "finished": False}
        self.granted = True
        self.outcomes = []  # what rollouts are told, the last one for ever
        self.received = []
        self.tickets = []
        self.pulls = 0
        self.transport.serve(
            KEYS.config, lambda key, m: self.reply(config="{}", schema="s", arrays=["reward"])
        )
        self.transport.serve(KEYS.tickets, lambda key, message: self.on_ticket(key, message))
        self.transport.serve(below(KEYS.weights), self.on_weights)
        self.transport.serve(KEYS.rollouts, self.on_rollout, workers=4)

    def reply(self, **meta):
        return Message(meta={**self.state, "retry_after": 0.05, "why": "because", **meta})

    def on_ticket(self, key, message):
        self.tickets.append(message.meta)
        return self.reply(granted=self.granted)

    def on_weights(self, key, message):
        self.pulls += 1
        if (message.meta["newer_than"], message.meta["session_id"]) == (
            self.state["version"],
            self.state["session_id"],
        ):
            return self.reply()
        return Message(
            {"w": np.ones(2)}, {"version": self.state["version"], "run_id": self.state["run_id"]}
        )

    def on_rollout(self, key, message):
        self.received.append(message)
        outcome = (
            self.outcomes.pop(0)
            if len(self.outcomes) > 1
            else self.outcomes[0]
            if self.outcomes
            else "accepted"
        )
        if isinstance(outcome, Exception):
            raise outcome
        if callable(outcome):
            outcome = outcome()
        return self.reply(outcome=outcome)

    def announce(self, **state):
        self.state |= state
        self.transport.publish(KEYS.announcement, Message(meta=self.state))


@pytest.fixture
def ends():
    """(in-memory hub, function that makes a link)."""
    hub = MemoryHub()
    links = []

    def make(**options):
        transport = MemoryTransport(hub)
        link = ActorLink(transport, "test", "a", **{"request_timeout": 20.0, **options})
        links.append((transport, link))
        return link

    yield hub, make
    for transport, link in links:
        link.close()
        transport.close()


@pytest.fixture
def joined(ends):
    """A function that makes a learner and a link that has its configuration."""
    hub, make = ends

    def join(**options):
        learner = Learner(hub)
        link = make(**options)
        link.config(60)
        return learner, link

    return join


def rollout(value=0.0):
    return Message({"reward": np.full(3, value)}, {"version": 0, "schema": "s", "steps": 3})


def test_config_waits_for_a_learner(ends):
    hub, make = ends
    link = make()
    with pytest.raises(TransportError):
        link.config(0.2)
    threading.Timer(0.2, Learner, [hub]).start()
    assert link.config(10) == ("{}", "e", "s", ("reward",))


def test_identity_is_added_and_counts(ends):
    hub, make = ends
    learner = Learner(hub)
    link = make()
    with pytest.raises(CongraspError, match="no configuration"):
        link.upload(rollout(), TICKET)
    link.config(60)
    for n in range(3):
        assert link.upload(rollout(n), Ticket(f"t{n}", 0)).result(60) == "accepted"
    assert make().incarnation != link.incarnation
    for n, message in enumerate(learner.received):
        assert message.arrays["reward"][0] == n
        expected = {
            "actor": "a",
            "incarnation": link.incarnation,
            "sequence": n,
            "run_id": "e",
            "ticket": f"t{n}",
        }
        assert message.meta == {"version": 0, "schema": "s", "steps": 3, **expected}


def test_a_repeated_ticket_request_keeps_its_id(joined):
    learner, link = joined()
    learner.granted = False
    assert link.acquire_ticket(0.2) is None
    assert len(learner.tickets) >= 2
    learner.granted = True
    learner.state["version"] = 7
    first = link.acquire_ticket(60)
    second = link.acquire_ticket(5)
    assert first.version == 7
    assert first.id != second.id
    assert {meta["ticket"] for meta in learner.tickets} == {first.id, second.id}
    link.give_back(second)
    assert learner.tickets[-1] == {
        "actor": "a",
        "incarnation": link.incarnation,
        "ticket": second.id,
        "give_back": True,
    }


def test_an_announcement_ends_the_wait_for_a_ticket(joined):
    learner, link = joined()
    learner.reply = lambda **meta: Message(meta={**learner.state, "retry_after": 20.0, **meta})
    learner.granted = False

    def move_on():
        learner.granted = True
        learner.announce(version=1)

    threading.Timer(0.2, move_on).start()
    assert link.acquire_ticket(15).version == 1


def test_weights_are_pulled_only_when_there_are_others(joined):
    learner, link = joined()
    assert link.weights(-1).meta["version"] == 0
    for _ in range(5):
        assert link.weights(0) is None
    assert learner.pulls == 1
    learner.announce(version=1)
    assert eventually(lambda: link.weights(0)).meta["version"] == 1
    assert link.weights(1) is None
    assert learner.pulls == 2
    learner.state["version"] = 2  # its announcement is lost; a ticket tells as well
    assert link.weights(1) is None
    link.acquire_ticket(60)
    assert link.weights(1).meta["version"] == 2
    learner.announce(version=1, session_id="2")  # it resumed from a checkpoint
    assert eventually(lambda: link.weights(2)).meta["version"] == 1
    learner.announce(version=1, session_id="3")
    assert eventually(lambda: link.weights(1)).meta["version"] == 1
    assert link.weights(1) is None


def test_rollout_is_sent_under_one_identity_until_it_is_answered(joined):
    learner, link = joined()
    learner.outcomes = ["retry", RuntimeError("bug"), "retry", "duplicate"]
    assert link.upload(rollout(), TICKET).result(60) == "duplicate"
    assert len({id(message) for message in learner.received}) == 1
    assert len(learner.received) == 4


@pytest.mark.parametrize("by", ["ticket", "weights", "announcement"])
def test_another_training_is_noticed_by_every_way(joined, by):
    learner, link = joined()
    if by == "announcement":
        learner.announce(run_id="f")
    learner.state["run_id"] = "f"
    with pytest.raises(RunRestarted):
        link.acquire_ticket(1) if by == "ticket" else link.weights(-1)


def test_finished_run_raises_run_finished(joined):
    learner, link = joined()
    learner.state["finished"] = True
    with pytest.raises(RunFinished):
        link.acquire_ticket(60)


def test_uploads_overlap_with_the_caller_up_to_the_window(joined):
    learner, link = joined(window=2)
    gate = threading.Event()
    learner.outcomes = [lambda: gate.wait(10) and "accepted"]
    outcomes = [link.upload(rollout(n), TICKET) for n in range(2)]  # both return at once
    third = threading.Thread(
        target=lambda: outcomes.append(link.upload(rollout(2), TICKET)), daemon=True
    )
    third.start()
    third.join(0.3)
    assert third.is_alive()
    assert len(learner.received) == 2
    assert link.flush(0.05) is False
    gate.set()
    third.join(5)
    assert link.flush(60) is True
    assert [outcome.result(0) for outcome in outcomes] == ["accepted"] * 3


def test_refusals_in_a_row_stop_the_actor_with_a_reason(joined):
    learner, link = joined(max_refusals=3)
    learner.outcomes = ["refused", "refused", "stale", "refused", "refused", "refused"]
    assert [link.upload(rollout(), TICKET).result(60) for _ in range(6)][2:4] == [
        "stale",
        "refused",
    ]
    for use in (
        lambda: link.upload(rollout(), TICKET),
        lambda: link.acquire_ticket(1),
        lambda: link.weights(0),
    ):
        with pytest.raises(CongraspError, match="refused 3 rollouts in a row: because"):
            use()
    assert len(learner.received) == 6


def test_a_message_always_damaged_is_given_up(joined):
    learner, link = joined(max_refusals=2)
    learner.outcomes = [CongraspError("The message's data do not match their checksum.")]
    assert link.upload(rollout(), TICKET).result(60) == "refused"
    assert len(learner.received) == 2
    assert link.upload(rollout(), TICKET).result(60) == "refused"
    with pytest.raises(CongraspError, match=r"refused 2 rollouts in a row: .*checksum"):
        link.upload(rollout(), TICKET)


def test_silent_learner_raises_after_the_patience(joined):
    learner, link = joined(patience=0.3)
    learner.transport.close()
    with pytest.raises(TransportError, match=r"not answered for 0\.3 s"):
        link.upload(rollout(), TICKET).result(60)
    with pytest.raises(TransportError, match=r"not answered for 0\.3 s"):
        link.acquire_ticket(60)


def test_one_line_is_logged_while_a_learner_does_not_answer(joined, monkeypatch, caplog):
    monkeypatch.setattr(patience_module, "NOTICED_S", 0.2)
    learner, link = joined(patience=20.0)
    learner.transport.close()
    outcome = link.upload(rollout(), TICKET)
    for _ in range(3):
        assert link.acquire_ticket(0.3) is None
    Learner(learner.hub, session_id="2")
    assert outcome.result(60) == "accepted"
    assert link.acquire_ticket(60)
    (line,) = (record.getMessage() for record in caplog.records)
    assert line.startswith("The learner does not answer; waiting for up to 20 s: No response for ")


def test_the_line_before_the_first_answer_does_not_say_that_the_learner_stopped(
    ends, monkeypatch, caplog
):
    monkeypatch.setattr(patience_module, "NOTICED_S", 0.2)
    _, make = ends
    link = make(patience=20.0)
    stop = threading.Event()
    threading.Timer(1.5, stop.set).start()
    assert link.wait_for_config(stop) is None
    (line,) = (record.getMessage() for record in caplog.records)
    assert line.startswith("The learner has not answered yet, perhaps because it is starting; ")


def test_a_suspended_actor_does_not_count_as_silence(joined, monkeypatch):
    learner, link = joined(patience=5.0)
    learner.transport.close()
    outcome = link.upload(rollout(), TICKET)
    assert link.acquire_ticket(0.2) is None
    running = time.monotonic
    # What a process sees that was stopped
    monkeypatch.setattr(time, "monotonic", lambda: running() + 60.0)
    assert link.acquire_ticket(0.2) is None
    assert not outcome.done()
    Learner(learner.hub, session_id="2")
    assert outcome.result(60) == "accepted"
    assert link.acquire_ticket(60)


def test_learner_that_talks_nonsense_ends_the_link(joined):
    learner, link = joined()
    learner.reply = lambda **meta: Message(meta={"hello": 1})
    with pytest.raises(CongraspError, match="is not valid"):
        link.upload(rollout(), TICKET).result(60)
    with pytest.raises(CongraspError, match="is not valid"):
        link.acquire_ticket(1)


def test_closing_drops_pending_uploads(joined):
    learner, link = joined()
    learner.outcomes = ["retry"]
    outcome = link.upload(rollout(), TICKET)
    link.close()
    with pytest.raises(TransportError, match="closed before"):
        outcome.result(60)
    assert link.flush(1)
    with pytest.raises(CongraspError, match="closed"):
        link.upload(rollout(), TICKET)


SLOW_S = 0.4
"""Duration of a request over the slow network of the following tests."""


class FarTransport(MemoryTransport):
    """A transport over which every query takes `SLOW_S`, and several may be under way."""

    def __init__(self, hub):
        super().__init__(hub)
        self.keys = []
        """Keys of the queries that were begun."""

    def query(self, key, message, *, timeout):
        self.keys.append(key)
        time.sleep(SLOW_S)
        return super().query(key, message, timeout=timeout)


@pytest.fixture
def far():
    """(learner, link, transport) over a slow network; one rollout that took no time has been
    uploaded, so that the link knows its pace.
    """
    hub = MemoryHub()
    learner = Learner(hub)
    with FarTransport(hub) as transport, ActorLink(transport, "test", "a") as link:
        link.config(60)
        ticket = link.acquire_ticket(60)
        assert link.weights(-1) is not None
        link.upload(rollout(), ticket)
        assert link.flush(60)
        yield learner, link, transport


def begin_pull(learner, transport, **state):
    """Announces a state, and waits until the link begins to fetch the policy."""
    pulls = transport.keys.count(KEYS.weights_for("actor", "a"))
    learner.announce(**state)
    eventually(lambda: transport.keys.count(KEYS.weights_for("actor", "a")) > pulls)


def test_tickets_are_requested_ahead_over_a_slow_network(far):
    learner, link, _ = far
    assert link.acquire_ticket(60) is not None
    eventually(lambda: len(learner.tickets) >= 4)
    began = time.monotonic()
    tickets = [link.acquire_ticket(60) for _ in range(3)]
    assert time.monotonic() - began < SLOW_S, "the tickets were not there"
    assert len({ticket.id for ticket in tickets}) == 3


def test_a_ticket_ahead_that_is_not_granted_is_waited_for_as_long_as_asked(far):
    learner, link, _ = far
    learner.granted = False
    while link.acquire_ticket(0.05) is not None:
        pass
    learner.granted = True
    assert link.acquire_ticket(60) is not None


def test_a_ticket_that_is_granted_before_an_earlier_one_is_used_first(far):
    learner, link, _ = far
    refused = []

    def grant_all_but_the_first(key, message):
        refused.append(message.meta["ticket"])
        return learner.reply(granted=message.meta["ticket"] != refused[0])

    assert link.acquire_ticket(60) is not None
    eventually(lambda: len(learner.tickets) >= 6)
    learner.on_ticket = grant_all_but_the_first
    for _ in range(8):
        assert link.acquire_ticket(20) is not None


def test_a_policy_on_its_way_is_waited_for_only_if_the_ticket_requires_it(far):
    learner, link, transport = far
    begin_pull(learner, transport, version=1)
    began = time.monotonic()
    assert link.weights(0, required=0) is None
    assert time.monotonic() - began < SLOW_S, "it waited for a policy that it did not need"
    newer = link.weights(0, required=1)
    assert newer.meta["version"] == 1
    assert link.weights(1, required=1) is None


def test_a_policy_is_fetched_when_it_is_announced(far):
    learner, link, transport = far
    pulls = learner.pulls
    begin_pull(learner, transport, version=1)
    eventually(lambda: link.weights(0, required=0) is not None)
    assert learner.pulls == pulls + 1


def test_a_policy_of_another_session_is_always_waited_for(far):
    learner, link, transport = far
    begin_pull(learner, transport, session_id="2")
    assert link.weights(0, required=0) is not None


def test_a_ticket_requires_a_newer_policy_if_updates_pass_during_rollouts(joined):
    learner, link = joined()
    reply = learner.reply
    learner.reply = lambda **meta: reply(required_version=3, **meta)
    learner.announce(version=5)
    assert link.acquire_ticket(60).required_version == 3
    ticket = link.acquire_ticket(60)
    learner.state["version"] = 6
    assert link.upload(rollout(), ticket).result(60) == "accepted"
    learner.state["version"] = 8
    assert link.acquire_ticket(60).required_version == 4


class ThinTransport(MemoryTransport):
    """A transport of 2 MB/s, which remembers the lengths of what it sent."""

    def __init__(self, hub):
        super().__init__(hub)
        self.lengths = []

    def query(self, key, message, *, timeout):
        length = len(encode(message))
        self.lengths.append(length)
        time.sleep(length / 2e6)
        return super().query(key, message, timeout=timeout)


def test_rollouts_are_compressed_over_a_thin_link_and_arrive_equal():
    hub = MemoryHub()
    learner = Learner(hub)
    content = np.repeat(np.random.default_rng(0).normal(size=1000), 40)
    message = Message({"reward": content}, {"version": 0, "schema": "s", "steps": 3})
    with ThinTransport(hub) as transport, ActorLink(transport, "test", "a") as link:
        link.config(60)
        for _ in range(2):
            assert link.upload(message, TICKET).result(60) == "accepted"
    first, second = transport.lengths[-2:]
    assert first > content.nbytes
    assert second < content.nbytes / 2
    np.testing.assert_array_equal(learner.received[1].arrays["reward"], content)
