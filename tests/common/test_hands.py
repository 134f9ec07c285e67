"""Allegro and Sharpa against the makers' figures, and what every hand must be able to do."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from congrasp.actors.physics.native import NativePhysics
from congrasp.actors.physics.scene import addresses
from congrasp.common.errors import CongraspError
from congrasp.common.hands import HANDS, get_hand
from congrasp.common.hands.kinematics import grasp_frame, link_poses
from congrasp.common.hands.mano import VARIABLE
from congrasp.common.hands.mjcf import add_hand, mujoco_link_poses, overlapping
from congrasp.common.hands.spec import link_origin
from congrasp.common.objects import procedural
from congrasp.common.objects.pool import scale_objects
from congrasp.common.task.config import TaskConfig
from tests.task import start_of

ROBOTS = ("allegro", "sharpa")
# Fingertips at zero, m, in the frame of the makers' models, thumb first.
TIPS = {
    "allegro": [
        (-0.0132, 0.1677, -0.0861),
        (0.0, 0.0553, 0.1334),
        (0.0, 0.0, 0.1362),
        (0.0, -0.0553, 0.1334),
    ],
    "sharpa": [
        (0.0154, 0.1233, 0.1102),
        (0.0010, 0.0303, 0.2004),
        (0.0000, 0.0100, 0.2034),
        (0.0015, -0.0103, 0.1974),
        (0.0030, -0.0311, 0.1914),
    ],
}
# Of the makers' frame in the wrist frame
ORIGIN = {
    "allegro": (0.0, 0.0, 0.095),
    "sharpa": (0.0, 0.0, 0.0),
}


@pytest.fixture(params=["human", "mano", *ROBOTS])
def hand(request, mano, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(mano))
    get_hand.cache_clear()
    yield get_hand(request.param)
    get_hand.cache_clear()


def _tips(hand, q):
    """Fingertips (tips, 3) in the wrist frame by MuJoCo, thumb first."""
    position, quaternion = mujoco_link_poses(hand, q)
    carriers = list(hand.tip_links)
    reach = np.array([np.subtract(hand.links[i].tip, link_origin(hand.links[i])) for i in carriers])
    return position[carriers] + Rotation.from_quat(quaternion[carriers], scalar_first=True).apply(
        reach
    )


@pytest.mark.parametrize("name", ROBOTS)
def test_fingertips_at_zero_are_where_the_makers_have_them(name):
    hand = get_hand(name)
    tips = _tips(hand, np.zeros(len(hand.joints))) - np.array(ORIGIN[name])
    if name == "sharpa":  # its fingertip is skin, a capsule's radius beyond the end of the axis
        distal = np.array([hand.links[i].capsules[0].end for i in hand.tip_links]) - np.array(
            [hand.links[i].capsules[0].start for i in hand.tip_links]
        )
        radii = np.array([hand.links[i].capsules[0].radius for i in hand.tip_links])
        tips = tips + radii[:, None] * distal / np.linalg.norm(distal, axis=-1, keepdims=True)
    np.testing.assert_allclose(tips, TIPS[name], atol=1e-4)


def test_joint_limits_torques_and_masses_are_the_makers():
    allegro = get_hand("allegro")
    sharpa = get_hand("sharpa")
    assert len(allegro.joints) == 16
    assert len(sharpa.joints) == 22
    assert sum(link.mass for link in allegro.links) == pytest.approx(0.955, abs=1e-3)
    assert sum(link.mass for link in sharpa.links) == pytest.approx(1.246, abs=1e-3)
    joints = {joint.name: joint for joint in (*allegro.joints, *sharpa.joints)}
    expected = {
        "thumb_0": (0.263, 1.396, 0.7),
        "thumb_1": (-0.105, 1.163, 0.7),
        "middle_0": (-0.47, 0.47, 0.7),
        "ring_3": (-0.227, 1.618, 0.7),
        "thumb_cmc_fe": (-0.1745, 1.9199, 3.3),
        "thumb_mcp_aa": (-0.3491, 0.3491, 1.864),
        "thumb_ip": (0.0, 1.7453, 0.638),
        "pinky_cmc": (0.0, 0.2618, 0.5285),
        "ring_dip": (0.0, 1.3963, 0.189),
    }
    for name, figures in expected.items():
        assert (joints[name].lower, joints[name].upper, joints[name].torque_limit) == figures, name
    assert allegro.object_scale == 1.4
    assert sharpa.object_scale == 1.1
    assert get_hand("human").object_scale == 1.0


@pytest.mark.parametrize(
    ("name", "joint", "tip", "anchor", "axis"),
    [  # where the makers' models have joints at zero
        ("allegro", "thumb_0", 0, (-0.0182, 0.0193, -0.0460), (0.0, -0.087, -0.996)),
        ("allegro", "thumb_1", 0, (-0.0132, 0.0567, -0.0764), (0.0, 0.996, -0.087)),
        ("allegro", "thumb_3", 0, (-0.0132, 0.1256, -0.0824), (1.0, 0.0, 0.0)),
        ("allegro", "index_1", 1, (0.0, 0.0449, 0.0148), (0.0, 0.996, -0.087)),
        ("allegro", "index_3", 1, (0.0, 0.0530, 0.1068), (0.0, 0.996, -0.087)),
        ("allegro", "ring_0", 3, (0.0, -0.0435, -0.0015), (0.0, -0.087, 0.996)),
        ("sharpa", "thumb_cmc_fe", 0, (0.0100, 0.0260, 0.0214), (0.0, 0.0, -1.0)),
        ("sharpa", "thumb_cmc_aa", 0, (0.0050, 0.0260, 0.0214), (1.0, 0.0, 0.0)),
        ("sharpa", "thumb_mcp_fe", 0, (0.0154, 0.0762, 0.0631), (0.866, 0.354, -0.354)),
        ("sharpa", "thumb_mcp_aa", 0, (0.0154, 0.0762, 0.0631), (0.5, -0.612, 0.612)),
        ("sharpa", "thumb_ip", 0, (0.0154, 0.1038, 0.0907), (0.866, 0.354, -0.354)),
        ("sharpa", "pinky_cmc", 4, (0.01136, -0.0263, 0.0869), (0.0, 0.0, 1.0)),
        ("sharpa", "index_pip", 1, (0.0010, 0.0303, 0.1429), (0.0, 1.0, 0.0)),
    ],
)
def test_joints_are_where_the_makers_have_them(name, joint, tip, anchor, axis):
    hand = get_hand(name)
    actual = next(x for x in hand.joints if x.name == joint)
    np.testing.assert_allclose(np.subtract(actual.anchor, ORIGIN[name]), anchor, atol=1e-4)
    np.testing.assert_allclose(actual.axis, axis, atol=1e-3)


@pytest.mark.parametrize("name", ("human", *ROBOTS))
def test_product_of_exponentials_agrees_with_mujoco(name):
    """Of the fingers; the wrist's joints are slides, then intrinsic x, y, z hinges."""
    hand = get_hand(name)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    add_hand(spec, hand)
    model = spec.compile()
    data = mujoco.MjData(model)
    compiled = jax.jit(link_poses, static_argnums=0)
    for q in np.random.default_rng(0).uniform(hand.lower, hand.upper, (4, len(hand.joints))):
        position, quaternion = compiled(hand, jnp.array(q, jnp.float32))
        data.qpos[6:] = q
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(position, data.xpos[2:], atol=1e-6)
        np.testing.assert_allclose(np.abs(np.sum(quaternion * data.xquat[2:], -1)), 1.0, atol=1e-5)
    data.qpos[:6] = [0.1, -0.2, 0.3, 0.4, -0.5, 0.6]
    mujoco.mj_kinematics(model, data)
    palm = model.body(hand.links[0].name).id
    np.testing.assert_allclose(data.xpos[palm], [0.1, -0.2, 0.3], atol=1e-9)
    turned = Rotation.from_euler("XYZ", [0.4, -0.5, 0.6]).as_quat(scalar_first=True)
    np.testing.assert_allclose(np.abs(turned @ data.xquat[palm]), 1.0, atol=1e-6)


