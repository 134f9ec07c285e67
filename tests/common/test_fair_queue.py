"""The order and the limits of a queue that clients share."""

import collections
import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from congrasp.common.transport.fair_queue import FairQueue
from congrasp.common.transport.senders import Peer

PEERS = st.builds(Peer, st.sampled_from("abc"), st.sampled_from("123"))


def peer(text):
    """Account and name of 'a1'."""
    return Peer(text[0], text[1:])


def filled(depth, share, peers):
    """A queue with one item for each of the peers; an item is its peer's text."""
    queue = FairQueue(depth, share)
    for text in peers.split():
        if queue.has_room(peer(text)):
            queue.add(text, peer(text))
    return queue


@pytest.mark.parametrize(
    ("queued", "newcomer", "admitted", "evicted"),
    [
        ("a1 a1 a1", "b1", True, None),  # not full
        ("a1 a1 a1 a1", "b1", True, "a1"),  # the only account loses
        ("a1 a2 a3 a4", "b1", True, "a4"),  # four names are one account
        ("a1 a2 b1 c1", "b1", False, None),  # as long as the longest
        ("a1 a2 b1 c1", "d1", True, "a2"),
        ("a1 b1 c1 d1", "e1", True, None),  # an account without an item is always admitted
        ("a1 b1 c1 d1", "a1", False, None),
        ("a1 a1 a1 a2", "a3", True, "a1"),  # within an account, the longest peer loses
        ("a1 a2 a3 a4", "a5", False, None),
        ("a1 a1 a1 b1", "a1", False, None),
        ("a1 a1 b1 b1", "c1", True, "b1"),  # of two, the one that came last
    ],
)
def test_admission(queued, newcomer, admitted, evicted):
    queue = filled(4, 4, queued)
    assert sorted(queue) == sorted(queued.split())
    assert queue.has_room(peer(newcomer)) == admitted
    if admitted:
        assert queue.add(newcomer, peer(newcomer)) == evicted


def served_names(queue, numbers):
    """Bytes that a queue holds after it has served names that send one item each; one waits."""
    for number in numbers:
        queue.add(number, Peer("a", f"name {number}"))
        if len(queue) > 1:
            served = queue.in_turn()[0]
            queue.end_turn(served)
            queue.pop(served)
    return tracemalloc.get_traced_memory()[0]


def test_invented_names_fill_no_memory():
    queue = FairQueue(4, 4)
    tracemalloc.start()
    try:
        before = served_names(queue, range(1000))
        after = served_names(queue, range(1000, 6000))
    finally:
        tracemalloc.stop()
    assert after - before < 50_000


def test_evicted_item_is_the_newest():
    queue = FairQueue(3, 3)
    for number in range(3):
        queue.add(number, Peer("a"))
    assert queue.add("b", Peer("b")) == 2
    assert queue.pop(Peer("a")) == 0


def test_peer_keeps_its_share():
    queue = filled(10, 2, "a1 a1 a2")
    assert not queue.has_room(peer("a1"))
    assert queue.has_room(peer("a2"))


def test_turns_alternate_between_accounts():
    queue = filled(20, 20, "a1 a2 a3 a3 b1 b1 c1")
    order = []
    while len(queue):
        turn = queue.in_turn()[0]
        queue.end_turn(turn)
        order.append(queue.pop(turn))
    assert order == ["a1", "b1", "c1", "a2", "b1", "a3", "a3"]


def take(queue):
    """Takes the item whose turn it is."""
    turn = queue.in_turn()[0]
    queue.end_turn(turn)
    return queue.pop(turn)


@pytest.mark.parametrize(
    ("queued", "newcomer"),
    [("a1 a1 a1 b1 b1 b1", "c1"), ("a1 a1 a1 a2 a2 a2", "a3")],
)
def test_newcomer_precedes_backlogs(queued, newcomer):
    queue = filled(20, 20, queued)
    taken = [take(queue) for _ in range(2)]
    queue.add(newcomer, peer(newcomer))
    assert queue.peers_ahead == 1
    taken += [take(queue) for _ in range(2)]
    assert taken == [queued[:2], queued[9:11], newcomer, queued[:2]]


@pytest.mark.parametrize(
    ("queued", "peers_ahead"),
    [("a1 a1 a1 b1 b1 b1", 0), ("a1 a1 a1 b1 b1", 1), ("a1 a1 b1 b1", 2)],
)
def test_backlogs_are_not_ahead(queued, peers_ahead):
    """After their first turns, only peers with a single item are."""
    queue = filled(20, 20, queued)
    for _ in range(2):
        take(queue)
    assert queue.peers_ahead == peers_ahead


@pytest.mark.parametrize(
    ("queued", "returning"),
    [("a1 a1 a1 b1 b1 b1", "c1"), ("a1 a1 a1 a2 a2 a2", "a3")],
)
def test_peer_that_returns_before_its_turn_is_last(queued, returning):
    queue = filled(20, 20, f"{queued} {returning}")
    first_round = [take(queue) for _ in range(3)]
    queue.add(returning, peer(returning))
    assert first_round + [take(queue) for _ in range(3)] == 2 * [
        queued[:2],
        queued[9:11],
        returning,
    ]


@given(st.lists(PEERS, max_size=60), st.integers(1, 8), st.integers(1, 8))
def test_admission_holds_for_all_orders(peers, depth, share):
    queue = FairQueue(depth, share)
    for number, newcomer in enumerate(peers):
        accounts = collections.Counter(sender.account for sender, _ in queue)
        length = queue.length_of_peer(newcomer)
        is_first = not accounts[newcomer.account]
        admitted = queue.has_room(newcomer)
        assert admitted or not is_first
        if not admitted:
            assert len(queue) >= depth or length >= share
            continue
        evicted = queue.add((newcomer, number), newcomer)
        accounts[newcomer.account] += 1
        assert len(queue) <= max(depth, queue.accounts)
        if evicted is not None:
            loser = evicted[0]
            assert accounts[loser.account] == max(accounts.values()) > 1
            assert evicted not in list(queue)
        assert queue.length_of_peer(newcomer) == length + 1 <= share


@given(st.lists(PEERS, max_size=60), PEERS)
def test_client_with_one_item_at_a_time_is_never_refused(flood, modest):
    queue = FairQueue(8, 4)
    modest = Peer("modest", modest.name)
    for newcomer in flood:
        if not queue.length_of_peer(modest):
            assert queue.has_room(modest)
            assert queue.add(modest, modest) != modest
        if queue.has_room(newcomer):
            assert queue.add(newcomer, newcomer) != modest
