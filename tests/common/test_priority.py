"""The paper's priority rules."""

import itertools

import numpy as np
import pytest

from common.hands.kinematics import grasp_frame, keypoints, link_transforms
from common.task.constraints.priority import explain, resolve
from tests.scenes import HAND, scene


def _flags(affordance: bool = False, pose: bool = False, trajectory: bool = False) -> dict[str, np.ndarray]:
    return {"affordance": np.full(4, affordance), "pose": np.full(4, pose), "trajectory": np.full(4, trajectory)}


def _resolve(affordance: bool, pose: bool, trajectory: bool):
    _, surface, asked = scene(0)
    return asked, resolve(HAND, surface, asked, _flags(affordance, pose, trajectory))


@pytest.mark.parametrize(("affordance", "pose", "trajectory"), list(itertools.product([False, True], repeat=3)))
def test_truth_table(affordance, pose, trajectory):
    _, done = _resolve(affordance, pose, trajectory)
    expected = {
        "affordance": affordance and not pose,
        "pose_finger": pose,
        "pose_wrist": pose and not trajectory,
        "trajectory": trajectory,
    }
    assert done.goal.active.keys() == expected.keys()
    for block, active in expected.items():
        np.testing.assert_array_equal(done.goal.active[block], np.full(4, active), err_msg=block)


def test_a_lone_heading_stays_as_asked():
    asked, done = _resolve(False, False, False)
    np.testing.assert_allclose(done.goal["heading"].position, asked["heading"].position, atol=1e-6)
    np.testing.assert_allclose(done.goal["heading"].direction, asked["heading"].direction, atol=1e-6)


@pytest.mark.parametrize("trajectory", [False, True])
def test_an_overridden_heading_is_that_of_the_overriding_reference(trajectory):
    from scipy.spatial.transform import Rotation

    asked, done = _resolve(False, not trajectory, trajectory)
    q = asked["trajectory"].quaternion[0, -1] if trajectory else asked["pose"].quaternion[0]
    expected = Rotation.from_quat(q, scalar_first=True).apply(grasp_frame(HAND).heading)
    np.testing.assert_allclose(done.goal["heading"].direction[0], expected, atol=1e-5)
    assert abs(np.dot(done.goal["heading"].direction[0], done.goal["heading"].cross[0])) < 1e-5


def test_a_lone_trajectorys_heading_is_at_the_centre_of_a_hand_that_is_closed_by_two_fifths():
    """By hand: the last waypoint is at (1, 2, 3) m and not turned, so the centre is that of the wrist frame, shifted."""
    _, surface, asked = scene(0)
    path = asked["trajectory"].position.copy()
    turns = asked["trajectory"].quaternion.copy()
    path[:, -1], turns[:, -1] = (1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0)
    asked = asked.replace("trajectory", position=path, quaternion=turns)
    q = 0.6 * HAND.q_open + 0.4 * HAND.q_closed
    tips = np.asarray(keypoints(HAND, link_transforms(HAND, q)))[len(HAND.links) :]
    center = (tips[0] + (tips[1] + tips[2] + tips[3] + tips[4]) / 4) / 2
    alone = resolve(HAND, surface, asked, _flags(trajectory=True)).goal
    np.testing.assert_allclose(alone["heading"].position, np.tile([1, 2, 3] + center, (4, 1)), atol=1e-5)
    # The fingers of a reference pose are known, and taken as they are.
    both = resolve(HAND, surface, asked, _flags(pose=True, trajectory=True)).goal
    tips = np.asarray(keypoints(HAND, link_transforms(HAND, asked["pose"].q)))[:, len(HAND.links) :]
    expected = np.array([1, 2, 3]) + (tips[:, 0] + tips[:, 1:].mean(1)) / 2
    np.testing.assert_allclose(both["heading"].position, expected, atol=1e-5)


def test_under_a_trajectory_the_poses_fingers_are_carried_by_its_last_waypoint():
    asked, done = _resolve(False, True, True)
    np.testing.assert_allclose(done.goal["pose"].position, asked["trajectory"].position[:, -1])
    np.testing.assert_allclose(done.goal["pose"].q, asked["pose"].q)


def _two_regions(graspable_x: float, avoid_x: float):
    _, surface, asked = scene(1)
    x = np.where(surface.avoid, avoid_x, graspable_x)
    points = np.stack([x, 0.001 * surface.points[..., 1], 0.001 * surface.points[..., 2]], -1).astype(np.float32)
    return surface._replace(points=points), asked


