"""Closed loops of links, whose joints follow the one that a motor turns."""

import numpy as np
import pytest

from congrasp.common.hands.mjcf import mujoco_link_poses
from congrasp.common.hands.motors import joint_positions
from congrasp.services.assets.hands.finger_checks import finger_findings
from congrasp.services.assets.hands.geometry_checks import open_overlap_finding
from congrasp.services.assets.hands.model_files import propose

FINGER = """
  <body name="{side}_crank" pos="{outer} 0 0.02">
    <joint name="{side}_crank_turn" axis="0 {sign} 0" range="0 0.8"/>
    <geom type="capsule" size="0.004" fromto="0 0 0 0 0 0.05"/></body>
  <body name="{side}" pos="{inner} 0 0.02">
    <joint name="{side}_turn" axis="0 {sign} 0" range="-0.3 1"/>
    <geom type="capsule" size="0.004" fromto="0 0 0 0 0 0.05"/>
    <body name="{side}_pad" pos="0 0 0.05">
      <joint name="{side}_pad_turn" axis="0 {sign} 0" range="{pad_range}"/>
      <geom type="capsule" size="0.004" fromto="0 0 0 {pin} 0 0"/>
      <geom type="capsule" size="0.006" fromto="0 0 0 0 0 0.04"/></body></body>"""
PIN = '<connect body1="{side}_pad" body2="{side}_crank" anchor="{pin} 0 0"/>'
OPENED = "closed loops of links are opened"


def gripper(folder, pad_range="-1 1"):
    """A gripper of two parallelograms, whose cranks have motors."""
    bodies = ""
    pins = ""
    motors = ""
    for side, sign in (("left", 1), ("right", -1)):
        pin = -0.015 * sign
        bodies += FINGER.format(
            side=side,
            sign=sign,
            outer=-0.055 * sign,
            inner=-0.04 * sign,
            pin=pin,
            pad_range=pad_range,
        )
        pins += PIN.format(side=side, pin=pin)
        motors += f'<position joint="{side}_crank_turn" kp="5" forcerange="-1 1"/>'
    file = folder / "gripper.xml"
    file.write_text(f"""
    <mujoco><compiler angle="radian" autolimits="true"/><worldbody>
    <body name="palm"><geom type="box" size="0.06 0.02 0.02"/>{bodies}</body>
    </worldbody><equality>{pins}</equality><actuator>{motors}</actuator></mujoco>""")
    return propose(file)


@pytest.fixture(scope="module")
def parallel(tmp_path_factory):
    return gripper(tmp_path_factory.mktemp("gripper"))


def test_joints_of_a_closed_loop_follow_its_motor(parallel):
    couplings = {coupling.joint: coupling for coupling in parallel.hand.couplings}
    for side in ("left", "right"):
        for joint, ratio in ((f"{side}_turn", 1.0), (f"{side}_pad_turn", -1.0)):
            assert couplings[joint].leader == f"{side}_crank_turn"
            assert couplings[joint].ratio == pytest.approx(ratio, abs=0.01)
            assert couplings[joint].offset == pytest.approx(0.0, abs=0.01)
    motors = {motor.name for motor in parallel.hand.motors}
    assert motors == {"left_crank_turn", "right_crank_turn"}
    assert not any(OPENED in note for note in parallel.notes)


def test_pad_of_a_parallelogram_keeps_its_direction(parallel):
    hand = parallel.hand
    q = joint_positions(hand, np.full(len(hand.motors), 0.6, np.float32))
    positions, quaternions = mujoco_link_poses(hand, q)
    pad = [link.name for link in hand.links].index("left_pad")
    assert abs(quaternions[pad, 0]) == pytest.approx(1.0, abs=1e-4)
    expected = [-0.04 + 0.05 * np.sin(0.6), 0.0, 0.02 + 0.05 * np.cos(0.6)]
    assert positions[pad] == pytest.approx(expected, abs=1e-3)


def test_crank_of_a_finger_passes_the_check(parallel):
    assert not [f for f in finger_findings(parallel.hand) if f.verdict == "failed"]
    assert open_overlap_finding(parallel.hand).verdict == "passed"


def test_torque_of_a_crank_is_limited_by_the_lever_of_its_finger(parallel):
    crank = next(joint for joint in parallel.hand.joints if joint.name == "left_crank_turn")
    assert crank.torque_limit == pytest.approx(1.0)


def test_loop_that_jams_is_opened(tmp_path):
    proposal = gripper(tmp_path, pad_range="-0.1 0.1")
    assert not proposal.hand.couplings
    assert any(OPENED in note for note in proposal.notes)
