"""One actor that means harm, in a process of its own, beside an honest one: the run goes on, and status works."""

import os
import subprocess
import sys

import pytest

from tests.attackers import ATTACKS
from tests.cluster import ROOT

SLOW = ("show_tokens", "publish_logs")  # the hub's own tests have tokens by the thousand


@pytest.mark.parametrize("what", [pytest.param(what, marks=[pytest.mark.slow] * (what in SLOW)) for what in ATTACKS])
def test_the_run_goes_on_beside_an_attacker(cluster, what):
    learner = cluster.start_learner()
    command = [sys.executable, str(ROOT / "tests" / "attackers.py"), what, cluster.endpoint, "chaos"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    attacker = subprocess.Popen(command, env=environment, stderr=(cluster.folder / "attacker.log").open("ab"))
    cluster.processes.append(attacker)
    works = {
        "hold_tickets": lambda status: status["counters"]["running"] >= 2,
        "show_tokens": lambda status: status["unlisted"] > 3000,
        "send_nonsense": lambda status: status["counters"]["rejected"] > 20,
        "publish_logs": bool,
    }
    cluster.wait(works[what], timeout=60.0)  # it has what it wants before the honest one comes
    cluster.start_actor("0.a")
    status = cluster.wait_for_updates(30, timeout=45.0)
    assert attacker.poll() is None and "0.a" in {role["id"] for role in status["roles"]}
    attacker.kill()
    final, _ = cluster.stop(learner)
    assert {actor for actor, *_ in final["history"]} == {"0.a"}
    assert (final["counters"]["damaged"] > 0) == (what == "send_nonsense")
