"""Heading sets against the paper's rules, checked from their definitions, and table geometry worked
out by hand.
"""

import dataclasses
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from congrasp.common.errors import TooWideError
from congrasp.common.hands import get_hand
from congrasp.common.hands.closure import CENTER_ONLY, CLOSURES, Outline, depth_below, outline
from congrasp.common.hands.kinematics import capsules, grasp_frame, link_transforms
from congrasp.common.objects.procedural import FAMILIES, GROUPS, generate, generate_many
from congrasp.common.task.sampling.heading_sampler import HeadingOptions, sample_headings
from congrasp.common.task.sampling.headings import (
    INWARD,
    MAX_WIDTH,
    Headings,
    closes_on,
    local_width,
    max_width,
)
from congrasp.common.task.sampling.reach import above, clear_table, feasible, within_reach

DOWN = [0.0, 0.0, -1.0]
LEVEL = [1.0, 0.0, 0.0]
UP = [0.0, 0.0, 1.0]
FLAT = np.array([0.0, 0.0, 0.05, 1.0, 0.0, 0.0, 0.0])
ANY = np.array([np.inf])  # opening of a hand that is open wide enough for everything


def made(*rows):
    """Headings from (position, direction) rows."""
    position, direction = (np.array(part, np.float32) for part in zip(*rows, strict=True))
    cross = np.cross(direction, [0.3, 0.5, 0.8])
    return Headings(position, direction, cross / np.linalg.norm(cross, axis=-1, keepdims=True))


def defined_width(points, position, direction, cross):
    """The definition, one heading at a time."""
    offset = points - position
    breadth = np.cross(direction, cross)
    slab = (np.abs(offset @ breadth) < 0.03) & (offset @ direction < 0.01)
    return np.ptp(offset[slab] @ cross)


def defined_opposition(obj, touchable, position, direction, cross, rounding):
    """The definition, one heading at a time: on both sides a normal within 45 degrees of the
    cross-finger axis.
    """
    offset = (obj.points - position)[:256]
    breadth = np.abs(offset @ np.cross(direction, cross))
    depth = offset @ direction
    slab = (breadth < 0.03 + rounding) & (depth < 0.01 + rounding) & touchable[:256]
    along = (offset @ cross)[slab]
    facing = (obj.normals[:256] @ cross)[slab]
    sides = facing[along < along.min() + 0.015 + 1e-6], facing[along > along.max() - 0.015 - 1e-6]
    return sides[0].min() < -np.cos(np.pi / 4) + 1e-6 and sides[1].max() > np.cos(np.pi / 4) - 1e-6


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(FAMILIES), st.booleans(), st.integers(0, 99))
def test_sampled_headings_obey_the_papers_rules(seed, family, affordance, draw):
    obj = generate(seed, family)
    headings = sample_headings(obj, np.random.default_rng(draw), use_affordance=affordance)
    assume(headings is not None)
    position, direction, cross = (part.astype(float) for part in headings)
    assert position.shape == direction.shape == cross.shape == (256, 3)
    assert all(part.dtype == np.float32 for part in headings)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(cross, axis=-1), 1, atol=1e-5)
    np.testing.assert_allclose((direction * cross).sum(-1), 0, atol=1e-5)
    # Two centimetres back lies a surface point, or one centimetre back for a region with little
    # room, and the direction is within 30 degrees of its inward normal.
    depths = (INWARD, INWARD / 2) if affordance else (INWARD,)
    distances = [
        np.linalg.norm((position - depth * direction)[:, None] - obj.points, axis=-1)
        for depth in depths
    ]
    distance = min(distances, key=lambda distance: distance.min(-1).max())
    source = distance.argmin(-1)
    assert distance.min(-1).max() < 1e-5
    assert -(direction * obj.normals[source]).sum(-1).min() > np.cos(np.radians(30)) - 1e-5
    widths = [
        defined_width(obj.points[:256], *heading)
        for heading in zip(position, direction, cross, strict=True)
    ]
    np.testing.assert_allclose(local_width(headings, obj.points), widths, atol=1e-5)
    assert max(widths) <= MAX_WIDTH + 1e-5
    avoid = obj.non_graspable_points
    touchable = ~avoid | (not affordance)
    for heading in zip(position, direction, cross, strict=True):
        assert any(
            defined_opposition(obj, touchable, *heading, rounding) for rounding in (0, 1e-6, -1e-6)
        )
    if affordance:
        assert not avoid[source].any()
        # No point of the avoid region within 1 cm of the approach, and the end nearer to the
        # graspable one.
        along = np.linspace(0, 0.15, 60)
        for p, v in zip(position[::16], direction[::16], strict=True):
            way = p - along[:, None] * v
            assert np.linalg.norm(way[:, None] - obj.points[avoid], axis=-1).min() > 0.0099
            to = np.linalg.norm(obj.points - p, axis=-1)
            assert to[~avoid].min() <= to[avoid].min() + 1e-6
        # Seen along the cross-finger axis, the graspable region reaches further to both sides.
        for p, v, w in zip(position, direction, cross, strict=True):
            offset = (obj.points - p)[:256]
            breadth = np.abs(offset @ np.cross(v, w))
            depth = offset @ v
            sides = (offset @ w)[(breadth < 0.0301) & (depth < 0.0101) & ~avoid[:256]]
            opposed = (offset @ w)[(breadth < 0.0299) & (depth < 0.0199) & avoid[:256]]
            assert (opposed < sides.max() - 0.0049).all()
            assert (opposed > sides.min() + 0.0049).all()
    else:
        graspable = dataclasses.replace(obj, graspable=np.ones_like(obj.graspable))
        unlabelled = sample_headings(graspable, np.random.default_rng(draw), use_affordance=False)
        for labelled_part, part in zip(headings, unlabelled, strict=True):
            np.testing.assert_array_equal(labelled_part, part)


