"""The node's loop over Zenoh against a simulated hand and wrist, while its policy server ends (`tests.benchmarks`)."""

import contextlib

import pytest

pytest.importorskip("rosbags")

from tests.base_install import steady_server
from tests.benchmarks.robot import Rig


def test_the_node_follows_a_server_and_opens_or_freezes_without_one(tmp_path):
    """The policy wants every joint at zero; nothing was lifted, so that the hand opens when the server has gone."""
    with contextlib.closing(Rig(tmp_path)) as rig:
        with steady_server() as port:
            rig.begin(f"tcp/127.0.0.1:{port}", "--hold", "0.4")
            rig.run(lambda: "follow" in "".join(rig.lines) and rig.commands > 60, 60.0)
        commands = rig.commands
        rig.run(lambda: rig.lines[-1].startswith("open:"), 20.0)
        rig.run(lambda: rig.commands > commands + 100, 20.0)
        assert any(line.startswith("hold:") for line in rig.lines)
    assert rig.robot.beyond <= 0.0 and rig.robot.strongest <= 1.0 + 1e-6
