"""Actors and servers wait for a learner that is late, restarts, or is cut off; an actor that is
gone without a word is replaced under the same name.
"""

import signal
import subprocess
import sys
import threading
import time

import pytest

from congrasp.common.errors import TransportError
from congrasp.common.transport import urls
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.ports import local_url
from congrasp.common.wire.codec import Message
from tests.cluster import assert_books_balance
from tests.partition import cuttable

pytestmark = pytest.mark.timeout(600)
KILLS = 6
PARTITION_SECONDS = 65.0


def rollouts(status):
    """Accepted rollouts by (actor, incarnation)."""
    roles = [role for role in status["roles"] if role["role"] == "actor"]
    return {(role["id"], role["incarnation"]): role.get("rollouts", 0) for role in roles}


def replace_a_silent_actor(cluster, silence):
    """Silences an actor, starts another one of its name, and returns when that has contributed."""
    before = cluster.wait(lambda status: rollouts(status))
    silence()
    cluster.start_actor("a")
    cluster.wait(
        lambda status: any(
            count
            for owner, count in rollouts(status).items()
            if owner[0] == "a" and owner not in rollouts(before)
        )
    )


def test_a_frozen_actor_is_replaced_under_its_name(cluster):
    learner = cluster.start_learner()
    actor = cluster.start_actor("a")
    cluster.wait(lambda status: any(rollouts(status).values()))
    replace_a_silent_actor(cluster, lambda: actor.send_signal(signal.SIGSTOP))
    assert_books_balance(cluster.stop(learner)[0])


def test_an_actor_behind_a_cut_link_is_replaced_under_its_name(cluster):
    learner = cluster.start_learner()
    with cuttable(cluster.endpoint) as link:
        cluster.start_actor("a", endpoint=link.endpoint)
        cluster.wait(lambda status: any(rollouts(status).values()))
        replace_a_silent_actor(cluster, link.cut)
        link.heal()
        assert_books_balance(cluster.stop(learner)[0])


@pytest.mark.slow
def test_twenty_half_open_actors_are_replaced_under_their_name(cluster):
    learner = cluster.start_learner()
    for _ in range(20):
        with cuttable(cluster.endpoint) as link:
            cluster.start_actor("a", endpoint=link.endpoint)
            cluster.wait(lambda status: any(rollouts(status).values()))
            replace_a_silent_actor(cluster, link.cut)
            for process in cluster.processes[-2:]:
                process.kill()
                process.wait()
        cluster.wait(lambda status: not rollouts(status))
    assert_books_balance(cluster.stop(learner)[0])


@pytest.mark.slow
@pytest.mark.parametrize("isolated", ["a", "ab"])
def test_actors_cut_off_for_over_a_minute_come_back(cluster, isolated):
    """One of two, or the learner from both."""
    learner = cluster.start_learner()
    with cuttable(cluster.endpoint) as link:
        for name in "ab":
            endpoint = link.endpoint if name in isolated else cluster.endpoint
            cluster.start_actor(name, endpoint=endpoint)
        before = cluster.wait(
            lambda status: len(rollouts(status)) == 2 and all(rollouts(status).values())
        )
        link.cut()
        cluster.wait(lambda status: len(rollouts(status)) == 2 - len(isolated))
        time.sleep(PARTITION_SECONDS)
        link.heal()
        back = cluster.wait(lambda status: len(rollouts(status)) == 2)
        assert rollouts(back).keys() == rollouts(before).keys()
        for owner, count in rollouts(back).items():
            cluster.wait(
                lambda status, owner=owner, count=count: rollouts(status).get(owner, 0) > count
            )
        assert_books_balance(cluster.stop(learner)[0])


@pytest.mark.slow
def test_a_client_cut_off_for_over_a_minute_is_answered_again():
    endpoint = local_url()
    key = Keys("policy").health
    with urls.listen(endpoint, "server") as server, cuttable(endpoint) as link:
        server.serve(key, lambda key, request: Message({}, {"ready": True}))
        with urls.connect(link.endpoint, "client") as client:
            assert client.query(key, Message(), timeout=10.0).meta["ready"]
            link.cut()
            with pytest.raises(TransportError):
                client.query(key, Message(), timeout=1.0)
            time.sleep(PARTITION_SECONDS)
            link.heal()
            while not is_answered(client, key):
                pass


def is_answered(client, key):
    try:
        return bool(client.query(key, Message(), timeout=1.0).meta["ready"])
    except TransportError:
        time.sleep(0.1)
        return False


@pytest.mark.slow
def test_the_bound_on_lag_holds_after_six_kills_of_the_learner(cluster):
    """The audit of `Cluster.stop` compares every rollout that was used with the bound."""
    cluster.options["pause"] = 0.05
    learner = cluster.start_learner(every=3)
    for name in ("a", "b"):
        cluster.start_actor(name)
    for _ in range(KILLS):
        cluster.wait_for_updates(4)
        learner.kill()
        learner.wait(5)
        learner = cluster.start_learner(every=3)
    cluster.wait_for_updates(4)
    _, counts = cluster.stop(learner)
    assert counts["above the limit on lag"] == 0


@pytest.mark.parametrize("role", ["actor", "serve"])
def test_a_process_without_a_learner_waits_and_ends_with_its_reason(tmp_path, role):
    url = local_url()
    command = [sys.executable, "-m", "congrasp", role, "--connect", url, "--run", "r"]
    if role == "serve":
        command += ["--listen", local_url()]
    lines = []
    waiting = threading.Event()
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=tmp_path
    ) as process:
        for line in process.stdout:
            lines.append(line)
            if url in line and not waiting.is_set():
                waiting.set()
                process.send_signal(signal.SIGTERM)
    assert waiting.is_set(), lines
    assert process.returncode == 128 + signal.SIGTERM, lines
    assert f"The {'server' if role == 'serve' else role} ends: stopped by SIGTERM." in lines[-1]


@pytest.mark.parametrize("role", ["actor", "serve"])
def test_patience_limits_the_wait(tmp_path, role):
    url = local_url()
    done = subprocess.run(
        [sys.executable, "-m", "congrasp", role, "--connect", url, "--patience", "0.5"],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=tmp_path,
        check=False,
    )
    assert done.returncode == 4, done.stderr
    assert url in done.stderr.splitlines()[-1], done.stderr
