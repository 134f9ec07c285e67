"""Outcomes of rollouts when real processes are killed and stopped, links and disks are slow, and
clocks jump.

Every test ends with the audit of `Cluster.stop`: nothing that was accepted is lost, duplicated or
corrupted, and nothing was learnt from that is older than the cap.
"""

import itertools
import random
import signal
import time

import pytest

from congrasp.common.io.journal import AUDIT, read_journal
from congrasp.learner.hub.write_ahead import FOLDER
from tests.benchmarks.attackers import throttled
from tests.cluster import assert_books_balance

pytestmark = pytest.mark.timeout(300)


def contributions(status):
    return {role["id"]: role["rollouts"] for role in status["roles"] if "rollouts" in role}


def actors(status):
    return {role["incarnation"] for role in status["roles"] if role["role"] == "actor"}


def taken_up(folder):
    """Rollouts that sessions of the learner took up from those before them."""
    lines = read_journal(folder / AUDIT / "learner-0.jsonl").intact
    return list(map(tuple, itertools.chain(*(line.get("taken", ()) for line in lines))))


def stop_with_rollouts(cluster, learner):
    """Stops the learner (SIGSTOP) while it has accepted rollouts on disk that it has not used."""
    while True:
        cluster.wait(lambda status: status["queue"]["length"])
        learner.send_signal(signal.SIGSTOP)
        if any((cluster.folder / FOLDER).rglob("*.safetensors")):
            return
        # On a busy machine it used them after it had answered.
        learner.send_signal(signal.SIGCONT)


def test_a_killed_learner_costs_no_rollout(cluster):
    """Killed with rollouts in its queue and in its update, each time; the next takes them up, and
    uses each once.
    """
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
    assert (
        counts["used"] + counts.get("waiting", 0) + counts.get("dropped", 0) == counts["accepted"]
    )
    # What a learner refused as stale before it died is a gap for the next one.
    assert final["counters"]["missing"] <= counts["made"] - counts["accepted"]
    assert_books_balance(final)
    finished = 0
    unknown = 0
    for name in ("a", "b"):
        outcomes = cluster.outcomes(name)
        assert sorted(entry["sequence"] for entry in outcomes) == list(range(len(outcomes)))
        undecided = {entry["sequence"] for entry in outcomes if entry["outcome"] == "unknown"}
        taken = {
            entry["sequence"] for entry in outcomes if entry["outcome"] in ("accepted", "duplicate")
        }
        assert len(undecided) <= 2  # on their way when the learner ended
        assert {
            sequence for actor, _, sequence in final["history"] if actor == name
        } <= taken | undecided
        finished, unknown = finished + len(outcomes), unknown + len(undecided)
    ledger = final["counters"]
    assert (
        finished - unknown
        <= sum(ledger[name] for name in ("consumed", "dropped", "queued", "stale", "missing"))
        <= finished
    )


def test_acknowledged_rollouts_survive_the_death_of_all_processes(cluster):
    """No process is left that could send anything again; others continue in their place."""
    cluster.options["pause"] = 0.05
    learner = cluster.start_learner(every=2)
    started = [cluster.start_actor(name) for name in "ab"]
    cluster.wait_for_updates(4)
    stop_with_rollouts(cluster, learner)
    for process in (learner, *started):
        process.kill()
    learner.wait(5)
    learner = cluster.start_learner()
    cluster.start_actor("last")
    cluster.wait(lambda status: contributions(status).get("last", 0) > 2)
    cluster.stop(learner)
    assert taken_up(cluster.folder)


