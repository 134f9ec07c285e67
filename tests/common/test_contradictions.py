"""Contradictions between constraints: each kind is found, measured and explained, and agreement says nothing."""

import numpy as np
import pytest

from congrasp.common.hands import get_hand
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.request import GraspRequest
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import goal_of
from congrasp.common.task.constraints.priority import contradictions

HAND = get_hand("human")
# A bar along x: its end at negative x may be grasped.
POINTS = np.stack([np.linspace(-0.1, 0.1, 41), np.zeros(41), np.zeros(41)], -1)
AVOID = POINTS[:, 0] > 0.02
NOT_TURNED = np.array([1.0, 0.0, 0.0, 0.0])
HEADING = grasp_frame(HAND).heading
CENTER = grasp_frame(HAND).center


def at(place):
    """An open hand, not turned, with its centre at a place."""
    return {"q": HAND.q_open, "position": np.array(place) - CENTER, "quaternion": NOT_TURNED}


def path_to(place):
    start = np.array(place) - CENTER - 0.15 * HEADING
    return {"position": np.linspace(start, np.array(place) - CENTER, 15), "quaternion": np.tile(NOT_TURNED, (15, 1))}


def all_of(avoid=None, **constraints):
    """Contradictions of a request for these constraints, and for an affordance if points are to be avoided."""
    asked = constraints if avoid is None else {**constraints, "affordance": {}}
    goal = goal_of(HAND, TaskConfig(), GraspRequest(asked))
    return contradictions(HAND, POINTS, np.zeros(len(POINTS), bool) if avoid is None else avoid, goal, asked)


def only(avoid=None, **constraints):
    (found,) = all_of(avoid, **constraints)
    return found


def test_what_agrees_says_nothing():
    place = (-0.06, 0.0, 0.0)
    path = path_to(place)
    on_graspable = {**path, "position": path["position"] - path["position"][-1] + [-0.1, 0.0, 0.05]}
    assert all_of(AVOID, heading={"direction": HEADING, "position": np.array(place)}, trajectory=on_graspable) == []
    assert all_of(heading={"direction": HEADING}, pose=at(place), trajectory=path) == []
    assert all_of() == []


def test_a_trajectory_that_ends_at_what_must_not_be_touched_is_refused():
    end = np.array([0.08, 0.03, 0.0])
    path = np.linspace(end + np.array([0, 0.2, 0]), end, 15)
    found = only(AVOID, trajectory={"position": path, "quaternion": np.tile(NOT_TURNED, (15, 1))})
    assert found.refused and (found.weaker, found.stronger) == ("affordance", "trajectory")
    graspable = np.hypot(0.08 - POINTS[~AVOID][:, 0].max(), 0.03)
    assert "3.0 cm from the avoid region" in found.message and f"{100 * graspable:.1f} cm from the" in found.message


def test_a_pose_away_from_the_trajectorys_end_keeps_its_fingers_alone():
    pose, path = at((-0.06, 0.0, 0.0)), path_to((-0.06, 0.0, 0.0))
    found = only(pose={**pose, "position": pose["position"] + np.array([0, 0, 0.05])}, trajectory=path)
    assert (found.weaker, found.stronger, found.refused) == ("pose", "trajectory", False)
    assert "5.0 cm and 0 degrees" in found.message and "only the fingers of the pose count" in found.message
    turned = np.array([np.cos(0.5), np.sin(0.5), 0.0, 0.0])
    assert "0.0 cm and 57 degrees" in only(pose={**pose, "quaternion": turned}, trajectory=path).message


def test_a_pose_that_touches_what_must_not_be_touched_names_the_links():
    tip = HAND.keypoints[len(HAND.links) + 1]
    pose = {"q": np.zeros(20), "quaternion": NOT_TURNED}
    found = only(AVOID, pose={**pose, "position": np.array([0.08, 0.0, 0.0]) - tip})
    assert (found.weaker, found.stronger, found.refused) == ("affordance", "pose", False)
    assert "index_distal" in found.message and "thumb" not in found.message
    assert all_of(AVOID, pose={**pose, "position": np.array([-0.08, 0, 0]) - tip}) == []


@pytest.mark.parametrize("stronger", ["pose", "trajectory"])
def test_a_heading_from_elsewhere_follows_the_reference(stronger):
    place = (-0.06, 0.0, 0.0)
    reference = {"pose": at(place)} if stronger == "pose" else {"trajectory": path_to(place)}
    found = only(heading={"direction": -HEADING}, **reference)
    assert (found.weaker, found.stronger) == ("heading", stronger)
    assert "180 degrees" in found.message and f"The {stronger} overrides it" in found.message


def test_a_heading_towards_what_must_not_be_touched_is_turned():
    found = only(AVOID, heading={"direction": np.array([0.0, -1.0, 0.0]), "position": np.array([0.08, 0.0, 0.0])})
    assert (found.weaker, found.stronger, found.refused) == ("heading", "affordance", False)
    assert "0.0 cm from the avoid region" in found.message and "redirects the heading" in found.message
