"""In which resting poses of its object a captured reference is asked for."""

import jax.numpy as jnp
import numpy as np

from congrasp.common import rotations
from congrasp.common.hands.files import HUMAN
from congrasp.common.hands.kinematics import capsules, grasp_frame, link_transforms
from congrasp.services.assets.captures.build import _resting_poses


def test_the_hand_is_not_in_the_table_or_as_little_as_can_be():
    """A hand from straight above, in resting poses in which the table is 1 mm, 15 mm and 45 mm too high for it.

    Further hands are 3 and 15 mm lower: one is requested in the first of them alone, 4 mm in the table, and the other,
    16 mm in it, in none.
    """
    frame = grasp_frame(HUMAN)
    own = rotations.frame_from_axes(jnp.array(frame.heading), jnp.array(frame.cross))
    down = rotations.frame_from_axes(jnp.array([0.0, 0, -1]), jnp.array([1.0, 0, 0]))
    turn = rotations.multiply(down, rotations.conjugate(own))
    ends = np.asarray(capsules(HUMAN, link_transforms(HUMAN, jnp.array(HUMAN.q_open)))).reshape(-1, 3)
    ends = np.asarray(rotations.rotate(jnp.broadcast_to(turn, (len(ends), 4)), jnp.array(ends)))
    reach = -(ends[:, 2] - np.repeat(HUMAN.capsule_radii, 2)).min()
    path = np.zeros((3, 4, 3), np.float32)
    path[:, :, 2] = reach + np.linspace(0.1, 0, 4)
    path[1:, :, 2] -= np.array([[0.003], [0.015]])
    quaternion = np.broadcast_to(np.asarray(turn), (3, 4, 4))
    rest = np.array([[0, 0, -depth, 1, 0, 0, 0] for depth in (0.001, 0.015, 0.045)], np.float32)
    q = np.stack([HUMAN.q_open] * 3).astype(np.float32)
    allowed = _resting_poses(HUMAN, q, path, quaternion, rest)
    np.testing.assert_array_equal(allowed, [[True, False, False], [True, False, False], [False, False, False]])
    rest[1, 2] = 0.02
    allowed = _resting_poses(HUMAN, q, path, quaternion, rest)
    np.testing.assert_array_equal(allowed, [[True, True, False], [False, True, False], [False, True, False]])
