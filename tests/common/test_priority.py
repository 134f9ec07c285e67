"""The paper's priority rules, and contradictions: each kind is found, measured and explained."""

import functools
import itertools

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.request import GraspRequest
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import goal_of
from congrasp.common.task.constraints.priority import (
    active_blocks,
    contradictions,
    explain,
    resolve,
)
from tests.scenes import HAND, points_of, scene


def _flags(
    affordance: bool = False, pose: bool = False, trajectory: bool = False
) -> dict[str, np.ndarray]:
    return {
        "affordance": np.full(4, affordance),
        "pose": np.full(4, pose),
        "trajectory": np.full(4, trajectory),
    }


resolved = jax.jit(functools.partial(resolve, HAND))


def _resolve(affordance: bool, pose: bool, trajectory: bool):
    _, surface, goal = scene(0)
    return goal, resolved(surface, goal, _flags(affordance, pose, trajectory))


def test_active_blocks_follow_priority():
    for flags in itertools.product([False, True], repeat=3):
        jax.tree.map(
            np.testing.assert_array_equal,
            _resolve(*flags)[1].goal.active,
            active_blocks(_flags(*flags)),
        )


def test_lone_heading_is_unchanged():
    requested, done = _resolve(False, False, False)
    np.testing.assert_allclose(
        done.goal["heading"].position, requested["heading"].position, atol=1e-6
    )
    np.testing.assert_allclose(
        done.goal["heading"].direction, requested["heading"].direction, atol=1e-6
    )


@pytest.mark.parametrize("trajectory", [False, True])
def test_overridden_heading_is_the_reference_s(trajectory):
    requested, done = _resolve(False, not trajectory, trajectory)
    q = requested["trajectory"].quaternion[0, -1] if trajectory else requested["pose"].quaternion[0]
    expected = Rotation.from_quat(q, scalar_first=True).apply(grasp_frame(HAND).heading)
    np.testing.assert_allclose(done.goal["heading"].direction[0], expected, atol=1e-5)
    assert abs(np.dot(done.goal["heading"].direction[0], done.goal["heading"].cross[0])) < 1e-5


def test_heading_of_a_lone_trajectory():
    """By hand: the last waypoint is at (1, 2, 3) m and not turned, so that the centre is only
    shifted.
    """
    _, surface, goal = scene(0)
    path = goal["trajectory"].position.copy()
    turns = goal["trajectory"].quaternion.copy()
    path[:, -1] = (1.0, 2.0, 3.0)
    turns[:, -1] = (1.0, 0.0, 0.0, 0.0)
    goal = goal.replace("trajectory", position=path, quaternion=turns)
    q = 0.6 * HAND.q_open + 0.4 * HAND.q_closed
    tips = np.asarray(points_of(q))[len(HAND.links) :]
    center = (tips[0] + (tips[1] + tips[2] + tips[3] + tips[4]) / 4) / 2
    alone = resolved(surface, goal, _flags(trajectory=True)).goal
    np.testing.assert_allclose(
        alone["heading"].position, np.tile(np.add(center, (1, 2, 3)), (4, 1)), atol=1e-5
    )
    # The fingers of a reference pose are known, and taken as they are.
    both = resolved(surface, goal, _flags(pose=True, trajectory=True)).goal
    tips = np.asarray(points_of(goal["pose"].q))[:, len(HAND.links) :]
    expected = np.array([1, 2, 3]) + (tips[:, 0] + tips[:, 1:].mean(1)) / 2
    np.testing.assert_allclose(both["heading"].position, expected, atol=1e-5)


def test_trajectory_sets_the_wrist_of_a_pose():
    requested, done = _resolve(False, True, True)
    np.testing.assert_allclose(done.goal["pose"].position, requested["trajectory"].position[:, -1])
    np.testing.assert_allclose(done.goal["pose"].q, requested["pose"].q)


def _two_regions(graspable_x: float, avoid_x: float):
    _, surface, goal = scene(1)
    x = np.where(surface.avoid, avoid_x, graspable_x)
    points = np.stack(
        [x, 0.001 * surface.points[..., 1], 0.001 * surface.points[..., 2]], -1
    ).astype(np.float32)
    return surface._replace(points=points), goal


