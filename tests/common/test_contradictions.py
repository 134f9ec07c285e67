"""Contradictions between constraints: each kind is found, measured and explained, and agreement says nothing."""

import numpy as np
import pytest

from common.constraints.contradictions import Wishes, contradictions
from common.hands import get_hand
from common.hands.kinematics import grasp_frame

HAND = get_hand("human")
# A bar along x: its end at negative x may be grasped.
POINTS = np.stack([np.linspace(-0.1, 0.1, 41), np.zeros(41), np.zeros(41)], -1)
MINUS = POINTS[:, 0] > 0.02
NOT_TURNED = np.array([1.0, 0.0, 0.0, 0.0])
HEADING = grasp_frame(HAND).heading
CENTER = grasp_frame(HAND).center


def at(place):
    """An open hand, not turned, with its centre at a place."""
    return HAND.q_open, np.array(place) - CENTER, NOT_TURNED


def path_to(place):
    start = np.array(place) - CENTER - 0.15 * HEADING
    return np.linspace(start, np.array(place) - CENTER, 15), np.tile(NOT_TURNED, (15, 1))


def only(wishes):
    (found,) = contradictions(HAND, POINTS, wishes)
    return found


def test_what_agrees_says_nothing():
    place = (-0.06, 0.0, 0.0)
    wishes = Wishes(HEADING, np.array(place), MINUS, trajectory=path_to(place))
    wrist_on_plus = wishes.trajectory[0] - wishes.trajectory[0][-1] + [-0.1, 0.0, 0.05]
    assert contradictions(HAND, POINTS, wishes._replace(trajectory=(wrist_on_plus, wishes.trajectory[1]))) == []
    assert contradictions(HAND, POINTS, Wishes(HEADING, pose=at(place), trajectory=path_to(place))) == []
    assert contradictions(HAND, POINTS, Wishes()) == []


def test_a_trajectory_that_ends_at_what_must_not_be_touched_is_refused():
    end = np.array([0.08, 0.03, 0.0])
    path = np.linspace(end + np.array([0, 0.2, 0]), end, 15)
    found = only(Wishes(minus=MINUS, trajectory=(path, np.tile(NOT_TURNED, (15, 1)))))
    assert found.refused and (found.weaker, found.stronger) == ("affordance", "trajectory")
    plus = np.hypot(0.08 - POINTS[~MINUS][:, 0].max(), 0.03)
    assert "3.0 cm from what must not be touched" in found.words and f"{100 * plus:.1f} cm from what may" in found.words


def test_a_pose_away_from_the_trajectorys_end_keeps_its_fingers_alone():
    q, position, quaternion = at((-0.06, 0.0, 0.0))
    found = only(Wishes(pose=(q, position + np.array([0, 0, 0.05]), quaternion), trajectory=path_to((-0.06, 0.0, 0.0))))
    assert (found.weaker, found.stronger, found.refused) == ("pose", "trajectory", False)
    assert "5.0 cm and 0 degrees" in found.words and "only the fingers count" in found.words
    turned = np.array([np.cos(0.5), np.sin(0.5), 0.0, 0.0])
    assert (
        "0.0 cm and 57 degrees" in only(Wishes(pose=(q, position, turned), trajectory=path_to((-0.06, 0.0, 0.0)))).words
    )


def test_a_pose_that_touches_what_must_not_be_touched_names_the_links():
    tip = HAND.keypoints[len(HAND.links) + 1]
    q = np.zeros(20)
    found = only(Wishes(minus=MINUS, pose=(q, np.array([0.08, 0.0, 0.0]) - tip, NOT_TURNED)))
    assert (found.weaker, found.stronger, found.refused) == ("affordance", "pose", False)
    assert "index_distal" in found.words and "thumb" not in found.words
    assert contradictions(HAND, POINTS, Wishes(minus=MINUS, pose=(q, np.array([-0.08, 0, 0]) - tip, NOT_TURNED))) == []


@pytest.mark.parametrize("stronger", ["pose", "trajectory"])
def test_a_heading_from_elsewhere_follows_the_reference(stronger):
    place = (-0.06, 0.0, 0.0)
    reference = {"pose": at(place)} if stronger == "pose" else {"trajectory": path_to(place)}
    found = only(Wishes(-HEADING, **reference))
    assert (found.weaker, found.stronger) == ("heading", stronger)
    assert "180 degrees" in found.words and f"The {stronger} overrides it" in found.words


def test_a_heading_towards_what_must_not_be_touched_is_turned():
    found = only(Wishes(np.array([0.0, -1.0, 0.0]), np.array([0.08, 0.0, 0.0]), MINUS))
    assert (found.weaker, found.stronger, found.refused) == ("heading", "affordance", False)
    assert "0.0 cm from what must not be touched" in found.words and "turns the heading" in found.words