def test_headings_repeat_with_the_random_state_and_differ_without():
    obj = generate(0, "hammer")
    first, again, other = (
        sample_headings(obj, np.random.default_rng(seed), use_affordance=True).position
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert len(np.unique(np.concatenate([first, other]), axis=0)) > 400


def test_directions_fill_the_cone_evenly():
    obj = generate(0, "box")
    headings = sample_headings(
        obj,
        np.random.default_rng(0),
        use_affordance=False,
        options=HeadingOptions(count=4000, attempts=20),
    )
    back = headings.position - INWARD * headings.direction
    source = np.linalg.norm(back[:, None] - obj.points, axis=-1).argmin(-1)
    cosine = -(headings.direction * obj.normals[source]).sum(-1)
    # Uniform in solid angle: half of the cone lies within acos((1 + cos 30) / 2) = 21.1 degrees.
    assert np.isclose((cosine > (1 + np.cos(np.radians(30))) / 2).mean(), 0.5, atol=0.06)


def test_narrow_rolls_are_preferred():
    obj = generate(5, "screwdriver")
    headings = sample_headings(obj, np.random.default_rng(0), use_affordance=True)
    assert (
        np.median([defined_width(obj.points, *heading) for heading in zip(*headings, strict=True)])
        < 0.05
    )


def test_the_first_surface_that_the_hand_meets_is_the_headings():
    obj = generate(1, "ring")
    headings = sample_headings(obj, np.random.default_rng(0), use_affordance=False)
    for p, v in zip(headings.position, headings.direction, strict=True):
        offset = obj.points - p
        depth = offset @ v
        aside = np.linalg.norm(offset - depth[:, None] * v, axis=-1)
        assert not ((aside < 0.0099) & (depth < -INWARD - 0.0151) & (depth > -0.169)).any()


def test_few_headings_are_repeated():
    obj = generate(0, "ball")
    tight = sample_headings(
        obj,
        np.random.default_rng(0),
        use_affordance=False,
        options=HeadingOptions(max_width=0.073, attempts=1),
    )
    assert tight.position.shape == (256, 3)
    different = len(np.unique(tight.position, axis=0))
    assert 0 < different < 256
    np.testing.assert_array_equal(
        tight.position[different : 2 * different], tight.position[:different]
    )


def test_object_wider_than_the_hand_is_refused():
    with pytest.raises(
        TooWideError, match=r"^'ball_0' is too wide: 7\.\d cm .* but the hand opens to 5\.0 cm"
    ):
        sample_headings(
            generate(0, "ball"),
            np.random.default_rng(0),
            use_affordance=False,
            options=HeadingOptions(max_width=0.05),
        )


def test_the_smaller_part_of_a_ball_cannot_be_held_alone():
    """Below its equator a ball slips out of any hand, and the avoid region is wider there."""
    ball = generate(0, "ball")
    height = ball.points[:, 2]
    for cut, held in ((0.3, False), (0.9, True)):
        labels = (height < np.quantile(height, 1 - cut)).astype(np.int32)
        capped = dataclasses.replace(ball, labels=labels, graspable=np.array([True, False]))
        assert (
            sample_headings(capped, np.random.default_rng(0), use_affordance=True) is not None
        ) is held


def test_lenient_option_approaches_small_parts():
    block = generate(0, "box")
    # One face: fingers meet the sides
    outer = np.flatnonzero(block.points[:, 2] > block.points[:, 2].max() - 0.004)
    labels = np.ones(len(block.points), np.int32)
    labels[outer] = 0
    spot = dataclasses.replace(block, labels=labels, graspable=np.array([True, False]))
    assert sample_headings(spot, np.random.default_rng(0), use_affordance=True) is None
    headings = sample_headings(
        spot, np.random.default_rng(0), use_affordance=True, options=HeadingOptions(lenient=True)
    )
    away = np.linalg.norm(block.points[None] - headings.position[:, None], axis=-1)
    assert (away[:, labels == 0].min(-1) < away[:, labels == 1].min(-1)).all()
    np.testing.assert_allclose((headings.direction * headings.cross).sum(-1), 0, atol=1e-5)


def test_an_object_without_o_plus_still_gets_headings():
    obj = generate(0, "box")
    barren = dataclasses.replace(obj, graspable=np.zeros(2, bool))
    assert np.isfinite(
        sample_headings(barren, np.random.default_rng(0), use_affordance=False).position
    ).all()
    assert sample_headings(barren, np.random.default_rng(0), use_affordance=True) is None


def test_feasible_headings_stay_above_the_table():
    steep = [0.0, np.sin(0.1), np.cos(0.1)]
    headings = made(
        ([0, 0, 0.0], DOWN),  # 5 cm high
        ([0, 0, -0.045], DOWN),  # 5 mm high
        ([0, 0, 0.0], LEVEL),
        ([0, 0, 0.0], UP),  # comes from inside the table
        ([0, 0, 0.0], [np.cos(0.05), 0, np.sin(0.05)]),  # rises a little
        ([0, 0, -0.045], [np.cos(0.05), 0, np.sin(0.05)]),  # 5 mm high
        ([0, 0, 0.3], steep),
    )
    np.testing.assert_array_equal(feasible(headings, FLAT), [1, 0, 1, 0, 1, 0, 0])
    np.testing.assert_array_equal(
        feasible(headings, FLAT, Outline(np.zeros((1, 1, 3)), np.array([0.004]), ANY)),
        [1, 1, 1, 0, 1, 1, 0],
    )
    upside_down = np.array([0, 0, 0.05, 0, 1.0, 0, 0])
    np.testing.assert_array_equal(feasible(headings, upside_down)[[0, 3]], [0, 1])


def test_above_is_a_cone_around_straight_down():
    tilted = [[np.sin(a), 0.0, -np.cos(a)] for a in np.radians([0, 29, 31, 90])]
    headings = made(*(([0, 0, 0], direction) for direction in tilted))
    np.testing.assert_array_equal(above(headings, FLAT), [1, 1, 0, 0])
    np.testing.assert_array_equal(above(headings, FLAT, cone=np.radians(25)), [1, 0, 0, 0])
    # A quarter turn about y takes the object's x axis to the world's -z axis.
    on_side = np.array([0, 0, 0.05, np.sqrt(0.5), 0, np.sqrt(0.5), 0])
    np.testing.assert_array_equal(above(headings, on_side), [0, 0, 0, 1])


def test_clearing_the_table_backs_out_along_the_direction():
    half = np.radians(60)
    headings = made(
        ([0, 0, -0.045], DOWN),  # 5 mm high: 5 mm back
        ([0, 0, -0.045], [np.sin(half), 0, -np.cos(half)]),  # the same height takes twice the way
        ([0, 0, -0.045], LEVEL),  # no way helps
        ([0, 0, -0.075], DOWN),  # 3.5 cm back is too far
        ([0, 0, 0.0], DOWN),
    )
    cleared = clear_table(headings, FLAT)
    moved = np.linalg.norm(cleared.position - headings.position, axis=-1)
    np.testing.assert_allclose(moved, [0.005, 0.01, 0, 0, 0], atol=2e-6)
    np.testing.assert_array_equal(feasible(cleared, FLAT), [1, 1, 0, 0, 1])
    np.testing.assert_array_equal(cleared.direction, headings.direction)


SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    "family",
    [pytest.param(name, marks=[pytest.mark.slow] * (i % 4 > 0)) for i, name in enumerate(FAMILIES)],
)
def test_every_family_can_be_reached_in_its_likeliest_pose(family, seed):
    obj = generate(seed, family)
    headings = sample_headings(obj, np.random.default_rng(0), use_affordance=False)
    assert feasible(clear_table(headings, obj.rest_poses[0]), obj.rest_poses[0]).mean() > 0.1


