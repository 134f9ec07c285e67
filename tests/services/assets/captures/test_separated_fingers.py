"""Fingers of a reference moved apart, worked out by hand for two of them."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.common.hands import get_hand
from congrasp.common.hands.files import HUMAN
from congrasp.common.hands.kinematics import link_transforms
from congrasp.common.hands.motors import follow_couplings
from congrasp.common.hands.spec import Capsule, Coupling, Hand, Joint, Link
from congrasp.common.task.plausibility import hand_hand
from congrasp.services.assets.captures.references import (
    MAX_OVERLAP_M,
    greatest_overlap,
    separate_fingers,
)

ASIDE = 0.02
LONG = 0.05
RADIUS = 0.005


def two_fingers(upper=1.0, couplings=()):
    """Fingers of 5 cm at x = -2 and 2 cm along y, that turn about z: `a` towards -x and `b` towards
    +x.

    So +x of `a` needs a negative angle: turned by -t and t, their tips are 2 (2 cm - 5 cm sin t)
    apart.
    """
    links = [Link("palm", "", (), (Capsule((0, -0.05, 0), (0, -0.04, 0), RADIUS),), 0.1, 1.0)]
    for name, x, limits in (("a", -ASIDE, (-upper, 1.0)), ("b", ASIDE, (-1.0, 1.0))):
        joint = Joint(name, (0, 0, 1), (x, 0, 0), *limits, kp=1.0, kv=0.1, torque_limit=1.0)
        shape = Capsule((x, 0, 0), (x, LONG, 0), RADIUS)
        links.append(Link(name, "palm", (joint,), (shape,), 0.05, 1.0, tip=(x, LONG, 0)))
    return Hand("two", tuple(links), "a", {}, {}, HUMAN.wrist, couplings=couplings)


def test_two_fingers_part_evenly():
    """Turned by 0.38 rad each they overlap by 7 mm; at t with 2 (2 cm - 5 cm sin t) = 1 cm - 1 mm
    by 1 mm.
    """
    hand = two_fingers()
    q = np.array([[-0.38, 0.38]], np.float32)
    overlap = 2 * RADIUS - 2 * (ASIDE - LONG * np.sin(0.38))
    np.testing.assert_allclose(greatest_overlap(hand, q), overlap, atol=1e-6)
    angle = np.arcsin((ASIDE - RADIUS + MAX_OVERLAP_M / 2) / LONG)
    np.testing.assert_allclose(separate_fingers(hand, q), [[-angle, angle]], atol=2e-4)


def test_the_other_finger_moves_if_one_is_at_its_limit():
    """`a` cannot leave -0.38 rad, where its tip is at 2 cm - 5 cm sin(0.38) from the middle: `b`
    makes all the room.
    """
    stiff = two_fingers()
    a = dataclasses.replace(stiff.links[1].joints[0], upper=-0.38)
    hand = dataclasses.replace(
        stiff,
        links=(stiff.links[0], dataclasses.replace(stiff.links[1], joints=(a,)), stiff.links[2]),
    )
    hand = dataclasses.replace(hand, open_pose={"a": -0.38}, closed_pose={"a": -0.38})
    angles = separate_fingers(hand, np.array([[-0.38, 0.38]], np.float32))
    assert angles[0, 0] == np.float32(-0.38)
    assert angles[0, 1] < 0.3
    np.testing.assert_allclose(greatest_overlap(hand, angles), MAX_OVERLAP_M, atol=2e-5)


def test_followers_still_follow():
    hand = two_fingers(couplings=(Coupling("b", "a", -1.0),))
    angles = separate_fingers(hand, np.array([[-0.38, 0.38]], np.float32))
    np.testing.assert_allclose(angles, follow_couplings(hand, angles), atol=1e-6)
    np.testing.assert_allclose(greatest_overlap(hand, angles), MAX_OVERLAP_M, atol=2e-5)


@pytest.mark.parametrize("name", ["human", "sharpa"])
@pytest.mark.slow
def test_overlapping_poses_are_separated_within_limits(name):
    hand = get_hand(name)
    rng = np.random.default_rng(3)
    share = rng.uniform(0.0, 1.0, (12, 1))
    q = (
        hand.q_open
        + share * (hand.q_closed - hand.q_open)
        + rng.normal(0, 0.25, (12, len(hand.joints)))
    )
    q = np.clip(q, hand.lower, hand.upper).astype(np.float32)
    before = np.asarray(greatest_overlap(hand, q))
    angles = separate_fingers(hand, q)
    deep = before > MAX_OVERLAP_M
    assert deep.any()
    assert not deep.all()
    np.testing.assert_array_equal(angles[~deep], q[~deep])
    assert np.all(angles >= hand.lower)
    assert np.all(angles <= hand.upper)
    np.testing.assert_array_less(
        hand_hand(hand, link_transforms(hand, jnp.asarray(angles))), MAX_OVERLAP_M + 5e-5
    )
    np.testing.assert_allclose(separate_fingers(hand, angles), angles, atol=1e-3)
