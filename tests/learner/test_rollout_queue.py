"""Accepted rollouts of a learner: deduplication, and what a checkpoint knows of them."""

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings

from congrasp.common.errors import CongraspError
from congrasp.learner.hub.queue import Sequences
from tests.learner.hub_bench import bundle, sequences


def test_resumed_hub_knows_used_and_counts_lost_rollouts(bench):
    b = bench(version=3, batch=3)
    for i in range(5):
        assert b.send(i, version=3)["outcome"] == "accepted"
    assert sequences(b.rollouts.next_batch(3, 1)) == [0, 1, 2]  # 3 and 4 wait
    b.hub.publish_weights(bundle(4), 4)
    durable = b.rollouts.durable()
    assert b.send(5, version=4)["outcome"] == "accepted"  # and then the learner is killed

    resumed = bench(batch=3, durable=durable)
    assert resumed.send(2, version=4)["outcome"] == "retry"  # its weights are not there yet
    resumed.hub.publish_weights(bundle(4), 4)
    assert resumed.rollouts.session_id != b.rollouts.session_id
    assert resumed.ledger()["accepted"] == resumed.ledger()["consumed"] == 3
    assert resumed.send(2, version=3)["outcome"] == "duplicate"
    # The actor goes on where it was: 3, 4 and 5 were acknowledged, and are gone with the killed
    # learner.
    assert resumed.send(7, version=4)["outcome"] == "accepted"
    assert resumed.send(6, version=4)["outcome"] == "accepted"
    assert resumed.send(6, version=4)["outcome"] == "duplicate"
    ledger = resumed.ledger()
    assert ledger["accepted"] == 5
    assert ledger["consumed"] == 3
    assert ledger["queued"] == 2
    assert ledger["missing"] == 3
    again = bench(version=5, batch=3, durable=resumed.rollouts.durable())
    assert again.send(8, version=5)["outcome"] == "accepted"
    # 6 and 7 were waiting as well
    assert again.ledger()["missing"] == 5
    assert again.ledger()["accepted"] == 4
    with pytest.raises(CongraspError, match="run id e, not f"):
        bench(run_id="f", durable=durable)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 40), st.booleans()), max_size=120))
def test_deduplication_is_exact_within_its_window(arrivals):
    decisions = Sequences()
    decided = {}
    for sequence, accepted in arrivals:
        assert (sequence in decisions) == (sequence in decided)
        assert (sequence in decisions.refused) == (decided.get(sequence) is False)
        if sequence not in decided:
            decisions.add(_header(sequence), accepted)
            decided[sequence] = accepted
        assert decisions.missing == max(decided) + 1 - len(decided)
    assert decisions.rollouts == sum(decided.values())


def test_deduplication_memory_is_bounded():
    decisions = Sequences(granted=20_000)
    for sequence in range(1, 20_000, 2):
        decisions.add(_header(sequence), sequence % 3 > 0)
        assert len(decisions.ahead) <= 64
        assert len(decisions.refused) <= 64
    assert 19_999 in decisions
    assert 20_001 not in decisions
    assert decisions.missing == 10_000


def test_invented_sequence_numbers_do_not_inflate_missing(bench):
    b = bench(version=0, batch=100)
    assert b.send(0, version=0)["outcome"] == "accepted"
    made_up = [number * 10**12 for number in range(1, 71)]
    for sequence in made_up:
        assert b.send(sequence, version=7)["outcome"] == "stale"  # of a version that there will be
    assert b.ledger()["missing"] <= 64 + 71  # what may overtake, and tickets
    assert b.send(made_up[-1], version=0)["outcome"] == "stale"  # still
    # Whose size is bounded though sequence 0 waits
    resumed = bench(batch=100, durable=b.rollouts.durable())
    assert resumed.ledger()["missing"] <= 2 * 64 + 71


def test_decisions_after_the_checkpoint_count_as_missing(bench):
    b = bench(version=5, batch=2)
    assert b.send(0, version=0)["outcome"] == "stale"
    assert b.send(2, version=5)["outcome"] == b.send(3, version=5)["outcome"] == "accepted"
    assert sequences(b.rollouts.next_batch(2, 1)) == [2, 3]
    b.hub.publish_weights(bundle(6), 6)
    assert b.ledger()["missing"] == 1
    durable = b.rollouts.durable()
    # Overtaken by 2 and 3, and lost with this learner
    assert b.send(1, version=6)["outcome"] == "accepted"
    assert b.ledger()["missing"] == 0
    resumed = bench(version=6, batch=2, durable=durable)
    assert resumed.send(0, version=6)["outcome"] == "stale"  # as before
    assert resumed.send(4, version=6)["outcome"] == "accepted"
    ledger = resumed.ledger()
    assert ledger["consumed"] == 2
    assert ledger["queued"] == 1
    assert ledger["stale"] == 1
    assert ledger["missing"] == 1


def _header(sequence):
    from congrasp.common.wire.messages import RolloutHeader

    return RolloutHeader("a", "01", sequence, 0, "e", "s", 1)
