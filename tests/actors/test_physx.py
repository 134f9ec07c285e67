"""PhysX: mechanics with known solutions, agreement with MuJoCo, determinism, and what it refuses."""

import dataclasses
import importlib.util

import mujoco
import numpy as np
import psutil
import pytest

from congrasp.actors.physics import make_physics
from congrasp.actors.physics.native import NativePhysics
from congrasp.actors.physics.scene import addresses, compile_scene
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.spec import Coupling, Motor
from congrasp.common.objects import procedural
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.types import CONTACTS_PER_LINK
from tests import task as suite
from tests.task import HAND, TASK

pytest.importorskip("sapien", reason="PhysX needs sapien: pip install 'congrasp[physx]'")

from congrasp.actors.physics.physx.batch import PhysxPhysics
from congrasp.actors.physics.physx.collisions import collisions
from congrasp.actors.physics.physx.contacts import ContactReader
from congrasp.actors.physics.physx.environment import CompiledScene, Environment
from congrasp.actors.physics.physx.units import LENGTH_SCALE

GRAVITY = 9.81
BOX = procedural.generate(0, "box")
FINGERS = len(HAND.joints)
OBJECTS = [procedural.generate(i, family) for i, family in enumerate(("box", "mug", "bowl"))]
FAR = np.array([[0.0, 0.5, 0.6]])


@pytest.fixture
def physx():
    """Makes PhysX engines, and closes them."""
    engines = []

    def make(objects=(BOX,), hand=HAND, task=TASK):
        engines.append(PhysxPhysics(hand, task, objects))
        return engines[-1]

    yield make
    for engine in engines:
        engine.close()


def resting(obj=BOX, **fields):
    """The object in its likeliest resting pose, and the hand far away."""
    pose = np.asarray(obj.rest_poses[:1], np.float32)
    start = {"object_position": pose[:, :3], "object_quaternion": pose[:, 3:]}
    return suite.start_of(**{"base_position": FAR, **start, **fields})


def alone(start, model=None):
    """An environment of the first object, by itself."""
    model = model or compile_scene(HAND, TASK, BOX)
    links = tuple(model.body(link.name).id for link in HAND.links)
    scene = CompiledScene(model, addresses(model, HAND), collisions(model), links)
    return Environment(scene, type(start)(*(np.asarray(field)[0] for field in start)))


def object_position(environment):
    return np.array(environment.object.entity_pose.p) / LENGTH_SCALE


def targets(**joints):
    """Targets that leave the hand where it starts, but for these joints, by their index."""
    target = np.concatenate([np.zeros(6), HAND.q_open])
    for index, value in joints.items():
        target[int(index[1:])] = value
    return target


def run(engine, start, target, steps, table=True):
    """Wrist and finger angles (T, 6 + F) of the first environment under one target."""
    state = engine.start(start)
    present = np.full(len(start.q), table)
    rows = []
    for _ in range(steps):
        state, after = engine.step(state, np.tile(target, (len(start.q), 1)), present)
        rows.append(np.concatenate([np.asarray(after.u)[0], np.asarray(after.q)[0]]))
    return np.array(rows)


def test_free_fall():
    environment = alone(resting())
    environment.place_table(False)
    height = object_position(environment)[2]
    steps = 200
    environment.step(targets(), steps, None)
    time = steps * environment.system.timestep
    # Semi-implicit Euler is half a step ahead
    expected = 0.5 * GRAVITY * time * (time + environment.system.timestep)
    np.testing.assert_allclose(height - object_position(environment)[2], expected, rtol=1e-3)
    np.testing.assert_allclose(
        environment.object.linear_velocity[2], -LENGTH_SCALE * GRAVITY * time, rtol=1e-3
    )


@pytest.mark.parametrize("share", [0.8, 0.95, 1.05, 1.2])
def test_slope_with_friction(share):
    """A box slides with g (sin a - mu cos a), and stays where mu is above tan a."""
    angle = np.deg2rad(20.0)
    friction = share * np.tan(angle)
    model = compile_scene(HAND, dataclasses.replace(TASK, object_damping=0.0), BOX)
    model.opt.gravity[:] = GRAVITY * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    # MuJoCo takes the greater friction of table and object
    model.geom("table").friction[0] = friction
    start = resting(friction=np.array([friction]))
    environment = alone(start, model)
    before = object_position(environment)
    steps = 400
    environment.step(targets(), steps, None)
    time = steps * environment.system.timestep
    slid = object_position(environment)[0] - before[0]
    expected = 0.5 * GRAVITY * (np.sin(angle) - friction * np.cos(angle)) * time**2
    np.testing.assert_allclose(slid, max(expected, 0.0), rtol=0.02, atol=2e-3)


