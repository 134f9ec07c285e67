"""The queue before the policy: every query is answered once, and too many are told so at once."""

import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from congrasp.common.errors import CongraspError, LateError, OverloadedError
from congrasp.services.serve.batching import Batcher, Parts


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
    threading.Thread(target=lambda: answer.set_result(batcher.submit(0, 10.0).result(10)), daemon=True).start()
    assert gate.entered.acquire(timeout=10)
    return answer


def test_what_arrives_during_a_batch_makes_the_next_one(gate):
    batcher = Batcher(gate, seconds={4: 1.0}, window=0.0, depth=10)
    futures = [running(batcher, gate)]
    futures += [batcher.submit(i, 10.0) for i in range(1, 7)]
    gate.go.set()
    assert [future.result(10) for future in futures] == [0, 10, 20, 30, 40, 50, 60]
    assert gate.batches == [[0], [1, 2, 3, 4], [5, 6]]
    batcher.close()


def test_one_too_many_is_refused_at_once_and_the_others_are_answered(gate):
    batcher = Batcher(gate, seconds={4: 1.0}, window=0.0, depth=2)
    futures = [running(batcher, gate)]
    futures += [batcher.submit(i, 10.0) for i in (1, 2)]
    with pytest.raises(OverloadedError, match="Overloaded: 2 queries are queued"):
        batcher.submit(3, 10.0)
    gate.go.set()
    assert [future.result(10) for future in futures] == [0, 10, 20]
    batcher.close()


def test_peers_take_turns_and_one_that_asks_without_end_is_refused_alone(gate):
    batcher = Batcher(gate, seconds={2: 1.0}, window=0.0, depth=10, share=3)
    futures = [running(batcher, gate)]
    futures += [batcher.submit(i, 10.0, peer="greedy") for i in (1, 2, 3)]
    for refuse in (lambda: batcher.submit(4, 10.0, peer="greedy"), lambda: batcher.check_room("greedy")):
        with pytest.raises(OverloadedError, match="Overloaded: 3 of your queries are queued"):
            refuse()
    batcher.check_room("modest")
    futures += [batcher.submit(i, 10.0, peer="modest") for i in (7, 8)]
    gate.go.set()
    assert [future.result(10) for future in futures] == [0, 10, 20, 30, 70, 80]
    assert gate.batches == [[0], [1, 7], [2, 8], [3]]
    batcher.close()


@pytest.fixture
def several(monkeypatch):
    """However long ago another peer has asked, it counts."""
    monkeypatch.setattr("congrasp.services.serve.batching._RECENT", 1e6)


class Letters(Gate):
    """Items are texts, whose letters are what they weigh, and are run one by one."""

    seconds, depth = {2: 1.0, 8: 1.6}, 10  # eight letters take less time than four times two

    def __call__(self, items, queued):
        self.entered.release()
        assert self.go.wait(10)
        self.batches.append(list(items))
        return [CongraspError("bad") if "!" in item else item.upper() for item in items]

    def batcher(self):
        parts = Parts(len, lambda item, first, end: item[first:end], lambda item, results: "".join(results))
        return Batcher(self, seconds=self.seconds, window=0.0, depth=self.depth, parts=parts)

    def run(self, *items):
        """Submits (peer, item) while the first is held back; their futures."""
        batcher, first = self.batcher(), Future()
        (peer, item), *rest = items
        threading.Thread(target=lambda: first.set_result(batcher.submit(item, 10.0, peer)), daemon=True).start()
        assert self.entered.acquire(timeout=10)
        futures = [batcher.submit(item, 10.0, peer) for peer, item in rest]
        self.go.set()
        return [first.result(10), *futures], batcher


def test_a_long_item_is_run_in_parts_beside_another_peers(several):
    gate = Letters()
    futures, batcher = gate.run(("a", "k"), ("b", "abcdefg"), ("a", "l"), ("b", "hi"), ("a", "mno"))
    assert [future.result(10) for future in futures] == ["K", "ABCDEFG", "L", "HI", "MNO"]
    assert gate.batches == [["k"], ["ab"], ["l", "m"], ["cd"], ["no"], ["ef"], ["g", "h"], ["i"]]
    batcher.close()


def test_the_peer_that_has_had_least_comes_next_however_long_its_items_are(several):
    gate = Letters()
    futures, batcher = gate.run(("a", "k"), ("b", "abcdefg"), ("c", "tuvwxyz"), ("a", "l"))
    assert [future.result(10) for future in futures] == ["K", "ABCDEFG", "TUVWXYZ", "L"]
    assert gate.batches == [["k"], ["ab"], ["tu"], ["l", "c"], ["vw"], ["de"], ["xy"], ["fg"], ["z"]]
    batcher.close()


def test_a_peer_that_is_alone_has_batches_as_large_as_they_are_quick():
    gate = Letters()
    futures, batcher = gate.run(("a", "k"), ("a", "abcdefg"), ("a", "hi"))
    assert [future.result(10) for future in futures] == ["K", "ABCDEFG", "HI"]
    assert gate.batches == [["k"], ["abcdefg", "h"], ["i"]]  # 9 letters: 1.6 s and 1.6 s, for 5 times 1 s
    batcher.close()