def test_poses_keep_within_limits_and_name_joints(hand):
    names = {joint.name for joint in hand.joints}
    assert len(names) == len(hand.joints)
    assert {*hand.open_pose, *hand.closed_pose} <= names
    for q in (hand.q_open, hand.q_closed):
        assert np.all(hand.lower <= q)
        assert np.all(q <= hand.upper)


def test_opening_and_palm_side(hand):
    """The heading leads out of the palm, which the closing fingers face."""
    frame = grasp_frame(hand)
    axes = np.stack([frame.heading, frame.cross])
    np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-6)
    assert 0.08 < frame.opening / hand.object_scale < 0.16
    opened, half = (_tips(hand, q) for q in (hand.q_open, (hand.q_open + hand.q_closed) / 2))
    gap = [np.linalg.norm(tips[1:].mean(0) - tips[0]) for tips in (opened, half)]
    assert gap[1] < 0.7 * gap[0]  # thumb and fingers come together
    assert frame.cross @ (opened[1:].mean(0) - opened[0]) > 0  # from the thumb to the fingers
    np.testing.assert_allclose(gap[0], frame.opening, rtol=1e-5)
    np.testing.assert_allclose(frame.center, 0.5 * (opened[0] + opened[1:].mean(0)), atol=1e-6)
    knuckles = np.mean(
        [link_origin(link) for link in hand.links if link.name.endswith("_proximal")], 0
    )
    assert frame.heading @ (frame.center - knuckles) > 0.03