@pytest.mark.parametrize("name", ["human", "sharpa", "allegro"])
def test_links_are_where_mujoco_has_them(physx, name):
    hand = get_hand(name)
    q = np.random.default_rng(0).uniform(hand.lower, hand.upper).astype(np.float32)
    start = resting(q=q[None])
    engine = physx(hand=hand, task=TaskConfig(hand=name))
    engine.start(start)
    environment = engine.environments[0]
    model = environment.scene.model
    model.body_pos[environment.scene.addresses.base_body] = FAR[0]
    data = mujoco.MjData(model)
    data.qpos[environment.scene.addresses.finger_qpos] = q
    mujoco.mj_kinematics(model, data)
    for body, link in environment.hand.bodies.items():
        np.testing.assert_allclose(link.entity_pose.p / LENGTH_SCALE, data.xpos[body], atol=1e-5)
        dot = abs(np.dot(link.entity_pose.q, data.xquat[body]))
        assert dot == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize(
    ("joint", "step", "tolerance"),
    [(0, 0.02, 1e-4), (2, 0.2, 2e-3), (3, 0.2, 1e-4), (5, -0.2, 1e-4), (8, 0.3, 1e-3)],
)
def test_servo_steps_are_those_of_mujoco(physx, joint, step, tolerance):
    """A small step of a slide, one at the force limit, of both kinds of hinges."""
    target = targets()
    target[joint] += step
    start = resting()
    native = NativePhysics(HAND, TASK, [BOX], 1)
    expected = run(native, start, target, 40)
    native.close()
    actual = run(physx(), start, target, 40)
    np.testing.assert_allclose(actual, expected, atol=tolerance)
    np.testing.assert_allclose(actual[-1, joint], target[joint], atol=2e-3)


def test_gains_scale_the_finger_servos_alone(physx):
    start = resting(q=HAND.q_open[None].astype(np.float32))
    start = type(start)(*(np.repeat(np.asarray(field), 3, 0) for field in start))
    start = start._replace(gain_scale=np.array([0.5, 1.0, 1.5]))
    engine = physx(task=dataclasses.replace(TASK, control_dt=0.0001, substeps=1))
    state = engine.start(start)
    target = np.tile(targets(), (3, 1)) + 0.01
    _, after = engine.step(state, target, np.ones(3, bool))
    speed = np.abs(after.q_velocity).max(1)
    np.testing.assert_allclose(speed / speed[1], [0.5, 1.0, 1.5], rtol=0.1)
    wrist_speed = np.abs(after.u_velocity).max(1)
    np.testing.assert_allclose(wrist_speed, wrist_speed[1], rtol=0.05)