@pytest.mark.parametrize("at_avoided", [True, False])
def test_affordance_redirects_a_near_heading(at_avoided):
    surface, goal = _two_regions(graspable_x=0.1, avoid_x=-0.1)
    where = np.tile(np.array([-0.1 if at_avoided else 0.1, 0.0, 0.0], np.float32), (4, 1))
    down = np.tile(np.array([0.0, 0.0, -1.0], np.float32), (4, 1))
    cross = np.tile(np.array([0.0, 1.0, 0.0], np.float32), (4, 1))
    goal = goal.replace("heading", position=where, direction=down, cross=cross)
    done = resolved(surface, goal, _flags(affordance=True))
    assert np.all(np.asarray(done.redirected) == at_avoided)
    np.testing.assert_allclose(done.goal["heading"].position[:, 0], 0.1, atol=1e-3)
    assert not np.any(resolved(surface, goal, _flags()).redirected)


def _redirected(
    points: list[list[float]], avoid: list[list[float]], direction: list[float], cross: list[float]
):
    """The heading of a hand that comes along a direction to (-0.1, 0, 0), and of an object with
    these points.
    """
    _, surface, goal = scene(1)
    rows = lambda v: np.tile(np.array(v, np.float32), (4, 1))  # noqa: E731
    # As many as in the other tests, so that one program does for all: the last of each region
    # counts several times.
    points = [*points, *[points[-1]] * (48 - len(points))]
    cloud = np.tile(np.float32([*points, *avoid, *[avoid[-1]] * (16 - len(avoid))]), (4, 1, 1))
    surface = surface._replace(
        points=cloud, avoid=np.tile(np.arange(cloud.shape[1]) >= len(points), (4, 1))
    )
    goal = goal.replace(
        "heading", position=rows([-0.1, 0, 0]), direction=rows(direction), cross=rows(cross)
    )
    done = resolved(surface, goal, _flags(affordance=True))
    assert np.all(done.redirected)
    assert not np.any(resolved(surface, done.goal, _flags(affordance=True)).redirected)
    return jax.tree.map(lambda array: np.asarray(array)[0], done.goal["heading"])


def test_redirection_keeps_a_feasible_direction():
    """By hand: of two graspable points the nearer one is at (0.1, 0, 0), and the position 2 cm
    behind it.
    """
    heading = _redirected([[0.1, 0, 0], [0.2, 0, 0]], [[-0.1, 0, 0]], [0, 0, -1], [1, 0, 0])
    np.testing.assert_allclose(heading.position, [0.1, 0, -0.02], atol=1e-6)
    np.testing.assert_allclose(heading.direction, [0, 0, -1], atol=1e-6)
    np.testing.assert_allclose(heading.cross, [1, 0, 0], atol=1e-6)


def test_redirection_ends_at_the_surface():
    """The middle of a ring of 4 cm is its hole: the heading goes to the ring."""
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([0.1 + 0.04 * np.cos(turn), 0 * turn, 0.04 * np.sin(turn)], -1)
    heading = _redirected(ring.tolist(), [[-0.1, 0, 0]], [0, 0, -1], [0, 1, 0])
    surface = heading.position - 0.02 * heading.direction
    assert np.linalg.norm(ring - surface, axis=-1).min() < 1e-6
    # From above, 3 mm of the ring or more are before each point but those of its upper half.
    assert surface[2] > -0.001
    assert np.allclose(heading.direction, [0, 0, -1], atol=1e-6)


def test_redirection_is_the_smallest_rotation():
    """By hand: v = -z and w = x from 15 cm above the avoid region, at which the graspable one lies
    20 cm aside.

    Straight down is blocked by another avoided point. v turns by atan2(0.2, 0.15) about y, away
    from -z; w with it: (0.6, 0, 0.8).
    """
    heading = _redirected([[0.1, 0, 0]], [[-0.1, 0, 0], [0.1, 0, 0.1]], [0, 0, -1], [1, 0, 0])
    np.testing.assert_allclose(heading.direction, [0.8, 0, -0.6], atol=1e-6)
    np.testing.assert_allclose(heading.cross, [0.6, 0, 0.8], atol=1e-6)
    np.testing.assert_allclose(heading.position, [0.1 + 0.016, 0, -0.012], atol=1e-6)


