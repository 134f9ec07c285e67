"""Wrist trajectories to reference poses, generated backwards from them (paper, section Hand
Morphology).
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common import rotations
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.spec import Hand
from congrasp.common.task.types import Array

_REPLAY_DT = 0.0025
"""Time step of the wrist's controller, s."""
_REPLAY_SECONDS = 0.5
"""Duration of the path, s."""
_SETTLE_SECONDS = 0.25
"""Time for the wrist to reach the end of the path, s."""


class PathStyle(NamedTuple):
    """Ranges from which a trajectory is drawn uniformly."""

    tilt: tuple[float, float]
    """Angle between the way back from the pose and its heading, rad."""
    distance: tuple[float, float]
    """Length of the way back, m."""
    amplitude: tuple[float, float]
    """Amplitude of the sinusoid across the way, m."""
    rotation: tuple[float, float]
    """Rotation of the wrist on the way, rad."""


PAPER = PathStyle(
    tilt=(0.0, np.deg2rad(15.0)),
    distance=(0.15, 0.25),
    amplitude=(0.01, 0.05),
    rotation=(0.0, np.deg2rad(30.0)),
)
"""Paths of the paper. Evaluations draw from it, whatever a policy was trained with."""
HUMAN = PathStyle(
    tilt=(0.0, np.deg2rad(75.0)),
    distance=(0.08, 0.20),
    amplitude=(0.0, 0.05),
    rotation=(0.0, np.deg2rad(60.0)),
)
"""Paths as people reach. Captured ones come at 17 to 63 degrees to the heading of their grasp (5th
to 95th percentile), from about 11 cm (`docs/notes/captures.md`)."""


@functools.partial(jax.jit, static_argnames=("hand", "waypoints", "style"))
def make_trajectories(
    hand: Hand,
    position: Array,
    quaternion: Array,
    key: Array,
    *,
    waypoints: int,
    style: PathStyle = PAPER,
) -> tuple[Array, Array]:
    """Generates one trajectory for each reference pose, backwards from it.

    From the final pose the wrist moves out in a direction near the heading, with a sinusoid across
    it and a rotation. The wrist's PD controller then follows the path, and its motion is resampled
    to K waypoints.

    Args:
      hand: its heading axis and wrist gains are used.
      position: (M, 3) final wrist positions in the object frame.
      quaternion: (M, 4) final wrist orientations.
      key: random key of the paths.
      waypoints: number K of waypoints.
      style: ranges of the paths.

    Returns:
      Positions (M, K, 3) and quaternions (M, K, 4, continuous in sign), from the far end to the
      pose.
    """
    count = position.shape[0]
    uniform_key, normal_key = jax.random.split(key)
    random = jax.random.uniform(uniform_key, (4, count, 1))
    tilt = _within(style.tilt, random[0])
    distance = _within(style.distance, random[1])
    amplitude = _within(style.amplitude, random[2])
    turn = _within(style.rotation, random[3])
    aside, sideways, axis = jax.random.normal(normal_key, (3, count, 3))
    heading = rotations.rotate(
        quaternion, jnp.broadcast_to(jnp.array(grasp_frame(hand).heading), (count, 3))
    )
    outward = -(jnp.cos(tilt) * heading + jnp.sin(tilt) * _perpendicular(aside, heading))
    lateral = _perpendicular(sideways, outward)
    axis = axis / jnp.linalg.norm(axis, axis=-1, keepdims=True)

    steps = int((_REPLAY_SECONDS + _SETTLE_SECONDS) / _REPLAY_DT)
    # 0: far, 1: at the pose
    s = jnp.clip(jnp.arange(steps) * _REPLAY_DT / _REPLAY_SECONDS, 0.0, 1.0)[:, None, None]
    slides = (1 - s) * distance * outward + jnp.sin(jnp.pi * s) * amplitude * lateral
    reached = _replay(hand, jnp.concatenate([slides, (1 - s) * turn * axis], -1))

    joints = _resampled(reached, waypoints)
    turns = rotations.from_rotation_vector(joints[..., 3:])
    last = jnp.broadcast_to(quaternion[:, None], turns.shape)
    return position[:, None] + joints[..., :3], rotations.multiply(turns, last)


def _resampled(motion: Array, waypoints: int) -> Array:
    """Wrist joints (M, K, 6) at waypoints that are evenly spaced along motions (T, M, 6)."""
    steps, count, _ = motion.shape
    moved = jnp.linalg.norm(jnp.diff(motion[..., :3], axis=0), axis=-1)
    length = jnp.concatenate([jnp.zeros((1, count)), jnp.cumsum(moved, 0)])
    length_at_waypoint = jnp.linspace(0.0, 1.0, waypoints)[:, None] * length[-1]
    step = jax.vmap(jnp.interp, (1, 1, None), 1)(
        length_at_waypoint, length, jnp.arange(float(steps))
    )
    before = jnp.clip(step.astype(jnp.int32), 0, steps - 2)
    share = (step - before)[..., None]
    columns = jnp.arange(count)
    joints = (1 - share) * motion[before, columns] + share * motion[before + 1, columns]
    return jnp.swapaxes(joints, 0, 1)


def _replay(hand: Hand, target: Array) -> Array:
    """Motion of the wrist's PD controller for targets (T, M, 6): each axis is a damped mass,
    semi-implicit Euler.
    """
    gains = hand.wrist
    mass, inertia = hand.wrist_inertia.tolist()
    kp = jnp.array([gains.slide_kp] * 3 + [gains.hinge_kp] * 3)
    kv = jnp.array([gains.slide_kv] * 3 + [gains.hinge_kv] * 3)
    limit = jnp.array([gains.slide_limit] * 3 + [gains.hinge_limit] * 3)
    weight = jnp.array([mass] * 3 + [inertia] * 3)

    def step(state: tuple[Array, Array], goal: Array) -> tuple[tuple[Array, Array], Array]:
        """Simulates one step of the wrist's servos."""
        x, v = state
        force = jnp.clip(kp * (goal - x), -limit, limit)
        v = (v + _REPLAY_DT * force / weight) / (1 + _REPLAY_DT * kv / weight)
        return (x + _REPLAY_DT * v, v), x

    start = target[0], jnp.zeros_like(target[0])
    _, motion = jax.lax.scan(step, start, target)
    return motion


def _perpendicular(vector: Array, axis: Array) -> Array:
    """Normalised components of vectors (M, 3) orthogonal to unit axes (M, 3)."""
    part = vector - jnp.sum(vector * axis, -1, keepdims=True) * axis
    return part / jnp.linalg.norm(part, axis=-1, keepdims=True)


def _within(limits: tuple[float, float], uniform: Array) -> Array:
    """Maps random numbers in [0, 1) to a range."""
    low, high = limits
    return low + (high - low) * uniform
