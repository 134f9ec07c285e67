"""Outcomes of accepted rollouts when processes are killed and stopped, links fail, and clocks jump.

Every test ends with the audit of `Cluster.stop`: nothing that was accepted is lost, duplicated or corrupted, and
nothing was learnt from that is older than the cap.
"""

import signal
import time

import pytest

from congrasp.common.io.journal import AUDIT, read_journal
from congrasp.common.wire.codec import Message
from congrasp.learner.hub.write_ahead import FOLDER
from congrasp.services.ops.audit import audit
from tests.benchmarks.second_reading import read_again
from tests.cluster import KEYS, A, Proxy, T, assert_books_balance, rollout

pytestmark = pytest.mark.timeout(300)


def names(status):
    return {role["id"] for role in status["roles"] if role["role"] == "actor"}


def contributions(status):
    return {role["id"]: role["rollouts"] for role in status["roles"] if "rollouts" in role}


def test_a_killed_learner_costs_nobody_a_rollout(cluster):
    """Killed with rollouts in its queue and in its update, each time; the next takes them up, and uses each once."""
    cluster.options["pause"] = 0.05
    learner = cluster.start_learner()
    for name in ("a", "b"):
        cluster.start_actor(name)
    for _ in range(2):
        cluster.wait_for_updates(3)
        cluster.wait(lambda status: status["queue"]["length"])
        learner.kill()
        learner.wait(5)
        learner = cluster.start_learner()
    cluster.wait_for_updates(3)
    final, counts = cluster.stop(learner)
    assert counts["used"] + counts.get("waiting", 0) + counts.get("dropped", 0) == counts["accepted"]
    # What a learner refused as stale before it died is a gap for the next one.
    assert final["counters"]["missing"] <= counts["made"] - counts["accepted"]
    assert_books_balance(final)
    made, unknown = 0, 0
    for name in ("a", "b"):
        outcomes = cluster.outcomes(name)
        assert sorted(entry["sequence"] for entry in outcomes) == list(range(len(outcomes)))
        asked = {entry["sequence"] for entry in outcomes if entry["outcome"] == "unknown"}
        taken = {entry["sequence"] for entry in outcomes if entry["outcome"] in ("accepted", "duplicate")}
        assert len(asked) <= 2  # on their way when the learner ended
        assert {sequence for actor, _, sequence in final["history"] if actor == name} <= taken | asked
        made, unknown = made + len(outcomes), unknown + len(asked)
    ledger = final["counters"]
    assert made - unknown <= sum(ledger[name] for name in ("consumed", "dropped", "queued", "stale", "missing")) <= made


def taken_up(folder):
    """Rollouts that sessions of the learner took up from those before them."""
    lines = read_journal(folder / AUDIT / "learner-0.jsonl").intact
    return [tuple(rollout) for line in lines for rollout in line.get("taken", ())]


def test_what_was_acknowledged_survives_the_death_of_learner_and_actors_together(cluster):
    """Nobody is left who could send anything again; others go on in their place."""
    cluster.options["pause"] = 0.05
    for attempt in range(2):
        learner = cluster.start_learner(every=2)
        actors = [cluster.start_actor(f"{name}{attempt}") for name in "ab"]
        cluster.wait_for_updates(4)
        cluster.wait(lambda status: status["queue"]["length"])
        for process in (*actors, learner):
            process.kill()
        learner.wait(5)
    learner = cluster.start_learner()
    cluster.start_actor("last")
    cluster.wait(lambda status: contributions(status).get("last", 0) > 2)
    cluster.stop(learner)
    assert len({actor for actor, *_ in taken_up(cluster.folder)}) >= 2
    assert read_again(cluster.folder)[:4] == (0, 0, 0, 0)


