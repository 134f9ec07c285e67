"""Queries: where their fields land, what is completed, and what is refused."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError, LayoutError
from congrasp.common.hands import get_hand
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import PAPER
from congrasp.common.task.normals import estimated_normals
from congrasp.common.wire.codec import Message
from congrasp.services.serve import requests
from congrasp.services.serve.requests import Layout
from tests.queries import packed

HAND = get_hand("human")
LAYOUT = Layout(HAND, TaskConfig(constraints=PAPER, surface_points=8, trajectory_points=3))
COMPLETE = jax.jit(LAYOUT.complete)
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0], np.float32)
coordinate = st.floats(-1.0, 1.0, width=32)
vector = st.tuples(coordinate, coordinate, coordinate).map(lambda v: np.array(v, np.float32))


def arrays(**changes):
    """The arrays of a query whose values tell where they belong."""
    rng = np.random.default_rng(0)
    state = (
        "q",
        "u",
        "q_target",
        "u_target",
        "q_initial",
        "object_position",
        "object_position_initial",
    )
    given_arrays = {
        name: rng.normal(size=LAYOUT.shapes[name]).astype(np.float32)
        for name in (*state, "base_position")
    }
    given_arrays |= dict.fromkeys(
        ("object_quaternion", "object_quaternion_initial", "base_quaternion"), IDENTITY
    )
    given_arrays |= {"time": np.float32(7), "table": np.bool_(True)}
    given_arrays |= {"surface_points": rng.normal(size=(8, 3)), "surface_avoid": np.arange(8) < 3}
    given_arrays |= {
        "heading_position": rng.normal(size=3),
        "heading_direction": np.array([0.0, 0.0, -1.0]),
    }
    return {name: value for name, value in {**given_arrays, **changes}.items() if value is not None}


def parse(constraints=("heading",), **changes):
    return completed(LAYOUT.parse(packed(LAYOUT, arrays(**changes), constraints)))


def completed(query):
    fields, checks = COMPLETE(query.vectors)
    if error := LAYOUT.find_error(query, np.asarray(checks)):
        raise error
    return query, {name: np.asarray(value[0]) for name, value in fields.items()}


def test_fields_land_in_their_places_and_absent_sensors_read_zero():
    sent = arrays()
    query, received = parse()
    assert query.vectors.shape == (1, LAYOUT.size)
    for name, value in sent.items():
        np.testing.assert_array_equal(received[name], np.asarray(value, np.float32), err_msg=name)
    for name in ("q_velocity", "object_velocity", "contact_force", "contact_found"):
        assert not received[name].any()
    np.testing.assert_array_equal(received["asked"], [1, 0, 0, 0])


def test_flags_follow_the_order_of_the_constraints():
    pose = {"pose_q": np.zeros(20), "pose_position": np.zeros(3), "pose_quaternion": IDENTITY}
    query, fields = parse(("pose", "affordance"), **pose)
    assert query.asked == ("affordance", "pose")
    np.testing.assert_array_equal(fields["asked"], [0, 1, 1, 0])


@given(vector, vector)
def test_the_cross_direction_is_made_unit_and_orthogonal_to_the_heading(direction, cross):
    length = np.linalg.norm(direction)
    assume(length > 0.1)
    _, received = parse(heading_direction=direction / length, heading_cross=cross)
    assert np.linalg.norm(received["heading_cross"]) == pytest.approx(1.0, abs=1e-5)
    assert received["heading_cross"] @ received["heading_direction"] == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize(
    ("turn", "along"),
    [([np.cos(0.3), 0, 0, np.sin(0.3)], 0.0), ([1, 0, 0, 0], 0.0), ([1, 0, 0, 0], 1.0)],
)
def test_without_a_cross_direction_the_hand_does_not_roll(turn, along):
    """It is the hand's own at the start, in the object's frame; along the heading it says
    nothing.
    """
    cross = grasp_frame(get_hand("human")).cross
    wrist = Rotation.from_euler("x", 0.4)
    thing = Rotation.from_quat(turn, scalar_first=True)
    held = thing.inv().apply(wrist.apply(cross))
    across = np.cross(held, [0.36, 0.48, 0.8])
    direction = held if along else across / np.linalg.norm(across)
    _, received = parse(
        heading_direction=direction,
        heading_cross=None,
        base_quaternion=wrist.as_quat(scalar_first=True),
        object_quaternion_initial=np.array(turn),
    )
    assert received["heading_cross"] @ held == pytest.approx(1.0 - along, abs=1e-5)


@pytest.mark.parametrize("count", [3, 8, 20])
def test_surface_points_are_resampled_to_the_policys_number(count):
    points = np.arange(count)[:, None] * np.ones(3)
    _, received = parse(surface_points=points, surface_avoid=np.arange(count) >= count // 2)
    coordinates = received["surface_points"][:, 0]
    assert coordinates[0] == 0
    assert np.all(np.diff(coordinates) >= 0)
    assert len(set(coordinates)) == min(count, 8)
    np.testing.assert_array_equal(received["surface_avoid"], coordinates >= count // 2)


@pytest.mark.parametrize(
    ("constraints", "changes", "words"),
    [
        (["flight"], {}, "no constraint 'flight'"),
        (
            ["affordance"],
            {},
            "no constraint that guides the wrist. Add one of: heading, pose, trajectory",
        ),
        (
            ["heading", "affordance"],
            {"surface_avoid": np.zeros(8, bool)},
            "some points, and to False for others",
        ),
        (["heading", "affordance"], {"surface_avoid": None}, "lacks the field 'surface_avoid'"),
        (["heading"], {"q": None}, "lacks the field 'q'"),
        (["heading"], {"q": np.zeros(22)}, r"'q' has shape \(22,\); it must be \(20,\)"),
        (["heading"], {"weight": np.zeros(1)}, "unknown field 'weight'"),
        (["heading"], {"asked": np.ones(4)}, "unknown field 'asked'"),
        (["heading"], {"u": np.full(6, np.inf)}, "'u' is not finite"),
        (["heading"], {"surface_points": np.zeros((0, 3))}, "surface_points"),
        (["heading"], {"surface_avoid": np.zeros(5, bool)}, r"must be \(8,\)"),
        (
            ["heading"],
            {"base_quaternion": np.zeros(4)},
            "'base_quaternion' has length 0.000, not 1",
        ),
        (
            ["trajectory"],
            {"trajectory_position": np.zeros((3, 3))},
            "lacks the field 'trajectory_quaternion'",
        ),
    ],
)
def test_bad_queries_name_the_field_and_the_rule(constraints, changes, words):
    with pytest.raises(CongraspError, match=words):
        parse(constraints, **changes)


def test_odd_constraints_are_refused_in_one_short_line():
    for names in (
        None,
        7,
        "heading",
        [["heading"]],
        [None],
        ["x" * 500_000],
        {"heading": 1},
        ["heading", 3],
    ):
        with pytest.raises(CongraspError, match="list of names") as caught:
            LAYOUT.parse(
                Message(
                    packed(LAYOUT, arrays()).arrays, {"layout": LAYOUT.digest, "constraints": names}
                )
            )
        assert len(str(caught.value)) < 120


def test_a_query_of_another_layout_is_refused():
    vector = packed(LAYOUT, arrays()).arrays["packed"]
    meta = {"constraints": ["heading"], "layout": LAYOUT.digest}
    assert len(LAYOUT.parse(Message({"packed": np.tile(vector, (64, 1))}, meta)).vectors) == 64
    for count in (0, 65):
        with pytest.raises(CongraspError, match=f"The query has {count} states"):
            LAYOUT.parse(Message({"packed": np.tile(vector, (count, 1))}, meta))
    task = TaskConfig(constraints=PAPER, surface_points=8, trajectory_points=3)
    others = (
        Layout(HAND, dataclasses.replace(task, trajectory_points=4)),
        Layout(dataclasses.replace(HAND, name="x"), task),
    )
    for wrong in (
        *(Message({"packed": vector}, {**meta, "layout": other.digest}) for other in others),
        Message({"packed": vector[0]}, meta),
        Message({"packed": vector[:, :-1]}, meta),
        Message({"packed": vector, "q": np.zeros(20)}, meta),
        Message({"packed": vector}, {"constraints": ["heading"]}),
        Message(arrays(), meta),
    ):
        with pytest.raises(LayoutError, match="does not match the policy's layout"):
            LAYOUT.parse(wrong)


def test_a_bad_query_of_a_batch_spoils_no_other():
    good, bad, third = (
        LAYOUT.parse(packed(LAYOUT, arrays(**changes)))
        for changes in ({}, {"u": np.full(6, np.nan)}, {"base_quaternion": np.zeros(4)})
    )
    queries = good, bad, good, third
    fields, checks = COMPLETE(np.concatenate([query.vectors for query in queries]))
    errors = [
        LAYOUT.find_error(query, row[None])
        for query, row in zip(queries, np.asarray(checks), strict=True)
    ]
    assert [error is not None for error in errors] == [False, True, False, True]
    assert "'u' is not finite" in str(errors[1])
    assert "base_quaternion" in str(errors[3])
    _, alone = parse()
    for name, value in fields.items():
        np.testing.assert_allclose(
            np.asarray(value)[[0, 2]], alone[name][None].repeat(2, 0), atol=1e-6, err_msg=name
        )
        assert np.isfinite(value).all()


CLOSER = TaskConfig(
    constraints=("heading",), surface_points=8, trajectory_points=3, surface_normals=True
)
UP = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (8, 1))


@functools.cache
def completing(task):
    layout = Layout(HAND, task)
    return layout, jax.jit(
        lambda vectors: (layout.complete(vectors)[1], layout.surface(layout.complete(vectors)[0]))
    )


def normals_of(task=CLOSER, **changes):
    """The normals with which a policy computes features for a query."""
    layout, complete = completing(task)
    points = "cloud" if task.observation == "camera" else "surface_points"
    given_arrays = {
        name: value
        for name, value in arrays(**changes).items()
        if name in {*layout.shapes, *changes}
    }
    if points == "cloud":
        given_arrays = {n: x for n, x in given_arrays.items() if "object" not in n} | {
            points: changes[points]
        }
    query = layout.parse(packed(layout, given_arrays))
    layout.estimate_normals(query.vectors)
    checks, surface = complete(query.vectors)
    if error := layout.find_error(query, np.asarray(checks)):
        raise error
    return np.asarray(surface.normals[0])


def test_given_normals_are_used_and_missing_ones_are_estimated():
    points = np.random.default_rng(1).normal(size=(8, 3)).astype(np.float32)
    np.testing.assert_array_equal(normals_of(surface_points=points, surface_normals=UP), UP)
    estimated = np.asarray(jax.jit(estimated_normals)(points[None]))[0]
    np.testing.assert_allclose(normals_of(surface_points=points), estimated, atol=1e-5)
    axes = np.eye(3)[np.arange(8) % 3]
    twice = {"surface_points": np.repeat(points, 2, 0), "surface_normals": np.repeat(axes, 2, 0)}
    np.testing.assert_array_equal(normals_of(**twice, surface_avoid=None), axes)
    # A policy that does not observe normals ignores them.
    assert "surface_normals" not in parse(surface_normals=UP)[1]


def test_normals_are_estimated_once_for_a_surface(monkeypatch):
    calls = []
    monkeypatch.setattr(
        requests,
        "estimated_normals",
        lambda points: calls.append(points) or estimated_normals(points),
    )
    layout = Layout(HAND, CLOSER)
    sent_normals = np.random.default_rng(3).normal(size=(2, 8, 3)).astype(np.float32)
    vectors = np.zeros((5, layout.size), np.float32)
    for row, surface in enumerate((0, 1, 0, 0, 1)):
        vectors[row, layout.offsets["surface_points"] :][:24] = sent_normals[surface].reshape(-1)
    vectors[3, layout.offsets["surface_normals"] :][:24] = UP.reshape(-1)
    layout.estimate_normals(vectors.copy())
    layout.estimate_normals(vectors)
    assert len(calls) == 2
    normals = layout.unpack(vectors)["surface_normals"]
    expected = np.asarray(estimated_normals(sent_normals))
    np.testing.assert_allclose(
        normals, [expected[0], expected[1], expected[0], UP, expected[1]], atol=1e-5
    )


@pytest.mark.parametrize(
    ("normals", "error"),
    [
        (2.0 * UP, "'surface_normals' has length 2.000, not 1"),
        (UP[:5], r"shape \(5, 3\); it must be \(8, 3\)"),
    ],
)
def test_normals_that_are_none_are_named(normals, error):
    with pytest.raises(CongraspError, match=error):
        normals_of(surface_normals=normals)


def test_estimated_normals_of_a_cloud_point_toward_its_camera():
    task = dataclasses.replace(CLOSER, observation="camera")
    sheet = np.random.default_rng(2).uniform(-0.05, 0.05, (8, 3)) * [1, 1, 0]
    for side in (1.0, -1.0):
        normals = normals_of(task, cloud=sheet, camera_position=np.array([0.1, 0.0, side]))
        np.testing.assert_allclose(normals, side * UP, atol=1e-3)
