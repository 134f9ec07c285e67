"""The examples' loops keep a simulated robot to its limits while their policy server is killed and
comes back.
"""

import contextlib
import time

import psutil
import pytest

import congrasp
from congrasp.common.policy import bundle as bundles
from tests.base_install import steady_server
from tests.benchmarks.robot import SEED, Rig
from tests.examples import example
from tests.task import HAND, TASK, heading_policy

SECONDS = 120.0
"""That a server has to start."""


@pytest.fixture(scope="module")
def loop():
    return example("robot_loop")


@pytest.fixture
def robot(loop):
    return loop.MujocoRobot(HAND, TASK, SEED, congrasp.JointLimits.of_hand(HAND))


def test_the_node_follows_a_server_and_opens_without_one(robot, tmp_path):
    """Over Zenoh, in a process of its own; nothing was lifted, so that the hand opens when the
    server has gone.
    """
    with contextlib.closing(Rig(tmp_path, robot, TASK)) as rig:
        with steady_server(HAND.name) as port:
            rig.begin(f"tcp/127.0.0.1:{port}", "--hold", "1.5")
            rig.run(lambda: "follow" in "".join(rig.lines) and rig.commands > 60, SECONDS)
        rig.run(lambda: rig.lines[-1].startswith("open:"), SECONDS)
        commands = rig.commands
        rig.run(lambda: rig.commands > commands + 50, SECONDS)
        assert any(line.startswith("hold:") for line in rig.lines)
    assert robot.beyond <= 0.0
    assert robot.strongest <= 1.0 + 1e-6


def test_joints_stay_in_limits_while_the_server_restarts(loop, robot, tmp_path):
    bundles.save(heading_policy(), tmp_path / "policy.safetensors")
    limits = congrasp.JointLimits.of_hand(HAND)
    robot.reset()
    server = loop.Server(tmp_path / "policy.safetensors")
    try:
        client = congrasp.PolicyClient(server.url, hand=HAND.name, timeout=0.2, wait=SECONDS)
        client.metadata()
        with congrasp.Guard(
            client, limits, HAND.q_open, stale=0.1, hold=0.3, fallback="open"
        ) as guard:
            grasps = loop.Grasps(robot, guard, TASK)
            ticker = congrasp.Ticker(100.0)
            counters = guard.counters

            def step_until(done):
                deadline = time.monotonic() + SECONDS
                while not done():
                    assert time.monotonic() < deadline, f"{counters} {guard.trouble}"
                    ticker.wait()
                    grasps.step()

            step_until(lambda: counters.follow >= 30)
            process = psutil.Process(server.pid)
            process.suspend()  # its link stays open, and silent
            step_until(lambda: counters.fallback >= 5)
            process.resume()
            step_until(lambda: grasps.outcomes["given up"] >= 1)
            before = grasps.outcomes["given up"]
            fallback = counters.fallback
            server.kill()
            answers = counters.answers
            step_until(lambda: counters.fallback >= fallback + 30)
            assert counters.hold > 0
            assert counters.lost > 0
            assert counters.answers <= answers + 1
            server.start()
            step_until(lambda: counters.answers >= answers + 30)
    finally:
        server.kill()
    assert grasps.outcomes["given up"] > before
    assert guard.trouble == ""
    assert counters.steps == ticker.ticks
    assert robot.beyond <= 0.0
    assert robot.fastest <= 1.0 + 1e-6
    assert robot.strongest <= 1.0 + 1e-6
