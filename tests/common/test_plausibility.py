"""Plausibility: capsules against distances worked out by hand and against MuJoCo, measures against
simple motions.
"""

import dataclasses
import functools
import itertools

import jax
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from congrasp.common.hands import get_hand
from congrasp.common.hands.kinematics import link_transforms
from congrasp.common.hands.mjcf import add_hand
from congrasp.common.objects import procedural
from congrasp.common.objects.distance import distance_field
from congrasp.common.objects.spec import Piece
from congrasp.common.task import plausibility
from congrasp.common.task.plausibility import (
    Sample,
    hand_hand,
    hand_object,
    hand_table,
    is_clean,
    measures,
    segment_distance,
)

HANDS = ("human", "allegro", "sharpa")
_distance = jax.jit(segment_distance)
_in_object = jax.jit(functools.partial(hand_object, get_hand("human")))
UPRIGHT = np.array([[1.0, 0.0, 0.0, 0.0]], np.float32)


def posed(name: str, q: np.ndarray):
    hand = get_hand(name)
    return hand, jax.device_get(jax.jit(lambda q: link_transforms(hand, q))(np.float32(q)[None]))


def deepest_contact(name: str, q: np.ndarray) -> float:
    """Deepest contact in metres between the links in MuJoCo, whose hand excludes what it
    excludes.
    """
    hand = get_hand(name)
    spec = mujoco.MjSpec()
    hand = dataclasses.replace(
        hand, links=tuple(dataclasses.replace(link, solids=()) for link in hand.links)
    )
    spec.compiler.degree = False
    add_hand(spec, hand, self_collision=True)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[[model.joint(joint.name).qposadr[0] for joint in hand.joints]] = q
    mujoco.mj_forward(model, data)
    return float(max(-data.contact.dist.min(initial=0.0), 0.0))


@pytest.mark.parametrize(
    ("a", "b", "c", "d", "distance"),
    [
        ((0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0), 1.0),  # parallel
        ((0, 0, 0), (1, 0, 0), (0.5, -1, 2), (0.5, 1, 2), 2.0),  # crossing
        ((0, 0, 0), (1, 0, 0), (4, 4, 0), (4, 9, 0), 5.0),  # end to end: 3-4-5
        ((0, 0, 0), (1, 0, 0), (0.5, 3, 0), (0.5, 8, 0), 3.0),  # an end and an inner point
        ((0, 0, 0), (0, 0, 0), (3, 4, 0), (3, 4, 0), 5.0),  # points
    ],
)
def test_distances_of_segments_worked_out_by_hand(a, b, c, d, distance):
    computed = _distance(*(np.array(x, np.float32) for x in (a, b, c, d)))
    assert float(computed) == pytest.approx(distance, abs=1e-6)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000))
def test_no_points_of_two_segments_are_nearer_than_their_distance(seed):
    a, b, c, d = np.random.default_rng(seed).normal(size=(4, 3)).astype(np.float32)
    share = np.linspace(0, 1, 60)[:, None]
    dense = np.linalg.norm((a + share * (b - a))[:, None] - (c + share * (d - c)), axis=-1).min()
    assert dense - 0.05 < float(_distance(a, b, c, d)) <= dense + 1e-5


@pytest.mark.parametrize("name", HANDS)
def test_hand_in_hand_is_the_deepest_contact_of_the_hands_model(name):
    hand = get_hand(name)
    rng = np.random.default_rng(0)
    measured = jax.jit(lambda q: hand_hand(hand, link_transforms(hand, q)))
    poses = [
        hand.q_open,
        hand.q_closed,
        *rng.uniform(hand.lower, hand.upper, (8, len(hand.joints))),
    ]
    depths = np.asarray(measured(np.array(poses, np.float32)))
    np.testing.assert_allclose(depths, [deepest_contact(name, q) for q in poses], atol=1e-5)
    # Open hands are free of themselves, some poses are not
    assert depths[0] == 0.0
    assert depths.max() > 0.002


def test_hand_in_table_is_the_lowest_point_of_a_capsule():
    hand, transforms = posed("human", np.zeros(20))
    # At zero the lowest capsule is the thumb's last: its tip's centre at z = -0.0403, its radius
    # 6.5 mm.
    for height, depth in ((0.0, 0.0468), (0.04, 0.0068), (0.05, 0.0)):
        penetration = hand_table(
            hand, transforms, np.array([[0.0, 0.0, height]], np.float32), UPRIGHT
        )
        assert float(penetration[0]) == pytest.approx(depth, abs=1e-6)
    over = (
        Rotation.from_euler("x", 180, degrees=True)
        .as_quat(scalar_first=True)[None]
        .astype(np.float32)
    )
    # Turned over, the middle finger's last joint is lowest: z = 0.0197, and the radius of its
    # middle link 8 mm.
    penetration = hand_table(hand, transforms, np.zeros((1, 3), np.float32), over)
    assert float(penetration[0]) == pytest.approx(0.0197 + 0.008, abs=1e-6)


