"""The queue before the policy: every query is answered once, and too many are told so at once."""

import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from congrasp.common.errors import CongraspError, LateError, OverloadedError
from congrasp.common.transport.senders import Peer
from congrasp.services.serve.batching import Batcher, Splitting


class Gate:
    """A function of batches that waits until it is let through, and remembers what it saw."""

    def __init__(self):
        self.batches = []
        self.entered = threading.Semaphore(0)
        self.go = threading.Event()

    def __call__(self, items, queued):
        assert len(queued) == len(items)
        self.entered.release()
        assert self.go.wait(10)
        self.batches.append(list(items))
        return [10 * item for item in items]


@pytest.fixture
def gate():
    return Gate()


def running(batcher, gate):
    """Submits an item, 0, that runs alone in its caller's thread and is held at the gate."""
    answer = Future()
    threading.Thread(
        target=lambda: answer.set_result(batcher.submit(0, 10.0).result(10)), daemon=True
    ).start()
    assert gate.entered.acquire(timeout=10)
    return answer


def test_a_batch_is_limited_by_weight(gate):
    batcher = Batcher(gate, size=4, window=0.0, depth=10, weigh=lambda item: item)
    futures = [running(batcher, gate)]
    futures += [batcher.submit(weight, 10.0) for weight in (3, 1, 2, 4, 1, 1)]
    gate.go.set()
    assert [future.result(10) for future in futures] == [0, 30, 10, 20, 40, 10, 10]
    assert gate.batches == [[0], [3, 1], [2], [4], [1, 1]]
    batcher.close()


def test_one_too_many_is_refused_at_once_and_the_others_are_answered(gate):
    batcher = Batcher(gate, size=4, window=0.0, depth=2)
    futures = [running(batcher, gate)]
    futures += [batcher.submit(i, 10.0) for i in (1, 2)]
    with pytest.raises(OverloadedError, match="Overloaded: 2 queries are queued"):
        batcher.submit(3, 10.0)
    gate.go.set()
    assert [future.result(10) for future in futures] == [0, 10, 20]
    batcher.close()


def test_peers_take_turns_and_a_flooding_peer_is_refused(gate):
    batcher = Batcher(gate, size=2, window=0.0, depth=10, peer_limit=3)
    futures = [running(batcher, gate)]
    futures += [batcher.submit(i, 10.0, peer=Peer("greedy")) for i in (1, 2, 3)]
    for refuse in (
        lambda: batcher.submit(4, 10.0, peer=Peer("greedy")),
        lambda: batcher.check_room(Peer("greedy")),
    ):
        with pytest.raises(OverloadedError, match="Overloaded: 3 of your queries are queued"):
            refuse()
    batcher.check_room(Peer("modest"))
    futures += [batcher.submit(i, 10.0, peer=Peer("modest")) for i in (7, 8)]
    gate.go.set()
    assert [future.result(10) for future in futures] == [0, 10, 20, 30, 70, 80]
    assert gate.batches == [[0], [1, 7], [2, 8], [3]]
    batcher.close()


@pytest.fixture
def several(monkeypatch):
    """However long ago another peer has asked, it counts."""
    monkeypatch.setattr("congrasp.services.serve.batching.ALONE_S", 1e6)


class Letters(Gate):
    """Items are texts, whose letters are what they weigh, and are run one by one."""

    def __init__(self, limits=(4,)):
        super().__init__()
        self._limits = limits

    def __call__(self, items, queued):
        self.entered.release()
        assert self.go.wait(10)
        self.batches.append(list(items))
        return [CongraspError("bad") if "!" in item else item.upper() for item in items]

    join = staticmethod("".join)
    run_again = staticmethod(lambda item, queue_s: f"{item} again")

    def batcher(self):
        splitting = Splitting(
            self._limits, lambda item, first, end: item[first:end], self.join, self.run_again
        )
        return Batcher(self, size=8, window=0.0, depth=20, weigh=len, splitting=splitting)

    def run(self, *items, timeout=10.0):
        """Submits (peer, item) while the first is held back; their futures."""
        batcher = self.batcher()
        first = Future()
        (peer, item), *rest = items
        threading.Thread(
            target=lambda: first.set_result(batcher.submit(item, 10.0, Peer(peer))), daemon=True
        ).start()
        assert self.entered.acquire(timeout=10)
        futures = [batcher.submit(item, timeout, Peer(peer)) for peer, item in rest]
        self.go.set()
        return [first.result(10), *futures], batcher


@pytest.mark.parametrize(
    ("items", "batches"),
    [
        (
            "a:k b:abcdefg a:l b:hi a:mno",
            [["k"], ["ab", "l", "m"], ["cd", "no"], ["efg", "h"], ["i"]],
        ),
        (
            "a:k b:abcdefg c:tuvwxyz a:l",
            [["k"], ["a", "t", "l"], ["bc", "uv"], ["de", "wx"], ["fg", "yz"]],
        ),
    ],
)
def test_peers_share_a_batch_however_long_their_items_are(several, items, batches):
    gate = Letters()
    queries = [item.split(":") for item in items.split()]
    futures, batcher = gate.run(*queries)
    assert [future.result(10) for future in futures] == [item.upper() for _, item in queries]
    assert gate.batches == batches
    batcher.close()


