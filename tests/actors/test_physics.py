"""Engines: contacts, resets, guards, holding a weight, and agreement with each other."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from congrasp.actors.physics import make_physics, resolve_physics
from congrasp.actors.physics.engine import ResetState, physics_state
from congrasp.actors.physics.pooled_model import LEAVES, PooledModel
from congrasp.actors.physics.scene import TABLE_AWAY, addresses, compile_scene, scene_spec
from congrasp.common import rotations
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.mjcf import WRIST_JOINTS
from congrasp.common.objects import procedural
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.control import Guided, carried_lead, track_load, wrist_lead, wrist_load
from tests import task as suite
from tests.scenes import scene
from tests.task import HAND, TASK

OBJECTS = [procedural.generate(i, family) for i, family in enumerate(["box", "cylinder", "mug"])]
ENVIRONMENTS = 3


def one_each(objects: Sequence[GraspObject]) -> ResetState:
    """Starts of the suite's episodes, one for each object, in its likeliest resting pose."""
    drawn = suite.episodes(suite.BATCH).reset_state
    start = jax.tree.map(lambda rows: rows[np.arange(len(objects)) % len(rows)], drawn)
    rest = np.array([obj.rest_poses[0] for obj in objects], np.float32)
    index = np.arange(len(objects), dtype=np.int32)
    return start._replace(
        object_index=index,
        object_position=rest[:, :3],
        object_quaternion=rest[:, 3:],
        q=_opened(len(objects)),
        u_velocity=np.zeros((len(objects), 6), np.float32),
    )


def _opened(count: int) -> np.ndarray:
    return np.tile(HAND.q_open, (count, 1)).astype(np.float32)


@pytest.fixture(scope="module")
def env():
    return one_each(OBJECTS)


def above(start: ResetState, height: float) -> ResetState:
    """The hand far above its object, palm down."""
    down = np.tile([1.0, 0.0, 0.0, 0.0], (len(start.q), 1)).astype(np.float32)
    position = np.asarray(start.object_position) + np.array([0.0, 0.09, height], np.float32)
    return start._replace(base_position=position, base_quaternion=down)


def grasp(start: ResetState, step: int) -> np.ndarray:
    """A scripted approach: down on the object within 15 steps, then closing."""
    target = np.zeros((len(start.q), 6 + len(HAND.joints)))
    target[:, 2] = -0.13 * min(1.0, step / 15)
    closing = np.clip((step - 15) / 20, 0.0, 1.0)
    target[:, 6:] = HAND.q_open + closing * (HAND.q_closed - HAND.q_open)
    return target


def servoed(start: ResetState) -> tuple[ResetState, np.ndarray]:
    """A start in the air with half the fingers' gains to one and a half times, and targets ahead of
    all joints.
    """
    start = above(start, 0.3)
    batch = len(start.q)
    start = start._replace(gain_scale=np.linspace(0.5, 1.5, batch).astype(np.float32))
    return start, np.concatenate([np.full((batch, 6), 0.01), np.asarray(start.q) + 0.1], 1).astype(
        np.float32
    )


def test_gains_scale_the_finger_servos_alone(native, env):
    """After one substep a joint at rest has the speed that the torque kp * ahead gave it:
    proportional to the gain.
    """
    physics = native([OBJECTS[0]] * 3, dataclasses.replace(TASK, control_dt=0.0005, substeps=1))
    start, target = servoed(env._replace(object_index=np.zeros(ENVIRONMENTS, int)))
    state = physics.start(start)
    _, after = physics.step(state, target, np.ones(ENVIRONMENTS, bool))
    speed = np.abs(np.asarray(after.q_velocity)).max(1)
    # Damping takes its part
    np.testing.assert_allclose(speed / speed[1], [0.5, 1.0, 1.5], rtol=0.1)
    physics.reset(state, np.array([True, False, False]), start._replace(gain_scale=np.ones(3)))
    gains = np.array([instance.model.actuator_gainprm[:, 0] for instance in physics.instances])
    np.testing.assert_allclose(gains[:, 6:], gains[1, 6:] * np.array([[1.0], [1.0], [1.5]]))
    np.testing.assert_array_equal(gains[:, :6], gains[[1, 1, 1], :6])  # of the wrist
    np.testing.assert_array_equal(*(physics.instances[i].model.actuator_forcerange for i in (0, 2)))


