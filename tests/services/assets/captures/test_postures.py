"""Natural posture of captured hands, against the policies' measure."""

import jax.numpy as jnp
import numpy as np

from congrasp.common.hands.files import HUMAN
from congrasp.common.hands.kinematics import keypoints, link_transforms
from congrasp.common.objects.procedural import plain_object
from congrasp.common.objects.spec import Piece
from congrasp.common.task.posture import unnatural
from congrasp.services.assets.captures.postures import posture_deviations
from congrasp.services.assets.captures.surface import Surface

BALL = plain_object("ball", (Piece("ellipsoid", (0.03, 0.03, 0.03)),), 500.0)


def test_captured_posture_counts_fingers_without_contact_as_idle():
    q = np.tile(HUMAN.q_open, (2, 1))
    index_pip = [joint.name for joint in HUMAN.joints].index("index_pip")
    q[:, index_pip] = 1.0
    links = len(HUMAN.links)
    index_tip = np.asarray(keypoints(HUMAN, link_transforms(HUMAN, q[0])))[links + 1]
    far_away = np.array([1.0, 0.0, 0.0])
    index_at_ball = -index_tip
    deviations = posture_deviations(
        HUMAN,
        q,
        np.stack([far_away, index_at_ball]),
        np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        Surface(BALL),
    )
    touching = np.zeros((1, len(HUMAN.links)), bool)
    without_contact = unnatural(HUMAN, jnp.asarray(q[:1]), jnp.asarray(touching))
    np.testing.assert_allclose(deviations[0], without_contact[0], atol=1e-6)
    assert deviations[1] < deviations[0] - 0.02
