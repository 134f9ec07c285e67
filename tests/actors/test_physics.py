"""Engines: contacts, resets, guards, holding a weight, and agreement with each other."""

import dataclasses
import os
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from actors.bank import build_bank
from actors.initial import sample
from actors.physics import resolve_physics
from actors.physics.engine import World
from actors.physics.mjx import MjxPhysics
from actors.physics.native import NativePhysics
from actors.physics.slots import LEAVES, Pool
from common import rotations
from common.config import TaskConfig
from common.errors import CongraspError
from common.hands import get_hand
from common.objects import procedural
from common.transport.ports import free_port

ROOT = pathlib.Path(__file__).parents[2]
HAND = get_hand("human")
TASK = TaskConfig(p_pose=0.0, p_trajectory=0.0, p_affordance=0.0)
OBJECTS = [procedural.generate(i, family) for i, family in enumerate(["box", "cylinder", "mug"])]
WORLDS = 3


@pytest.fixture(scope="module")
def initial():
    """What the worlds start from: one for each object."""
    bank = build_bank(HAND, TASK, OBJECTS, 0)
    fresh = sample(HAND, TASK, bank, jax.random.key(1), WORLDS)
    index = jnp.arange(WORLDS)
    rest = bank.rest[index, 0]
    return fresh._replace(
        world=fresh.world._replace(object_index=index, object_position=rest[:, :3], object_quaternion=rest[:, 3:])
    )


def _above(world: World, height: float) -> World:
    """The hand far above its object, palm down."""
    down = np.tile([1.0, 0.0, 0.0, 0.0], (WORLDS, 1)).astype(np.float32)
    position = np.asarray(world.object_position) + np.array([0.0, 0.09, height], np.float32)
    return world._replace(base_position=position, base_quaternion=down)


def _grasp(world: World, step: int) -> np.ndarray:
    """A scripted approach: down on the object within 15 steps, then closing."""
    target = np.zeros((WORLDS, 6 + len(HAND.joints)))
    target[:, 2] = -0.13 * min(1.0, step / 15)
    closing = np.clip((step - 15) / 20, 0.0, 1.0)
    target[:, 6:] = HAND.q_open + closing * (HAND.q_closed - HAND.q_open)
    return target


def test_objects_rest_and_the_hand_stays_without_commands(initial):
    physics = NativePhysics(HAND, TASK, OBJECTS, 1)
    state = physics.start(_above(initial.world, 0.3))
    still = np.concatenate([np.zeros((WORLDS, 6)), np.asarray(initial.world.q)], 1)
    for _ in range(50):
        state, seen = physics.step(state, still, np.ones(WORLDS, bool))
    np.testing.assert_allclose(seen.object_position, initial.world.object_position, atol=2e-3)
    np.testing.assert_allclose(seen.q, initial.world.q, atol=1e-3)  # gravity on the hand is compensated
    assert not seen.contact_found.any() and not seen.bad.any()
    physics.close()


def test_a_removed_table_lets_objects_fall_freely(initial):
    physics = NativePhysics(HAND, TASK, OBJECTS, 1)
    state = physics.start(_above(initial.world, 0.3))
    still = np.concatenate([np.zeros((WORLDS, 6)), np.asarray(initial.world.q)], 1)
    table = np.array([True, False, False])
    for _ in range(20):
        state, seen = physics.step(state, still, table)
    drop = np.asarray(initial.world.object_position)[:, 2] - seen.object_position[:, 2]
    assert abs(drop[0]) < 2e-3
    np.testing.assert_allclose(drop[1:], 0.5 * 9.81 * 0.2**2, rtol=0.05)
    physics.close()


def test_a_stationary_object_stays_when_pushed(initial):
    physics = NativePhysics(HAND, TASK, OBJECTS, 1)
    world = _above(initial.world, 0.19)._replace(stationary=np.ones(WORLDS, bool))
    state = physics.start(world)
    touched = np.zeros(WORLDS, bool)
    for step in range(40):
        state, seen = physics.step(state, _grasp(world, step), np.ones(WORLDS, bool))
        touched |= seen.contact_found.any((1, 2))
    assert touched.any()
    np.testing.assert_allclose(seen.object_position, initial.world.object_position, atol=4e-3)
    physics.close()


