"""Resting poses against solid angles worked out by hand, and what keeps round objects still."""

import dataclasses
import itertools

import mujoco
import numpy as np
import pytest

from congrasp.common.objects import shapes
from congrasp.common.objects.mjcf import CONTACT, add_object
from congrasp.common.objects.procedural import generate
from congrasp.common.objects.resting import TableScene, quasi_static_poses, rest_poses, settle
from congrasp.common.objects.shapes import mass_properties, sample_union
from congrasp.common.objects.spec import GraspObject, Piece


def make(*pieces, density=800.0):
    """An object of these pieces, which must have their common centre of mass at the origin."""
    mass, center, inertia = mass_properties(pieces, np.full(len(pieces), density))
    np.testing.assert_allclose(center, 0, atol=1e-9)
    points, normals, _ = sample_union(pieces, np.random.default_rng(0))
    vertices = np.concatenate([shapes.tessellate(piece)[0] for piece in pieces])
    return GraspObject(
        "test",
        "test",
        pieces,
        ("whole",),
        np.array([True]),
        mass,
        inertia,
        points,
        normals,
        np.zeros(512, np.int32),
        np.zeros((0, 7)),
        vertices,
        np.zeros((0, 3), np.int32),
    )


def test_a_box_has_six_poses_with_the_solid_angles_of_its_faces():
    half = np.array([0.02, 0.03, 0.05])
    poses, likelihood = quasi_static_poses((Piece("box", tuple(half)),))
    # A rectangle of half sides a, b seen from d before its middle: 4 asin(ab / sqrt((a^2 + d^2)(b^2
    # + d^2))).
    a = half[[1, 2, 0]]
    b = half[[2, 0, 1]]
    d = half
    share = np.arcsin(a * b / np.sqrt((a**2 + d**2) * (b**2 + d**2))) / np.pi

    order = np.repeat(np.argsort(-share), 2)
    np.testing.assert_allclose(likelihood, share[order], rtol=1e-6)
    np.testing.assert_allclose(poses[:, 2], half[order], rtol=1e-9)
    np.testing.assert_allclose(likelihood.sum(), 1, rtol=1e-6)


def test_a_cylinder_stands_with_the_likelihood_of_its_ends():
    radius = 0.03
    half = 0.05
    poses, likelihood = quasi_static_poses((Piece("cylinder", (radius, half, 0)),))
    standing = np.isclose(poses[:, 2], half, atol=1e-6)
    assert standing.sum() == 2
    # Solid angle of a disc: 2 pi (1 - h / sqrt(h^2 + r^2)); the object's is a polygon of 24 sides.
    np.testing.assert_allclose(
        likelihood[standing], (1 - half / np.hypot(half, radius)) / 2, rtol=0.03
    )
    np.testing.assert_allclose(poses[~standing, 2], radius, rtol=1e-4)


def test_a_face_beside_which_the_centre_of_mass_falls_is_no_resting_pose():
    # An oblique prism that leans over by more than its foot: it cannot stand on it.
    foot = np.array([[-0.01, -0.01], [0.01, -0.01], [0.01, 0.01], [-0.01, 0.01]])
    lean = np.array([0.03, 0.0])
    vertices = np.array(
        [[*(xy + side * lean), side * 0.04] for side, xy in itertools.product((-1, 1), foot)]
    )
    poses, likelihood = quasi_static_poses((Piece("mesh", (0, 0, 0), vertices=vertices),))
    down = np.array([-shapes.matrix(pose[3:])[2] for pose in poses])
    assert (np.abs(down[:, 2]) < 0.99).all()
    np.testing.assert_allclose(likelihood.sum(), 1, rtol=1e-6)


def test_an_egg_ends_on_its_flattest_side():
    obj = make(Piece("ellipsoid", (0.02, 0.03, 0.05)))
    poses = rest_poses(obj)
    np.testing.assert_allclose(poses[:, 2], 0.02, atol=5e-4)
    down = np.array([-shapes.matrix(pose[3:])[2] for pose in poses])
    assert sorted(np.round(down[:, 0]).tolist()) == [-1.0, 1.0]