@pytest.mark.parametrize(
    "family", ["bottle", "mug", "teapot", "hammer", "pan", "flashlight", "camera", "cup", "ring"]
)
@pytest.mark.parametrize("seed", SEEDS)
def test_parts_that_are_made_to_be_held_can_be(family, seed):
    obj = generate(seed, family)
    headings = sample_headings(obj, np.random.default_rng(0), use_affordance=True)
    assert max(feasible(clear_table(headings, pose), pose).mean() for pose in obj.rest_poses) > 0.1


def test_a_hand_needs_room_below_its_centre():
    """A bar of 6 cm along the cross-finger axis, 1 cm thick: level it needs 1 cm, upright 4 cm."""
    bar = Outline(np.array([[[0, -0.03, 0], [0, 0.03, 0]]]), np.array([0.01, 0.01]), ANY)
    upright = Headings(*(np.array([row], np.float32) for row in ([0, 0, -0.02], LEVEL, UP)))
    level = upright._replace(cross=np.array([[0, 1, 0]], np.float32))
    assert not feasible(upright, FLAT, bar)[0]
    assert feasible(level, FLAT, bar)[0]  # 3 cm high
    higher = upright._replace(position=np.array([[0, 0, -0.009]], np.float32))
    assert feasible(higher, FLAT, bar)[0]  # 4.1 cm high
    down = Headings(*(np.array([row], np.float32) for row in ([0, 0, -0.06], DOWN, LEVEL)))
    cleared = clear_table(down, FLAT, bar)
    # 1 cm high: as thick as the bar is
    np.testing.assert_allclose(cleared.position[0], [0, 0, -0.04], atol=2e-6)
    assert feasible(cleared, FLAT, bar)[0]


