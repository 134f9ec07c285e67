"""No command leaves the limits, whatever comes in."""

import dataclasses
import json
import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.task.config import ControlConfig
from congrasp.services.client.floor import Floor
from congrasp.services.client.limiter import Limited, Limiter
from congrasp.services.client.limits import JointLimits

JOINTS = 9
PERIOD = 0.01


def with_wrist(fingers, slides, hinges):
    return np.concatenate([fingers, np.repeat([slides, hinges], 3)])


LIMITS = JointLimits(
    lower=with_wrist([-0.5, 0.0, 0.2], -0.3, -1.0),
    upper=with_wrist([0.5, 1.6, 0.2], 0.3, 1.0),
    speed=with_wrist([6.0, 3.0, 1.0], 1.5, 6.0),
    torque=with_wrist([0.7, 0.0, 5.0], 24.0, 3.0),
    kp=with_wrist([3.0, 3.0, 50.0], 2000.0, 70.0),
    kv=with_wrist([0.1, 0.0, 2.0], 100.0, 4.0),
    acceleration=with_wrist([0.0, 200.0, 0.0], 30.0, 0.0),
    palm=np.array([[0.0, 0.0, -0.05, 0.02], [0.1, 0.0, 0.0, 0.03]]),
)
SLIDES = slice(-6, -3)
HINGES = slice(-3, None)
FLOOR = Floor(
    np.array([0.0, 0.6, 0.8, 0.1]),
    (np.array([0.1, 0.2, 0.2]), np.array([0.8, 0.0, 0.6, 0.0])),
    LIMITS.palm,
)
"""Of which the palm begins above: (0.6, 0.8).(0.2, 0.2) - 0.1 = 0.18 m at the wrist."""
ANY = st.floats(allow_nan=True, allow_infinity=True, width=64)
NEAR = st.floats(-2.0, 2.0)
VALUES = st.one_of(
    st.lists(st.one_of(NEAR, ANY), min_size=JOINTS, max_size=JOINTS).map(np.array),
    st.lists(ANY, max_size=5),
    st.sampled_from(
        [
            None,
            "far",
            math.nan,
            [[0.0] * JOINTS],
            [None] * JOINTS,
            [1j] * JOINTS,
            [10**400] * JOINTS,
            ["x"] * JOINTS,
            {},
        ]
    ),
)
STEPS = st.lists(
    st.tuples(VALUES, VALUES, VALUES, st.one_of(st.floats(0.0, 1.0), ANY)), min_size=1, max_size=20
)


@settings(max_examples=60, deadline=None)
@example([([], [], [], -1e-187), ([], [], [], 0.0)], [0.0] * JOINTS)
@given(STEPS, st.lists(NEAR, min_size=JOINTS, max_size=JOINTS))
def test_limiter_output_stays_within_limits_for_any_input(steps, start):
    limiter = Limiter(LIMITS, np.array(start), period=PERIOD, floor=FLOOR)
    last = limiter.target
    least = min(FLOOR.clearance(last[-6:]), 0.0)
    for target, position, velocity, now in steps:
        limited = limiter.limit(target, position, velocity, now)
        assert np.isfinite(limited.target).all()
        assert np.isfinite(limited.torque).all()
        assert (limited.target >= LIMITS.lower).all()
        assert (limited.target <= LIMITS.upper).all()
        assert (np.abs(limited.target - last) <= LIMITS.speed * PERIOD + 1e-12).all()
        assert (np.abs(limited.torque) <= LIMITS.torque).all()
        for three, fastest, strongest in ((SLIDES, 1.5, 24.0), (HINGES, 6.0, 3.0)):
            assert np.linalg.norm((limited.target - last)[three]) <= fastest * PERIOD + 1e-9
            assert np.linalg.norm(limited.torque[three]) <= strongest + 1e-9
        assert FLOOR.clearance(limited.target[-6:]) >= least - 1e-9
        last = limited.target


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(0.0, 0.1), min_size=2, max_size=30))
def test_over_any_times_a_target_is_no_faster_than_its_limit(times):
    """Times that go back and forth give no more way than the time from the first to the latest."""
    limiter = Limiter(LIMITS, np.zeros(JOINTS), period=PERIOD)
    limiter.limit(np.zeros(JOINTS), np.zeros(JOINTS), np.zeros(JOINTS), times[0])
    begin = limiter.target
    for now in times[1:]:
        free = np.full(JOINTS, 9.0)
        limiter.limit(free, free, np.zeros(JOINTS), now)
    passed = max(times) - times[0]
    assert (np.abs(limiter.target - begin) <= LIMITS.speed * passed + 1e-12).all()