@pytest.mark.slow
def test_an_accepted_rollout_that_is_damaged_on_disk_is_neither_used_nor_called_lost(cluster):
    learner = cluster.start_learner(pause=1.0)
    actor = cluster.start_actor()
    cluster.wait(lambda status: status["queue"]["length"] >= 2)
    for process in (actor, learner):
        process.kill()
        process.wait(5)
    lines = read_journal(cluster.folder / AUDIT / "a.jsonl").intact
    last = max(line["answer"] for line in lines if line.get("outcome") == "accepted")
    (kept,) = (cluster.folder / FOLDER / "0").glob(f"*~a~*~{last}.safetensors")
    kept.write_bytes(kept.read_bytes()[:-1] + b"?")
    learner = cluster.start_learner()
    cluster.start_actor("b")
    cluster.wait(lambda status: contributions(status).get("b", 0) > 2)
    _, counts = cluster.stop(learner)
    assert counts["damaged on disk"] == 1 and ("a", last) not in {(a, n) for a, _, n in taken_up(cluster.folder)}
    assert audit(cluster.folder).exit_code == 6
    assert kept.with_name(kept.name + ".aside").exists()


@pytest.mark.slow
def test_without_a_write_ahead_log_a_killed_learner_takes_along_what_it_had(cluster):
    learner = cluster.start_learner(pause=0.5, write_ahead=False)
    cluster.start_actor()
    cluster.wait_for_updates(2)
    cluster.wait(lambda status: status["queue"]["length"])
    learner.kill()
    learner.wait(5)
    assert not (cluster.folder / FOLDER).exists()
    learner = cluster.start_learner(write_ahead=False)
    cluster.wait_for_updates(2)
    _, counts = cluster.stop(learner)
    assert counts.get("not kept on disk", 0) + counts.get("undone", 0) >= 1


def test_updates_that_die_before_a_checkpoint_are_undone_and_counted(cluster):
    learner = cluster.start_learner(every=1000)
    cluster.start_actor()
    cluster.wait_for_updates(12)  # of two rollouts each: far more than an actor still holds to send again
    learner.kill()
    learner.wait(5)
    cluster.checkpoint.write_text('{"durable": null, "history": [], "version": 0}')
    learner = cluster.start_learner(every=1)
    cluster.wait_for_updates(3)
    final, counts = cluster.stop(learner)
    assert counts["undone"] >= 4
    assert final["counters"]["undone"] >= counts["undone"]  # some of them were sent again in time


@pytest.mark.slow
def test_actors_and_learner_stopped_for_fifteen_seconds(cluster):
    learner = cluster.start_learner()
    stopped = cluster.start_actor("a")
    cluster.start_actor("b")
    cluster.wait(lambda status: len(contributions(status)) == 2)
    stopped.send_signal(signal.SIGSTOP)
    began = time.monotonic()
    status = cluster.wait(lambda status: names(status) == {"b"})
    before = status["counters"]["accepted"]
    cluster.wait(lambda status: status["counters"]["accepted"] >= before + 4)  # nobody waits for it
    learner.send_signal(signal.SIGSTOP)
    time.sleep(15)
    learner.send_signal(signal.SIGCONT)
    stopped.send_signal(signal.SIGCONT)
    assert time.monotonic() - began > 15
    before = cluster.wait(lambda status: len(contributions(status)) == 2)
    cluster.wait(
        lambda status: all(contributions(status).get(name, 0) > contributions(before)[name] for name in ("a", "b"))
    )
    cluster.stop(learner)


@pytest.fixture
def proxy(cluster):
    made = Proxy(cluster.port)
    yield made
    made.close()


@pytest.mark.slow
def test_a_link_that_goes_silent_is_noticed_and_comes_back(cluster, proxy):
    learner = cluster.start_learner()
    cluster.start_actor("a", endpoint=proxy.endpoint)
    cluster.start_actor("b")
    cluster.wait(lambda status: contributions(status).get("a", 0) > 3 and "b" in contributions(status))
    proxy.silence()
    status = cluster.wait(lambda status: names(status) == {"b"})
    before = status["counters"]["accepted"]
    status = cluster.wait(lambda status: status["counters"]["accepted"] >= before + 4)
    proxy.restore()
    came = cluster.wait(lambda status: "a" in contributions(status))
    cluster.wait(lambda status: contributions(status).get("a", 0) > contributions(came)["a"])
    cluster.stop(learner)