def test_batches_of_backlogs_are_small(several):
    """A newcomer waits for the end of a small batch, unless peers with a single item fill it."""
    gate = Letters(limits=(2, 8))
    backlogs = [(peer, "x") for peer in 5 * "bcd"]
    futures, batcher = gate.run(("a", "k"), *backlogs)
    assert [future.result(10) for future in futures] == ["K", *15 * "X"]
    assert [len(batch) for batch in gate.batches] == [1, 6, 2, 2, 2, 3]
    batcher.close()


def test_a_peer_that_is_alone_has_its_items_run_whole():
    gate = Letters()
    futures, batcher = gate.run(("a", "k"), ("a", "abcdefg"), ("a", "hi"))
    assert [future.result(10) for future in futures] == ["K", "ABCDEFG", "HI"]
    assert gate.batches == [["k"], ["abcdefg"], ["hi"]]
    batcher.close()


def test_an_item_of_which_a_part_fails_is_run_no_further(several):
    gate = Letters()
    futures, batcher = gate.run(("a", "k"), ("b", "ab!defgh"), ("a", "l"), ("b", "ij"))
    assert str(futures[1].exception(10)) == "bad"
    assert [futures[i].result(10) for i in (0, 2, 3)] == ["K", "L", "IJ"]
    assert gate.batches == [["k"], ["ab", "l"], ["!def"], ["ij"]]
    batcher.close()


def test_an_error_of_joining_fails_its_item_alone(several):
    """The worker continues."""
    gate = Letters()
    gate.join = lambda results: 1 / 0
    futures, batcher = gate.run(("a", "k"), ("b", "abcdefg"), ("a", "l"))
    assert isinstance(futures[1].exception(10), ZeroDivisionError)
    assert batcher.submit("m", 10.0).result(10) == "M"
    batcher.close()


def test_an_item_whose_parts_do_not_match_runs_again(several):
    gate = Letters()
    gate.join = lambda results: None
    futures, batcher = gate.run(("a", "k"), ("b", "abcdefg"))
    assert futures[1].result(10) == "abcdefg again"
    batcher.close()


def test_an_item_runs_again_only_before_its_deadline(several):
    def join_late(results):
        time.sleep(0.3)

    gate = Letters()
    gate.join = join_late
    futures, batcher = gate.run(("a", "k"), ("b", "abcdefg"), timeout=0.25)
    with pytest.raises(LateError):
        futures[1].result(10)
    batcher.close()


def test_a_query_whose_deadline_passed_is_not_computed(gate):
    batcher = Batcher(gate, size=4, window=0.0, depth=4)
    running(batcher, gate)
    late = batcher.submit(1, 0.001)
    patient = batcher.submit(2, 10.0)
    time.sleep(0.02)
    gate.go.set()
    assert patient.result(10) == 20
    with pytest.raises(LateError, match="deadline"):
        late.result(10)
    assert gate.batches == [[0], [2]]
    batcher.close()


def test_a_lone_item_runs_in_its_callers_thread_and_a_crowd_in_another():
    threads = []
    go = threading.Event()

    def run(items, queued):
        threads.append(threading.get_ident())
        assert len(threads) == 1 or go.wait(10)
        return items

    batcher = Batcher(run, size=4, window=0.0, depth=4)
    alone = threading.get_ident()
    assert batcher.submit(1, 10.0).result(0) == 1
    pool = ThreadPoolExecutor(1)
    held = pool.submit(batcher.submit, 2, 10.0)
    while len(threads) < 2:
        time.sleep(0.001)
    crowd = [batcher.submit(i, 10.0) for i in (3, 4)]
    go.set()
    assert [future.result(10) for future in (held.result(10), *crowd)] == [2, 3, 4]
    assert threads[0] == alone
    assert threads[2] not in (alone, threads[1])
    assert len(threads) == 3
    batcher.close()
    pool.shutdown()


def test_a_failure_reaches_its_own_batch_alone():
    def run(items, queued):
        if "bad" in items:
            raise ZeroDivisionError
        return [CongraspError("refused") if item == "odd" else item for item in items]

    batcher = Batcher(run, size=1, window=0.0, depth=4)
    bad, odd, good = (batcher.submit(item, 10.0) for item in ("bad", "odd", "good"))
    assert isinstance(bad.exception(10), ZeroDivisionError)
    assert str(odd.exception(10)) == "refused"
    assert good.result(10) == "good"
    batcher.close()


def test_closing_refuses_waiting_and_new_items(gate):
    batcher = Batcher(gate, size=1, window=0.0, depth=4)
    first = running(batcher, gate)
    waiting = batcher.submit(1, 10.0)
    closing = threading.Thread(target=batcher.close)
    closing.start()
    with pytest.raises(CongraspError, match="shutting down"):
        while True:
            batcher.submit(2, 10.0)
            time.sleep(0.001)
    gate.go.set()
    assert first.result(10) == 0
    with pytest.raises(CongraspError, match="shutting down"):
        waiting.result(10)
    closing.join(10)
    assert not closing.is_alive()


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(), max_size=60), st.integers(1, 8), st.sampled_from([0.0, 0.001]))
def test_every_item_gets_its_own_answer(items, size, window):
    seen = []

    def run(batch, queued):
        seen.extend(batch)
        assert 1 <= len(batch) <= size
        return [-item for item in batch]

    batcher = Batcher(run, size=size, window=window, depth=len(items) + 1)
    futures = [batcher.submit(item, 10.0) for item in items]
    assert [future.result(10) for future in futures] == [-item for item in items]
    assert seen == items
    batcher.close()
