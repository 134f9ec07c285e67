"""The paper's priority rules."""

import itertools

import numpy as np
import pytest

from common.hands.kinematics import grasp_frame
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