@pytest.mark.parametrize(
    "piece",
    [
        Piece("ellipsoid", (0.03, 0.03, 0.03)),
        Piece("cylinder", (0.03, 0.05, 0)),
        Piece("capsule", (0.02, 0.05, 0)),
    ],
)
def test_round_objects_rest_still(piece):
    obj = make(piece)
    for pose in rest_poses(obj):
        settled = settle(obj, pose, 5.0)
        assert settled.speed < 1e-3
        assert settled.moved < 1e-3


def test_the_free_joints_damping_stops_a_rolling_ball_after_the_distance_worked_out():
    radius = 0.03
    speed = 0.05
    obj = make(Piece("ellipsoid", (radius,) * 3))
    scene = TableScene(obj)
    data = scene.data
    mujoco.mj_resetData(scene.model, data)
    data.qpos[:] = [0, 0, radius, 1, 0, 0, 0]
    data.qvel[:] = [speed, 0, 0, 0, speed / radius, 0]
    mujoco.mj_step(scene.model, data, nstep=2000)
    # (m + I/r^2) dv/dt = -(c/r^2 + c) v for rolling without slip; the way is v0 times the time
    # constant.
    inertia = 0.4 * obj.mass * radius**2
    constant = (obj.mass + inertia / radius**2) / (
        CONTACT.free_damping / radius**2 + CONTACT.free_damping
    )
    assert np.linalg.norm(data.qvel) < 0.01
    np.testing.assert_allclose(data.qpos[0], speed * constant, rtol=0.1)


def test_settling_reports_the_motion():
    obj = make(Piece("box", (0.02, 0.02, 0.02)))
    fallen = settle(obj, np.array([0, 0, 0.05, 1.0, 0, 0, 0]), 1.0)
    np.testing.assert_allclose(fallen.moved, 0.03, atol=1e-3)
    flying = settle(obj, np.array([0, 0, 1.0, 1.0, 0, 0, 0]), 0.2)
    # The mean of the last 25 ms
    np.testing.assert_allclose(flying.speed, 9.81 * (0.2 - 0.025 / 2), rtol=0.02)


@pytest.mark.parametrize("family", ["mug", "bowl", "hammer"])
def test_the_mujoco_body_is_the_object(family):
    obj = generate(4, family)
    spec = mujoco.MjSpec()
    add_object(spec, obj, "body", contype=2, conaffinity=4)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    body = model.body("body")
    np.testing.assert_allclose(body.mass, obj.mass)
    turn = shapes.matrix(body.iquat)
    np.testing.assert_allclose(
        turn @ np.diag(body.inertia) @ turn.T, obj.inertia, rtol=1e-5, atol=1e-12
    )
    np.testing.assert_allclose(body.ipos, 0, atol=1e-12)
    assert model.nq == 7
    np.testing.assert_allclose(model.dof_damping, CONTACT.free_damping)
    assert model.ngeom == len(obj.pieces)
    np.testing.assert_array_equal(model.geom_contype, 2)
    np.testing.assert_array_equal(model.geom_conaffinity, 4)
    for i, piece in enumerate(obj.pieces):
        geom = model.geom(f"body_{i}")
        if piece.vertices is None:
            np.testing.assert_allclose(geom.pos, piece.pos, atol=1e-9)
            continue
        start = model.mesh_vertadr[geom.dataid[0]]
        count = model.mesh_vertnum[geom.dataid[0]]
        placed = (
            model.mesh_vert[start : start + count] @ data.geom_xmat[i].reshape(3, 3).T
            + data.geom_xpos[i]
        )
        expected = piece.vertices @ shapes.rotation(piece).T + piece.pos
        np.testing.assert_allclose(np.sort(placed, 0), np.sort(expected, 0), atol=1e-6)


def test_poses_follow_the_object_when_it_is_turned():
    obj = generate(2, "knife")
    turn = np.array([0.6, 0.0, 0.8, 0.0])
    moved = tuple(
        dataclasses.replace(
            piece,
            pos=tuple(shapes.matrix(turn) @ piece.pos),
            quat=tuple(_product(turn, np.array(piece.quat))),
        )
        for piece in obj.pieces
    )
    before = quasi_static_poses(obj.pieces)
    after = quasi_static_poses(moved)
    np.testing.assert_allclose(after[1], before[1], rtol=1e-6)
    np.testing.assert_allclose(after[0][:, 2], before[0][:, 2], rtol=1e-6)


def _product(a, b):
    out = np.empty(4)
    mujoco.mju_mulQuat(out, a, b)
    return out