def test_an_actor_killed_while_it_uploads_leaves_nothing_behind(cluster):
    cluster.options["steps"] = 2000  # a rollout has about 2.8 MB, and one is always on its way
    learner = cluster.start_learner()
    for _ in range(2):
        actor = cluster.start_actor()
        before = cluster.wait(lambda status: len(actors(status)) == 1)["counters"]["accepted"]
        cluster.wait(lambda status, before=before: status["counters"]["accepted"] >= before + 4)
        time.sleep(random.uniform(0, 0.05))
        actor.send_signal(signal.SIGKILL)
        status = cluster.wait(lambda status: not actors(status))
        assert status["counters"]["running"] == 0
    assert cluster.status()["counters"]["damaged"] == 0
    final, _ = cluster.stop(learner)
    assert_books_balance(final)
    history = {tuple(identity[1:]) for identity in final["history"]}
    acknowledged = {
        (entry["incarnation"], entry["sequence"])
        for entry in cluster.outcomes()
        if entry["outcome"] == "accepted"
    }
    # All that was acknowledged was learnt from, or waited at the end.
    assert len(acknowledged - history) <= final["counters"]["queued"] + final["counters"]["dropped"]
    assert len({incarnation for incarnation, _ in history}) == 2


def test_a_suspended_actor_blocks_no_other_and_returns(cluster):
    """Its connection stays open and silent."""
    learner = cluster.start_learner()
    actor = cluster.start_actor("a")
    cluster.start_actor("b")
    cluster.wait(
        lambda status: (
            min(contributions(status).values(), default=0) > 1 and len(actors(status)) == 2
        )
    )
    actor.send_signal(signal.SIGSTOP)
    before = cluster.wait(lambda status: len(actors(status)) == 1)
    assert "b" in contributions(before)
    cluster.wait(lambda status: contributions(status)["b"] >= contributions(before)["b"] + 4)
    actor.send_signal(signal.SIGCONT)
    back = cluster.wait(lambda status: "a" in contributions(status))
    cluster.wait(lambda status: contributions(status).get("a", 0) > contributions(back)["a"])
    assert_books_balance(cluster.stop(learner)[0])
    assert actor.wait(10) == 0


@pytest.mark.slow
def test_a_learner_that_is_stopped_for_fifteen_seconds_continues_with_all_actors(cluster):
    learner = cluster.start_learner()
    for name in ("a", "b"):
        cluster.start_actor(name)
    cluster.wait(lambda status: len(contributions(status)) == 2)
    learner.send_signal(signal.SIGSTOP)
    time.sleep(15)
    learner.send_signal(signal.SIGCONT)
    before = contributions(cluster.wait(lambda status: len(contributions(status)) == 2))
    cluster.wait(
        lambda status: all(
            contributions(status).get(name, 0) > count for name, count in before.items()
        )
    )
    cluster.stop(learner)


@pytest.mark.slow
def test_a_slow_link_slows_its_actor_alone(cluster):
    """Two rollouts take some five seconds, longer than the three that the actor allows other
    requests.
    """
    cluster.options["steps"] = 400  # 560 kB
    learner = cluster.start_learner(pause=0.3)
    with throttled(cluster.endpoint, 220e3) as slow:
        cluster.start_actor("slow", endpoint=slow)
        cluster.start_actor("fast")
        cluster.wait(lambda status: contributions(status).get("fast", 0) > 3)
        cluster.wait_for_updates(3)  # for which none has to wait
        status = cluster.wait(lambda status: cluster.outcomes("slow"))
        assert {entry["outcome"] for entry in cluster.outcomes("slow")} <= {"accepted", "stale"}
        assert status["counters"]["duplicate"] == 0  # once is enough
        cluster.stop(learner)


def test_a_disk_slower_than_an_actor_waits_costs_no_rollout(cluster):
    """Uploads time out although the rollout has arrived, and are sent again."""
    learner = cluster.start_learner(disk=0.6)
    cluster.start_actor(request_timeout=0.3)
    status = cluster.wait_for_updates(2)
    assert status["counters"]["duplicate"] > 0
    # A rollout that another one has overtaken is missing until it arrives, a lost one for ever.
    cluster.wait(lambda status: status["counters"]["missing"] == 0)
    cluster.stop(learner)


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
