"""Grippers with slides, which are imported as pairs of hinges."""

import numpy as np
import pytest

from congrasp.common.hands.mjcf import mujoco_link_poses
from congrasp.common.hands.motors import joint_positions, motor_limits
from congrasp.services.assets.hands.model_files import propose

FORCE_N = 20.0
FINGER = """
  <body name="{side}" pos="{x} 0 0.02" quat="{quat}">
    <joint name="{side}_slide" type="slide" axis="1 0 0" range="0 0.04" ref="0.01"/>
    <geom type="box" size="0.005 0.008 0.03" pos="0 0 0.03"/></body>"""
FINGERS = FINGER.format(side="left", x=-0.015, quat="0 0 0 1") + FINGER.format(
    side="right", x=0.015, quat="1 0 0 0"
)
MOTOR = '<position joint="{side}_slide" kp="1000" forcerange="-{force} {force}"/>'
MIMIC = '<joint joint1="right_slide" joint2="left_slide" polycoef="0 1 0 0 0"/>'


def gripper(folder, motors, equalities=""):
    """A gripper whose file has it 1 cm open of 4 cm on each side."""
    servos = "".join(MOTOR.format(side=side, force=FORCE_N) for side in motors)
    file = folder / "gripper.xml"
    file.write_text(f"""
    <mujoco><compiler angle="radian" autolimits="true"/><worldbody>
    <body name="palm"><geom type="box" size="0.08 0.02 0.02"/>{FINGERS}</body>
    </worldbody><equality>{equalities}</equality><actuator>{servos}</actuator></mujoco>""")
    return propose(file)


@pytest.fixture(scope="module")
def proposal(tmp_path_factory):
    return gripper(tmp_path_factory.mktemp("gripper"), ("left", "right"))


def poses(hand, share):
    """Positions and orientations of both fingers at a share of the way from open to closed."""
    lower, upper = motor_limits(hand)
    ends = np.where(np.abs(lower) > np.abs(upper), lower, upper)
    positions, quaternions = mujoco_link_poses(hand, joint_positions(hand, share * ends))
    names = [link.name for link in hand.links]
    fingers = [names.index("left"), names.index("right")]
    return positions[fingers], quaternions[fingers]


def test_slides_become_pairs_of_hinges(proposal):
    hand = proposal.hand
    assert {motor.name for motor in hand.motors} == {"left_slide", "right_slide"}
    followers = {coupling.joint: coupling.leader for coupling in hand.couplings}
    assert followers == {
        "left_slide_parallel": "left_slide",
        "right_slide_parallel": "right_slide",
    }
    assert any("slides are replaced" in note for note in proposal.notes)


def test_finger_on_a_slide_moves_without_turning(proposal):
    opened, _ = poses(proposal.hand, 0.0)
    for share in (0.25, 0.5, 0.75, 1.0):
        positions, quaternions = poses(proposal.hand, share)
        way = positions - opened
        assert way[:, 0] == pytest.approx([0.04 * share, -0.04 * share], abs=2e-4)
        assert np.abs(way[:, 2]).max() < 0.0015
        assert np.abs(quaternions[:, 0]) == pytest.approx([1.0, 1.0], abs=1e-5)


def test_zero_of_a_slide_is_the_open_gripper(proposal):
    fingers = {link.name: link for link in proposal.hand.links}
    assert proposal.hand.open_pose == {}
    # 45 mm from the middle, less half of a finger of 10 mm
    inner = min(capsule.start[0] - capsule.radius for capsule in fingers["right"].capsules)
    assert inner == pytest.approx(0.04, abs=0.004)


def test_force_of_a_slide_is_kept(proposal):
    leaders = [joint for joint in proposal.hand.joints if joint.kp]
    for joint in leaders:
        radius = 0.04 / (joint.upper - joint.lower)
        assert joint.torque_limit / radius == pytest.approx(FORCE_N, rel=1e-3)
        assert joint.kp / radius**2 == pytest.approx(1000.0, rel=1e-3)


def test_slide_that_mimics_another_follows_it(tmp_path):
    hand = gripper(tmp_path, ("left",), MIMIC).hand
    (motor,) = hand.motors
    assert motor.name == "left_slide"
    opened, _ = poses(hand, 0.0)
    closed, _ = poses(hand, 1.0)
    assert (closed - opened)[:, 0] == pytest.approx([0.04, -0.04], abs=2e-4)
