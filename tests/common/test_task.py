"""Observation, control, reward and metrics: invariance of frames, and formulas against independent NumPy."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from common.config import RewardWeights, TaskConfig
from common.hands.kinematics import grasp_frame, hand_center, keypoints, link_transforms
from common.task.control import active_waypoint, decode, guidance_pose, heading_wrist_pose, wrist_to_joints
from common.task.features import FAR, features, wrist_pose
from common.task.metrics import errors
from common.task.observation import layout, observe, squash
from common.task.reward import TERMS, pose_gate, reward_terms
from common.task.types import MASKS
from tests.scenes import HAND, F, K, L, moved, near_targets, scene

TASK = TaskConfig()
FEATURES = jax.jit(functools.partial(features, HAND, TASK))
OBSERVE = jax.jit(functools.partial(observe, TASK))
REWARD = jax.jit(functools.partial(reward_terms, HAND, TASK))
ERRORS = jax.jit(functools.partial(errors, HAND, TASK))
DECODE = jax.jit(functools.partial(decode, HAND))
UNIT = RewardWeights(**{name: 1.0 for name in TERMS}, force_max=5.0)


def _blocks(observation: np.ndarray) -> dict[str, np.ndarray]:
    out, start = {}, 0
    for name, size in layout(HAND, TASK):
        out[name] = np.asarray(observation)[:, start : start + size]
        start += size
    assert start == observation.shape[1]
    return out


def _rotation(q: np.ndarray) -> Rotation:
    return Rotation.from_quat(q, scalar_first=True)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**31), st.integers(0, 2**31))
def test_moving_and_turning_the_whole_scene_changes_nothing(seed, motion):
    state, surface, goal = scene(seed)
    rng = np.random.default_rng(motion)
    # Heights decide on `drop`, so that the invariance of rewards is about turns round the vertical and level shifts;
    # observations do not know the vertical and stand any motion.
    level = moved(state, np.append(rng.normal(size=2), 0.0), Rotation.from_euler("z", rng.uniform(-3, 3)))
    free = moved(state, rng.normal(size=3), Rotation.random(rng=rng))
    here, there, anywhere = (FEATURES(s, surface, goal) for s in (state, level, free))
    np.testing.assert_allclose(OBSERVE(state, here, goal), OBSERVE(level, there, goal), atol=2e-3)
    np.testing.assert_allclose(OBSERVE(state, here, goal), OBSERVE(free, anywhere, goal), atol=2e-3)
    a, b = REWARD(UNIT, state, here, goal), REWARD(UNIT, level, there, goal)
    for name in TERMS:
        np.testing.assert_allclose(a[name], b[name], rtol=2e-3, atol=5e-3, err_msg=name)
    action = rng.normal(size=(4, F + 6)).astype(np.float32)
    for x, y in zip(
        DECODE(TASK.control, state, here, goal, action), DECODE(TASK.control, free, anywhere, goal, action), strict=True
    ):
        np.testing.assert_allclose(x, y, atol=2e-3)
    for name, x, y in zip(
        ERRORS(state, here, goal)._fields, ERRORS(state, here, goal), ERRORS(free, anywhere, goal), strict=True
    ):
        np.testing.assert_allclose(x, y, atol=2e-3, err_msg=name)


def test_features_against_numpy():
    state, surface, goal = scene(7)
    seen = FEATURES(state, surface, goal)
    b = 2
    wrist = _rotation(state.base_quaternion[b]) * Rotation.from_euler("XYZ", state.u[b, 3:])
    origin = state.base_position[b] + _rotation(state.base_quaternion[b]).apply(state.u[b, :3])
    np.testing.assert_allclose(seen.wrist_position[b], origin, atol=1e-5)
    body = _rotation(state.object_quaternion[b])
    cloud = wrist.inv().apply(body.apply(surface.points[b]) + state.object_position[b] - origin)  # in the wrist frame
    points = np.asarray(keypoints(HAND, link_transforms(HAND, state.q[b])))
    offsets = cloud[None] - points[:, None]
    distance = np.linalg.norm(offsets, axis=-1)
    nearest = offsets[np.arange(len(points)), distance.argmin(1)]
    np.testing.assert_allclose(seen.nearest[b], nearest, atol=1e-4)
    minus = np.where(surface.minus[b], distance, np.inf)
    np.testing.assert_allclose(
        seen.distance_minus[b], (minus.min(1) - HAND.keypoint_radii)[1:].min(), atol=1e-4
    )  # the palm does not count as a finger
    forces = wrist.inv().apply(state.contact_force[b].reshape(-1, 3)).reshape(L, -1, 3)
    forces *= state.contact_found[b][..., None]
    np.testing.assert_allclose(seen.force[b], forces.sum(1), atol=1e-4)
    where = body.inv().apply(state.contact_position[b].reshape(-1, 3) - state.object_position[b])
    label = surface.minus[b][np.linalg.norm(where[:, None] - surface.points[b][None], axis=-1).argmin(1)].reshape(L, -1)
    np.testing.assert_array_equal(seen.touching_minus[b], (state.contact_found[b] & label).any(1))
    np.testing.assert_array_equal(seen.touching_plus[b], (state.contact_found[b] & ~label).any(1))
    np.testing.assert_allclose(seen.force_minus[b], (forces * label[..., None]).sum(1), atol=1e-4)
    np.testing.assert_allclose(seen.force_plus[b] + seen.force_minus[b], seen.force[b], atol=1e-4)


def test_without_o_minus_there_is_nothing_to_avoid():
    state, surface, goal = scene(8)
    seen = FEATURES(state, surface._replace(minus=np.zeros_like(surface.minus)), goal)
    assert np.all(np.asarray(seen.distance_minus) == np.float32(FAR))
    assert not np.any(seen.nearest_minus) and not np.any(seen.touching_minus)


@pytest.mark.parametrize("bit", range(4))
def test_inactive_constraints_are_zero_in_observation_and_reward(bit):
    state, surface, goal = scene(9)
    mask = goal.mask.copy()
    mask[:, bit] = 0.0
    off = goal._replace(mask=mask)
    seen = FEATURES(state, surface, off)
    blocks = _blocks(OBSERVE(state, seen, off))
    for i, name in enumerate(MASKS):
        assert np.any(blocks[name]) == (i != bit)
    np.testing.assert_array_equal(blocks["mask"], mask)
    terms = REWARD(UNIT, state, seen, off)
    prefix = {"pose_finger": ("pose_finger", "pose_link"), "pose_wrist": ("pose_wrist",)}
    for name in TERMS:
        if name.startswith(prefix.get(MASKS[bit], (MASKS[bit],))):
            assert not np.any(terms[name]), name


def test_observation_blocks_by_hand():
    state, surface, goal = scene(10)
    seen = FEATURES(state, surface, goal)
    blocks = _blocks(OBSERVE(state, seen, goal))
    np.testing.assert_allclose(blocks["state"][:, :F], state.q)
    np.testing.assert_allclose(blocks["pose_finger"][:, :F], goal.pose_q - state.q, atol=1e-6)
    center = np.asarray(seen.center)
    np.testing.assert_allclose(blocks["heading"][:, :3], center)
    np.testing.assert_allclose(blocks["heading"][:, 6:9], blocks["heading"][:, 3:6] - center, atol=1e-6)
    # u-bar of a pose: the virtual joints that would put the wrist there.
    b = 1
    body = _rotation(state.object_quaternion[b])
    target = body.apply(goal.pose_position[b]) + state.object_position[b]
    base = _rotation(state.base_quaternion[b])
    u = base.inv().apply(target - state.base_position[b])
    np.testing.assert_allclose(blocks["pose_wrist"][b, :3], u - state.u[b, :3], atol=1e-4)
    turn = (base.inv() * body * _rotation(goal.pose_quaternion[b])).as_euler("XYZ")
    np.testing.assert_allclose(blocks["pose_wrist"][b, 3:], turn - state.u[b, 3:], atol=2e-3)
    assert blocks["trajectory"].shape == (4, 6 * K)
    np.testing.assert_allclose(squash(np.array([[5.0, 0.0, 0.0]])), [[0.5, 0.0, 0.0]])


@pytest.mark.parametrize("near", [False, True])
def test_reward_terms_against_numpy(near):
    """Far from its targets a hand pays the most that tracking can cost: 15 cm and half a radian."""
    state, surface, goal = scene(11)
    goal = near_targets(state, goal, 12) if near else goal
    seen = FEATURES(state, surface, goal)
    terms = {name: np.asarray(value) for name, value in REWARD(UNIT, state, seen, goal).items()}
    b = 3
    d = np.linalg.norm(np.asarray(seen.nearest)[b], axis=-1)
    weights = HAND.contact_weights
    np.testing.assert_allclose(terms["distance"][b], -(HAND.keypoint_weights * d).sum(), rtol=1e-4)
    plus = np.asarray(seen.touching_plus)[b]
    np.testing.assert_allclose(terms["contact"][b], (weights * plus).sum(), rtol=1e-5)
    plus_force = np.linalg.norm(np.asarray(seen.force_plus)[b], axis=-1)
    np.testing.assert_allclose(terms["force"][b], (weights * plus * np.minimum(plus_force, 5) / 5).sum(), rtol=1e-4)
    force = np.linalg.norm(np.asarray(seen.force)[b], axis=-1)
    np.testing.assert_allclose(terms["force_excess"][b], -np.clip(force - 5, 0, 50).sum(), rtol=1e-4)
    shift = state.object_position[b] - state.object_position_initial[b]
    np.testing.assert_allclose(terms["object_position"][b], -min(shift @ shift, 0.04), rtol=1e-4)
    turn = _rotation(state.object_quaternion[b]).inv() * _rotation(state.object_quaternion_initial[b])
    np.testing.assert_allclose(terms["object_rotation"][b], -min(turn.magnitude() ** 2, 1.0), rtol=1e-3)
    np.testing.assert_allclose(terms["wrist_velocity"][b], -(state.u_velocity[b] ** 2).sum(), rtol=1e-4)
    np.testing.assert_allclose(terms["finger_deviation"][b], -((state.q[b] - state.q_initial[b]) ** 2).sum(), rtol=1e-4)
    frame = grasp_frame(HAND)
    wrist_position, wrist_quaternion = (np.asarray(x)[b] for x in wrist_pose(state))
    wrist = _rotation(wrist_quaternion)
    body = _rotation(state.object_quaternion[b])
    v = wrist.apply(frame.heading)
    np.testing.assert_allclose(terms["heading_direction"][b], v @ body.apply(goal.heading_direction[b]), atol=1e-4)
    points = np.asarray(keypoints(HAND, link_transforms(HAND, state.q[b])))
    center = wrist.apply(np.asarray(hand_center(HAND, points))) + wrist_position
    target = body.apply(goal.heading_position[b]) + state.object_position[b]
    np.testing.assert_allclose(terms["heading_position"][b], -min(np.linalg.norm(center - target), 0.15), rtol=1e-3)
    gate = np.clip((0.10 - d.min()) / 0.07, 0, 1)
    np.testing.assert_allclose(
        terms["pose_finger"][b], -gate * ((state.q[b] - goal.pose_q[b]) ** 2).sum(), rtol=1e-3, atol=1e-5
    )
    pose_position = body.apply(goal.pose_position[b]) + state.object_position[b]
    pose_turn = body * _rotation(goal.pose_quaternion[b])
    reference = np.asarray(keypoints(HAND, link_transforms(HAND, goal.pose_q[b])))
    reference = wrist.inv().apply(pose_turn.apply(reference) + pose_position - wrist_position)
    np.testing.assert_allclose(terms["pose_link"][b], -gate * ((reference - points) ** 2).sum(), rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(
        terms["pose_wrist_position"][b], -min(((wrist_position - pose_position) ** 2).sum(), 0.15**2), rtol=1e-3
    )
    np.testing.assert_allclose(
        terms["pose_wrist_rotation"][b], -(min((wrist.inv() * pose_turn).magnitude(), 0.5) ** 2), rtol=1e-3, atol=1e-4
    )
    way = body.apply(goal.trajectory_position[b]) + state.object_position[b]
    k = min(np.linalg.norm(way - wrist_position, axis=-1).argmin() + 1, K - 1)
    np.testing.assert_allclose(
        terms["trajectory_position"][b], -min(((way[k] - wrist_position) ** 2).sum(), 0.15**2), rtol=1e-3
    )
    way_turn = body * _rotation(goal.trajectory_quaternion[b, k])
    np.testing.assert_allclose(
        terms["trajectory_rotation"][b], -(min((wrist.inv() * way_turn).magnitude(), 0.5) ** 2), rtol=1e-3, atol=1e-4
    )
    barrier = np.logaddexp(0.0, (0.01 - float(seen.distance_minus[b])) / 0.002)
    np.testing.assert_allclose(terms["affordance_distance"][b], -barrier, rtol=1e-3)
    minus_force = np.linalg.norm(np.asarray(seen.force_minus)[b], axis=-1)
    np.testing.assert_allclose(terms["affordance_force"][b], -np.minimum(minus_force, 10).sum(), rtol=1e-4)


def test_without_affordance_every_contact_is_rewarded():
    state, surface, goal = scene(12)
    off = goal._replace(mask=np.zeros_like(goal.mask))
    seen = FEATURES(state, surface, off)
    terms = REWARD(UNIT, state, seen, off)
    np.testing.assert_allclose(terms["contact"], (HAND.contact_weights * np.asarray(seen.touching)).sum(-1), rtol=1e-5)


def test_pose_gate_by_hand():
    np.testing.assert_allclose(pose_gate(np.array([0.2, 0.1, 0.065, 0.03, 0.0])), [0, 0, 0.5, 1, 1], atol=1e-6)


def test_dropping_is_seen_five_centimetres_down():
    state, surface, goal = scene(13)
    for depth, expected in ((0.049, 0.0), (0.051, -1.0)):
        low = state._replace(object_position=state.object_position_initial - np.array([0, 0, depth], np.float32))
        assert np.all(np.asarray(REWARD(UNIT, low, FEATURES(low, surface, goal), goal)["drop"]) == expected)


def test_fingers_integrate_actions_within_their_limits():
    state, surface, goal = scene(14)
    seen = FEATURES(state, surface, goal)
    action = np.zeros((4, F + 6), np.float32)
    action[:, 0], action[:, 1] = 1.0, 100.0
    target = DECODE(TASK.control, state, seen, goal, action).q_target
    np.testing.assert_allclose(
        target[:, 0], np.minimum(state.q_target[:, 0] + TASK.control.finger_scale, HAND.upper[0]), rtol=1e-5
    )
    np.testing.assert_allclose(target[:, 1], HAND.upper[1])
    np.testing.assert_allclose(target[:, 2:], state.q_target[:, 2:], atol=1e-6)


def test_active_waypoint_is_one_ahead_of_the_nearest_and_stops_at_the_last():
    path = np.zeros((3, 5, 3), np.float32)
    path[..., 0] = np.arange(5)
    wrist = np.array([[-1, 0, 0], [1.6, 0, 0], [9, 0, 0]], np.float32)
    np.testing.assert_array_equal(active_waypoint(wrist, path, 1), [1, 3, 4])
    np.testing.assert_array_equal(active_waypoint(wrist, path, 0), [0, 2, 4])


def test_heading_pose_aligns_axis_cross_and_center():
    _, _, goal = scene(15)
    center = np.tile(grasp_frame(HAND).center, (4, 1))
    position, quaternion = (np.asarray(x) for x in heading_wrist_pose(HAND, goal, center))
    for b in range(4):
        wrist = _rotation(quaternion[b])
        np.testing.assert_allclose(wrist.apply(grasp_frame(HAND).heading), goal.heading_direction[b], atol=1e-5)
        np.testing.assert_allclose(wrist.apply(grasp_frame(HAND).cross), goal.heading_cross[b], atol=1e-5)
        np.testing.assert_allclose(wrist.apply(center[b]) + position[b], goal.heading_position[b], atol=1e-5)


@pytest.mark.parametrize(
    ("mask", "source"), [((0, 0, 0, 0), "heading"), ((0, 1, 1, 0), "pose"), ((1, 1, 0, 1), "trajectory")]
)
def test_guidance_follows_the_strongest_constraint_on_the_initial_object(mask, source):
    state, surface, goal = scene(16)
    goal = goal._replace(mask=np.tile(np.array(mask, np.float32), (4, 1)))
    seen = FEATURES(state, surface, goal)
    position, _ = guidance_pose(HAND, TASK.control, state, seen, goal)
    body = _rotation(state.object_quaternion_initial[0])
    here = np.asarray(seen.wrist_position)[0]
    if source == "heading":
        local = np.asarray(heading_wrist_pose(HAND, goal, seen.center)[0])[0]
    elif source == "pose":
        local = goal.pose_position[0]
    else:
        way = body.apply(goal.trajectory_position[0]) + state.object_position_initial[0]
        local = goal.trajectory_position[0, min(np.linalg.norm(way - here, axis=-1).argmin() + 1, K - 1)]
    np.testing.assert_allclose(position[0], body.apply(local) + state.object_position_initial[0], atol=1e-4)


def test_wrist_target_is_guidance_plus_residual_within_the_limits():
    state, surface, goal = scene(17)
    seen = FEATURES(state, surface, goal)
    zero, one = np.zeros((4, F + 6), np.float32), np.zeros((4, F + 6), np.float32)
    one[:, F:] = 1.0
    still, pushed = (np.asarray(DECODE(TASK.control, state, seen, goal, a).u_target) for a in (zero, one))
    np.testing.assert_allclose(pushed - still, np.tile([0.02] * 3 + [0.1] * 3, (4, 1)), atol=1e-5)
    ahead = still - state.u
    assert np.all(np.linalg.norm(ahead[:, :3], axis=-1) <= 0.08 + 1e-5)
    assert np.all(np.linalg.norm(ahead[:, 3:], axis=-1) <= 0.5 + 1e-5)
    goal_joints = wrist_to_joints(state, *guidance_pose(HAND, TASK.control, state, seen, goal))
    toward = np.asarray(goal_joints)[:, :3] - state.u[:, :3]
    cosine = np.sum(toward * ahead[:, :3], -1) / np.linalg.norm(toward, axis=-1) / np.linalg.norm(ahead[:, :3], axis=-1)
    np.testing.assert_allclose(cosine, 1.0, atol=1e-4)


def test_metrics_against_numpy():
    state, surface, goal = scene(18)
    seen = FEATURES(state, surface, goal)
    found = ERRORS(state, seen, goal)
    b = 0
    wrist_position, wrist_quaternion = (np.asarray(x)[b] for x in wrist_pose(state))
    wrist, body = _rotation(wrist_quaternion), _rotation(state.object_quaternion[b])
    v, target = wrist.apply(grasp_frame(HAND).heading), body.apply(goal.heading_direction[b])
    np.testing.assert_allclose(found.heading_rad[b], np.arccos(np.clip(v @ target, -1, 1)), atol=1e-4)
    points = np.asarray(keypoints(HAND, link_transforms(HAND, state.q[b])))
    center = wrist.apply(np.asarray(hand_center(HAND, points))) + wrist_position
    off = center - body.apply(goal.heading_position[b]) - state.object_position[b]
    np.testing.assert_allclose(found.heading_m[b], np.linalg.norm(off - (off @ target) * target), atol=1e-4)
    pose = body.apply(goal.pose_position[b]) + state.object_position[b]
    np.testing.assert_allclose(found.pose_m[b], np.linalg.norm(wrist_position - pose), atol=1e-4)
    base = _rotation(state.base_quaternion[b])
    hinges = (base.inv() * body * _rotation(goal.pose_quaternion[b])).as_euler("XYZ") - state.u[b, 3:]
    hinges = (hinges + np.pi) % (2 * np.pi) - np.pi
    expected = np.abs(np.concatenate([state.q[b] - goal.pose_q[b], hinges])).mean()
    np.testing.assert_allclose(found.pose_rad[b], expected, atol=1e-3)
    np.testing.assert_allclose(found.minus_links[b], np.sum(np.asarray(seen.touching_minus)[b]))
    np.testing.assert_allclose(found.any_links[b], np.sum(np.asarray(seen.touching)[b]))


def test_fixed_center_is_the_open_hands_whatever_the_fingers_do():
    state, surface, goal = scene(19)
    seen = features(HAND, dataclasses.replace(TASK, dynamic_center=False), state, surface, goal)
    np.testing.assert_allclose(seen.center, np.tile(grasp_frame(HAND).center, (4, 1)))