def test_objects_rest_and_the_hand_stays_without_commands(on_cpu, env):
    physics = on_cpu(OBJECTS)
    state = physics.start(above(env, 0.3))
    still = np.concatenate([np.zeros((ENVIRONMENTS, 6)), np.asarray(env.q)], 1)
    for _ in range(50):
        state, after = physics.step(state, still, np.ones(ENVIRONMENTS, bool))
    np.testing.assert_allclose(after.object_position, env.object_position, atol=2e-3)
    np.testing.assert_allclose(after.q, env.q, atol=1e-3)  # gravity on the hand is compensated
    assert not after.contact_found.any()
    assert not after.diverged.any()


def test_a_removed_table_lets_objects_fall_freely(on_cpu, env):
    physics = on_cpu(OBJECTS)
    state = physics.start(above(env, 0.3))
    still = np.concatenate([np.zeros((ENVIRONMENTS, 6)), np.asarray(env.q)], 1)
    table = np.array([True, False, False])
    for _ in range(20):
        state, after = physics.step(state, still, table)
    drop = np.asarray(env.object_position)[:, 2] - after.object_position[:, 2]
    assert abs(drop[0]) < 2e-3
    np.testing.assert_allclose(drop[1:], 0.5 * 9.81 * 0.2**2, rtol=0.05)


def test_a_stationary_object_stays_when_pushed(on_cpu, env):
    physics = on_cpu(OBJECTS)
    start = above(env, 0.19)._replace(stationary=np.ones(ENVIRONMENTS, bool))
    state = physics.start(start)
    touched = np.zeros(ENVIRONMENTS, bool)
    for step in range(40):
        state, after = physics.step(state, grasp(start, step), np.ones(ENVIRONMENTS, bool))
        touched |= after.contact_found.any((1, 2))
    assert touched.any()
    np.testing.assert_allclose(after.object_position, env.object_position, atol=4e-3)


def test_a_scaled_mass_is_the_mass_of_a_heavier_object(native, env):
    """Its inertia and the weights of its constraints change with it."""
    heavy = [
        dataclasses.replace(obj, mass=3 * obj.mass, inertia=3 * obj.inertia) for obj in OBJECTS
    ]
    scaled = native(OBJECTS)
    compiled = native(heavy)
    scaled.start(env._replace(mass_scale=np.full(ENVIRONMENTS, 3.0)))
    compiled.start(env._replace(mass_scale=np.ones(ENVIRONMENTS)))
    # The compiler's
    names = {name for name in dir(mujoco.MjModel) if name.startswith(("body_", "dof_"))} - {
        "dof_M0"
    }
    for ours, theirs in zip(scaled.instances, compiled.instances, strict=True):
        for name in names:
            if isinstance(value := getattr(ours.model, name), np.ndarray):
                # Nothing depends on the mass of everything together
                world = name.startswith("body_")
                np.testing.assert_allclose(
                    value[world:], getattr(theirs.model, name)[world:], 1e-5, 1e-9, err_msg=name
                )