@pytest.mark.slow
def test_a_slow_link_slows_its_actor_alone(cluster, proxy):
    """Two rollouts take some five seconds, longer than the three that the actor allows other requests."""
    cluster.options["steps"] = 400  # 560 kB
    proxy.bytes_per_second = 220e3
    learner = cluster.start_learner(pause=0.3)
    cluster.start_actor("slow", endpoint=proxy.endpoint)
    cluster.start_actor("fast")
    cluster.wait(lambda status: "slow" in names(status) and contributions(status).get("fast", 0) > 3)
    cluster.wait_for_updates(3)  # for which nobody has to wait
    status = cluster.wait(lambda status: cluster.outcomes("slow"))
    assert {entry["outcome"] for entry in cluster.outcomes("slow")} <= {"accepted", "stale"}
    assert status["counters"]["duplicate"] == 0  # once is enough
    cluster.stop(learner)


def test_a_disk_slower_than_an_actor_waits_costs_no_rollout(cluster):
    """Uploads time out although the rollout has arrived, and are sent again."""
    learner = cluster.start_learner(disk=0.6)
    cluster.start_actor(request_timeout=0.3)
    status = cluster.wait_for_updates(3)
    assert status["counters"]["duplicate"] > 0
    final, _ = cluster.stop(learner)
    assert final["counters"]["missing"] == 0


@pytest.mark.slow
def test_wall_clocks_do_not_matter(cluster):
    """The clocks of learner and actor jump by weeks with every look at them."""
    learner = cluster.start_learner(clock="jumps")
    cluster.start_actor("a", clock="jumps")
    cluster.start_actor("b")
    cluster.wait_for_updates(10)
    status = cluster.wait(lambda status: min(contributions(status).values(), default=0) > 3)
    assert status["counters"]["expired"] == 0
    cluster.stop(learner)


def test_actors_of_another_version_or_hand_end_in_a_line_and_the_run_continues(cluster):
    """Their rollouts have another schema, or the arrays of a hand with more joints."""
    learner = cluster.start_learner()
    cluster.start_actor("a")
    cluster.wait_for_updates(1)
    kinds = {"version": {"schema": "t"}, "hand": {"actions": A + 3}}
    strangers = [cluster.start_actor(name, **kind) for name, kind in kinds.items()]
    assert [stranger.wait(240) for stranger in strangers] == [1, 1]
    errors = (cluster.folder / "actor.err").read_text().splitlines()
    assert sum("CongraspError" in line and "refused" in line for line in errors) == 2, errors
    for name in kinds:
        assert {entry["outcome"] for entry in cluster.outcomes(name)} <= {"refused", "unknown"}
    cluster.wait_for_updates(3)
    final, _ = cluster.stop(learner)
    assert final["counters"]["damaged"] > 0 and {actor for actor, *_ in final["history"]} == {"a"}


def test_replayed_rollouts_and_tickets_of_others_change_nothing(cluster):
    learner = cluster.start_learner(pause=0.2)
    cluster.start_actor()
    cluster.wait(lambda status: status["counters"]["accepted"] >= 4)
    (who,) = (role for role in cluster.status()["roles"] if role["id"] == "a")
    mine = {"actor": "a", "incarnation": who["incarnation"], "run_id": "e", "ticket": "x"}

    def replay(**meta):
        other = rollout(T, 77, cluster.status()["version"])  # under the name of one that was accepted
        message = Message(other.arrays, {**other.meta, **mine, **meta})
        return cluster.observer.query(KEYS.rollout("a"), message, timeout=5).meta["outcome"]

    assert [replay(sequence=sequence) for sequence in range(3)] == ["duplicate"] * 3
    assert replay(sequence=0, run_id="another") == "stale"
    asked = {"actor": "b", "incarnation": "01", "ticket": "y"}
    cluster.wait(
        lambda status: cluster.observer.query(KEYS.ticket("b"), Message(meta=asked), timeout=5).meta["granted"]
    )
    for thief in ({**asked, "actor": "c"}, {**asked, "incarnation": "02"}):
        cluster.observer.query(KEYS.ticket(thief["actor"]), Message(meta={**thief, "give_back": True}), timeout=5)
    assert cluster.status()["counters"]["returned"] == 0
    cluster.observer.query(KEYS.ticket("b"), Message(meta={**asked, "give_back": True}), timeout=5)
    assert cluster.status()["counters"]["returned"] == 1
    final, _ = cluster.stop(learner)
    assert final["counters"]["duplicate"] == 3