def gripper(force):
    """A scene whose hand is two plates on slides that press a box of 100 g from both sides."""
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.0025
    base = spec.worldbody.add_body(name="hand_base")
    palm = base.add_body(name="palm", gravcomp=1.0)
    hinge = mujoco.mjtJoint.mjJNT_HINGE
    slide = mujoco.mjtJoint.mjJNT_SLIDE
    names = ("wrist_x", "wrist_y", "wrist_z", "wrist_rx", "wrist_ry", "wrist_rz")
    for index, name in enumerate(names):
        axis = np.eye(3)[index % 3]
        palm.add_joint(name=name, axis=axis, type=slide if index < 3 else hinge, armature=1.0)
    box = mujoco.mjtGeom.mjGEOM_BOX
    slippery = {"contype": 1, "conaffinity": 0, "friction": [0.01, 0, 0]}
    palm.add_geom(type=box, size=[0.02] * 3, pos=[0, 0, 0.2], **slippery)
    for name, side in (("left", -1.0), ("right", 1.0)):
        plate = palm.add_body(name=name, pos=[0.05 * side, 0, 0], gravcomp=1.0)
        plate.add_joint(name=name, type=slide, axis=[-side, 0, 0], damping=5.0, armature=0.05)
        plate.add_geom(type=box, size=[0.005, 0.03, 0.03], **slippery)
    for name in (*names, "left", "right"):
        actuator = spec.add_actuator(
            name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, forcelimited=True
        )
        actuator.set_to_position(1000.0, kv=50.0)
        limit = 500.0 if name in names else force
        actuator.forcerange = [-limit, limit]
    table = spec.worldbody.add_body(name="table", mocap=True)
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    table.add_geom(name="table", type=plane, size=[1, 1, 1], contype=0, conaffinity=2)
    held = spec.worldbody.add_body(name="object")
    held.add_freejoint(name="object")
    held.add_geom(type=box, size=[0.02] * 3, mass=0.1, contype=2, conaffinity=1)
    model = spec.compile()
    joints = [model.joint(name) for name in names]
    free = model.joint("object")
    where = dataclasses.replace(
        addresses(compile_scene(HAND, TASK, BOX), HAND),
        wrist_qpos=np.array([joint.qposadr[0] for joint in joints]),
        wrist_qvel=np.array([joint.dofadr[0] for joint in joints]),
        finger_qpos=np.array([model.joint(name).qposadr[0] for name in ("left", "right")]),
        finger_qvel=np.array([model.joint(name).dofadr[0] for name in ("left", "right")]),
        object_qpos=free.qposadr[0] + np.arange(7),
        object_qvel=free.dofadr[0] + np.arange(6),
        object_body=model.body("object").id,
        base_body=model.body("hand_base").id,
        motors=np.array([6, 7]),
    )
    links = tuple(model.body(name).id for name in ("palm", "left", "right"))
    return CompiledScene(model, where, collisions(model), links)


@pytest.mark.parametrize(("friction", "is_held"), [(0.5, True), (0.12, True), (0.08, False)])
def test_grip_between_two_plates(friction, is_held):
    """Two plates press with 5 N: their friction carries 0.98 N if it is above 0.098."""
    force = 5.0
    scene = gripper(force)
    start = suite.start_of(
        q=np.zeros((1, 2), np.float32),
        base_position=np.array([[0.0, 0.0, 0.5]]),
        object_position=np.array([[0.0, 0.0, 0.5]]),
        friction=np.array([friction]),
    )
    environment = Environment(scene, type(start)(*(np.asarray(field)[0] for field in start)))
    target = np.zeros(8)
    target[6:] = 0.05
    # Gravity begins when the plates have closed
    environment.object.disable_gravity = True
    environment.step(target, 200, None)
    environment.object.disable_gravity = False
    environment.place_table(False)
    before = object_position(environment)
    environment.step(target, 400, None)
    dropped = before[2] - object_position(environment)[2]
    if not is_held:
        assert dropped > 0.05
        return
    assert dropped < 5e-3
    contact_force = np.zeros((3, CONTACTS_PER_LINK, 3))
    position = np.zeros((3, CONTACTS_PER_LINK, 3))
    touches = np.zeros((3, CONTACTS_PER_LINK), bool)
    ContactReader(environment).read(contact_force, position, touches)
    on_left, on_right = contact_force.sum(1)[1:]
    np.testing.assert_allclose([on_left[0], on_right[0]], [-force, force], rtol=0.02)
    # The object presses the plates down with its weight, by friction alone
    np.testing.assert_allclose(on_left[2] + on_right[2], -0.1 * GRAVITY, rtol=0.05)
    assert not touches[0].any()
    assert touches[1:].any(1).all()


def test_palm_carries_a_box(physx):
    height = float(np.abs(BOX.points[:, 2]).max())
    start = suite.start_of(
        base_position=np.array([[0.0, -0.05, 0.5]]),
        base_quaternion=np.array([[0.0, 1.0, 0.0, 0.0]]),  # palm up
        q=np.zeros((1, FINGERS)),
        object_position=np.array([[0.0, 0.0, 0.52 + height]]),
    )
    engine = physx()
    state = engine.start(start)
    forces = []
    for _ in range(150):
        state, after = engine.step(state, np.zeros((1, 6 + FINGERS)), np.ones(1, bool))
        forces.append(after.contact_force.sum((1, 2))[0])
    np.testing.assert_allclose(np.mean(forces[-40:], 0)[2], -BOX.mass * GRAVITY, rtol=0.05)
    assert np.abs(after.object_velocity).max() < 5e-3