def test_contact_force_is_that_of_the_object_on_the_link(on_cpu, env):
    """An object that lies on a flat, upturned hand presses it down with its weight."""
    box = dataclasses.replace(OBJECTS[0])
    physics = on_cpu([box])
    height = float(np.abs(box.points[:, 2]).max())
    start = suite.start_of(
        base_position=np.array([[0.0, -0.05, 0.5]]),
        base_quaternion=np.array([[0.0, 1.0, 0.0, 0.0]]),  # palm up
        q=np.zeros((1, len(HAND.joints))),
        object_position=np.array([[0.0, 0.0, 0.52 + height]]),
    )
    state = physics.start(start)
    forces = []
    for _ in range(150):
        state, after = physics.step(state, np.zeros((1, 6 + len(HAND.joints))), np.ones(1, bool))
        forces.append(after.contact_force.sum((1, 2))[0])
    np.testing.assert_allclose(np.mean(forces[-40:], 0)[2], -box.mass * 9.81, rtol=0.1)


def test_a_diverged_environment_alone_is_flagged_and_reset(native, env, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    physics = native(OBJECTS, threads=2)
    start = above(env, 0.3)
    state = physics.start(start)
    still = np.concatenate([np.zeros((ENVIRONMENTS, 6)), np.asarray(env.q)], 1)
    state, _ = physics.step(state, still, np.ones(ENVIRONMENTS, bool))
    physics.instances[1].data.qvel[:] = np.nan
    state, after = physics.step(state, still, np.ones(ENVIRONMENTS, bool))
    np.testing.assert_array_equal(after.diverged, [False, True, False])
    assert all(np.isfinite(field).all() for field in after)
    np.testing.assert_allclose(after.q[1], np.asarray(start.q)[1], atol=1e-6)
    state, after = physics.step(state, still, np.ones(ENVIRONMENTS, bool))
    assert not after.diverged.any()
    assert not list(tmp_path.iterdir()), "MuJoCo wrote its own log"


def test_environments_whose_solver_reached_its_limit_are_counted(native, env):
    start = jax.tree.map(np.asarray, env)
    physics = native(OBJECTS)
    state = physics.start(start)
    target = grasp(start, 0)
    table = np.ones(ENVIRONMENTS, bool)
    for limited in (0, 1, 2):
        for instance in physics.instances:
            instance.model.opt.iterations = 100
        for instance in physics.instances[:limited]:
            instance.model.opt.iterations = 1
        state, after = physics.step(state, target, table)
        np.testing.assert_allclose(after.occupancy, [0.0, 0.0, limited / ENVIRONMENTS], rtol=1e-6)


def test_an_environment_that_was_used_before_is_as_good_as_new(on_cpu, env):
    """Worlds are recycled: neither state nor mass of an earlier episode may be left in them."""
    physics = on_cpu(OBJECTS)
    fresh = on_cpu(OBJECTS)
    start = above(env, 0.19)
    everywhere = np.ones(ENVIRONMENTS, bool)
    state = physics.start(
        start._replace(mass_scale=np.full(ENVIRONMENTS, 3.0), stationary=everywhere)
    )
    for step in range(30):
        physics.step(state, grasp(start, step), ~everywhere)
    swapped = start._replace(object_index=np.array([2, 0, 0]))
    state, new = physics.reset(state, everywhere, swapped), fresh.start(swapped)
    for step in range(30):
        state, after = physics.step(state, grasp(start, step), everywhere)
        new, expected = fresh.step(new, grasp(start, step), everywhere)
    assert after.contact_found.any()
    for a, b in zip(after, expected, strict=True):
        np.testing.assert_array_equal(a, b)


def test_reset_changes_only_the_masked_environments(on_cpu, env):
    physics = on_cpu(OBJECTS)
    start = above(env, 0.3)
    state = physics.start(start)
    moving = np.concatenate([np.full((ENVIRONMENTS, 6), 0.05), np.asarray(start.q)], 1)
    for _ in range(10):
        state, before = physics.step(state, moving, np.ones(ENVIRONMENTS, bool))
    mask = np.array([False, True, False])
    state = physics.reset(state, mask, start._replace(object_index=np.array([0, 2, 2])))
    after = physics.read(state)
    np.testing.assert_allclose(after.u[1], 0.0)
    np.testing.assert_allclose(after.u[~mask], before.u[~mask], atol=1e-7)


def test_slots_are_the_same_bodies_as_models_of_their_own():
    pool = PooledModel(HAND, TASK, OBJECTS)
    body = pool.model.body("object").id
    leaves = pool.leaves(OBJECTS)
    for i, obj in enumerate(OBJECTS):
        np.testing.assert_allclose(leaves["body_mass"][i, body], obj.mass)
        np.testing.assert_allclose(
            np.sort(leaves["body_inertia"][i, body]), np.linalg.eigvalsh(obj.inertia), rtol=1e-6
        )
    assert set(leaves) == set(LEAVES)


def test_a_pool_may_begin_with_an_object_whose_inertia_is_diagonal():
    """MuJoCo has a shortcut for such bodies, which the other objects' inertias must not take."""
    upright = procedural.generate(9000, "capsule")
    skewed = procedural.generate(9001, "mug")
    leaves = PooledModel(HAND, TASK, [upright, skewed]).leaves([upright, skewed])
    assert np.isfinite(leaves["body_inertia"]).all()


def test_pooled_model_is_restored_after_an_error():
    """Some pieces of the second object fill all slots, and the next one has none."""
    box, cylinder = OBJECTS[:2]
    pool = PooledModel(HAND, TASK, [box, cylinder])
    before = {name: getattr(pool.model, name).copy() for name in LEAVES}
    too_many = dataclasses.replace(cylinder, pieces=cylinder.pieces * 50)
    with pytest.raises(CongraspError, match="pieces"):
        pool.leaves([box, too_many])
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(pool.model, name), value)


