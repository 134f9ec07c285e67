"""Observation, control, reward and metrics: invariance of frames, and formulas against independent
NumPy.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from congrasp.common.hands.kinematics import grasp_frame, hand_center
from congrasp.common.task import metrics
from congrasp.common.task.config import RewardWeights, TaskConfig
from congrasp.common.task.constraints import PAPER
from congrasp.common.task.constraints.heading import heading_wrist_pose
from congrasp.common.task.constraints.pose import pose_gate
from congrasp.common.task.constraints.trajectory import active_waypoint
from congrasp.common.task.control import decode, guidance_pose
from congrasp.common.task.features import features, scene_of
from congrasp.common.task.geometry import NO_POINT_DISTANCE, squash, wrist_pose, wrist_to_joints
from congrasp.common.task.metrics import errors
from congrasp.common.task.observation import fields, layout, observe
from congrasp.common.task.reward import reward_terms, terms
from tests.scenes import HAND, F, K, L, active, near_targets, points_of, scene, units

TASK = TaskConfig(constraints=PAPER)
TERMS = terms(TASK)
UNIT = RewardWeights(**{name: 1.0 for name in TERMS}, force_max=5.0)


def _compiled(function: Callable) -> Callable:
    """A function of a `Scene` as one of its state, surface and goal."""
    return jax.jit(
        lambda state, surface, goal, *rest: function(
            scene_of(HAND, TASK, state, surface, goal), *rest
        )
    )


FEATURES = jax.jit(functools.partial(features, HAND, TASK))
OBSERVE = _compiled(observe)
REWARD = _compiled(reward_terms)
ERRORS = _compiled(errors)
DECODE = _compiled(decode)
GUIDANCE = _compiled(guidance_pose)
WRIST = jax.jit(wrist_pose)
TO_JOINTS = jax.jit(wrist_to_joints)
HEADING_WRIST = jax.jit(functools.partial(heading_wrist_pose, HAND))
CENTER = jax.jit(functools.partial(hand_center, HAND))


def _blocks(observation: np.ndarray) -> dict[str, np.ndarray]:
    out = {}
    start = 0
    for name, size in layout(HAND, TASK):
        out[name] = np.asarray(observation)[:, start : start + size]
        start += size
    assert start == observation.shape[1]
    return out


def _joint_differences(turn: Rotation, present: np.ndarray) -> np.ndarray:
    """(3,) what the hinges x, y, z must turn by from their present angles: the less of the two
    ways, in SciPy.
    """
    x, y, z = turn.as_euler("XYZ")
    ways = np.array([[x, y, z], [x + np.pi, np.pi - y, z + np.pi]]) - present
    ways = (ways + np.pi) % (2 * np.pi) - np.pi
    return ways[(ways**2).sum(-1).argmin()]


def _rotation(q: np.ndarray) -> Rotation:
    return Rotation.from_quat(q, scalar_first=True)


def test_features_against_numpy():
    state, surface, goal = scene(7)
    geometry = FEATURES(state, surface, goal)
    avoided = geometry.by_constraint["affordance"]
    b = 2
    wrist = _rotation(state.base_quaternion[b]) * Rotation.from_euler("XYZ", state.u[b, 3:])
    origin = state.base_position[b] + _rotation(state.base_quaternion[b]).apply(state.u[b, :3])
    np.testing.assert_allclose(geometry.wrist_position[b], origin, atol=1e-5)
    body = _rotation(state.object_quaternion[b])
    # In the wrist frame
    cloud = wrist.inv().apply(body.apply(surface.points[b]) + state.object_position[b] - origin)
    points = np.asarray(points_of(state.q[b]))
    offsets = cloud[None] - points[:, None]
    distance = np.linalg.norm(offsets, axis=-1)
    nearest = offsets[np.arange(len(points)), distance.argmin(1)]
    np.testing.assert_allclose(geometry.nearest[b], nearest, atol=1e-4)
    avoid = np.where(surface.avoid[b], distance, np.inf)
    # The palm does not count as a finger
    np.testing.assert_allclose(
        avoided.distance[b], (avoid.min(1) - HAND.keypoint_radii)[1:].min(), atol=1e-4
    )
    forces = wrist.inv().apply(state.contact_force[b].reshape(-1, 3)).reshape(L, -1, 3)
    forces *= state.contact_found[b][..., None]
    np.testing.assert_allclose(geometry.force[b], forces.sum(1), atol=1e-4)
    where = body.inv().apply(state.contact_position[b].reshape(-1, 3) - state.object_position[b])
    label = surface.avoid[b][
        np.linalg.norm(where[:, None] - surface.points[b][None], axis=-1).argmin(1)
    ].reshape(L, -1)
    np.testing.assert_array_equal(avoided.touching[b], (state.contact_found[b] & label).any(1))
    np.testing.assert_array_equal(
        avoided.touching_graspable[b], (state.contact_found[b] & ~label).any(1)
    )
    np.testing.assert_allclose(avoided.force[b], (forces * label[..., None]).sum(1), atol=1e-4)
    np.testing.assert_allclose(
        geometry.force[b] - avoided.force[b], (forces * ~label[..., None]).sum(1), atol=1e-4
    )


def test_without_an_avoid_region_there_is_nothing_to_avoid():
    state, surface, goal = scene(8)
    geometry = FEATURES(
        state, surface._replace(avoid=np.zeros_like(surface.avoid)), goal
    ).by_constraint["affordance"]
    assert np.all(np.asarray(geometry.distance) == np.float32(NO_POINT_DISTANCE))
    assert not np.any(geometry.nearest)
    assert not np.any(geometry.touching)


def test_observation_blocks_by_hand():
    state, surface, goal = scene(10)
    geometry = FEATURES(state, surface, goal)
    parts = _blocks(OBSERVE(state, surface, goal))
    np.testing.assert_allclose(parts["state"][:, :F], state.q)
    np.testing.assert_allclose(parts["pose_finger"][:, :F], goal["pose"].q - state.q, atol=1e-6)
    center = np.asarray(geometry.center)
    np.testing.assert_allclose(parts["heading"][:, :3], center)
    np.testing.assert_allclose(
        parts["heading"][:, 6:9], parts["heading"][:, 3:6] - center, atol=1e-6
    )
    # u-bar of a pose: the virtual joints that would put the wrist there.
    b = 1
    body = _rotation(state.object_quaternion[b])
    target = body.apply(goal["pose"].position[b]) + state.object_position[b]
    base = _rotation(state.base_quaternion[b])
    u = base.inv().apply(target - state.base_position[b])
    np.testing.assert_allclose(parts["pose_wrist"][b, :3], u - state.u[b, :3], atol=1e-4)
    for quaternion, seen in (
        (goal["pose"].quaternion[b], parts["pose_wrist"][b]),
        *zip(goal["trajectory"].quaternion[b], parts["trajectory"][b].reshape(K, 6), strict=True),
    ):
        turn = base.inv() * body * _rotation(quaternion)
        np.testing.assert_allclose(seen[3:], _joint_differences(turn, state.u[b, 3:]), atol=5e-3)
    assert parts["trajectory"].shape == (4, 6 * K)
    np.testing.assert_allclose(squash(np.array([[5.0, 0.0, 0.0]])), [[0.5, 0.0, 0.0]])


def test_normals_belong_to_the_nearest_points():
    """n of the surface point nearest to each keypoint, in the wrist frame, and the height -n . d
    above its plane.
    """
    state, surface, goal = scene(10)
    before = np.asarray(OBSERVE(state, surface, goal))
    exact = surface._replace(normals=units(np.random.default_rng(0), 4, surface.points.shape[1]))
    task = dataclasses.replace(TASK, surface_normals=True)
    observed = np.asarray(
        jax.jit(lambda *given: observe(scene_of(HAND, task, *given)))(state, exact, goal)
    )
    described = fields(HAND, task)["state"]
    names = [field.name for field in described]
    assert names[names.index("nearest") :][:3] == ["nearest", "normal", "height"]
    start = sum(field.size for field in described[: names.index("normal")])
    points = HAND.keypoints.shape[0]
    np.testing.assert_allclose(
        np.delete(observed, np.s_[start : start + 4 * points], 1), before, atol=1e-6
    )
    b = 2
    normal = observed[b, start : start + 3 * points].reshape(-1, 3)
    height = observed[b, start + 3 * points : start + 4 * points]
    wrist = _rotation(state.base_quaternion[b]) * Rotation.from_euler("XYZ", state.u[b, 3:])
    origin = state.base_position[b] + _rotation(state.base_quaternion[b]).apply(state.u[b, :3])
    body = _rotation(state.object_quaternion[b])
    keys = wrist.apply(np.asarray(points_of(state.q[b]))) + origin
    keys = body.inv().apply(keys - state.object_position[b])  # in the object frame
    nearest = np.linalg.norm(keys[:, None] - exact.points[b], axis=-1).argmin(1)
    expected = exact.normals[b][nearest]
    np.testing.assert_allclose(normal, (wrist.inv() * body).apply(expected), atol=1e-5)
    np.testing.assert_allclose(
        height, np.sum((keys - exact.points[b][nearest]) * expected, -1), atol=1e-4
    )


@pytest.mark.parametrize("near", [False, True])
def test_reward_terms_against_numpy(near):  # noqa: PLR0915
    """Far from its targets a hand pays the most that tracking can cost: 15 cm and half a radian."""
    state, surface, goal = scene(11)
    goal = near_targets(state, goal, 12) if near else goal
    geometry = FEATURES(state, surface, goal)
    avoided = geometry.by_constraint["affordance"]
    paid = {name: np.asarray(value) for name, value in REWARD(state, surface, goal, UNIT).items()}
    b = 3
    d = np.linalg.norm(np.asarray(geometry.nearest)[b], axis=-1)
    weights = HAND.contact_weights
    np.testing.assert_allclose(paid["distance"][b], -(HAND.keypoint_weights * d).sum(), rtol=1e-4)
    graspable = np.asarray(avoided.touching_graspable)[b]
    np.testing.assert_allclose(paid["contact"][b], (weights * graspable).sum(), rtol=1e-5)
    pressed = np.linalg.norm(np.asarray(geometry.force - avoided.force)[b], axis=-1)
    np.testing.assert_allclose(
        paid["force"][b], (weights * graspable * np.minimum(pressed, 5) / 5).sum(), rtol=1e-4
    )
    force = np.linalg.norm(np.asarray(geometry.force)[b], axis=-1)
    np.testing.assert_allclose(paid["force_excess"][b], -np.clip(force - 5, 0, 50).sum(), rtol=1e-4)
    shift = state.object_position[b] - state.object_position_initial[b]
    np.testing.assert_allclose(paid["object_position"][b], -min(shift @ shift, 0.04), rtol=1e-4)
    turn = _rotation(state.object_quaternion[b]).inv() * _rotation(
        state.object_quaternion_initial[b]
    )
    np.testing.assert_allclose(
        paid["object_rotation"][b], -min(turn.magnitude() ** 2, 1.0), rtol=1e-3
    )
    np.testing.assert_allclose(
        paid["wrist_velocity"][b], -(state.u_velocity[b] ** 2).sum(), rtol=1e-4
    )
    np.testing.assert_allclose(
        paid["finger_deviation"][b], -((state.q[b] - state.q_initial[b]) ** 2).sum(), rtol=1e-4
    )
    frame = grasp_frame(HAND)
    wrist_position, wrist_quaternion = (np.asarray(x)[b] for x in WRIST(state))
    wrist = _rotation(wrist_quaternion)
    body = _rotation(state.object_quaternion[b])
    v = wrist.apply(frame.heading)
    np.testing.assert_allclose(
        paid["heading_direction"][b], v @ body.apply(goal["heading"].direction[b]), atol=1e-4
    )
    points = np.asarray(points_of(state.q[b]))
    center = wrist.apply(np.asarray(CENTER(points))) + wrist_position
    target = body.apply(goal["heading"].position[b]) + state.object_position[b]
    np.testing.assert_allclose(
        paid["heading_position"][b], -min(np.linalg.norm(center - target), 0.15), rtol=1e-3
    )
    gate = np.clip((0.10 - d.min()) / 0.07, 0, 1)
    np.testing.assert_allclose(
        paid["pose_finger"][b],
        -gate * ((state.q[b] - goal["pose"].q[b]) ** 2).sum(),
        rtol=1e-3,
        atol=1e-5,
    )
    pose_position = body.apply(goal["pose"].position[b]) + state.object_position[b]
    pose_turn = body * _rotation(goal["pose"].quaternion[b])
    reference = np.asarray(points_of(goal["pose"].q[b]))
    reference = wrist.inv().apply(pose_turn.apply(reference) + pose_position - wrist_position)
    np.testing.assert_allclose(
        paid["pose_link"][b], -gate * ((reference - points) ** 2).sum(), rtol=1e-3, atol=1e-5
    )
    np.testing.assert_allclose(
        paid["pose_wrist_position"][b],
        -min(((wrist_position - pose_position) ** 2).sum(), 0.15**2),
        rtol=1e-3,
    )
    np.testing.assert_allclose(
        paid["pose_wrist_rotation"][b],
        -(min((wrist.inv() * pose_turn).magnitude(), 0.5) ** 2),
        rtol=1e-3,
        atol=1e-4,
    )
    way = body.apply(goal["trajectory"].position[b]) + state.object_position[b]
    guiding = _rotation(state.object_quaternion_initial[b]).apply(goal["trajectory"].position[b])
    guiding += state.object_position_initial[b]
    k = min(np.linalg.norm(guiding - wrist_position, axis=-1).argmin() + 1, K - 1)
    np.testing.assert_allclose(
        paid["trajectory_position"][b],
        -min(((way[k] - wrist_position) ** 2).sum(), 0.15**2),
        rtol=1e-3,
    )
    way_turn = body * _rotation(goal["trajectory"].quaternion[b, k])
    np.testing.assert_allclose(
        paid["trajectory_rotation"][b],
        -(min((wrist.inv() * way_turn).magnitude(), 0.5) ** 2),
        rtol=1e-3,
        atol=1e-4,
    )
    barrier = np.logaddexp(0.0, (0.01 - float(avoided.distance[b])) / 0.002)
    np.testing.assert_allclose(paid["affordance_distance"][b], -barrier, rtol=1e-3)
    avoided_force = np.linalg.norm(np.asarray(avoided.force)[b], axis=-1)
    np.testing.assert_allclose(
        paid["affordance_force"][b], -np.minimum(avoided_force, 10).sum(), rtol=1e-4
    )


def test_without_affordance_every_contact_is_rewarded():
    state, surface, goal = scene(12)
    off = dataclasses.replace(goal, active=active())
    geometry = FEATURES(state, surface, off)
    paid = REWARD(state, surface, off, UNIT)
    earned = (HAND.contact_weights * np.asarray(geometry.touching)).sum(-1)
    np.testing.assert_allclose(paid["contact"], earned, rtol=1e-5)


def test_pose_gate_by_hand():
    np.testing.assert_allclose(
        pose_gate(np.array([0.2, 0.1, 0.065, 0.03, 0.0])), [0, 0, 0.5, 1, 1], atol=1e-6
    )


def test_dropping_is_seen_five_centimetres_down():
    state, surface, goal = scene(13)
    for depth, expected in ((0.049, 0.0), (0.051, -1.0)):
        low = state._replace(
            object_position=state.object_position_initial - np.array([0, 0, depth], np.float32)
        )
        assert np.all(np.asarray(REWARD(low, surface, goal, UNIT)["drop"]) == expected)


def test_fingers_integrate_actions_within_their_limits():
    state, surface, goal = scene(14)
    action = np.zeros((4, F + 6), np.float32)
    action[:, 0] = 1.0
    action[:, 1] = 100.0
    target = DECODE(state, surface, goal, TASK.control, action).q_target
    np.testing.assert_allclose(
        target[:, 0],
        np.minimum(state.q_target[:, 0] + TASK.control.finger_scale, HAND.upper[0]),
        rtol=1e-5,
    )
    np.testing.assert_allclose(target[:, 1], HAND.upper[1])
    np.testing.assert_allclose(target[:, 2:], state.q_target[:, 2:], atol=1e-6)


def test_active_waypoint_is_one_ahead():
    path = np.zeros((3, 5, 3), np.float32)
    path[..., 0] = np.arange(5)
    wrist = np.array([[-1, 0, 0], [1.6, 0, 0], [9, 0, 0]], np.float32)
    np.testing.assert_array_equal(active_waypoint(wrist, path, 1), [1, 3, 4])
    np.testing.assert_array_equal(active_waypoint(wrist, path, 0), [0, 2, 4])


def test_heading_pose_aligns_axis_cross_and_center():
    _, _, goal = scene(15)
    center = np.tile(grasp_frame(HAND).center, (4, 1))
    position, quaternion = (np.asarray(x) for x in HEADING_WRIST(goal["heading"], center))
    for b in range(4):
        wrist = _rotation(quaternion[b])
        np.testing.assert_allclose(
            wrist.apply(grasp_frame(HAND).heading), goal["heading"].direction[b], atol=1e-5
        )
        np.testing.assert_allclose(
            wrist.apply(grasp_frame(HAND).cross), goal["heading"].cross[b], atol=1e-5
        )
        np.testing.assert_allclose(
            wrist.apply(center[b]) + position[b], goal["heading"].position[b], atol=1e-5
        )


@pytest.mark.parametrize(
    ("on", "source"),
    [
        ((), "heading"),
        (("pose_finger", "pose_wrist"), "pose"),
        (("affordance", "pose_finger", "trajectory"), "trajectory"),
    ],
)
def test_guidance_of_the_strongest_constraint(on, source):
    state, surface, goal = scene(16)
    goal = dataclasses.replace(goal, active=active(*on))
    geometry = FEATURES(state, surface, goal)
    position, _ = GUIDANCE(state, surface, goal, TASK.control)
    body = _rotation(state.object_quaternion_initial[0])
    here = np.asarray(geometry.wrist_position)[0]
    if source == "heading":
        local = np.asarray(HEADING_WRIST(goal["heading"], geometry.center)[0])[0]
    elif source == "pose":
        local = goal["pose"].position[0]
    else:
        way = body.apply(goal["trajectory"].position[0]) + state.object_position_initial[0]
        local = goal["trajectory"].position[
            0, min(np.linalg.norm(way - here, axis=-1).argmin() + 1, K - 1)
        ]
    np.testing.assert_allclose(
        position[0], body.apply(local) + state.object_position_initial[0], atol=1e-4
    )


def test_wrist_target_is_guidance_plus_residual():
    state, surface, goal = scene(17)
    far = dataclasses.replace(
        TASK.control,
        guidance_position_limit=1e3,
        approach_position_limit=1e3,
        guidance_rotation_limit=1e3,
        wrist_acceleration=0.0,
        wrist_angular_acceleration=0.0,
    )
    zero = np.zeros((4, F + 6), np.float32)
    one = np.zeros((4, F + 6), np.float32)
    one[:, F:] = 1.0
    still, pushed = (np.asarray(DECODE(state, surface, goal, far, a).u_target) for a in (zero, one))
    np.testing.assert_allclose(pushed - still, np.tile([0.02] * 3 + [0.1] * 3, (4, 1)), atol=1e-5)
    np.testing.assert_allclose(
        still, TO_JOINTS(state, *GUIDANCE(state, surface, goal, far)), atol=1e-5
    )


def test_no_action_drives_the_wrist_beyond_its_limits():
    """By the servos' own law: acceleration (kp (target - u) - kv v) / m, and speeds that targets
    can sustain.

    Where the table is gone a third of the acceleration is left, but what slows the wrist down by
    its servos' own rate.
    """
    state, surface, goal = scene(17)
    state = state._replace(table=np.array([True, False, True, False]))
    share = np.where(state.table, 1.0, 1 / 3)
    wrist = HAND.wrist
    mass, inertia = HAND.wrist_inertia
    for scale in (0.0, 1.0, -30.0):
        action = np.full((4, F + 6), scale, np.float32)
        target = np.asarray(DECODE(state, surface, goal, TASK.control, action).u_target)
        lead = target - state.u
        speed = state.u_velocity
        for part, kp, kv, inert, most, farthest in (
            (slice(0, 3), wrist.slide_kp, wrist.slide_kv, mass, 15.0, 0.04),
            (slice(3, 6), wrist.hinge_kp, wrist.hinge_kv, inertia, 150.0, 0.3),
        ):
            force = kp * lead[:, part] - kv * speed[:, part]
            acceleration = np.linalg.norm(force, axis=-1) / inert
            allowed = np.clip(np.linalg.norm(speed[:, part], axis=-1) * kp / kv, most * share, most)
            assert np.all(acceleration <= allowed * 1.001)
            if scale == -30.0:
                assert np.all(acceleration >= allowed * 0.99)
            # Where the wrist is faster than a target sustains, it is slowed down.
            fast = np.linalg.norm(speed[:, part], axis=-1) * kv / kp > farthest
            assert np.all((np.sum(force * speed[:, part], -1) < 0)[fast])


def test_a_wrist_at_rest_starts_towards_its_guidance():
    state, surface, goal = scene(17)
    state = state._replace(u_velocity=np.zeros((4, 6), np.float32))
    ahead = (
        np.asarray(
            DECODE(state, surface, goal, TASK.control, np.zeros((4, F + 6), np.float32)).u_target
        )
        - state.u
    )
    toward = (
        np.asarray(TO_JOINTS(state, *GUIDANCE(state, surface, goal, TASK.control)))[:, :3]
        - state.u[:, :3]
    )
    cosine = (
        np.sum(toward * ahead[:, :3], -1)
        / np.linalg.norm(toward, axis=-1)
        / np.linalg.norm(ahead[:, :3], axis=-1)
    )
    np.testing.assert_allclose(cosine, 1.0, atol=1e-4)
    # 15 m/s^2 times 0.988 kg over 1,800 N/m
    np.testing.assert_allclose(np.linalg.norm(ahead[:, :3], axis=-1), 0.00823, atol=1e-5)


def test_metrics_against_numpy():
    state, surface, goal = scene(18)
    geometry = FEATURES(state, surface, goal)
    expected_metrics = {}
    weights = {}
    for name, (numerator, denominator) in ERRORS(state, surface, goal).items():
        expected_metrics[name] = np.asarray(numerator)
        weights[name] = np.asarray(denominator)
    b = 0
    wrist_position, wrist_quaternion = (np.asarray(x)[b] for x in WRIST(state))
    wrist = _rotation(wrist_quaternion)
    body = _rotation(state.object_quaternion[b])
    v = wrist.apply(grasp_frame(HAND).heading)
    target = body.apply(goal["heading"].direction[b])
    np.testing.assert_allclose(
        expected_metrics["heading_rad"][b], np.arccos(np.clip(v @ target, -1, 1)), atol=1e-4
    )
    points = np.asarray(points_of(state.q[b]))
    center = wrist.apply(np.asarray(CENTER(points))) + wrist_position
    off = center - body.apply(goal["heading"].position[b]) - state.object_position[b]
    np.testing.assert_allclose(
        expected_metrics["heading_m"][b], np.linalg.norm(off - (off @ target) * target), atol=1e-4
    )
    pose = body.apply(goal["pose"].position[b]) + state.object_position[b]
    np.testing.assert_allclose(
        expected_metrics["pose_m"][b], np.linalg.norm(wrist_position - pose), atol=1e-4
    )
    base = _rotation(state.base_quaternion[b])
    turn = base.inv() * body * _rotation(goal["pose"].quaternion[b])
    hinges = _joint_differences(turn, state.u[b, 3:])
    expected = np.abs(np.concatenate([state.q[b] - goal["pose"].q[b], hinges])).mean()
    np.testing.assert_allclose(expected_metrics["pose_rad"][b], expected, atol=1e-3)
    links = np.sum(np.asarray(geometry.by_constraint["affordance"].touching)[b])
    np.testing.assert_allclose(expected_metrics["affordance_ratio"][b], links)
    np.testing.assert_allclose(
        weights.pop("affordance_ratio")[b], np.sum(np.asarray(geometry.touching)[b])
    )
    assert all((weight == 1.0).all() for weight in weights.values())


def test_fixed_center_is_that_of_initial_fingers():
    fixed = dataclasses.replace(TASK, dynamic_center=False)
    fixed_features = jax.jit(functools.partial(features, HAND, fixed))
    state, surface, goal = scene(19)
    geometry = fixed_features(state, surface, goal)
    np.testing.assert_allclose(
        geometry.center, np.tile(grasp_frame(HAND).center, (4, 1)), atol=1e-6
    )
    began = state._replace(q_initial=state.q_target)
    expected = CENTER(points_of(state.q_target))
    np.testing.assert_allclose(fixed_features(began, surface, goal).center, expected, atol=1e-6)
    assert np.abs(expected - geometry.center).max() > 0.01


def test_guidance_reward_and_error_share_a_waypoint():
    """By hand: waypoints every 2 cm along x, the wrist at 4.4 cm, the object pushed by 3 cm along
    x.

    The guidance counts on the object as it lay: nearest is waypoint 2 at 4 cm, active is 3. On the
    object as it lies now the waypoints begin at 3 cm, and the nearest would be number 1.
    """
    state, surface, goal = scene(22)
    x = np.array([1, 0, 0], np.float32)
    none = np.tile(np.array([1, 0, 0, 0], np.float32), (4, 1))
    state = state._replace(
        u=np.zeros((4, 6), np.float32),
        base_position=np.tile(0.044 * x, (4, 1)),
        base_quaternion=none,
        object_position=np.tile(0.03 * x, (4, 1)),
        object_position_initial=np.zeros((4, 3), np.float32),
        object_quaternion=none,
        object_quaternion_initial=none,
    )
    path = np.tile(0.02 * np.arange(K, dtype=np.float32)[:, None] * x, (4, 1, 1))
    goal = goal.replace("trajectory", position=path, quaternion=np.tile(none[:, None], (1, K, 1)))
    position, _ = GUIDANCE(state, surface, goal, TASK.control)
    np.testing.assert_allclose(position, np.tile(0.06 * x, (4, 1)), atol=1e-6)
    # The same waypoint, carried by the object: 9 cm, which is 4.6 cm from the wrist.
    np.testing.assert_allclose(ERRORS(state, surface, goal)["trajectory_m"][0], 0.046, atol=1e-6)
    np.testing.assert_allclose(
        REWARD(state, surface, goal, UNIT)["trajectory_position"], -(0.046**2), atol=1e-6
    )


@pytest.mark.parametrize("steps", [50, 100])
def test_an_error_is_divided_by_the_steps_that_were_summed(steps):
    """Where the object is held in place the table never goes, and the approach is as long as the
    episode.
    """
    one = np.ones(1)
    step = {spec.name: (0.2 * one, one) for spec in metrics.specs(TASK)}
    sums = metrics.empty_sums(TASK, 1)
    accumulate = jax.jit(functools.partial(metrics.accumulate, TASK))
    for _ in range(steps):
        sums = accumulate(sums, step, approach=one > 0, hold=one < 0)
    errors = metrics.episode_errors(TASK, sums)
    np.testing.assert_allclose(errors["trajectory_m"], 0.2, rtol=1e-5)
    np.testing.assert_allclose(errors["trajectory_rad"], 0.2, rtol=1e-5)
    np.testing.assert_allclose(errors["heading_m"], 0.0)