def test_short_items_of_many_are_batched_and_a_few_run_one_after_another(several):
    gate = Letters()
    gate.seconds = {1: 1.0, 8: 3.0}
    futures, batcher = gate.run(*((peer, peer) for peer in "abcdefghijk"))
    assert [future.result(10) for future in futures] == list("ABCDEFGHIJK")
    assert gate.batches == [["a"], list("bcdefghi"), ["j"], ["k"]]
    batcher.close()


def test_a_full_queue_lets_a_short_item_in_for_the_longest(several):
    gate = Letters()
    gate.depth = 3
    futures, batcher = gate.run(("a", "k"), ("b", "bcd"), ("c", "cdefg"), ("d", "def"), ("e", "ef"))
    with pytest.raises(OverloadedError, match="Overloaded: 3 shorter queries are queued"):
        futures[2].result(10)
    assert [futures[i].result(10) for i in (0, 1, 3, 4)] == ["K", "BCD", "DEF", "EF"]
    batcher.close()


def test_long_items_take_half_of_the_time_alongside_short_ones(several):
    """A part takes 0.1 s, and so does the rest after it, in which a short item runs at once in its caller's thread."""
    began, threads = [], []

    def run(items, queued):
        began.append(time.monotonic())
        threads.append(threading.current_thread())
        time.sleep(0.1 if "b" <= items[0] <= "d" else 0.0)
        return items

    parts = Parts(len, lambda item, first, end: item[first:end], lambda item, results: "".join(results))
    batcher = Batcher(run, seconds={1: 1.0, 8: 8.0}, window=0.0, depth=9, parts=parts)
    assert batcher.submit("k", 10.0, "a").result(10) == "k"
    assert batcher.submit("bcd", 10.0, "b").result(10) == "bcd"
    assert len(began) == 4 and began[2] - began[1] >= 0.2  # the last part is as short as the short item
    batcher._rested = time.monotonic() + 60.0
    long = batcher.submit("ef", 10.0, "b")
    assert batcher.submit("l", 10.0, "a").result(0) == "l" and threads[-1] is threading.current_thread()
    assert not long.done()
    batcher._rested = 0.0
    assert batcher.submit("m", 10.0, "a").result(10) == "m" and long.result(10) == "ef"
    batcher.close()


def test_an_item_of_which_a_part_fails_is_run_no_further(several):
    gate = Letters()
    futures, batcher = gate.run(("a", "k"), ("b", "ab!defgh"), ("a", "l"), ("b", "ij"))
    assert str(futures[1].exception(10)) == "bad"
    assert [futures[i].result(10) for i in (0, 2, 3)] == ["K", "L", "IJ"]
    assert gate.batches == [["k"], ["ab"], ["l", "!"], ["ij"]]
    batcher.close()


def test_a_query_whose_deadline_passed_is_not_computed(gate):
    batcher = Batcher(gate, seconds={4: 1.0}, window=0.0, depth=4)
    running(batcher, gate)
    late, patient = batcher.submit(1, 0.001), batcher.submit(2, 10.0)
    time.sleep(0.02)
    gate.go.set()
    assert patient.result(10) == 20
    with pytest.raises(LateError, match="deadline"):
        late.result(10)
    assert gate.batches == [[0], [2]]
    batcher.close()


def test_a_lone_item_runs_in_its_callers_thread_and_a_crowd_in_another():
    threads, go = [], threading.Event()

    def run(items, queued):
        threads.append(threading.get_ident())
        assert len(threads) == 1 or go.wait(10)
        return items

    batcher = Batcher(run, seconds={4: 1.0}, window=0.0, depth=4)
    alone = threading.get_ident()
    assert batcher.submit(1, 10.0).result(0) == 1
    pool = ThreadPoolExecutor(1)
    held = pool.submit(batcher.submit, 2, 10.0)
    while len(threads) < 2:
        time.sleep(0.001)
    crowd = [batcher.submit(i, 10.0) for i in (3, 4)]
    go.set()
    assert [future.result(10) for future in (held.result(10), *crowd)] == [2, 3, 4]
    assert threads[0] == alone and threads[2] not in (alone, threads[1]) and len(threads) == 3
    batcher.close()
    pool.shutdown()


def test_a_failure_reaches_its_own_batch_alone():
    def run(items, queued):
        if "bad" in items:
            raise ZeroDivisionError
        return [CongraspError("refused") if item == "odd" else item for item in items]

    batcher = Batcher(run, seconds={1: 1.0}, window=0.0, depth=4)
    bad, odd, good = (batcher.submit(item, 10.0) for item in ("bad", "odd", "good"))
    assert isinstance(bad.exception(10), ZeroDivisionError)
    assert str(odd.exception(10)) == "refused"
    assert good.result(10) == "good"
    batcher.close()


def test_closing_refuses_what_waits_and_what_comes(gate):
    batcher = Batcher(gate, seconds={1: 1.0}, window=0.0, depth=4)
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

    batcher = Batcher(run, seconds={size: 1.0}, window=window, depth=len(items) + 1)
    futures = [batcher.submit(item, 10.0) for item in items]
    assert [future.result(10) for future in futures] == [-item for item in items]
    assert seen == items
    batcher.close()