@pytest.fixture
def optimised():
    """MJX's program takes longer without the compiler's optimisations, which other tests do
    without.
    """
    name = "jax_disable_most_optimizations"
    before = jax.config.read(name)
    jax.config.update(name, False)
    yield
    jax.config.update(name, before)


def side_by_side(native, step, start, state, targets):
    """Measurements of both engines after each step, and the state of the other, whose step this
    is.
    """
    ours = native.start(start)
    table = np.ones(len(start.q), bool)
    for target in targets:
        ours, x = native.step(ours, target, table)
        state, y = step(state, jnp.asarray(target, jnp.float32), jnp.asarray(table))
        yield x, y, state


def agreeing(native, step, start, begin):
    """A scripted grasp, which agrees tightly until something is touched and squeezed, statistically
    after that.
    """
    force = np.zeros((2, len(start.q)))
    targets = [grasp(start, i) for i in range(40)]
    for i, (x, y, state) in enumerate(side_by_side(native, step, start, begin, targets)):
        if i < 10:
            assert not x.contact_found.any()
            for name in ("q", "u", "object_position", "q_velocity", "u_velocity"):
                np.testing.assert_allclose(
                    getattr(x, name), getattr(y, name), atol=2e-4, err_msg=f"{name} at {i}"
                )
        force += [np.linalg.norm(after.contact_force, axis=-1).sum((1, 2)) for after in (x, y)]
        yield i, x, y, state
    assert (force[0] > 0).all(), "the script must touch every object"
    assert not np.asarray(y.diverged).any()
    np.testing.assert_allclose(x.object_position, y.object_position, atol=0.03)
    np.testing.assert_allclose(force[0], force[1], rtol=0.35, atol=20.0)


def _begun(engine, start):
    """A state on a certain device: another would have the step compiled once more."""
    return jax.device_put(engine.start(jax.tree.map(jnp.asarray, start)), jax.devices()[0])


