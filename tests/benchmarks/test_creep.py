"""Creep of the benchmark: motion in the wrist frame, whatever the wrist does."""

import types

import numpy as np
from scipy.spatial.transform import Rotation

from tests.benchmarks.creep import creep


def test_creep_is_motion_in_the_wrist_frame():
    """The first object moves with the turning wrist; the second slides by 3 mm along it and turns by 5 degrees."""
    wrist = Rotation.from_rotvec([[0.0, 0.0, 0.0], [0.0, 0.0, 0.7]])  # at two steps
    place = np.array([[0.1, 0.0, 0.3], [0.2, -0.1, 0.4]])
    local = np.array([[[0.0, 0.05, 0.0]] * 2, [[0.0, 0.05, 0.0], [0.0, 0.053, 0.0]]])  # object, step
    tilt = [np.zeros((2, 3)), np.array([[0, 0, 0], [np.radians(5.0), 0, 0]])]
    quaternions = [(wrist * Rotation.from_rotvec(t)).as_quat(scalar_first=True) for t in tilt]
    trace = types.SimpleNamespace(
        wrist_position=np.stack([place] * 2, 1),
        wrist_quaternion=np.stack([wrist.as_quat(scalar_first=True)] * 2, 1),
        object_position=np.stack([wrist.apply(offsets) + place for offsets in local], 1),
        object_quaternion=np.stack(quaternions, 1),
    )
    moved, turned = creep(trace, 0)
    np.testing.assert_allclose(moved, [0.0, 3.0], atol=1e-6)
    np.testing.assert_allclose(turned, [0.0, 5.0], atol=1e-5)