def test_contact_force_is_that_of_the_object_on_the_link(initial):
    """An object that lies on a flat, upturned hand presses it down with its weight."""
    box = dataclasses.replace(OBJECTS[0])
    physics = NativePhysics(HAND, TASK, [box], 1)
    upturned = np.array([[0.0, 1.0, 0.0, 0.0]], np.float32)  # palm up
    height = float(np.abs(box.points[:, 2]).max())
    world = World(
        object_index=np.zeros(1, int),
        mass_scale=np.ones(1),
        friction=np.ones(1),
        base_position=np.array([[0.0, -0.05, 0.5]]),
        base_quaternion=upturned,
        q=np.zeros((1, len(HAND.joints))),
        object_position=np.array([[0.0, 0.0, 0.52 + height]]),
        object_quaternion=np.array([[1.0, 0.0, 0.0, 0.0]]),
        stationary=np.zeros(1, bool),
    )
    state = physics.start(world)
    forces = []
    for _ in range(150):
        state, seen = physics.step(state, np.zeros((1, 6 + len(HAND.joints))), np.ones(1, bool))
        forces.append(seen.contact_force.sum((1, 2))[0])
    np.testing.assert_allclose(np.mean(forces[-40:], 0)[2], -box.mass * 9.81, rtol=0.1)
    physics.close()


def test_gains_hold_half_a_kilogram_without_shaking():
    cylinder = next(
        obj for seed in range(200) if 0.02 < (obj := procedural.generate(seed, "cylinder")).pieces[0].size[0] < 0.03
    )
    scale = 0.5 / cylinder.mass
    physics = NativePhysics(HAND, TASK, [cylinder], 1)
    # The axis across the palm, welded until the fingers have closed firmly around it.
    center = np.array([0.005, -0.09, -0.035])
    sideways = np.array([np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0])
    world = World(
        object_index=np.zeros(1, int),
        mass_scale=np.full(1, scale),
        friction=np.ones(1),
        base_position=np.array([[0.0, 0.0, 1.0]]),
        base_quaternion=np.array([[1.0, 0.0, 0.0, 0.0]]),
        q=HAND.q_open[None],
        object_position=np.array([[0.0, 0.0, 1.0]]) + center,
        object_quaternion=sideways[None],
        stationary=np.ones(1, bool),
    )
    state = physics.start(world)
    cell = physics.cells[0]
    target = np.zeros((1, 6 + len(HAND.joints)))
    speeds, positions = [], []
    for step in range(250):
        firm = HAND.q_open + min(1.3, step / 30) * (HAND.q_closed - HAND.q_open)
        target[:, 6:] = np.clip(firm, HAND.lower, HAND.upper)
        if step == 60:
            cell.data.eq_active[physics._where.weld] = False
        state, seen = physics.step(state, target, np.zeros(1, bool))
        if step >= 200:
            speeds.append(np.linalg.norm(seen.object_velocity))
            positions.append(seen.object_position[0])
    assert positions[-1][2] > 0.85, "the object fell"
    assert max(speeds) < 0.05, "the object shakes"
    assert np.ptp(np.array(positions), 0).max() < 0.01
    physics.close()