def test_redirection_ends_where_a_hand_closes():
    """Two plates across the fingers, one of 14 cm that is nearer, one of 6 cm: 12 cm are the
    most.
    """
    wide = [[0.0, y, 0] for y in np.linspace(-0.07, 0.07, 15)]
    narrow = [[0.1, y, 0] for y in np.linspace(-0.03, 0.03, 15)]
    heading = _redirected([*wide, *narrow], [[-0.1, 0, 0]], [0, 0, -1], [0, 1, 0])
    np.testing.assert_allclose(heading.position[[0, 2]], [0.1, -0.02], atol=1e-6)


@pytest.mark.parametrize("wobble", [0.0, 1e-7, -1e-7])
def test_redirection_is_robust_to_rounding(wobble):
    """The heading turns by a right angle, to where its cross-finger direction w pointed: w turns
    with it, whatever the last bits of w were."""
    avoid = [[-0.1, 0, 0], [-0.1, 0, 0.12], [0.1, 0, 0.25]]
    heading = _redirected([[0.1, 0, 0.15]], avoid, [0, 0, -1], [1, wobble, 0])
    np.testing.assert_allclose(heading.direction, [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(heading.cross, [0, 0, 1], atol=1e-5)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_redirected_headings_lead_to_the_graspable_region(seed):
    """For any cloud: a point of the region is 2 cm before the position, and the rules have nothing
    more to change.
    """
    _, surface, goal = scene(seed)
    done = resolved(surface, goal, _flags(affordance=True))
    moved = np.asarray(done.redirected)
    heading = jax.device_get(done.goal["heading"])
    assert not np.any(resolved(surface, done.goal, _flags(affordance=True)).redirected)
    before = heading.position - 0.02 * heading.direction
    away = np.where(
        surface.avoid, np.inf, np.linalg.norm(surface.points - before[:, None], axis=-1)
    ).min(-1)
    assert (away[moved] < 1e-5).all()
    np.testing.assert_allclose(np.linalg.norm(heading.direction, axis=-1), 1.0, atol=1e-5)
    np.testing.assert_allclose(np.sum(heading.direction * heading.cross, -1), 0.0, atol=1e-5)
    for name, given_array in goal["heading"]._asdict().items():
        np.testing.assert_allclose(getattr(heading, name)[~moved], given_array[~moved], atol=1e-6)


def test_parallel_cross_direction_is_replaced():
    _, surface, goal = scene(3)
    for wobble in (0.0, 1e-7):
        cross = goal["heading"].direction + np.float32([wobble, 0, 0])
        heading = resolved(surface, goal.replace("heading", cross=cross), _flags()).goal["heading"]
        np.testing.assert_allclose(np.sum(heading.cross * heading.direction, -1), 0.0, atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(heading.cross, axis=-1), 1.0, atol=1e-6)


@pytest.mark.parametrize(("end_x", "aligned"), [(0.1, True), (-0.1, False)])
def test_trajectory_and_affordance_must_agree(end_x, aligned):
    surface, goal = _two_regions(graspable_x=0.1, avoid_x=-0.1)
    path = goal["trajectory"].position.copy()
    path[:, -1] = [end_x, 0.0, 0.05]
    goal = goal.replace("trajectory", position=path)
    both = _flags(affordance=True, trajectory=True)
    assert np.all(np.asarray(resolved(surface, goal, both).aligned) == aligned)
    assert np.all(resolved(surface, goal, _flags(trajectory=True)).aligned)


def test_explanations_name_overridden_constraints():
    words = " ".join(explain(["affordance", "pose", "trajectory"]))
    assert "only the fingers of the reference pose count" in words.lower()
    assert "overridden by the reference pose" in words
    assert explain([]) == ["The heading guides the wrist."]


# --- contradictions, of which agreement says nothing ---


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
    return {
        "position": np.linspace(start, np.array(place) - CENTER, 15),
        "quaternion": np.tile(NOT_TURNED, (15, 1)),
    }


def all_of(avoid=None, **constraints):
    """Contradictions of a request for these constraints, and for an affordance if points are to be
    avoided.
    """
    requested = constraints if avoid is None else {**constraints, "affordance": {}}
    goal = goal_of(HAND, TaskConfig(), GraspRequest(requested))
    return contradictions(
        HAND, POINTS, np.zeros(len(POINTS), bool) if avoid is None else avoid, goal, requested
    )


def only(avoid=None, **constraints):
    (conflict,) = all_of(avoid, **constraints)
    return conflict


def test_agreeing_constraints_have_no_message():
    place = (-0.06, 0.0, 0.0)
    path = path_to(place)
    on_graspable = {**path, "position": path["position"] - path["position"][-1] + [-0.1, 0.0, 0.05]}
    assert (
        all_of(
            AVOID,
            heading={"direction": HEADING, "position": np.array(place)},
            trajectory=on_graspable,
        )
        == []
    )
    assert all_of(heading={"direction": HEADING}, pose=at(place), trajectory=path) == []
    assert all_of() == []


def test_trajectory_to_avoid_region_is_refused():
    end = np.array([0.08, 0.03, 0.0])
    path = np.linspace(end + np.array([0, 0.2, 0]), end, 15)
    conflict = only(
        AVOID, trajectory={"position": path, "quaternion": np.tile(NOT_TURNED, (15, 1))}
    )
    assert conflict.refused
    assert conflict.weaker == "affordance"
    assert conflict.stronger == "trajectory"
    graspable = np.hypot(0.08 - POINTS[~AVOID][:, 0].max(), 0.03)
    assert "3.0 cm from the avoid region" in conflict.message
    assert f"{100 * graspable:.1f} cm from the" in conflict.message


def test_pose_off_the_trajectory_keeps_its_fingers():
    pose = at((-0.06, 0.0, 0.0))
    path = path_to((-0.06, 0.0, 0.0))
    conflict = only(
        pose={**pose, "position": pose["position"] + np.array([0, 0, 0.05])}, trajectory=path
    )
    assert (conflict.weaker, conflict.stronger, conflict.refused) == ("pose", "trajectory", False)
    assert "5.0 cm and 0 degrees" in conflict.message
    assert "only the fingers of the pose count" in conflict.message
    turned = np.array([np.cos(0.5), np.sin(0.5), 0.0, 0.0])
    assert (
        "0.0 cm and 57 degrees"
        in only(pose={**pose, "quaternion": turned}, trajectory=path).message
    )


def test_pose_on_avoid_region_names_the_links():
    tip = HAND.keypoints[len(HAND.links) + 1]
    pose = {"q": np.zeros(20), "quaternion": NOT_TURNED}
    conflict = only(AVOID, pose={**pose, "position": np.array([0.08, 0.0, 0.0]) - tip})
    assert (conflict.weaker, conflict.stronger, conflict.refused) == ("affordance", "pose", False)
    assert "index_distal" in conflict.message
    assert "thumb" not in conflict.message
    assert all_of(AVOID, pose={**pose, "position": np.array([-0.08, 0, 0]) - tip}) == []


@pytest.mark.parametrize("stronger", ["pose", "trajectory"])
def test_contradicting_heading_is_overridden(stronger):
    place = (-0.06, 0.0, 0.0)
    reference = {"pose": at(place)} if stronger == "pose" else {"trajectory": path_to(place)}
    conflict = only(heading={"direction": -HEADING}, **reference)
    assert conflict.weaker == "heading"
    assert conflict.stronger == stronger
    assert "180 degrees" in conflict.message
    assert f"The {stronger} overrides it" in conflict.message


def test_heading_to_avoid_region_is_redirected():
    conflict = only(
        AVOID,
        heading={"direction": np.array([0.0, -1.0, 0.0]), "position": np.array([0.08, 0.0, 0.0])},
    )
    assert (conflict.weaker, conflict.stronger, conflict.refused) == (
        "heading",
        "affordance",
        False,
    )
    assert "0.0 cm from the avoid region" in conflict.message
    assert "redirects the heading" in conflict.message
