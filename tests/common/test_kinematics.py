"""Forward kinematics, grasp frame and hand centre of the human hand."""

import jax.numpy as jnp
import mujoco
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from congrasp.common import rotations
from congrasp.common.hands import kinematics
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.mjcf import add_hand
from tests.compiled import Compiled
from tests.scenes import HAND, points_of

of_hand = Compiled(kinematics, HAND)


def _model() -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    add_hand(spec, HAND)
    return spec.compile()


def test_human_hand_has_twenty_finger_joints_four_for_each_finger():
    assert len(HAND.joints) == 20
    assert len(HAND.tip_links) == 5
    assert HAND.links[HAND.tip_links[0]].name == "thumb_distal"
    assert np.all(HAND.lower <= HAND.q_open) and np.all(HAND.q_open <= HAND.upper)
    assert np.all(HAND.lower <= HAND.q_closed) and np.all(HAND.q_closed <= HAND.upper)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31))
def test_product_of_exponentials_agrees_with_mujoco(seed):
    model = _model()
    data = mujoco.MjData(model)
    q = np.random.default_rng(seed).uniform(HAND.lower, HAND.upper)
    data.qpos[6:] = q
    mujoco.mj_kinematics(model, data)
    position, quaternion = of_hand.link_poses(np.float32(q))
    np.testing.assert_allclose(position, data.xpos[2:], atol=1e-6)
    np.testing.assert_allclose(np.abs(np.sum(quaternion * data.xquat[2:], -1)), 1.0, atol=1e-6)


def test_wrist_joints_are_slides_then_intrinsic_xyz_hinges():
    model = _model()
    data = mujoco.MjData(model)
    u = np.array([0.1, -0.2, 0.3, 0.4, -0.5, 0.6])
    data.qpos[:6] = u
    mujoco.mj_kinematics(model, data)
    palm = model.body("palm").id
    np.testing.assert_allclose(data.xpos[palm], u[:3], atol=1e-9)
    quaternion = np.asarray(rotations.euler_to_quaternion(jnp.array(u[3:])))
    np.testing.assert_allclose(np.abs(quaternion @ data.xquat[palm]), 1.0, atol=1e-6)


def test_grasp_frame_is_orthonormal_and_points_out_of_the_palm():
    frame = grasp_frame(HAND)
    assert abs(frame.heading @ frame.cross) < 1e-6
    np.testing.assert_allclose([np.linalg.norm(frame.heading), np.linalg.norm(frame.cross)], 1.0, atol=1e-6)
    tips = np.asarray(points_of(HAND.q_open))[len(HAND.links) :]
    assert frame.cross @ (tips[1:].mean(0) - tips[0]) > 0  # from the thumb to the fingers
    assert frame.heading[2] < 0  # the palm faces -z
    np.testing.assert_allclose(frame.opening, np.linalg.norm(tips[1:].mean(0) - tips[0]), atol=1e-6)


def test_hand_center_is_midway_between_thumb_and_mean_of_fingers():
    points = np.zeros((1, len(HAND.keypoints), 3), np.float32)
    points[0, len(HAND.links)] = [1.0, 0.0, 0.0]  # thumb
    points[0, len(HAND.links) + 1 :] = [[0.0, 2.0, 0.0], [0.0, 4.0, 0.0], [0.0, 6.0, 0.0], [0.0, 8.0, 0.0]]
    np.testing.assert_allclose(of_hand.hand_center(points)[0], [0.5, 2.5, 0.0])


def test_center_moves_towards_the_palm_when_the_fingers_close():
    def depth(q: np.ndarray) -> float:
        return float(np.linalg.norm(of_hand.hand_center(points_of(q))))

    assert depth(HAND.q_closed) < depth(HAND.q_open)