def test_a_diverged_world_is_marked_and_put_back_while_the_others_go_on(initial, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    physics = NativePhysics(HAND, TASK, OBJECTS, 2)
    world = _above(initial.world, 0.3)
    state = physics.start(world)
    still = np.concatenate([np.zeros((WORLDS, 6)), np.asarray(initial.world.q)], 1)
    state, _ = physics.step(state, still, np.ones(WORLDS, bool))
    physics.cells[1].data.qvel[:] = np.nan
    state, seen = physics.step(state, still, np.ones(WORLDS, bool))
    np.testing.assert_array_equal(seen.bad, [False, True, False])
    assert all(np.isfinite(field).all() for field in seen)
    np.testing.assert_allclose(seen.q[1], np.asarray(world.q)[1], atol=1e-6)
    state, seen = physics.step(state, still, np.ones(WORLDS, bool))
    assert not seen.bad.any()
    assert not list(tmp_path.iterdir()), "MuJoCo wrote its own log"
    physics.close()


def test_a_world_that_was_used_before_is_as_good_as_new(initial):
    """Worlds are recycled: neither state nor mass of an earlier episode may be left in them."""
    physics, fresh = NativePhysics(HAND, TASK, OBJECTS, 1), NativePhysics(HAND, TASK, OBJECTS, 1)
    world = _above(initial.world, 0.19)
    everywhere = np.ones(WORLDS, bool)
    state = physics.start(world._replace(mass_scale=np.full(WORLDS, 3.0), stationary=everywhere))
    for step in range(30):
        physics.step(state, _grasp(world, step), ~everywhere)
    swapped = world._replace(object_index=np.array([2, 0, 0]))
    state, new = physics.reset(state, everywhere, swapped), fresh.start(swapped)
    for step in range(30):
        state, seen = physics.step(state, _grasp(world, step), everywhere)
        new, expected = fresh.step(new, _grasp(world, step), everywhere)
    assert seen.contact_found.any()
    for a, b in zip(seen, expected, strict=True):
        np.testing.assert_array_equal(a, b)
    physics.close()
    fresh.close()


def test_reset_changes_only_the_masked_worlds(initial):
    physics = NativePhysics(HAND, TASK, OBJECTS, 1)
    world = _above(initial.world, 0.3)
    state = physics.start(world)
    moving = np.concatenate([np.full((WORLDS, 6), 0.05), np.asarray(world.q)], 1)
    for _ in range(10):
        state, before = physics.step(state, moving, np.ones(WORLDS, bool))
    mask = np.array([False, True, False])
    state = physics.reset(state, mask, world._replace(object_index=np.array([0, 2, 2])))
    after = physics.read(state)
    np.testing.assert_allclose(after.u[1], 0.0)
    np.testing.assert_allclose(after.u[~mask], before.u[~mask], atol=1e-7)
    physics.close()


def test_slots_are_the_same_bodies_as_models_of_their_own():
    pool = Pool(HAND, TASK, OBJECTS)
    body = pool.model.body("object").id
    leaves = pool.leaves(OBJECTS)
    for i, obj in enumerate(OBJECTS):
        np.testing.assert_allclose(leaves["body_mass"][i, body], obj.mass)
        np.testing.assert_allclose(np.sort(leaves["body_inertia"][i, body]), np.linalg.eigvalsh(obj.inertia), rtol=1e-6)
    assert set(leaves) == set(LEAVES)


def test_a_pool_may_begin_with_an_object_whose_inertia_is_diagonal():
    """MuJoCo has a shortcut for such bodies, which the other objects' inertias must not take."""
    upright, skewed = procedural.generate(9000, "capsule"), procedural.generate(9001, "mug")
    leaves = Pool(HAND, TASK, [upright, skewed]).leaves([upright, skewed])
    assert np.isfinite(leaves["body_inertia"]).all()


@pytest.mark.timeout(400)
@pytest.mark.parametrize("implementation", ["warp", "jax"])
def test_engines_agree(initial, implementation, monkeypatch):
    """Free motion agrees tightly, a scripted grasp statistically; three different objects in one batch."""
    from actors.physics import mjx

    world = _above(initial.world, 0.19)
    native = NativePhysics(HAND, TASK, OBJECTS, 1)
    other = MjxPhysics(HAND, TASK, OBJECTS, implementation)
    step = jax.jit(other.step)
    a, b = native.start(world), other.start(jax.tree.map(jnp.asarray, world))
    table = np.ones(WORLDS, bool)
    force = np.zeros((2, WORLDS))
    for i in range(40):
        target = _grasp(world, i)
        a, x = native.step(a, target, table)
        b, y = step(b, jnp.asarray(target, jnp.float32), jnp.asarray(table))
        if not x.contact_found.any() and i < 10:
            for name in ("q", "u", "object_position", "q_velocity", "u_velocity"):
                np.testing.assert_allclose(getattr(x, name), getattr(y, name), atol=2e-4, err_msg=f"{name} at {i}")
            if implementation == "warp":  # what fills its buffers is what MuJoCo C finds
                found = [sum(cell.data.ncon for cell in native.cells), max(cell.data.nefc for cell in native.cells)]
                room = [WORLDS * mjx.CONTACTS_PER_WORLD, mjx.CONSTRAINTS_PER_WORLD]
                np.testing.assert_allclose(y.usage, np.divide(found, room), rtol=1e-5)
        assert not x.usage.any() and np.all(y.usage <= 1)
        force += [np.linalg.norm(seen.contact_force, axis=-1).sum((1, 2)) for seen in (x, y)]
    assert force[0].max() > 0, "the script must make contact"
    assert not np.asarray(y.bad).any()
    np.testing.assert_allclose(x.q, y.q, atol=0.25)
    np.testing.assert_allclose(x.object_position, y.object_position, atol=0.03)
    np.testing.assert_allclose(force[0], force[1], rtol=0.35, atol=20.0)
    # A reset puts the masked worlds back and leaves the rest.
    mask = jnp.array([True, False, False])
    again = other.read(other.reset(b, mask, jax.tree.map(jnp.asarray, world)))
    np.testing.assert_allclose(again.u[0], 0.0, atol=1e-6)
    np.testing.assert_allclose(again.u[1:], y.u[1:], atol=1e-6)
    if implementation == "warp":
        monkeypatch.setattr(mjx, "CONTACTS_PER_WORLD", 2)
        _, crowded = step(other.start(jax.tree.map(jnp.asarray, world)), jnp.asarray(target, jnp.float32), table)
        assert crowded.usage[0] > 1 > crowded.usage[1]
    else:
        assert not np.any(y.usage)
    native.close()


def test_contacts_between_links_are_refused_where_there_are_none():
    task = dataclasses.replace(TASK, hand_self_collision=True)
    with pytest.raises(CongraspError, match=r"'jax' has no contacts between the links .* native or warp"):
        MjxPhysics(HAND, task, OBJECTS, "jax")


def test_a_demanded_gpu_that_is_missing_is_one_clear_line():
    with pytest.raises(CongraspError, match="NVIDIA GPU"):
        resolve_physics("warp")
    assert resolve_physics("auto") == "native"


def test_object_velocity_is_in_the_world_frame(initial):
    physics = NativePhysics(HAND, TASK, OBJECTS, 1)
    state = physics.start(_above(initial.world, 0.3))
    cell = physics.cells[0]
    spin = np.array([0.0, 0.0, 3.0])  # about the world's vertical
    quaternion = jnp.asarray(cell.data.qpos[physics._where.object_qpos[3:]], jnp.float32)
    local = np.asarray(rotations.rotate(rotations.conjugate(quaternion), jnp.asarray(spin, jnp.float32)))
    cell.data.qvel[physics._where.object_qvel[3:]] = local
    physics._qpos[0], physics._qvel[0] = cell.data.qpos, cell.data.qvel
    np.testing.assert_allclose(physics.read(state).object_angular_velocity[0], spin, atol=1e-5)
    physics.close()


def test_an_engine_uses_its_own_ranks_device():
    """Two processes of one job: JAX counts the devices of both, and MJX would take the first."""
    port, environment = free_port(), {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "tests.actors.rank_engine"]
    ranks = [
        subprocess.Popen([*command, str(rank), str(port), "warp"], env=environment, stdout=subprocess.PIPE, text=True)
        for rank in range(2)
    ]
    try:
        for rank, process in enumerate(ranks):
            assert process.communicate(timeout=120.0)[0].splitlines()[-1:] == [f"[{rank}] True"]
    finally:
        for process in ranks:
            process.kill()
