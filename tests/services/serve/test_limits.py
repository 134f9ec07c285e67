"""No command leaves the limits, whatever comes in."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.services.client.limits import JointLimits, Limiter, as_numbers

JOINTS, PERIOD = 3, 0.01
LIMITS = JointLimits(
    lower=np.array([-0.5, 0.0, 0.2]),
    upper=np.array([0.5, 1.6, 0.2]),
    speed=np.array([6.0, 3.0, 1.0]),
    torque=np.array([0.7, 0.0, 5.0]),
    kp=np.array([3.0, 3.0, 50.0]),
    kv=np.array([0.1, 0.0, 2.0]),
)
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
STEPS = st.lists(st.tuples(VALUES, VALUES, VALUES, st.one_of(st.floats(0.0, 1.0), ANY)), min_size=1, max_size=20)


@settings(max_examples=60, deadline=None)
@given(STEPS, st.lists(NEAR, min_size=JOINTS, max_size=JOINTS))
def test_positions_speeds_and_torques_stay_within_the_limits_whatever_comes_in(steps, start):
    limiter = Limiter(LIMITS, np.array(start), period=PERIOD)
    last = limiter.target
    for target, position, velocity, now in steps:
        limited = limiter.limit(target, position, velocity, now)
        assert np.isfinite(limited.target).all() and np.isfinite(limited.torque).all()
        assert (limited.target >= LIMITS.lower).all() and (limited.target <= LIMITS.upper).all()
        assert (np.abs(limited.target - last) <= LIMITS.speed * PERIOD + 1e-12).all()
        assert (np.abs(limited.torque) <= LIMITS.torque).all()
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


def test_a_target_goes_where_it_is_wanted_at_the_speed_and_torque_of_its_limits():
    limits = JointLimits(*(np.array([x]) for x in (-1.0, 1.0, 6.0, 0.6, 3.0, 0.1)))
    limiter = Limiter(limits, np.zeros(1), period=PERIOD)

    def limit(target, position, velocity, now):
        return limiter.limit(np.array([target]), np.array([position]), np.array([velocity]), now)

    assert limit(0.01, 0.0, 0.0, 0.0).target == pytest.approx(0.01)  # the first period
    fast = limit(0.5, 0.4, 0.0, 0.01)
    assert fast.target == pytest.approx(0.07) and fast.by == ("speed",)  # 6 rad/s for 10 ms
    strong = limit(0.12, -0.1, 0.0, 0.02)  # the servo reaches 0.6 N.m / 3 N.m/rad = 0.2 rad ahead of the joint
    assert strong.target == pytest.approx(0.1) and strong.by == ("torque",)
    assert strong.torque == pytest.approx(0.6)
    moving = limit(0.12, 0.1, -3.0, 0.03)  # 3 * 0.02 + 0.1 * 3 = 0.36 N.m
    assert moving.target == pytest.approx(0.12) and moving.by == () and moving.torque == pytest.approx(0.36)
    held = limit(math.nan, 0.1, 0.0, 0.04)
    assert held.target == pytest.approx(0.12) and held.by == ("not_finite",)
    unmeasured = limit(0.15, math.nan, 0.0, 0.05)
    assert unmeasured.target == pytest.approx(0.12) and unmeasured.torque == 0.0


def test_limits_of_a_hand_are_those_of_its_model():
    hand = get_hand("allegro")
    limits = JointLimits.of_hand(hand, margin=0.01)
    np.testing.assert_allclose(limits.lower[:16], hand.lower + 0.01, atol=1e-6)
    narrow = JointLimits.of_hand(hand, margin=9.0)
    np.testing.assert_allclose(narrow.lower[:16], (hand.lower + hand.upper) / 2, atol=1e-6)
    assert limits.torque[0] == 0.7 and limits.torque[16] == hand.wrist.slide_limit
    assert limits.kp[-1] == hand.wrist.hinge_kp and len(limits.speed) == 22


@pytest.mark.parametrize(
    "wrong", [{"speed": [np.nan]}, {"torque": [-1.0]}, {"upper": [-2.0]}, {"kp": [0.0]}, {"kv": [0.0, 0.0]}]
)
def test_limits_that_are_none_are_refused(wrong):
    fields = {"lower": [-1.0], "upper": [1.0], "speed": [1.0], "torque": [1.0], "kp": [1.0], "kv": [0.0]}
    with pytest.raises(CongraspError, match="limits"):
        JointLimits(**{name: np.array(value) for name, value in {**fields, **wrong}.items()})
    with pytest.raises(ValueError, match="read-only"):
        LIMITS.upper[0] = np.nan
    with pytest.raises(CongraspError, match="finite"):
        Limiter(LIMITS, np.array([0.0, math.inf, 0.0]))


def test_what_is_no_array_of_numbers_is_nan():
    assert np.isnan(as_numbers("x", 2)).all() and np.isnan(as_numbers([1.0], 2)).all()
    np.testing.assert_array_equal(as_numbers([1, 2], 2), [1.0, 2.0])
