"""Finger angles from joint positions: a captured hand's pose projected onto the joints of the `human` hand.

The two hands have bones of different lengths, so the directions of the bones in the wrist frame are fitted. Four joints
of a finger cannot follow three bones exactly; the residual is reported.
"""

import functools
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from congrasp.common.hands.human import HUMAN
from congrasp.common.hands.spec import link_origin
from congrasp.services.assets.captures.sequence import FINGERS


class Fit(NamedTuple):
    """Finger angles and residuals."""

    q: np.ndarray
    """(20,) rad; may lie outside the hand's limits."""
    angle: float
    """Root mean square angle between the fifteen bones and those of the capture, rad."""
    tip: float
    """Mean distance of the fingertips from those of the capture, m; mostly the hands' different sizes."""


class _Finger(NamedTuple):
    axes: np.ndarray  # (n, 3) joint axes, from the palm outwards
    anchors: np.ndarray  # (n, 3)
    first: int  # index of its first joint in q
    carriers: tuple[int, ...]  # number of joints that move each of the four points
    points: np.ndarray  # (4, 3) three link origins and the tip, at zero


@functools.cache
def _fingers() -> tuple[_Finger, ...]:
    """The `human` hand's fingers in the order of `FINGERS`."""
    names = [joint.name for joint in HUMAN.joints]
    found = []
    for finger in FINGERS:
        chain = [link for link in HUMAN.links if link.name.startswith(finger)]
        joints = [joint for link in chain for joint in link.joints]
        moved = np.cumsum([len(link.joints) for link in chain])
        tip = chain[-1].tip
        assert len(chain) == 3 and tip is not None
        found.append(
            _Finger(
                np.array([joint.axis for joint in joints]),
                np.array([joint.anchor for joint in joints]),
                names.index(joints[0].name),
                (*(int(count) for count in moved), int(moved[-1])),
                np.array([*(link_origin(link) for link in chain), tip]),
            )
        )
    return tuple(found)


def joint_positions(q: np.ndarray) -> np.ndarray:
    """Joints and tips (..., 5, 4, 3) of `FINGERS` of the `human` hand at angles q (..., 20), in its wrist frame, m."""
    return np.stack([_points(f, q[..., f.first : f.first + len(f.axes)]) for f in _fingers()], -3)


def fit(joints: np.ndarray) -> Fit:
    """Fits the `human` hand's finger angles to the directions of a capture's bones.

    Args:
      joints: (5, 4, 3) joints and tips of the captured hand, in the wrist frame, m.
    """
    q = np.zeros(len(HUMAN.joints))
    for finger, wanted in zip(_fingers(), _directions(joints), strict=True):

        def residual(angles: np.ndarray, finger: _Finger = finger, wanted: np.ndarray = wanted) -> np.ndarray:
            """Differences (9,) between the bones' directions and the wanted ones."""
            return (_directions(_points(finger, angles)) - wanted).ravel()

        q[finger.first :][: len(finger.axes)] = least_squares(residual, np.zeros(len(finger.axes)), method="lm").x
    q = (q + np.pi) % (2 * np.pi) - np.pi
    reached = joint_positions(q)
    cosine = (_directions(reached) * _directions(joints)).sum(-1).clip(-1, 1)
    tips = np.linalg.norm(reached[:, 3] - joints[:, 3], axis=-1)
    return Fit(q, float(np.sqrt((np.arccos(cosine) ** 2).mean())), float(tips.mean()))


def _directions(points: np.ndarray) -> np.ndarray:
    """Unit vectors (..., 3, 3) along the bones between points (..., 4, 3)."""
    bones = np.diff(points, axis=-2)
    return bones / np.linalg.norm(bones, axis=-1, keepdims=True).clip(1e-9)


def _points(finger: _Finger, angles: np.ndarray) -> np.ndarray:
    """Joints and tip (..., 4, 3) of a finger at its angles (..., n), by the product of exponentials."""
    vectors = (angles[..., None] * finger.axes).reshape(-1, 3)
    turns = Rotation.from_rotvec(vectors).as_matrix().reshape(*angles.shape, 3, 3)
    turn, shift = np.broadcast_to(np.eye(3), (*angles.shape[:-1], 3, 3)), np.zeros((*angles.shape[:-1], 3))
    placed, moved = [], 0
    for carrier, point in zip(finger.carriers, finger.points, strict=True):
        for j in range(moved, carrier):
            shift = shift + (turn @ (finger.anchors[j] - turns[..., j, :, :] @ finger.anchors[j])[..., None])[..., 0]
            turn = turn @ turns[..., j, :, :]
        moved = carrier
        placed.append(turn @ point + shift)
    return np.stack(placed, -2)
