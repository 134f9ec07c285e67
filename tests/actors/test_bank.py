"""Constraint banks: references that the table allows, and references renewed by the policy's own
grasps.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.actors.harvest import Grasps, renew
from congrasp.actors.references_file import save_references, with_saved_references
from congrasp.common import rotations as module
from congrasp.common.errors import CongraspError
from congrasp.common.hands.kinematics import capsules, link_transforms
from congrasp.common.task.sampling.bank import SHARED, surface_of
from congrasp.common.task.sampling.build import bank_form, build_bank
from congrasp.common.task.sampling.closed_poses import Poses
from congrasp.common.task.sampling.object_headings import POSES
from congrasp.common.task.sampling.references import make_references
from tests import task as suite
from tests.compiled import Compiled
from tests.scenes import pointing
from tests.task import HAND, TASK

OBJECTS = [suite.OBJECTS[3], suite.OBJECTS[0]]  # a hammer and a box
F = len(HAND.joints)
rotations = Compiled(module)
references = jax.jit(make_references, static_argnums=(0, 4))
ends_of = jax.jit(lambda q: capsules(HAND, link_transforms(HAND, q)).reshape(-1, 3))


@pytest.fixture(scope="module")
def bank():
    return jax.tree.map(lambda rows: rows[np.array([3, 0])], suite.bank())


def test_headings_of_a_flat_object_stay_above_the_table(bank):
    rest = np.asarray(bank.rest)
    for n in range(len(OBJECTS)):
        for r in range(rest.shape[1]):
            index = np.asarray(bank.heading_index)[n, 0, r]
            position = np.asarray(bank.heading_position)[n, 0, index]
            direction = np.asarray(bank.heading_direction)[n, 0, index]
            position = position - np.asarray(bank.heading_back)[n, 0, r][:, None] * direction
            quaternion = np.broadcast_to(rest[n, r, 3:], (len(index), 4))
            height = np.asarray(rotations.rotate(quaternion, position))[:, 2] + rest[n, r, 2]
            assert height.min() >= 0.006  # fingertips are that thick
            assert np.asarray(rotations.rotate(quaternion, direction))[:, 2].max() <= 0.1 + 1e-5
    assert (
        np.asarray(bank.heading_back) > 0
    ).any()  # the hammer is thinner than twice two centimetres
    assert (np.asarray(bank.heading_back) <= 0.03 + 1e-5).all()


def test_normals_belong_to_the_points_of_their_object(bank):
    for n, obj in enumerate(OBJECTS):
        place = np.linalg.norm(obj.points[:, None] - np.asarray(bank.points[n]), axis=-1).argmin(0)
        np.testing.assert_allclose(bank.normals[n], obj.normals[place], atol=1e-6)
    drawn = jnp.array([1, 0])
    assert surface_of(TASK, bank, drawn).normals is None
    surface = surface_of(dataclasses.replace(TASK, surface_normals=True), bank, drawn)
    np.testing.assert_array_equal(surface.normals, np.asarray(bank.normals)[[1, 0]])


def test_references_with_fingers_in_the_table_are_not_valid():
    """From above, the lowest finger a centimetre over the table and a centimetre in it."""
    q = jnp.zeros((1, F))
    down = pointing(-1.0)
    ends = ends_of(q)
    height = rotations.rotate(jnp.broadcast_to(down, (len(ends), 4)), ends)[:, 2]
    reach = float(jnp.max(np.repeat(HAND.capsule_radii, 2) - height))
    assert reach > 0.1
    position = jnp.array([[0.0, 0.0, reach + 0.01 - 0.05], [0.0, 0.0, reach - 0.01 - 0.05]])
    poses = Poses(jnp.tile(q, (2, 1)), position, jnp.stack([down, down]))
    rest = jnp.array([[[0, 0, 0.05, 1, 0, 0, 0]]] * 2, jnp.float32)
    *_, valid = references(HAND, poses, rest, jax.random.key(0), TASK.trajectory_points)
    np.testing.assert_array_equal(valid, [[True], [False]])


@pytest.mark.parametrize("constraints", [TASK.constraints, ("heading",)])
def test_bank_form_matches_the_built_bank(constraints):
    """Of a task with references and of one without."""
    task = dataclasses.replace(TASK, constraints=constraints)
    bank = suite.bank() if task == TASK else build_bank(HAND, task, suite.OBJECTS, 0)
    form = bank_form(HAND, task, suite.OBJECTS)
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), form) == jax.tree.map(
        lambda leaf: (leaf.shape, leaf.dtype), bank
    )


def test_an_object_that_cannot_be_approached_is_named():
    wide = dataclasses.replace(OBJECTS[1], name="wide", points=OBJECTS[1].points * 10)
    lifted = dataclasses.replace(wide, rest_poses=np.array([[0, 0, -5.0, 1, 0, 0, 0]]))
    with pytest.raises(CongraspError, match="'wide' cannot be approached"):
        build_bank(HAND, TASK, [lifted], 0)


def test_a_bank_without_references_keeps_the_headings():
    without_references = build_bank(
        HAND, dataclasses.replace(TASK, constraints=("heading", "affordance")), suite.OBJECTS, 0
    )
    assert not np.any(without_references.pose_valid)
    for name in SHARED:
        got = np.asarray(getattr(without_references, name))
        with_references = np.asarray(getattr(suite.bank(), name))
        assert got.shape == with_references.shape, name
        assert got.dtype == with_references.dtype, name
        if not name.startswith(("pose", "trajectory")):
            np.testing.assert_array_equal(got, with_references, err_msg=name)


@pytest.fixture(scope="module")
def flat_bank(bank):
    """The bank with objects in no pose that forbids a grasp from straight above."""
    flat = bank._replace(rest=bank.rest.at[:, :].set(jnp.array([0, 0, 0.3, 1.0, 0, 0, 0])))
    return flat._replace(pose_valid=jnp.ones_like(flat.pose_valid))


def _grasps(angle: float, count: int = 4) -> Grasps:
    """Grasps of the graspable region of the second object from straight above, of which `count`
    were found.
    """
    second = jnp.ones(4, int)
    above = jnp.array([[0.0, 0.0, 0.2]] * 4)
    return Grasps(
        jnp.arange(4) < count,
        second,
        second,
        jnp.full((4, F), angle),
        above,
        jnp.stack([pointing(-1.0)] * 4),
    )


def test_a_grasp_replaces_one_reference_of_its_object_and_region(flat_bank):
    grasp = _grasps(0.123, 1)
    key = jax.random.key(1)
    used = flat_bank._replace(pose_valid=flat_bank.pose_valid.at[1, 1, :, 7].set(False))
    new = renew(HAND, TASK, used, grasp, key)
    # Where there was none to use
    assert np.flatnonzero((new.pose_q != used.pose_q).any(-1)[1, 1]).tolist() == [7]
    new = renew(HAND, TASK, flat_bank, grasp, key)
    changed = np.asarray((new.pose_q != flat_bank.pose_q).any(-1))
    assert changed[1, 1].sum() == 1
    assert changed.sum() == 1
    (slot,) = np.flatnonzero(changed[1, 1])
    np.testing.assert_allclose(new.pose_q[1, 1, slot], 0.123)
    np.testing.assert_allclose(new.trajectory_position[1, 1, slot, -1], [0, 0, 0.2], atol=2e-3)
    others = np.delete(np.arange(POSES), slot)
    np.testing.assert_array_equal(
        new.trajectory_position[1, 1, others], flat_bank.trajectory_position[1, 1, others]
    )
    np.testing.assert_array_equal(new.pose_valid[0], flat_bank.pose_valid[0])
    nothing = renew(HAND, TASK, flat_bank, _grasps(0.123, 0), key)
    jax.tree.map(np.testing.assert_array_equal, nothing, flat_bank)


def test_policy_grasps_of_all_ages_replace_half_of_the_references(flat_bank):
    """Of 64 generations of 4 grasps for 10 places, the last half is expected in half of the
    places.
    """
    now = flat_bank
    for age in range(64):
        now = renew(HAND, TASK, now, _grasps(age / 100), jax.random.key(age))
    changed = np.asarray((now.pose_q != flat_bank.pose_q).any(-1))[1, 1]
    np.testing.assert_array_equal(changed, np.arange(POSES) < POSES // 2)
    assert np.asarray(now.grasps).tolist() == [[0, 0], [0, 256]]
    ages = np.asarray(now.pose_q)[1, 1, : POSES // 2, 0] * 100
    assert np.ptp(ages) > 24
    assert 1 <= (ages < 32).sum() <= 9


def test_references_of_the_policy_outlive_a_restart(bank, tmp_path):
    path = tmp_path / "new folder" / "a.safetensors"
    read = functools.partial(with_saved_references, path, HAND, TASK)
    assert read(bank) is bank
    grown = bank._replace(
        pose_q=bank.pose_q.at[1, 1, 0].set(0.5), grasps=bank.grasps.at[1, 1].add(3)
    )
    save_references(path, grown)
    restored = read(bank)
    np.testing.assert_array_equal(restored.grasps, grown.grasps)
    for name in ("pose_q", "pose_position", "pose_quaternion"):
        np.testing.assert_allclose(getattr(restored, name), getattr(grown, name), atol=2e-3)
    np.testing.assert_allclose(
        restored.trajectory_position[:, :, :, -1], restored.pose_position, atol=1e-4
    )
    np.testing.assert_allclose(jnp.linalg.norm(restored.pose_quaternion, axis=-1), 1.0, atol=1e-6)
    others = bank._replace(points=bank.points.at[0, 0, 0].add(1e-3))
    assert read(others) is others
    path.write_bytes(path.read_bytes()[:-1])
    assert read(bank) is bank