@pytest.mark.parametrize("at_avoided", [True, False])
def test_affordance_turns_a_heading_that_comes_nearer_to_the_avoid_region(at_avoided):
    surface, asked = _two_regions(graspable_x=0.1, avoid_x=-0.1)
    where = np.tile(np.array([-0.1 if at_avoided else 0.1, 0.0, 0.0], np.float32), (4, 1))
    down = np.tile(np.array([0.0, 0.0, -1.0], np.float32), (4, 1))
    cross = np.tile(np.array([0.0, 1.0, 0.0], np.float32), (4, 1))
    asked = asked.replace("heading", position=where, direction=down, cross=cross)
    done = resolve(HAND, surface, asked, _flags(affordance=True))
    assert np.all(np.asarray(done.redirected) == at_avoided)
    np.testing.assert_allclose(done.goal["heading"].position[:, 0], 0.1, atol=1e-3)
    assert not np.any(resolve(HAND, surface, asked, _flags()).redirected)


def test_a_redirected_heading_turns_the_hand_by_the_least_rotation():
    """By hand: v = -z and w = x from 15 cm above the avoid region, at which the graspable one lies 20 cm aside.

    v turns by atan2(0.2, 0.15) about y, away from -z; w with it: (0.6, 0, 0.8).
    """
    surface, asked = _two_regions(graspable_x=0.1, avoid_x=-0.1)
    surface = surface._replace(points=surface.points * np.array([1, 0, 0], np.float32))
    rows = lambda *v: np.tile(np.array(v, np.float32), (4, 1))  # noqa: E731
    asked = asked.replace("heading", position=rows(-0.1, 0, 0), direction=rows(0, 0, -1), cross=rows(1, 0, 0))
    heading = resolve(HAND, surface, asked, _flags(affordance=True)).goal["heading"]
    np.testing.assert_allclose(heading.direction, rows(0.8, 0, -0.6), atol=1e-6)
    np.testing.assert_allclose(heading.cross, rows(0.6, 0, 0.8), atol=1e-6)


@pytest.mark.parametrize("wobble", [0.0, 1e-7, -1e-7])
def test_rounding_does_not_decide_on_the_roll_of_a_redirected_heading(wobble):
    """The heading turns by a right angle, to where its cross-finger direction w pointed: w turns with it, whatever the
    last bits of w were."""
    surface, asked = _two_regions(graspable_x=0.1, avoid_x=-0.1)
    surface = surface._replace(points=surface.points * np.array([1, 0, 0], np.float32) + np.float32([0, 0, 0.15]))
    rows = lambda *v: np.tile(np.array(v, np.float32), (4, 1))  # noqa: E731
    asked = asked.replace("heading", position=rows(-0.1, 0, 0), direction=rows(0, 0, -1), cross=rows(1, wobble, 0))
    heading = resolve(HAND, surface, asked, _flags(affordance=True)).goal["heading"]
    np.testing.assert_allclose(heading.direction, rows(1, 0, 0), atol=1e-6)
    np.testing.assert_allclose(heading.cross, rows(0, 0, 1), atol=1e-5)


def test_a_cross_finger_direction_along_the_heading_is_replaced_by_an_orthogonal_one():
    _, surface, asked = scene(3)
    for wobble in (0.0, 1e-7):
        cross = asked["heading"].direction + np.float32([wobble, 0, 0])
        heading = resolve(HAND, surface, asked.replace("heading", cross=cross), _flags()).goal["heading"]
        np.testing.assert_allclose(np.sum(heading.cross * heading.direction, -1), 0.0, atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(heading.cross, axis=-1), 1.0, atol=1e-6)


@pytest.mark.parametrize(("end_x", "aligned"), [(0.1, True), (-0.1, False)])
def test_trajectory_and_affordance_must_agree(end_x, aligned):
    surface, asked = _two_regions(graspable_x=0.1, avoid_x=-0.1)
    path = asked["trajectory"].position.copy()
    path[:, -1] = [end_x, 0.0, 0.05]
    asked = asked.replace("trajectory", position=path)
    both = _flags(affordance=True, trajectory=True)
    assert np.all(np.asarray(resolve(HAND, surface, asked, both).aligned) == aligned)
    assert np.all(resolve(HAND, surface, asked, _flags(trajectory=True)).aligned)


def test_explanations_name_what_is_overridden():
    words = " ".join(explain(["affordance", "pose", "trajectory"]))
    assert "fingers count" in words and "overridden by the reference pose" in words
    assert explain([]) == ["The heading guides the wrist."]