def test_a_target_moves_at_the_speed_and_torque_limits():
    limits = JointLimits(*(np.append(x, np.ones(6)) for x in (-1.0, 1.0, 6.0, 0.6, 3.0, 0.1)))
    limits = dataclasses.replace(limits, lower=-limits.upper)
    limiter = Limiter(limits, np.zeros(7), period=PERIOD)

    def limit(*given):
        *three, now = given
        limited = limiter.limit(*(np.append(x, np.zeros(6)) for x in three), now)
        return Limited(limited.target[0], limited.torque[0], limited.by)

    assert limit(0.01, 0.0, 0.0, 0.0).target == pytest.approx(0.01)  # the first period
    fast = limit(0.5, 0.4, 0.0, 0.01)
    assert fast.target == pytest.approx(0.07)
    assert fast.by == ("speed",)  # 6 rad/s for 10 ms
    # The servo reaches 0.6 N.m / 3 N.m/rad = 0.2 rad ahead of the joint
    strong = limit(0.12, -0.1, 0.0, 0.02)
    assert strong.target == pytest.approx(0.1)
    assert strong.by == ("torque",)
    assert strong.torque == pytest.approx(0.6)
    moving = limit(0.12, 0.1, -3.0, 0.03)  # 3 * 0.02 + 0.1 * 3 = 0.36 N.m
    assert moving.target == pytest.approx(0.12)
    assert moving.by == ()
    assert moving.torque == pytest.approx(0.36)
    held = limit(math.nan, 0.1, 0.0, 0.04)
    assert held.target == pytest.approx(0.12)
    assert held.by == ("not_finite",)
    unmeasured = limit(0.15, math.nan, 0.0, 0.05)
    assert unmeasured.target == pytest.approx(0.12)
    assert unmeasured.by == ("not_finite", "torque")
    # 3 N.m/rad from 0.1 rad, where the joint was last
    assert unmeasured.torque == pytest.approx(0.06)


