"""The two ends of the link over the in-memory transport."""

import threading

import numpy as np
import pytest

from actors.link import ActorLink, RunEnded
from common.errors import CongraspError
from common.transport.keys import key
from common.transport.memory import MemoryBroker, MemoryTransport
from common.wire.codec import Message
from learner.hub import LearnerHub, RolloutSizes
from learner.staleness import StalenessManager
from tests.rollouts import ACTION, OBSERVATION, SCHEMA, bundle, rollout

pytestmark = pytest.mark.timeout(30)


class Ends:
    """A hub, and links to it."""

    def __init__(self, batch: int = 2):
        self.broker = MemoryBroker()
        self.batch = batch
        self.hub = self.start()

    def start(self, epoch: str = "e") -> LearnerHub:
        self.transport = MemoryTransport(self.broker)
        return LearnerHub(
            self.transport,
            run="r",
            config_json="{}",
            epoch=epoch,
            sizes=RolloutSizes(OBSERVATION, ACTION, SCHEMA),
            staleness=StalenessManager(max_staleness=1, batch=self.batch),
        )

    def link(self, name: str = "a", patience: float = 5.0) -> ActorLink:
        link = ActorLink(MemoryTransport(self.broker), run="r", actor=name, patience=patience)
        link.config()
        return link


@pytest.fixture
def ends() -> Ends:
    return Ends()


def _send(link: ActorLink, count: int, version: int = 0) -> None:
    for n in range(count):
        ticket = link.acquire_ticket(threading.Event())
        assert ticket is not None
        link.upload(rollout(sequence=n, version=version), ticket)
    assert link._idle.wait(5.0)


def test_rollouts_arrive_in_order_and_once(ends):
    ends.hub.publish_weights(bundle(0), 0)
    link = ends.link()
    _send(link, 2)
    batch = ends.hub.next_batch(2, 5.0)
    assert [message.meta["sequence"] for message in batch] == [0, 1]
    assert ends.hub.next_batch(1, 0.05) is None
    ledger = ends.hub.status()["ledger"]
    assert (ledger["accepted"], ledger["consumed"], ledger["refused"]) == (2, 2, 0)
    link.close()


def test_the_same_identity_is_a_duplicate_and_not_queued_again(ends):
    ends.hub.publish_weights(bundle(0), 0)
    client = MemoryTransport(ends.broker)
    replies = [client.query(key("r", "rollout"), rollout(sequence=0), timeout=1.0) for _ in range(3)]
    assert [reply.meta["outcome"] for reply in replies] == ["accepted", "duplicate", "duplicate"]
    assert len(ends.hub.next_batch(1, 1.0)) == 1
    assert ends.hub.next_batch(1, 0.05) is None


def test_no_ticket_before_there_is_a_policy_and_none_beyond_the_bound(ends):
    link = ends.link()
    ask = lambda: MemoryTransport(ends.broker).query(  # noqa: E731
        key("r", "ticket"), Message({}, {"actor": "a", "incarnation": link.incarnation}), timeout=1.0
    )
    assert ask().meta["ticket"] is None
    ends.hub.publish_weights(bundle(0), 0)
    assert [ask().meta["ticket"] is not None for _ in range(5)] == [True] * 4 + [False]
    link.close()


def test_tickets_of_a_dead_actor_return(ends):
    ends.hub.publish_weights(bundle(0), 0)
    transport = MemoryTransport(ends.broker)
    link = ActorLink(transport, run="r", actor="a", patience=5.0)
    link.config()
    for _ in range(4):
        assert link.acquire_ticket(threading.Event()) is not None
    transport.close()
    assert ends.hub.status()["running"] == 0
    assert ends.hub.status()["ledger"]["expired"] == 4
    link.close()


def test_old_rollouts_are_dropped_and_counted(ends):
    ends.hub.publish_weights(bundle(5), 5)
    client = MemoryTransport(ends.broker)
    for sequence, version in enumerate([3, 4, 5]):
        client.query(key("r", "rollout"), rollout(sequence=sequence, version=version), timeout=1.0)
    batch = ends.hub.next_batch(2, 1.0)
    assert [message.meta["version"] for message in batch] == [4, 5]
    assert ends.hub.status()["ledger"]["stale"] == 1


def test_weights_are_pulled_by_version(ends):
    ends.hub.publish_weights(bundle(3), 3)
    link = ends.link()
    np.testing.assert_array_equal(link.weights(-1).arrays["actor/w"], [3, 3, 3])
    assert link.weights(3) is None
    link.close()


def test_refusals_end_the_actor_in_words(ends):
    ends.hub.publish_weights(bundle(0), 0)
    link = ends.link()
    bad = rollout()
    bad.arrays["reward"] = np.full((4, 2), np.nan, np.float32)
    with pytest.raises(CongraspError, match="refused 3 rollouts: .*'reward'.*not finite"):
        for _ in range(5):
            link.upload(bad, link.acquire_ticket(threading.Event()))
            link._idle.wait(5.0)
    assert ends.hub.status()["running"] == 0
    link.close()


def test_the_end_and_a_new_training_reach_the_actor(ends):
    ends.hub.publish_weights(bundle(0), 0)
    link = ends.link()
    ends.transport.close()
    ends.start(epoch="other").publish_weights(bundle(0), 0)
    with pytest.raises(RunEnded, match="new training"):
        link.acquire_ticket(threading.Event())
    link.close()
    ends.transport.close()
    hub = ends.start()
    link = ends.link("b")
    hub.finish()
    with pytest.raises(RunEnded, match="ended"):
        link.acquire_ticket(threading.Event())
    link.close()


def test_a_restart_forgets_queued_rollouts_so_that_they_may_be_sent_again(ends):
    client = MemoryTransport(ends.broker)
    ends.hub.publish_weights(bundle(0), 0)
    for sequence in range(3):
        client.query(key("r", "rollout"), rollout(sequence=sequence), timeout=1.0)
    ends.hub.next_batch(1, 1.0)
    state = ends.hub.state()
    ends.transport.close()
    hub = ends.start()
    hub.restore(state)
    outcomes = [
        client.query(key("r", "rollout"), rollout(sequence=sequence), timeout=1.0).meta["outcome"]
        for sequence in range(3)
    ]
    assert outcomes == ["duplicate", "accepted", "accepted"]
    ledger = hub.status()["ledger"]
    assert ledger["accepted"] == 3 and ledger["consumed"] == 1
