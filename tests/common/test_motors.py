"""Hands with fewer motors than joints: coupled and tendon-driven joints, from the formulas to all
three engines.
"""

import dataclasses
import json
import pathlib

import jax
import mujoco
import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.files import hand_from_text, hand_text
from congrasp.common.hands.mjcf import WRIST_JOINTS, add_hand
from congrasp.common.hands.motors import (
    follow_couplings,
    joint_positions,
    motor_limits,
    motor_positions,
)
from congrasp.common.hands.spec import Coupling, Motor
from congrasp.common.policy.bundle import policy_spec
from congrasp.common.task.sampling.closed_poses import finger_groups
from congrasp.services.assets.hands.model_files import import_hand
from congrasp.services.train.presets import get_preset, with_hand

TENDON = Motor("middle_tendon", {"middle_2": 1.0, "middle_3": 0.5}, 3.0, 0.1, 0.7)
COUPLINGS = (Coupling("index_3", "index_2", 0.9), Coupling("ring_1", "index_1", 0.8, 0.1))


@pytest.fixture(scope="module")
def hand():
    """Allegro with a coupled fingertip, a finger that follows another's, and a tendon over two
    joints.
    """
    allegro = dataclasses.replace(
        get_hand("allegro"), name="coupled", couplings=COUPLINGS, tendons=(TENDON,)
    )
    return hand_from_text(hand_text(allegro))


def _index(hand, *names):
    joints = [joint.name for joint in hand.joints]
    return [joints.index(name) for name in names]


def test_motors_and_joints_by_hand(hand):
    names = [motor.name for motor in hand.motors]
    assert len(names) == 16 - 3
    assert names[:6] == [
        "thumb_0",
        "thumb_1",
        "thumb_2",
        "thumb_3",
        "index_0",
        "index_1",
    ]
    assert "middle_tendon" in names
    assert not {"index_3", "ring_1", "middle_2", "middle_3"} & {*names}
    m = np.zeros(len(names), np.float32)
    m[names.index("index_2")] = 1.0
    m[names.index("index_1")] = 0.5
    m[names.index("middle_tendon")] = 1.0
    q = joint_positions(hand, m)
    i2, i3, r1, m2, m3 = _index(hand, "index_2", "index_3", "ring_1", "middle_2", "middle_3")
    np.testing.assert_allclose(q[[i2, i3, r1]], [1.0, 0.9, 0.1 + 0.8 * 0.5], rtol=1e-6)
    # Of -0.174 to 1.709 and -0.227 to 1.618 rad: the tendon goes from -0.2875 to 2.518, and both
    # joints with it.
    share = (1.0 + 0.174 + 0.5 * 0.227) / (1.709 + 0.174 + 0.5 * (1.618 + 0.227))
    np.testing.assert_allclose(
        q[[m2, m3]], [-0.174 + share * 1.883, -0.227 + share * 1.845], rtol=1e-5
    )
    lower, upper = motor_limits(hand)
    assert lower[names.index("middle_tendon")] == pytest.approx(-0.174 - 0.5 * 0.227)
    # The follower's 1.618 rad end its leader's way at 1.618 / 0.9, beyond the leader's own 1.709;
    # its -0.227 do not.
    assert upper[names.index("index_2")] == pytest.approx(1.709)
    assert upper[names.index("index_1")] == pytest.approx(1.61)
    assert lower[names.index("index_1")] == pytest.approx(-0.196)


def test_motors_go_to_joints_and_back_within_all_limits(hand):
    lower, upper = motor_limits(hand)
    m = np.random.default_rng(0).uniform(lower, upper, (50, len(hand.motors))).astype(np.float32)
    q = joint_positions(hand, m)
    np.testing.assert_allclose(motor_positions(hand, q), m, atol=1e-6)
    np.testing.assert_allclose(follow_couplings(hand, q), q, atol=1e-6)
    assert (q > hand.lower - 1e-5).all()
    assert (q < hand.upper + 1e-5).all()
    human = get_hand("human")
    assert motor_positions(human, q) is q
    assert joint_positions(human, q) is q
    assert follow_couplings(human, q) is q


def test_poses_follow_and_fingers_that_one_motor_moves_close_together(hand):
    i2, i3, r1, i1 = _index(hand, "index_2", "index_3", "ring_1", "index_1")
    for q in (hand.q_open, hand.q_closed):
        assert q[i3] == pytest.approx(0.9 * q[i2])
        assert q[r1] == pytest.approx(0.1 + 0.8 * q[i1])
    groups = finger_groups(hand)
    finger_of_joint = groups.of_joint
    count = groups.number
    assert count == 3
    assert finger_of_joint[r1] == finger_of_joint[i1] != finger_of_joint[0]


def test_a_policy_has_as_many_actions_as_motors(hand):
    config = with_hand(get_preset("quickstart"), hand.reference)
    assert policy_spec(config.task, config.network).action_size == 6 + 13