def test_wrist_targets_have_limits_of_speed_acceleration_and_force_by_their_norm():
    free = {
        "kp": np.ones(7),
        "kv": np.zeros(7),
        "lower": np.full(7, -9.0),
        "upper": np.full(7, 9.0),
    }
    limits = JointLimits(
        speed=np.full(7, 2.0), torque=np.full(7, 5.0), acceleration=np.full(7, 20.0), **free
    )
    limiter = Limiter(limits, np.zeros(7), period=0.1)
    # 1 m from where it is: 2 m/s after one step of 20 m/s^2
    goal = np.array([0.0, 0.6, 0.8, 0.0, 0.0, 0.0, 0.0])
    places = [np.zeros(7)]
    for step in range(20):
        places.append(limiter.limit(goal, places[-1], np.zeros(7), 0.1 * step).target)
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / 0.1
    # Straight
    np.testing.assert_allclose(np.array(places)[:, 2] * 3, np.array(places)[:, 1] * 4, atol=1e-9)
    assert speeds.max() == pytest.approx(2.0)
    assert (np.abs(np.diff(speeds, prepend=0.0)) <= 2.0 + 1e-9).all()
    # And stops there at once: 2 / 0.1
    np.testing.assert_allclose(speeds[:6], [2.0, 2.0, 2.0, 2.0, 2.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(places[-1], goal, atol=1e-9)
    far = Limiter(limits, np.zeros(7), period=0.1).limit(
        100.0 * goal, np.zeros(7), np.zeros(7), 0.0
    )
    assert np.linalg.norm(far.torque) <= 5.0
    assert far.by == ("torque", "speed")
    slow = dataclasses.replace(limits, acceleration=np.full(7, 2.0))
    limiter = Limiter(slow, np.zeros(7), period=0.1)
    places = [np.zeros(7)]
    for step in range(40):
        places.append(limiter.limit(goal, places[-1], np.zeros(7), 0.1 * step).target)
    speeds = np.diff(np.array(places) @ goal) / 0.1
    np.testing.assert_allclose(speeds[:4], [0.2, 0.4, 0.6, 0.8], atol=1e-9)
    assert (np.abs(np.diff(speeds)) <= 0.2 + 1e-9).all()
    assert (np.array(places) @ goal <= 1.0 + 1e-9).all()
    np.testing.assert_allclose(places[-1], goal, atol=1e-6)


def test_a_palm_is_as_high_as_its_lowest_sphere():
    """The base is 0.3 m up and turned by 90 degrees about x, so that its y axis points up: x, y, z
    are x, -z, y.
    """
    half = np.sqrt(0.5)
    floor = Floor(
        np.array([0.0, 0.0, 1.0, 0.05]),
        (np.array([0.0, 0.0, 0.3]), np.array([half, half, 0.0, 0.0])),
        np.array([[0.0, -0.1, 0.0, 0.02], [0.0, 0.0, 0.2, 0.01]]),
    )
    np.testing.assert_allclose(floor.normal, [0.0, 1.0, 0.0], atol=1e-12)
    assert floor.clearance(np.zeros(6)) == pytest.approx(0.3 - 0.05 - 0.1 - 0.02)
    assert floor.clearance(np.array([0.5, -0.1, 0.7, 0.0, 0.0, 0.0])) == pytest.approx(0.03)
    # Y to z, z to -y: down
    turned = floor.clearance(np.array([0.0, 0.0, 0.0, np.pi / 2, 0.0, 0.0]))
    assert turned == pytest.approx(0.3 - 0.05 - 0.2 - 0.01)


def test_limits_of_a_hand_are_those_of_its_model():
    hand = get_hand("allegro")
    limits = JointLimits.of_hand(hand, margin=0.01)
    np.testing.assert_allclose(limits.lower[:16], hand.lower + 0.01, atol=1e-6)
    narrow = JointLimits.of_hand(hand, margin=9.0)
    np.testing.assert_allclose(narrow.lower[:16], (hand.lower + hand.upper) / 2, atol=1e-6)
    assert limits.torque[0] == 0.7
    mass = sum(link.mass for link in hand.links) + 0.65
    # A = 15 m/s^2
    assert limits.torque[16] == pytest.approx(15.0 * mass)
    assert 23.0 < limits.torque[16] < 25.0
    assert limits.kp[-1] == hand.wrist.hinge_kp
    assert len(limits.speed) == 22
    older = JointLimits.of_hand(hand, ControlConfig(wrist_acceleration=0.0))
    assert older.torque[16] == hand.wrist.slide_limit
    again = JointLimits(**json.loads(json.dumps(limits.as_lists())))
    for field in dataclasses.fields(limits):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(limits, field.name))


def test_a_limit_of_the_grip_is_one_of_the_torque_by_the_way_to_the_fingertip():
    hand = get_hand("allegro")
    limits = JointLimits.of_hand(hand, grip=5.0)
    last = hand.links[hand.tip_links[1]]
    root = hand.finger_roots[1]
    first = next(link for link in hand.links if link.name == root)
    for link in (first, last):
        joint = link.joints[0]
        lever = np.linalg.norm(np.subtract(last.tip, joint.anchor))
        expected = min(5.0 * lever, joint.torque_limit)
        assert limits.torque[hand.joints.index(joint)] == pytest.approx(expected)
        assert 0.02 < lever < 0.2


@pytest.mark.parametrize(
    "wrong",
    [
        {"speed": [np.nan]},
        {"torque": [-1.0]},
        {"upper": [-2.0]},
        {"kp": [0.0]},
        {"kv": [0.0, 0.0]},
        {"palm": [0.0]},
    ],
)
def test_limits_that_are_none_are_refused(wrong):
    fields = {
        "lower": [-1.0],
        "upper": [1.0],
        "speed": [1.0],
        "torque": [1.0],
        "kp": [1.0],
        "kv": [0.0],
    }
    with pytest.raises(CongraspError, match="limits"):
        JointLimits(**{name: np.repeat(value, 7) for name, value in {**fields, **wrong}.items()})
    with pytest.raises(ValueError, match="read-only"):
        LIMITS.upper[0] = np.nan
    with pytest.raises(CongraspError, match="finite"):
        Limiter(LIMITS, np.full(9, math.inf))
    with pytest.raises(CongraspError, match="six wrist joints"):
        JointLimits(**{name: np.array(value) for name, value in fields.items()})