def test_hand_in_object_is_the_radius_less_the_axis_distance():
    hand, transforms = posed("human", np.zeros(20))
    ball = procedural.generate(1, "ball")
    ball = type(ball)(**{**ball.__dict__, "pieces": (Piece("ellipsoid", (0.03, 0.03, 0.03)),)})
    field = distance_field([ball])
    index = np.zeros(1, int)
    tip = np.array(hand.links[6].tip)
    radius = hand.links[6].capsules[0].radius
    along = tip - np.array(hand.links[6].capsules[0].start)
    along /= np.linalg.norm(along)
    for gap in (0.010, 0.0, -0.004):
        centre = (tip + (radius + 0.03 + gap) * along)[None].astype(np.float32)
        depth = _in_object(transforms, centre, UPRIGHT, index, field)
        assert float(depth[0]) == pytest.approx(max(-gap, 0.0), abs=2e-4)


def test_a_finger_through_a_thin_blade_counts_with_its_thickness():
    hand, transforms = posed("human", np.zeros(20))
    blade = procedural.generate(1, "box")
    plate = Piece("box", (0.06, 0.001, 0.06))
    vertices = np.array(
        list(itertools.product((-0.06, 0.06), (-0.001, 0.001), (-0.06, 0.06))),
        np.float32,
    )
    blade = type(blade)(**{**blade.__dict__, "pieces": (plate,), "visual_vertices": vertices})
    middle = 0.5 * np.add(
        *[np.array(getattr(hand.links[8].capsules[0], end)) for end in ("start", "end")]
    )
    depth = _in_object(
        transforms,
        middle[None].astype(np.float32),
        UPRIGHT,
        np.zeros(1, int),
        distance_field([blade]),
    )
    # The plate lies across the middle finger; the points on the axis are at most 4 mm apart.
    thickest = max(capsule.radius for capsule in hand.links[8].capsules)
    assert thickest - 0.001 < float(depth[0]) < thickest + 0.0025


def motion(steps: int, **arrays: np.ndarray) -> Sample:
    """Samples of one episode, zero but for what is given."""
    shapes = {"wrist_velocity": 3, "finger_velocity": 2, "link_force": 4, "torque_share": 2}
    shapes |= {"object_position": 3, "object_quaternion": 4}
    zeros = {
        name: np.zeros((steps, 1, *([shapes[name]] if name in shapes else [])))
        for name in Sample._fields
    }
    return Sample(**{**zeros, **arrays})


def test_measures_of_a_motion_worked_out_by_hand():
    # The wrist jumps to 1 m/s in the first step, goes on, and stops; a joint speeds up by 100
    # rad/s^2.
    wrist = np.zeros((4, 1, 3))
    wrist[:3, 0, 0] = 1.0
    fingers = np.zeros((4, 1, 2))
    fingers[:, 0, 0] = [1.0, 2.0, 3.0, 4.0]
    force = np.zeros((4, 1, 4))
    force[2:, 0, :2] = [[2.0, 4.0], [6.0, 0.0]]
    torque = np.zeros((4, 1, 2))
    torque[3, 0] = [1.0, 0.6]
    depth = np.array([[0.001], [0.004], [0.0], [0.002]])
    samples = motion(
        4,
        wrist_velocity=wrist,
        finger_velocity=fingers,
        link_force=force,
        torque_share=torque,
        hand_hand=depth,
    )
    measured = measures(samples, 0.01)
    assert set(measured) == set(plausibility.MEASURES)
    expected = {
        "hand_hand_mm": 4.0,
        "hand_table_mm": 0.0,
        "wrist_speed": 1.0,
        "wrist_speed_mean": 0.75,
        "wrist_acceleration": 100.0,
        "wrist_acceleration_mean": 50.0,  # 100, 0, 0, 100
        "wrist_acceleration_p95": 100.0,
        "finger_jerk": np.sqrt(1e4**2 / 8),  # from rest one acceleration of 100 rad/s^2, then none
        "link_force": 4.0,  # 2, 4 and 6 N
        "link_force_peak": 6.0,
        "torque_share": 0.2,
        "torque_share_peak": 1.0,
    }
    for name, value in expected.items():
        assert measured[name][0] == pytest.approx(value, rel=1e-5), name


def test_hand_without_meshes_has_no_mesh_measure():
    measured = measures(motion(2, hand_mesh=np.full((2, 1), np.nan)), 0.01)
    assert set(measured) == {*plausibility.MEASURES} - {"hand_mesh_mm"}


def test_clean_is_held_and_shallow_everywhere():
    shallow = {"hand_hand_mm": 1.9, "hand_table_mm": 1.9, "hand_object_mm": 2.9}
    assert is_clean(
        np.array([True]), {name: np.array([x]) for name, x in shallow.items()}
    ).tolist() == [True]
    assert is_clean(
        np.array([False]), {name: np.array([x]) for name, x in shallow.items()}
    ).tolist() == [False]
    for name, value in (
        ("hand_hand_mm", 2.0),
        ("hand_table_mm", 2.0),
        ("hand_object_mm", 3.0),
        ("hand_mesh_mm", 3.0),
    ):
        values = {**shallow, name: value}
        assert is_clean(
            np.array([True]), {name: np.array([x]) for name, x in values.items()}
        ).tolist() == [False]