def grasps(engine, start, steps=40):
    """States of a scripted grasp from above."""
    batch = len(start.q)
    state = engine.start(start)
    states = []
    for step in range(steps):
        target = np.zeros((batch, 6 + FINGERS))
        target[:, 2] = -0.13 * min(1.0, step / 15)
        closing = np.clip((step - 15) / 20, 0.0, 1.0)
        target[:, 6:] = HAND.q_open + closing * (HAND.q_closed - HAND.q_open)
        state, after = engine.step(state, target, np.full(batch, step < 35))
        states.append(after)
    assert any(after.contact_found.any() for after in states)
    return states


def on_the_table(objects):
    """Starts of `grasps`, one for each object."""
    starts = []
    for index, obj in enumerate(objects):
        position = np.asarray(obj.rest_poses[:1, :3]) + np.array([[0.0, 0.09, 0.19]])
        down = np.array([[1.0, 0.0, 0.0, 0.0]])
        start = resting(obj, base_position=position, base_quaternion=down)
        starts.append(start._replace(object_index=np.array([index])))
    return type(start)(*(np.concatenate(fields) for fields in zip(*starts, strict=True)))


def assert_equal_states(first, second):
    for before, after in zip(first, second, strict=True):
        for name, values, others in zip(before._fields, before, after, strict=True):
            np.testing.assert_array_equal(values, others, err_msg=name)


def test_results_do_not_depend_on_earlier_episodes(physx):
    start = on_the_table(OBJECTS)
    used = physx(OBJECTS)
    grasps(used, start._replace(mass_scale=np.full(3, 3.0), object_index=np.array([2, 0, 1])))
    assert_equal_states(grasps(physx(OBJECTS), start), grasps(used, start))


@pytest.fixture
def processes():
    """An engine of three processes."""
    engine = make_physics("physx", HAND, TASK, OBJECTS, threads=3)
    yield engine
    engine.close()


def start_of_batch(batch):
    """Starts of `grasps` with different masses, on all objects."""
    rows = np.arange(batch) % len(OBJECTS)
    start = on_the_table(OBJECTS)
    start = type(start)(*(np.asarray(field)[rows] for field in start))
    return start._replace(mass_scale=np.linspace(0.5, 2.0, batch))


def test_results_do_not_depend_on_processes(physx, processes):
    """With a number of environments that the processes do not share evenly, pushes, and resets."""
    batch = 32
    start = start_of_batch(batch)
    mask = np.arange(batch) % 5 == 0
    force = np.random.default_rng(0).normal(size=(batch, 3))
    results = []
    for engine in (physx(OBJECTS), processes):
        states = grasps(engine, start, steps=25)
        engine.reset(engine, mask, start)
        states.append(engine.read(engine))
        target = np.tile(targets(), (batch, 1))
        states.append(engine.step(engine, target, np.ones(batch, bool), force)[1])
        engine.replace_objects(engine, OBJECTS[::-1])
        engine.reset(engine, mask, start)
        states.append(engine.step(engine, target, mask)[1])
        results.append(states)
    assert_equal_states(*results)


def test_an_ended_process_is_an_error(processes):
    start = start_of_batch(32)
    before = psutil.Process().children()
    processes.start(start)
    workers = [child for child in psutil.Process().children() if child not in before]
    assert len(workers) == 2
    workers[1].kill()
    with pytest.raises(CongraspError, match="has ended"):
        grasps(processes, start)
    assert not any(worker.is_running() for worker in workers)
    # It can be used again
    processes.start(start)


def test_a_diverged_environment_is_marked_and_put_back(physx):
    start = on_the_table([BOX, BOX])
    engine = physx([BOX, BOX])
    state = engine.start(start)
    hold = np.tile(targets(), (2, 1))
    engine.environments[1].object.linear_velocity = np.array([LENGTH_SCALE * 1e4, 0.0, 0.0])
    state, after = engine.step(state, hold, np.ones(2, bool))
    np.testing.assert_array_equal(after.diverged, [False, True])
    np.testing.assert_allclose(after.object_position[1], start.object_position[1], atol=1e-6)
    np.testing.assert_array_equal(after.contact_position[1], 0.0)
    state, after = engine.step(state, hold, np.ones(2, bool))
    assert not after.diverged.any()
    np.testing.assert_allclose(after.object_position, start.object_position, atol=1e-3)