def test_every_hand_holds_a_heavy_cylinder_between_thumb_and_fingers(hand):
    """Frame, limits, gains and torques: fingers that close around a cylinder in the hand's middle
    carry 400 g.
    """
    held = next(
        obj
        for i in range(99)
        if 0.02 < (obj := procedural.generate(i, "cylinder")).pieces[0].size[0] < 0.03
    )
    task = TaskConfig(hand=hand.name)
    (cylinder,) = scale_objects(hand, task, [held])
    frame = grasp_frame(hand)
    tips = _tips(hand, hand.q_open + 0.5 * (hand.q_closed - hand.q_open))
    center = 0.5 * (tips[0] + tips[1:].mean(0)) - 0.01 * frame.heading
    along = np.cross(frame.heading, frame.cross)
    axes = np.stack([frame.heading, frame.cross, along], -1)
    down = Rotation.from_matrix(
        np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]) @ axes.T
    )
    quaternion = (down * Rotation.from_matrix(axes)).as_quat(scalar_first=True)
    reset_state = start_of(
        mass_scale=np.full(1, 0.4 / cylinder.mass),
        base_position=np.array([[0.0, 0.0, 1.0]]),
        base_quaternion=down.as_quat(scalar_first=True)[None],
        q=hand.q_open[None],
        object_position=np.array([[0.0, 0.0, 1.0]]) + down.apply(center),
        object_quaternion=quaternion[None],
        stationary=np.ones(1, bool),
    )
    physics = NativePhysics(hand, task, [cylinder], 1)
    state = physics.start(reset_state)
    target = np.zeros((1, 6 + len(hand.joints)))
    touched = np.zeros(len(hand.links), bool)
    speeds = []
    for step in range(220):
        firm = hand.q_open + min(1.2, step / 30) * (hand.q_closed - hand.q_open)
        target[:, 6:] = np.clip(firm, hand.lower, hand.upper)
        if step == 60:
            instance = physics.instances[0]
            instance.data.eq_active[addresses(instance.model, hand).weld] = False
        state, after = physics.step(state, target, np.zeros(1, bool))
        touched |= after.contact_found[0].any(-1)
        if step >= 180:
            speeds.append(np.linalg.norm(after.object_velocity))
    physics.close()
    fingers = {hand.links[i].name.partition("_")[0] for i in np.flatnonzero(touched)}
    assert "thumb" in fingers, fingers
    assert len(fingers - {"palm"}) >= 3, fingers
    moved = np.asarray(after.object_position[0]) - reset_state.object_position[0]
    # Fingers may pull it into the palm
    assert moved[2] > -0.02, "the object fell"
    assert np.linalg.norm(moved) < 0.10, "the object fell"
    assert max(speeds) < 0.05, "the object shakes"


def test_scaled_objects_keep_their_density():
    obj = dataclasses.replace(
        procedural.generate(3, "mug"), origin=(0.1, 0.0, -0.2), file_scale=0.01
    )
    larger = obj.scaled(1.4)
    assert larger.mass == pytest.approx(1.4**3 * obj.mass)
    np.testing.assert_allclose(larger.inertia, 1.4**5 * obj.inertia)
    for name in ("points", "visual_vertices"):
        np.testing.assert_allclose(getattr(larger, name), 1.4 * getattr(obj, name))
    np.testing.assert_allclose(larger.origin, (0.14, 0.0, -0.28))
    assert larger.file_scale == pytest.approx(0.014)
    np.testing.assert_allclose(larger.rest_poses[:, :3], 1.4 * obj.rest_poses[:, :3])
    np.testing.assert_array_equal(larger.rest_poses[:, 3:], obj.rest_poses[:, 3:])
    for a, b in zip(larger.pieces, obj.pieces, strict=True):
        np.testing.assert_allclose([*a.size, *a.pos], 1.4 * np.array([*b.size, *b.pos]))
    hand = get_hand("allegro")
    literal = TaskConfig(constant_mass=False)
    assert scale_objects(hand, literal, [obj])[0].mass == larger.mass
    assert scale_objects(hand, dataclasses.replace(literal, object_scale=1.0), [obj])[0] is obj
    household = scale_objects(hand, TaskConfig(), [obj])[0]
    assert household.mass == pytest.approx(obj.mass)
    np.testing.assert_allclose(household.inertia, 1.4**2 * obj.inertia)
    np.testing.assert_allclose(household.points, larger.points)


def test_a_hand_that_does_not_exist_is_one_line_with_those_that_do():
    with pytest.raises(CongraspError, match=r"no hand 'claw'.*allegro, human, mano, sharpa"):
        get_hand("claw")
    assert set(HANDS) == {"human", "allegro", "sharpa", "mano"}


def test_links_that_nest_do_not_collide_and_all_others_do(hand):
    """With self-collision an open hand touches nothing of its own, and a fist comes to rest on
    itself.
    """
    # As the makers say
    assert get_hand("allegro") is not hand or overlapping(hand) == (("palm", "thumb_proximal"),)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = 0.0025
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    add_hand(spec, hand, self_collision=True)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[6:] = hand.q_open
    mujoco.mj_forward(model, data)
    assert not (data.contact.dist < 0).any()
    touched = False
    deepest = 0.0
    for step in range(400):
        data.ctrl[6:] = hand.q_open + min(1.0, step / 200) * (hand.q_closed - hand.q_open)
        mujoco.mj_step(model, data)
        touched |= data.ncon > 0
        deepest = min(deepest, data.contact.dist.min(initial=0.0))
    assert touched
    assert -0.005 < deepest < 0
    assert np.abs(data.qvel).max() < 0.05