def test_wrong_couplings_are_one_line(hand):
    fields = json.loads(hand_text(hand))

    def refused(word, **changes):
        with pytest.raises(CongraspError, match=word) as raised:
            hand_from_text(json.dumps({**fields, **changes}), "mine.json")
        assert "\n" not in str(raised.value)

    follow = {"joint": "index_3", "leader": "index_2", "ratio": 0.9, "offset": 0.0}
    refused("'index_3' cannot follow 'elbow'", couplings=[{**follow, "leader": "elbow"}])
    refused(
        "cannot follow 'index_2'",
        couplings=[follow, {**follow, "joint": "index_2", "leader": "index_3"}],
    )
    refused("ratio zero", couplings=[{**follow, "ratio": 0.0}])
    refused("leave it no range", couplings=[{**follow, "offset": 5.0}])
    refused(
        "'index_3' is outside its limits in the closed pose", couplings=[{**follow, "ratio": 1.5}]
    )
    tendon = fields["tendons"][0]
    refused(
        "pulls 'index_3', which", tendons=[{**tendon, "joints": {"index_3": 1.0, "middle_3": 1.0}}]
    )
    refused("at least two joints", tendons=[{**tendon, "joints": {"middle_3": 1.0}}])
    refused("'thumb_0' of a tendon is taken", tendons=[{**tendon, "name": "thumb_0"}])
    refused(
        "torque limit of 'middle_tendon' must be above zero",
        tendons=[{**tendon, "torque_limit": 0.0}],
    )


def _closing(hand):
    """The hand alone with its motors half closed, and the indices of its finger joints in qpos."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = 0.0025
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.iterations = 24
    spec.option.ls_iterations = 40
    add_hand(spec, hand)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[6:] = hand.q_open
    data.ctrl[6:] = motor_positions(hand, 0.5 * (hand.q_open + hand.q_closed))
    assert [model.actuator(i).name for i in range(model.nu)] == [
        *WRIST_JOINTS,
        *(x.name for x in hand.motors),
    ]
    return model, data


@pytest.mark.slow
def test_warp_couples_joints_as_mujoco_c_does(hand):
    from mujoco.mjx.third_party import mujoco_warp  # takes seconds

    model, native = _closing(hand)
    theirs = mujoco_warp.put_model(model)
    data = mujoco_warp.put_data(model, native)
    for _ in range(40):
        mujoco.mj_step(model, native)
        mujoco_warp.step(theirs, data)
    np.testing.assert_allclose(data.qpos.numpy()[0], native.qpos, atol=1e-5)
    q = native.qpos[6:]
    assert np.abs(q - hand.q_open).max() > 0.3
    np.testing.assert_allclose(follow_couplings(hand, q), q, atol=2e-3)


@pytest.mark.slow
def test_mjx_couples_joints_as_mujoco_c_does():
    from mujoco import mjx  # takes seconds

    claw = import_hand(pathlib.Path(__file__).parents[1] / "hands" / "claw.urdf").hand
    tendon = Motor("tendon", {"opposing_root": 1.0, "opposing_middle": 0.5}, 4.0, 0.1, 1.0)
    follow = Coupling("left_middle", "left_root", 0.9)
    model, native = _closing(dataclasses.replace(claw, couplings=(follow,), tendons=(tendon,)))
    compiled = mjx.put_model(model, impl="jax")
    fresh = mjx.put_data(model, native, impl="jax")
    step = jax.jit(
        lambda data: jax.lax.scan(lambda d, _: (mjx.step(compiled, d), None), data, None, 100)[0]
    )
    mujoco.mj_step(model, native, 100)
    np.testing.assert_allclose(step(fresh).qpos, native.qpos, atol=1e-3)


def test_a_tendon_moves_its_free_joints_if_one_is_held(hand):
    model, data = _closing(hand)
    held, other, leader, follower = (
        model.joint(x) for x in ("middle_2", "middle_3", "index_2", "index_3")
    )
    target = data.ctrl[model.actuator("middle_tendon").id]
    model.jnt_range[held.id, 1] = 0.3  # an object in its way
    for _ in range(400):
        data.qfrc_applied[follower.dofadr] = -0.2  # N.m against the motor of the leader
        mujoco.mj_step(model, data)
    angle = data.qpos[held.qposadr][0]
    shared = data.qpos[other.qposadr][0]
    assert angle == pytest.approx(0.3, abs=0.02)
    assert angle + 0.5 * shared == pytest.approx(target, abs=0.05)
    now = data.qpos[leader.qposadr][0]
    assert data.qpos[follower.qposadr][0] == pytest.approx(0.9 * now, abs=5e-3)
    # Virtual work: the leader's motor holds 0.9 times what acts on the follower.
    expected = data.ctrl[model.actuator("index_2").id] - 0.9 * 0.2 / 3.0
    assert now == pytest.approx(expected, abs=5e-3)