@pytest.mark.timeout(900)
@pytest.mark.slow
def test_jax_agrees_with_native(native, env, optimised):
    """Three different objects in one batch."""
    start = above(env, 0.19)
    # Without the hand's contacts with itself and the table, which take minutes to compile there.
    task = dataclasses.replace(TASK, hand_self_collision=False, hand_table_collision=False)
    engine = native(OBJECTS, task)
    other = make_physics("jax", HAND, task, OBJECTS, threads=1)
    step = jax.jit(other.step)
    *_, (_, x, y, b) = steps = [*agreeing(engine, step, start, _begun(other, start))]
    assert not any(x.occupancy[:2].any() or y.occupancy.any() for _, x, y, _ in steps)
    # A finger that slips a step earlier lands elsewhere, so not every joint; nearly all of them,
    # though.
    apart = np.abs(np.asarray(x.q) - np.asarray(y.q))
    assert np.quantile(apart, 0.95) < 0.15, np.sort(apart.ravel())
    assert np.median(apart) < 0.02, np.sort(apart.ravel())
    # A reset puts the masked environments back and leaves the rest.
    mask = jnp.array([True, False, False])
    again = other.read(other.reset(b, mask, jax.tree.map(jnp.asarray, start)))
    np.testing.assert_allclose(again.u[0], 0.0, atol=1e-6)
    np.testing.assert_allclose(again.u[1:], y.u[1:], atol=1e-6)
    start, target = servoed(env)
    *_, (x, y, _) = side_by_side(engine, step, start, _begun(other, start), [target] * 5)
    np.testing.assert_allclose(x.q, y.q, atol=2e-4)


def test_too_many_environments_for_the_memory_are_refused(native, env, monkeypatch):
    monkeypatch.setattr("congrasp.actors.physics.native.memory", lambda: 1_500_000)
    physics = native(OBJECTS)
    with pytest.raises(
        CongraspError, match=r"environments of MuJoCo C need .* GB are free.*smaller --environments"
    ):
        physics.start(env)


def test_a_demanded_gpu_that_is_missing_is_one_clear_line():
    with pytest.raises(CongraspError, match="NVIDIA GPU"):
        resolve_physics("warp")
    assert resolve_physics("auto") == "native"


def test_object_velocity_is_in_the_world_frame(native, env):
    physics = native(OBJECTS)
    physics.start(above(env, 0.3))
    instance = physics.instances[0]
    spin = np.array([0.0, 0.0, 3.0])  # about the world's vertical
    where = addresses(instance.model, HAND)
    quaternion = jnp.asarray(instance.data.qpos[where.object_qpos[3:]], jnp.float32)
    local = np.asarray(
        rotations.rotate(rotations.conjugate(quaternion), jnp.asarray(spin, jnp.float32))
    )
    velocity = instance.data.qvel.copy()
    velocity[where.object_qvel[3:]] = local
    spinning = physics_state(
        np,
        where,
        instance.data.qpos[None],
        velocity[None],
        instance.data.sensordata[None],
        np.zeros(1, bool),
        np.zeros(3),
    )
    np.testing.assert_allclose(spinning.object_angular_velocity[0], spin, atol=1e-5)


PLAIN = TaskConfig()


def _scene(**settings):
    return compile_scene(
        HAND, dataclasses.replace(PLAIN, **settings), procedural.generate(0, "box")
    )


def test_fingertips_alone_resist_turning():
    model = _scene()
    tips = {f"{HAND.links[i].name}_0" for i in HAND.tip_links}
    for geom in range(model.ngeom):
        name = model.geom(geom).name
        if name.startswith(tuple(link.name for link in HAND.links)):
            soft = name in tips
            assert model.geom_condim[geom] == (4 if soft else 1)
            assert model.geom_friction[geom, 1] == (PLAIN.torsional_friction if soft else 0.0)
    hard = _scene(torsional_friction=0.0)
    assert hard.geom_condim.max() == 3


