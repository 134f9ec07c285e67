"""The paper's priority rules."""

import itertools

import numpy as np
import pytest

from common.constraints.priority import Request, explain, resolve
from common.hands.kinematics import grasp_frame
from tests.scenes import HAND, scene


def _resolve(affordance: bool, pose: bool, trajectory: bool, seed: int = 0, **goal):
    _, surface, asked = scene(seed)
    flags = [np.full(4, flag) for flag in (affordance, pose, trajectory)]
    return asked._replace(**goal), surface, resolve(HAND, surface, Request(asked._replace(**goal), *flags))


@pytest.mark.parametrize(("affordance", "pose", "trajectory"), list(itertools.product([False, True], repeat=3)))
def test_truth_table(affordance, pose, trajectory):
    _, _, done = _resolve(affordance, pose, trajectory)
    expected = [affordance and not pose, pose, pose and not trajectory, trajectory]
    np.testing.assert_array_equal(done.goal.mask, np.tile(np.array(expected, np.float32), (4, 1)))


def test_a_lone_heading_stays_as_asked():
    asked, _, done = _resolve(False, False, False)
    np.testing.assert_allclose(done.goal.heading_position, asked.heading_position, atol=1e-6)
    np.testing.assert_allclose(done.goal.heading_direction, asked.heading_direction, atol=1e-6)


@pytest.mark.parametrize("trajectory", [False, True])
def test_an_overridden_heading_is_that_of_the_overriding_reference(trajectory):
    from scipy.spatial.transform import Rotation

    asked, _, done = _resolve(False, not trajectory, trajectory)
    q = asked.trajectory_quaternion[0, -1] if trajectory else asked.pose_quaternion[0]
    expected = Rotation.from_quat(q, scalar_first=True).apply(grasp_frame(HAND).heading)
    np.testing.assert_allclose(done.goal.heading_direction[0], expected, atol=1e-5)
    assert abs(np.dot(done.goal.heading_direction[0], done.goal.heading_cross[0])) < 1e-5


def test_under_a_trajectory_the_poses_fingers_are_carried_by_its_last_waypoint():
    asked, _, done = _resolve(False, True, True)
    np.testing.assert_allclose(done.goal.pose_position, asked.trajectory_position[:, -1])
    np.testing.assert_allclose(done.goal.pose_q, asked.pose_q)


def _two_regions(plus_x: float, minus_x: float):
    _, surface, asked = scene(1)
    x = np.where(surface.minus, minus_x, plus_x)
    points = np.stack([x, 0.001 * surface.points[..., 1], 0.001 * surface.points[..., 2]], -1).astype(np.float32)
    return surface._replace(points=points), asked


@pytest.mark.parametrize("at_minus", [True, False])
def test_affordance_turns_a_heading_that_comes_nearer_to_o_minus(at_minus):
    surface, asked = _two_regions(plus_x=0.1, minus_x=-0.1)
    where = np.tile(np.array([-0.1 if at_minus else 0.1, 0.0, 0.0], np.float32), (4, 1))
    down = np.tile(np.array([0.0, 0.0, -1.0], np.float32), (4, 1))
    cross = np.tile(np.array([0.0, 1.0, 0.0], np.float32), (4, 1))
    asked = asked._replace(heading_position=where, heading_direction=down, heading_cross=cross)
    off, on = np.zeros(4, bool), np.ones(4, bool)
    done = resolve(HAND, surface, Request(asked, on, off, off))
    assert np.all(np.asarray(done.redirected) == at_minus)
    np.testing.assert_allclose(done.goal.heading_position[:, 0], 0.1, atol=1e-3)
    assert not np.any(resolve(HAND, surface, Request(asked, off, off, off)).redirected)


@pytest.mark.parametrize(("end_x", "aligned"), [(0.1, True), (-0.1, False)])
def test_trajectory_and_affordance_must_agree(end_x, aligned):
    surface, asked = _two_regions(plus_x=0.1, minus_x=-0.1)
    path = asked.trajectory_position.copy()
    path[:, -1] = [end_x, 0.0, 0.05]
    asked = asked._replace(trajectory_position=path)
    off, on = np.zeros(4, bool), np.ones(4, bool)
    assert np.all(np.asarray(resolve(HAND, surface, Request(asked, on, off, on)).aligned) == aligned)
    assert np.all(resolve(HAND, surface, Request(asked, off, off, on)).aligned)


def test_explanations_name_what_is_overridden():
    words = " ".join(explain(affordance=True, pose=True, trajectory=True))
    assert "fingers count" in words and "overridden by the reference pose" in words
    assert explain(affordance=False, pose=False, trajectory=False) == ["The heading guides the wrist."]