def undriven(hand, joint_name):
    """The links of a hand with one joint without a motor of its own."""
    links = []
    for link in hand.links:
        joints = []
        for joint in link.joints:
            if joint.name == joint_name:
                joint = dataclasses.replace(joint, kp=0.0, kv=0.0, torque_limit=0.0)
            joints.append(joint)
        links.append(dataclasses.replace(link, joints=tuple(joints)))
    return tuple(links)


def angles_of(engine_name, hand, target):
    """Finger angles (T, F) in free motion to the targets of the motors."""
    engine = make_physics(engine_name, hand, TASK, [BOX], threads=1)
    target = np.concatenate([np.zeros(6), target])
    angles = run(engine, resting(q=hand.q_open[None]), target, 60)[:, 6:]
    engine.close()
    return angles


def test_a_coupled_joint_follows_its_neighbour(physx):
    hand = dataclasses.replace(
        HAND,
        links=undriven(HAND, "index_dip"),
        couplings=(Coupling("index_dip", "index_pip", 0.6, 0.05),),
    )
    names = [joint.name for joint in hand.joints]
    target = np.full(len(hand.motors), 0.2)
    angles = angles_of("physx", hand, target)
    expected = 0.05 + 0.6 * angles[:, names.index("index_pip")]
    # It starts out of place, and is there within a few steps
    np.testing.assert_allclose(angles[5:, names.index("index_dip")], expected[5:], atol=5e-3)
    native = angles_of("native", hand, target)
    np.testing.assert_allclose(angles[-1], native[-1], atol=5e-3)


def test_a_tendon_pulls_its_joints(physx):
    """The sum over its joints reaches the target; both have the same torque but for the ratio."""
    tendon = Motor("index_tendon", {"index_pip": 1.0, "index_dip": 0.8}, 3.0, 0.05, 0.6)
    hand = dataclasses.replace(
        HAND,
        links=undriven(dataclasses.replace(HAND, links=undriven(HAND, "index_dip")), "index_pip"),
        tendons=(tendon,),
    )
    names = [joint.name for joint in hand.joints]
    coefficients = np.array([tendon.joints.get(name, 0.0) for name in names])
    begin = hand.q_open @ coefficients
    # Within the torque limit, where damping counts in PhysX but not in MuJoCo
    length = begin + 0.15
    target = np.where([motor.name == tendon.name for motor in hand.motors], length, 0.2)
    lengths = {}
    for engine in ("native", "physx"):
        lengths[engine] = angles_of(engine, hand, target) @ coefficients
    np.testing.assert_allclose(lengths["physx"][-1], length, atol=2e-3)
    np.testing.assert_allclose(lengths["physx"], lengths["native"], atol=5e-3)


def test_more_links_than_its_filter_has_bits_are_refused(physx):
    extra = tuple(
        dataclasses.replace(HAND.links[-1], name=f"extra_{i}", joints=(), tip=None, parent="palm")
        for i in range(32)
    )
    hand = dataclasses.replace(HAND, links=(*HAND.links, *extra))
    with pytest.raises(CongraspError, match="at most 31 links"):
        physx(hand=hand)


def test_rollouts_are_made_on_it(physx):
    worker = suite.worker(physics=physx(suite.OBJECTS))
    rollout = worker.collect(suite.command(noise=0.3), 3)
    assert np.all(np.isfinite(rollout.reward))


def test_a_coupling_of_distant_joints_is_refused(physx):
    first, *_, last = HAND.joints
    hand = dataclasses.replace(HAND, couplings=(Coupling(last.name, first.name, 1.0),))
    with pytest.raises(CongraspError, match=f"'{last.name}' follows '{first.name}'"):
        physx(hand=hand)


def test_a_missing_package_is_named(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "sapien" else find(name)
    )
    with pytest.raises(CongraspError, match=r"pip install 'congrasp\[physx\]'"):
        make_physics("physx", HAND, TASK, [BOX], threads=1)