def test_a_spinning_object_keeps_half_of_its_speed_for_two_thirds_of_a_second():
    """Its joint is damped by c: the speed falls as exp(-c t / I)."""
    model = _scene()
    data = mujoco.MjData(model)
    where = model.joint("object").dofadr[0]
    data.mocap_pos[model.body("table").mocapid[0]] = (0, 0, -1000)
    data.qpos[model.joint("object").qposadr[0] : model.joint("object").qposadr[0] + 3] = (1, 1, 1)
    axis = int(np.argmax(model.body("object").inertia))
    data.qvel[where + 3 + axis] = 1.0
    inertia = model.body("object").inertia[axis]
    seconds = 0.5
    mujoco.mj_step(model, data, round(seconds / model.opt.timestep))
    spun = np.linalg.norm(data.qvel[where + 3 : where + 6])
    assert spun == pytest.approx(np.exp(-PLAIN.object_damping * seconds / inertia), rel=0.02)


@pytest.mark.parametrize("name", ["human", "allegro", "sharpa"])
def test_a_load_of_one_and_a_half_kilograms_sinks_less_than_five_millimetres(name):
    hand = get_hand(name)
    task = TaskConfig()
    spec = scene_spec(hand, task)
    palm = next(body for body in spec.bodies if body.name == hand.links[0].name)
    load = palm.add_body(pos=(0.05, 0.0, 0.08))
    load.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(0.03, 0, 0), mass=1.5, contype=0, conaffinity=0
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    data.mocap_pos[model.body("table").mocapid[0]] = TABLE_AWAY
    wrist = [model.joint(joint) for joint in WRIST_JOINTS]
    places = [int(joint.qposadr[0]) for joint in wrist]
    speeds = [int(joint.dofadr[0]) for joint in wrist]
    momentum = jnp.zeros((1, 6))
    u = np.zeros((1, 6))
    v = np.zeros((1, 6))

    @jax.jit
    def law(momentum, u, v):
        load = wrist_load(hand, task, momentum, u, v)
        state = scene(0, batch=1)[0]._replace(
            u=u, u_velocity=v, wrist_load=load, table=jnp.zeros(1, bool)
        )
        far = jnp.full(1, task.control.guidance_position_limit)
        guided = Guided(-u, far, v, state.table)
        return (
            u
            + wrist_lead(hand, task.control, guided, jnp.zeros((1, 6)))
            + carried_lead(hand, state)
        )

    after = jax.jit(lambda momentum, u, v, target: track_load(hand, task, momentum, u, v, target))
    sunk = []
    speed = []
    for _ in range(200):
        target = law(momentum, u, v)
        data.ctrl[: len(wrist)] = target[0]
        mujoco.mj_step(model, data, task.substeps)
        u = data.qpos[places][None]
        v = data.qvel[speeds][None]
        momentum = after(momentum, u, v, target)
        sunk.append(np.linalg.norm(u[0, :3]))
        speed.append(np.linalg.norm(v[0, :3]))
    assert max(sunk) < 0.005
    assert sunk[-1] < 1e-4
    assert max(speed[-50:]) < 1e-3


def test_the_observer_measures_a_constant_acceleration():
    """A wrist in free fall whose servos give it nothing."""
    hand = get_hand("human")
    task = TaskConfig()
    momentum = jnp.zeros((1, 6))
    steps = 30
    down = jnp.array([[0.0, 0.0, -9.81, 0.0, 0.0, 0.0]])
    stiffness, damping = hand.wrist_servos
    u = jnp.zeros((1, 6))
    v = jnp.zeros((1, 6))
    for _ in range(steps):
        mean = v + 0.5 * task.control_dt * down
        halfway, u, v = (
            u + 0.5 * task.control_dt * mean,
            u + task.control_dt * mean,
            v + task.control_dt * down,
        )
        # Targets at which the servos give no acceleration on average: stiffness (u_tgt - u) =
        # damping v.
        momentum = track_load(hand, task, momentum, u, v, halfway + damping / stiffness * mean)
    np.testing.assert_allclose(wrist_load(hand, task, momentum, u, v), down, atol=1e-3)
