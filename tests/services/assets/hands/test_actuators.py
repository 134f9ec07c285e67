"""Tendons through space, whose levers are known where they run around a pulley."""

import pathlib

import mujoco
import numpy as np
import pytest

from congrasp.services.assets.hands.actuators import Drive, servos

_FINGER = (pathlib.Path(__file__).parents[3] / "hands" / "tendons.xml").read_text()


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