def test_clearance_of_partly_closed_hands():
    """Open it reaches 5 cm down, closed 1 cm; its centre is 3 cm high."""
    hand = Outline(
        np.array([[[0, 0, -0.04]], [[0, 0, 0.0]]]), np.array([0.01]), np.array([0.1, 0.05])
    )
    cross = np.array([[0, 1, 0]], np.float32)  # v x w is up
    low = Headings(np.array([[0, 0, -0.02]], np.float32), np.array([LEVEL], np.float32), cross)
    assert feasible(low, FLAT, hand)[0]
    wide = np.array([0.029, 0.031, 0.5])  # with two fingers of 1 cm: 4.9, 5.1 and 52 cm
    thrice = Headings(*(np.repeat(part, 3, 0) for part in low))
    np.testing.assert_array_equal(feasible(thrice, FLAT, hand, wide), [True, False, False])


def test_the_width_is_that_of_the_slab_where_fingers_close():
    """A cross of two bars, 4 x 10 cm and 10 x 2 cm, whose centre the hand comes to from above."""
    one, other = np.meshgrid(np.linspace(-0.05, 0.05, 11), [0.0])
    along_x = np.stack([one, other, 0 * one], -1).reshape(-1, 3)
    points = np.concatenate(
        [along_x, 0.4 * along_x[:, [1, 0, 2]], [[0.09, 0, -0.05], [0.09, 0.04, 0]]]
    )
    headings = Headings(
        np.zeros((3, 3), np.float32),
        np.array([DOWN, DOWN, LEVEL], np.float32),
        np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32),
    )
    # 9 cm out is a point 5 cm below, past the fingers' end, and one 4 cm aside; both lie beyond a
    # level hand's reach.
    np.testing.assert_allclose(local_width(headings, points), [0.1, 0.04, 0.0], atol=1e-6)
    far = headings._replace(position=np.float32([[0, 1, 0]] * 3))
    np.testing.assert_array_equal(local_width(far, points)[:1], 0)


