"""The one-parameter family of finger poses."""

import functools

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from congrasp.common.hands import get_hand
from congrasp.common.hands.closure import (
    CLOSURES,
    WIDEST_GAP_M,
    closure_pose,
    preshape,
    table_of_gaps,
    wide_angles,
    widest_gap,
    widest_pose,
)
from congrasp.common.hands.kinematics import grasp_frame, keypoints, link_transforms

HANDS = ("human", "allegro", "sharpa")


@functools.cache
def _compiled(hand):
    """Closure pose and keypoints of a hand, each as one program."""
    points = jax.jit(lambda q: keypoints(hand, link_transforms(hand, q)))
    return jax.jit(functools.partial(closure_pose, hand)), points


def _tips(hand, q):
    return np.asarray(_compiled(hand)[1](np.asarray(q, np.float32)))[len(hand.links) :]


def _pose(hand, closures):
    return np.asarray(_compiled(hand)[0](np.float32(closures)))


@pytest.mark.parametrize("name", HANDS)
def test_the_shipped_wide_pose_is_the_one_that_is_found(name):
    hand = get_hand(name)
    widest = hand.posed(widest_pose(hand))
    np.testing.assert_allclose(wide_angles(hand), widest, atol=0.03)
    assert (wide_angles(hand) >= hand.lower - 1e-6).all()
    assert (wide_angles(hand) <= hand.upper + 1e-6).all()


@pytest.mark.parametrize("name", HANDS)
def test_gaps_are_those_between_skins_along_the_cross_finger_axis(name):
    hand = get_hand(name)
    cross = grasp_frame(hand).cross
    radii = hand.keypoint_radii[len(hand.links) :]
    for closure, gap in zip(CLOSURES, table_of_gaps(hand), strict=True):
        tips = _tips(hand, _pose(hand, [closure]))
        skins = (tips[1:] - tips[0]) @ cross - radii[1:] - radii[0]
        assert gap == pytest.approx(skins.min(), abs=1e-4)


@pytest.mark.parametrize("name", HANDS)
def test_the_widest_pose_opens_by_a_quarter_and_faces_the_object_as_the_open_one_does(name):
    hand = get_hand(name)
    gaps = table_of_gaps(hand)
    frame = grasp_frame(hand)
    assert (np.diff(gaps) < 0).all()
    assert widest_gap(hand) > 1.25 * gaps[CLOSURES.tolist().index(0.0)]
    assert widest_gap(hand) > 0.9 * WIDEST_GAP_M * hand.object_scale
    tips = _tips(hand, wide_angles(hand))
    across = tips[1:].mean(0) - tips[0]
    assert across @ frame.cross / np.linalg.norm(across) > np.cos(np.radians(5))


def test_closures_meet_the_three_poses_and_mix_between_them():
    hand = get_hand("human")
    ends = _pose(hand, [[-1.0], [0.0], [1.0]])
    np.testing.assert_allclose(ends, [wide_angles(hand), hand.q_open, hand.q_closed], atol=1e-6)
    half = _pose(hand, [-0.5])
    np.testing.assert_allclose(half, (wide_angles(hand) + hand.q_open) / 2, atol=1e-6)
    apart = np.linspace(-1, 1, len(hand.joints), dtype=np.float32)
    for joint, closure in enumerate(apart):
        angles = _pose(hand, [closure])[joint]
        assert _pose(hand, apart)[joint] == pytest.approx(angles, abs=1e-6)


_preshape = jax.jit(functools.partial(preshape, get_hand("human")))


@settings(deadline=None, max_examples=20)
@given(width=st.floats(0.0, 0.12), margin=st.floats(0.015, 0.06))
def test_a_preshaped_hand_is_wider_than_the_object_by_the_margin_or_as_wide_as_it_opens(
    width, margin
):
    hand = get_hand("human")
    q = np.asarray(_preshape(np.float32([width]), np.float32(margin)))[0]
    tips = _tips(hand, q)
    radii = hand.keypoint_radii[len(hand.links) :]
    gap = ((tips[1:] - tips[0]) @ grasp_frame(hand).cross - radii[1:] - radii[0]).min()
    assert gap == pytest.approx(min(width + margin, widest_gap(hand)), abs=2e-3)
