"""Tendons through space, whose levers are known where they run around a pulley."""

import mujoco
import numpy as np
import pytest

from congrasp.services.assets.hands.actuators import Drive, servos

_FINGER = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="palm">
      <geom type="box" size=".02 .02 .02"/>
      <site name="low" pos=".012 0 0"/><site name="back" pos="-.012 0 0"/>
      <body name="near" pos="0 0 .05">
        <joint name="root" axis="0 1 0" range="-.4 .4"/>
        <geom name="pulley" type="cylinder" size=".01 .01" euler="1.5707963 0 0" contype="0" conaffinity="0"/>
        <geom type="capsule" size=".005" fromto="0 0 0 0 0 .04"/>
        <site name="front of near" pos=".012 0 .03"/><site name="back of near" pos="-.012 0 .03"/>
        <site name="side" pos=".01 0 0"/><site name="side of back" pos="-.01 0 0"/>
        <body name="far" pos="0 0 .06">
          <joint name="end" axis="0 1 0" range="0 .8"/>
          <geom type="capsule" size=".005" fromto="0 0 0 0 0 .03"/>
          <site name="tip" pos=".006 0 .02"/>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon>
    <spatial name="flexor"><site site="low"/><geom geom="pulley" sidesite="side"/><site site="front of near"/>
      <site site="tip"/></spatial>
    <spatial name="extensor"><site site="back"/><geom geom="pulley" sidesite="side of back"/>
      <site site="back of near"/></spatial>
  </tendon>
  <actuator>
    <position name="pull" tendon="flexor" kp="20000" forcerange="-50 50" ctrlrange="0 .2"/>
    {}
  </actuator>
</mujoco>"""


def _drive(actuators: str) -> Drive:
    model = mujoco.MjModel.from_xml_string(_FINGER.format(actuators))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return Drive(model, data, {0: "root", 1: "end"}, {0: 0.1, 1: 0.04})


def test_a_motor_of_a_tendon_through_space_has_the_tendons_mean_levers():
    """The sites of the far joint are (.012, .03) and (.006 cos q + .02 sin q, .06 + .02 cos q - .006 sin q)."""
    model = mujoco.MjModel.from_xml_string(_FINGER.format(""))
    (servo,) = servos(model, notes := [])
    assert set(servo.joints) == {0, 1} and servo.kp == 20000 and servo.reach is None
    lengths = [
        np.hypot(0.006 * np.cos(q) + 0.02 * np.sin(q) - 0.012, 0.03 + 0.02 * np.cos(q) - 0.006 * np.sin(q))
        for q in (0.0, 0.8)
    ]
    assert servo.joints[1] == pytest.approx((lengths[1] - lengths[0]) / 0.8, rel=1e-6)
    below, above, radius = np.hypot(0.012, 0.05), np.hypot(0.012, 0.03), 0.01
    between = np.arctan2(0.05, 0.012) + np.arctan2(0.03, 0.012)  # rad around the axis at 0, on the tendon's side
    straight = np.sqrt(below**2 + above**2 - 2 * below * above * np.cos(between - 0.4))
    around = between + 0.4 - np.arccos(radius / below) - np.arccos(radius / above)
    wrapped = np.sqrt(below**2 - radius**2) + np.sqrt(above**2 - radius**2) + radius * around
    assert around > 0 and servo.joints[0] == pytest.approx((straight - wrapped) / 0.8, rel=1e-6)
    assert len(notes) == 1 and notes[0].startswith("1 motors pull spatial tendons")


def test_a_joint_hangs_on_the_tendon_that_pulls_it_most():
    """Of a flexor of two joints and an extensor of one, the one that pulls a joint alone keeps it."""
    drive = _drive('<position name="push" tendon="extensor" kp="10000"/>')
    assert drive.tendons() == ()
    both = _drive('<position name="again" tendon="flexor" kp="10000"/>')
    (tendon,) = both.tendons()
    assert set(tendon.joints) == {"root", "end"}
    assert any("1 motors that only pull joints of others are dropped" in note for note in both.remarks())