def test_distance_back_is_limited():
    """At heights of 0 and -10 mm a centre that needs 1 cm moves 1 and 2 cm: the latter only where
    there is no other.
    """
    both = made(([0, 0, -0.05], DOWN), ([0, 0, -0.06], DOWN))
    point = SimpleNamespace(points=np.zeros((1, 3)))
    (cleared,), (reachable,) = within_reach(both, point, FLAT[None], CENTER_ONLY, opposed=False)
    np.testing.assert_array_equal(reachable, [True, False])
    np.testing.assert_allclose(cleared.position[:, 2], [-0.04, -0.06], atol=2e-6)
    deep = Headings(*(part[1:] for part in both))
    (cleared,), (reachable,) = within_reach(deep, point, FLAT[None], CENTER_ONLY, opposed=False)
    assert reachable[0]
    np.testing.assert_allclose(cleared.position[0, 2], -0.04, atol=2e-6)


@pytest.mark.parametrize("name", ["human", "allegro", "sharpa"])
def test_a_table_that_the_outline_clears_is_clear_of_the_hand(name):
    """Against the hand's capsules themselves, posed at random headings."""
    hand = get_hand(name)
    rng = np.random.default_rng(0)
    v, w = np.linalg.qr(rng.normal(size=(50, 3, 3)))[0].transpose(0, 2, 1)[:, :2].transpose(1, 0, 2)
    up = np.stack([v[:, 2], w[:, 2], np.cross(v, w)[:, 2]], -1)
    frame = grasp_frame(hand)
    axes = np.stack([frame.heading, frame.cross, np.cross(frame.heading, frame.cross)], -1)
    turn = np.einsum("hij,kj->hik", np.stack([v, w, np.cross(v, w)], -1), axes)
    ends = jax.jit(lambda q: capsules(hand, link_transforms(hand, q)))(hand.q_open)
    ends = np.asarray(ends).reshape(-1, 3) - frame.center
    opened = CLOSURES.tolist().index(0.0)
    lowest = np.einsum("hj,ej->he", turn[:, 2], ends) - np.repeat(hand.capsule_radii, 2)
    np.testing.assert_allclose(depth_below(outline(hand), up)[opened], -lowest.min(-1), atol=1e-6)


def test_card_is_approached_with_the_centre_clear():
    card = made(([0, 0, -0.05], DOWN), ([0, 0, -0.05], UP))
    # Fingers reach 6 cm beyond the centre
    tall = Outline(np.array([[[0.05, 0, 0]]]), np.array([0.01]), ANY)
    assert not feasible(clear_table(card, FLAT, tall), FLAT, tall).any()
    point = SimpleNamespace(points=np.zeros((1, 3)))
    (cleared,), (reachable,) = within_reach(card, point, FLAT[None], tall, opposed=False)
    np.testing.assert_array_equal(reachable, [True, False])
    np.testing.assert_allclose(cleared.position[0], [0, 0, -0.04], atol=2e-6)


def test_opposing_surfaces_of_corner_and_strip():
    """Two edges from the origin along x and y, and a strip 4 cm wide a metre away; along the
    diagonal, turned by 5 degrees, one edge's normal is at 50 degrees to the cross-finger axis."""
    t = np.linspace(0.002, 0.06, 30)[:, None]
    x, y = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    points = np.concatenate([t * x, t * y, 0.98 * y + t * x, 1.02 * y + t * x])
    part = SimpleNamespace(points=points, normals=np.repeat([-y, -x, -y, y], 30, axis=0))
    angle = np.radians([50.0, 0.0])
    direction = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    cross = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], -1)
    both = Headings(0.02 * direction + [[0, 0, 0], [0, 1, 0]], direction, cross)
    for opposed, expected in ((True, [False, True]), (False, [True, True])):
        np.testing.assert_array_equal(
            within_reach(both, part, FLAT[None], CENTER_ONLY, opposed=opposed)[1], [expected]
        )


