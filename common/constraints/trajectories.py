"""Wrist trajectories made backwards from reference poses (paper, section Hand Morphology).

From the final pose the wrist moves out by 15-25 cm within 15 degrees of the heading, with a lateral sinusoid of 1-5 cm
and up to 30 degrees of rotation. The path is replayed through the wrist's PD controller and what the wrist reaches is
resampled to K waypoints.
"""

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from common.hands.kinematics import grasp_frame
from common.hands.spec import Hand

DISTANCE = (0.15, 0.25)
CONE = np.deg2rad(15.0)
AMPLITUDE = (0.01, 0.05)
ROTATION = np.deg2rad(30.0)
_REPLAY_DT = 0.0025
_REPLAY_SECONDS = 0.5
_SETTLE_SECONDS = 0.25


def make_trajectories(
    hand: Hand, position: np.ndarray, quaternion: np.ndarray, rng: np.random.Generator, waypoints: int
) -> tuple[np.ndarray, np.ndarray]:
    """One trajectory for each reference pose.

    Args:
      hand: its heading axis and wrist gains are used.
      position: (M, 3) final wrist positions in the object frame.
      quaternion: (M, 4) final wrist orientations.
      rng: source of the random path.
      waypoints: K.

    Returns:
      Positions (M, K, 3) and quaternions (M, K, 4, w first and continuous in sign), from far to near.
    """
    count = len(position)
    end = Rotation.from_quat(quaternion, scalar_first=True)
    heading = end.apply(grasp_frame(hand).heading)
    outward = -_tilted(heading, rng.uniform(0.0, CONE, count), rng)
    lateral = _perpendicular(outward, rng)
    distance = rng.uniform(*DISTANCE, count)
    amplitude = rng.uniform(*AMPLITUDE, count)
    turn = _perpendicular(rng.normal(size=(count, 3)), rng) * rng.uniform(0.0, ROTATION, (count, 1))

    steps = int((_REPLAY_SECONDS + _SETTLE_SECONDS) / _REPLAY_DT)
    s = np.clip(np.arange(steps) * _REPLAY_DT / _REPLAY_SECONDS, 0.0, 1.0)  # 0: far, 1: at the pose
    target = np.empty((steps, count, 6))
    target[..., :3] = (
        (1 - s)[:, None, None] * (distance[:, None] * outward)
        + np.sin(np.pi * s)[:, None, None] * (amplitude[:, None] * lateral)
    )  # fmt: skip
    target[..., 3:] = (1 - s)[:, None, None] * turn
    reached = _replay(hand, target)

    path, vector = reached[..., :3], reached[..., 3:]
    length = np.concatenate([np.zeros((1, count)), np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=-1), 0)])
    positions = np.empty((count, waypoints, 3))
    quaternions = np.empty((count, waypoints, 4))
    times = np.arange(steps)
    for m in range(count):
        when = np.interp(np.linspace(0.0, length[-1, m], waypoints), length[:, m], times)
        positions[m] = position[m] + np.stack([np.interp(when, times, path[:, m, k]) for k in range(3)], -1)
        turns = Slerp(times, Rotation.from_rotvec(vector[:, m]))(when) * end[m]
        quaternions[m] = turns.as_quat(scalar_first=True)
    return positions.astype(np.float32), _continuous(quaternions).astype(np.float32)


def _replay(hand: Hand, target: np.ndarray) -> np.ndarray:
    """What the wrist's PD controller reaches of targets (T, M, 6): each axis a damped mass, semi-implicit Euler."""
    gains = hand.wrist
    mass = sum(link.mass for link in hand.links) + gains.slide_armature
    inertia = sum(link.mass for link in hand.links) * 0.06**2 + gains.hinge_armature
    kp = np.array([gains.slide_kp] * 3 + [gains.hinge_kp] * 3)
    kv = np.array([gains.slide_kv] * 3 + [gains.hinge_kv] * 3)
    limit = np.array([gains.slide_limit] * 3 + [gains.hinge_limit] * 3)
    weight = np.array([mass] * 3 + [inertia] * 3)
    x, v = target[0].copy(), np.zeros_like(target[0])
    reached = np.empty_like(target)
    for t, goal in enumerate(target):
        reached[t] = x
        force = np.clip(kp * (goal - x), -limit, limit)
        v = (v + _REPLAY_DT * force / weight) / (1 + _REPLAY_DT * kv / weight)
        x = x + _REPLAY_DT * v
    return reached


def _perpendicular(axis: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Random unit vectors (M, 3) orthogonal to axes (M, 3)."""
    random = rng.normal(size=axis.shape)
    unit = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
    random -= np.sum(random * unit, -1, keepdims=True) * unit
    return random / np.linalg.norm(random, axis=-1, keepdims=True)


def _tilted(axis: np.ndarray, angle: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Unit vectors (M, 3) at angles (M,) from unit axes (M, 3), to a random side."""
    return np.cos(angle)[:, None] * axis + np.sin(angle)[:, None] * _perpendicular(axis, rng)


def _continuous(quaternions: np.ndarray) -> np.ndarray:
    """Signs (M, K, 4) chosen so that neighbours lie in one hemisphere."""
    flips = np.sign(np.sum(quaternions[:, 1:] * quaternions[:, :-1], -1))
    signs = np.concatenate([np.ones((len(quaternions), 1)), np.cumprod(np.where(flips < 0, -1.0, 1.0), 1)], 1)
    return quaternions * signs[..., None]
