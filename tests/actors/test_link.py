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
from congrasp.common.wire.codec import Message
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
        self.transport.serve(KEYS.tickets, self.on_ticket)
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