@pytest.mark.parametrize(("thick", "over"), [(0.03, True), (0.05, False)])
def test_closed_fingers_stay_over_the_table(thick, over):
    """3 cm over the table: fingers 12 mm thick that close vertically on 3 cm reach 27 mm down, on 5
    cm 37 mm.

    A second heading, half a metre aside, closes level on a plate 1 cm thick.
    """
    reaching = Outline(
        0.05 * np.array([[[0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]]), np.array([0.01]), ANY
    )
    position = np.array([[0, 0, -0.02], [-0.5, 0.5, -0.02]])
    headings = Headings(position, np.array([LEVEL] * 2), np.array([UP, [0, 1, 0]], float))
    half = np.array([0, 0, thick / 2]), np.array([0, 0.005, 0])
    points = np.concatenate([[p + h, p - h] for p, h in zip(position, half, strict=True)])
    part = SimpleNamespace(points=points, normals=np.array([UP, DOWN, [0, 1, 0], [0, -1, 0]]))
    assert not feasible(headings, FLAT, reaching).any()
    np.testing.assert_array_equal(
        within_reach(headings, part, FLAT[None], reaching)[1], [[over, True]]
    )


def bar_headings(*depths):
    """Headings along x, at depths in a bar (x from 0 to 8 cm, 3 cm wide) whose first 4 cm are
    graspable.
    """
    x, y = np.meshgrid(np.linspace(0, 0.08, 33), [-0.015, 0.015])
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], -1)
    count = len(depths)
    position = np.stack([np.array(depths), np.zeros(count), np.zeros(count)], -1)
    axes = (np.tile(axis, (count, 1)) for axis in (LEVEL, [0.0, 1.0, 0.0]))
    return Headings(position, *axes), points, points[:, 0] > 0.04


def test_fingers_close_on_the_region_where_they_end():
    """By hand: they reach 1 cm beyond the position, and keep 1 cm off the avoid region, which
    begins at 4.25 cm.
    """
    assert closes_on(*bar_headings(0.02, 0.01)).all()
    # Behind the bar's end nothing is between them; further in they meet the avoid region at the
    # same width.
    assert not closes_on(*bar_headings(-0.015, 0.03, 0.05)).any()
    headings, points, avoid = bar_headings(0.03)
    points[avoid, 1] *= 0.6  # the avoid region is thinner: the graspable one is met first
    assert closes_on(headings, points, avoid).all()


def covered(obj, hand):
    """Headings (H) cleared in each resting pose, and (R, H) bool whether they are allowed, on the
    graspable region.
    """
    widest = max_width(hand, 1.0)
    headings = sample_headings(
        obj, np.random.default_rng(0), use_affordance=True, options=HeadingOptions(max_width=widest)
    )
    if headings is None:
        return [], np.zeros((len(obj.rest_poses), 0), bool)
    return within_reach(headings, obj, obj.rest_poses, hand, obj.non_graspable_points)


@pytest.mark.parametrize("families", ["all", "scans"])
@pytest.mark.slow
def test_every_region_has_a_heading_that_can_be_held_or_is_uncovered(families):
    """Over a pool: what is allowed obeys the rules at the place to which the table moved it."""
    hand = outline(get_hand("human"))
    uncovered = 0
    objects = generate_many(66 if families == "all" else 12, 1_000_000, (families,))
    assert {obj.family for obj in objects} == set(GROUPS[families])
    for obj in objects:
        points = obj.points[:256].astype(float)
        avoid = obj.non_graspable_points[:256]
        for moved, allowed, rest in zip(*covered(obj, hand), obj.rest_poses, strict=False):
            assert not allowed.any() or local_width(moved, obj.points)[allowed].max() <= max_width(
                hand, 1.0
            )
            assert feasible(moved, rest, hand, local_width(moved, obj.points))[allowed].all()
            for position, direction, cross in zip(
                *(part[allowed][:8].astype(float) for part in moved), strict=True
            ):
                away = np.linalg.norm(points - position, axis=-1)
                assert away[~avoid].min() < away[avoid].min()
                offset = points - position
                slab = np.abs(offset @ np.cross(direction, cross)) < 0.03
                held = offset[slab & ~avoid & (offset @ direction < 0.01)] @ cross
                other = offset[slab & avoid & (offset @ direction < 0.02)] @ cross
                assert len(held) >= 2
                if len(other):
                    assert held.min() + 0.005 <= other.min() + 1e-6
                    assert other.max() - 1e-6 <= held.max() - 0.005
        uncovered += not covered(obj, hand)[1].any()
    assert uncovered <= 0.1 * len(objects)
