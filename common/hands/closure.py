"""Closures: a one-parameter family of finger poses from the widest pose through the open one to the
fist.

The pose of a closure c in [-1, 1] has the finger angles q_open + c (q_closed - q_open) if c is
positive, else q_open - c (q_wide - q_open). The gap of a pose is the free space between the skins
of the thumb's and the nearest other fingertip along the cross-finger axis, in metres. The outline
of a hand is its extent around its centre in a few of these poses.
"""

import functools
from typing import NamedTuple

import numpy as np

from congrasp.common.hands import kinematics
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.motors import joint_positions, motor_limits, motor_positions
from congrasp.common.hands.spec import Hand
from congrasp.common.runtime.lazy_jax import jax, jnp
from congrasp.common.task.types import Array

CLOSURES = np.round(np.arange(-1.0, 0.51, 0.1), 6)
"""Closures (S,) at which gaps and outlines are tabulated, from the widest pose to the gaps of thin
objects."""
PRESHAPE_MARGIN_M = 0.03
"""Distance by which the gap of a preshaped hand exceeds the object's width in evaluation and
requests. It is not scaled with the hand, as the range in training is not
(`TaskConfig.preshape_margin`)."""
MAX_OBJECT_WIDTH_M = 0.12
"""Greatest width of objects that the human hand grasps; other hands multiply it by their
`object_scale`."""
_SIDE_CLEARANCE_M = 0.01
"""Distance on either side of the widest object to which a hand opens. It is less than half of
`PRESHAPE_MARGIN_M`: around the widest objects, fingers are preshaped to the hand's widest pose, and
the margin is what that leaves."""
WIDEST_GAP_M = MAX_OBJECT_WIDTH_M + 2 * _SIDE_CLEARANCE_M
"""Gap beyond which no hand needs to open; other hands multiply it by their `object_scale`."""
_MIN_GAP_STEP_M = 1e-6
"""Least difference of neighbouring entries in the table of gaps."""
_OFFSET_WEIGHT = 0.5
"""Weight of a changed offset (m^2) relative to a missing gap (m^2)."""
_TURN_WEIGHT = 2e-6
"""Weight of a motor's rotation (rad^2) relative to a missing gap (m^2)."""


class Outline(NamedTuple):
    """Balls whose hull contains the hand, in S finger poses from the least to the most closed.

    The frame has its origin at the hand's centre and the axes v, w and v x w of the grasp frame.
    """

    points: np.ndarray
    """(S, E, 3) centres of the balls, m."""
    radii: np.ndarray
    """(E,) m."""
    gaps: np.ndarray
    """(S,) gaps, m."""


CENTER_ONLY = Outline(np.zeros((1, 1, 3)), np.array([0.01]), np.array([np.inf]))
"""Outline of a ball with a radius of 1 cm around the hand's centre, which fits any gap: in place of
a hand's outline where only its centre has to be above the table."""


def closure_pose(hand: Hand, closure: Array) -> Array:
    """Finger angles (..., F) at closures (..., 1), or at (..., F) closures, one for each joint."""
    c = jnp.asarray(closure)
    q_wide = jnp.asarray(wide_angles(hand))
    q_open = jnp.asarray(hand.q_open)
    q_closed = jnp.asarray(hand.q_closed)
    to_closed = jnp.maximum(c, 0.0) * (q_closed - q_open)
    to_wide = jnp.maximum(-c, 0.0) * (q_wide - q_open)
    return q_open + to_closed + to_wide


def preshape(hand: Hand, width: Array, margin: Array | float = PRESHAPE_MARGIN_M) -> Array:
    """Returns the finger angles (B, F) of hands that open around objects.

    Args:
      hand: the hand.
      width: (B,) widths of the objects, m.
      margin: () or (B,) distance by which the gap exceeds the width, m; less if the hand does not
        open that wide.
    """
    gaps = table_of_gaps(hand)
    closure = jnp.interp(width + margin, gaps[::-1], CLOSURES[::-1])
    return closure_pose(hand, closure[..., None])


@functools.cache
def table_of_gaps(hand: Hand) -> np.ndarray:
    """Gaps (S,) in metres at `CLOSURES`, made strictly decreasing where the hand's are not.

    `preshape` interpolates the closure of a gap, for which the gaps must differ.
    """
    compiled_gaps = jax.jit(_gaps_at, static_argnums=0)
    measured_gaps = kinematics.untraced(compiled_gaps, hand, CLOSURES.astype(np.float32))
    gaps = np.asarray(measured_gaps, np.float64)
    return np.minimum.accumulate(gaps) - _MIN_GAP_STEP_M * np.arange(len(gaps))


@functools.cache
def wide_angles(hand: Hand) -> np.ndarray:
    """Finger angles (F,) of the hand's widest pose, computed if the hand's data has none."""
    if hand.wide_pose is not None:
        return hand.posed(hand.wide_pose)
    return hand.posed(kinematics.untraced(widest_pose, hand))


def widest_gap(hand: Hand) -> float:
    """Gap in metres between thumb and fingers in the hand's widest pose."""
    return float(table_of_gaps(hand)[0])


def widest_pose(hand: Hand) -> dict[str, float]:
    """Finger angles of the pose nearest to the open one in which all fingers have a gap of
    `WIDEST_GAP_M` to the thumb, or the widest that their limits allow.

    It faces the object as the open pose does: the fingertips keep their offsets from the thumb's
    along the heading axis and along the axis orthogonal to it and the cross-finger axis. L-BFGS-B,
    started at the open pose, minimises over the motors the squared missing gaps and changed
    offsets, summed over the other fingers.
    """
    # Late, because the help of commands imports this module
    from scipy.optimize import minimize

    lower, upper = motor_limits(hand)
    start = np.asarray(motor_positions(hand, hand.q_open), float)
    program = jax.jit(jax.value_and_grad(functools.partial(_cost, hand)))

    def scaled_cost(motors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cost () and gradient (M,); the default tolerances of L-BFGS-B assume costs around one."""
        cost, gradient = program(jnp.asarray(motors, jnp.float32))
        return np.asarray(cost, float) / _TURN_WEIGHT, np.asarray(gradient, float) / _TURN_WEIGHT

    bounds = np.stack([lower, upper], -1)
    result = minimize(scaled_cost, start, jac=True, method="L-BFGS-B", bounds=bounds)
    q = np.asarray(joint_positions(hand, jnp.asarray(result.x, jnp.float32)))
    followers = {coupling.joint for coupling in hand.couplings}
    angles = {}
    for joint, angle in zip(hand.joints, q, strict=True):
        if joint.name not in followers:
            angles[joint.name] = round(float(angle), 3)
    return angles


def _cost(hand: Hand, motors: Array) -> Array:
    """Cost () in m^2 that `widest_pose` minimises."""
    open_q = jnp.asarray(hand.q_open)
    open_motors = motor_positions(hand, open_q)
    tips = _tips(hand, joint_positions(hand, motors))
    open_tips = _tips(hand, open_q)
    missing_gap = jnp.maximum(WIDEST_GAP_M * hand.object_scale - _finger_gaps(hand, tips), 0.0)
    moved = (tips[1:] - tips[0]) - (open_tips[1:] - open_tips[0])
    offset = moved[:, ::2]  # along v and v x w
    return (
        jnp.sum(missing_gap**2)
        + _OFFSET_WEIGHT * jnp.sum(offset**2)
        + _TURN_WEIGHT * jnp.sum((motors - open_motors) ** 2)
    )


def _gaps_at(hand: Hand, closures: Array) -> Array:
    """Gaps (S,) in m of a hand at closures (S,)."""
    q = closure_pose(hand, closures[:, None])
    return jnp.min(_finger_gaps(hand, _tips(hand, q)), -1)


def _tips(hand: Hand, q: Array) -> Array:
    """Fingertips (..., G, 3) in m, thumb first, in the grasp frame's axes v, w and v x w."""
    frame = grasp_frame(hand)
    axes = np.stack([frame.heading, frame.cross, np.cross(frame.heading, frame.cross)])
    points = kinematics.keypoints(hand, kinematics.link_transforms(hand, q))
    return points[..., len(hand.links) :, :] @ jnp.asarray(axes.T, jnp.float32)


def _finger_gaps(hand: Hand, tips: Array) -> Array:
    """Free space (..., G - 1) in m along w between the skins of the thumb's and each other
    fingertip.

    Args:
      hand: the hand.
      tips: (..., G, 3) fingertips, thumb first, in the axes of the grasp frame (`_tips`), m.
    """
    radii = hand.keypoint_radii[len(hand.links) :]
    return tips[..., 1:, 1] - tips[..., :1, 1] - radii[1:] - radii[0]


@functools.cache
def outline(hand: Hand) -> Outline:
    """Returns the hand's capsules in the poses of `CLOSURES`."""
    frame = kinematics.grasp_frame(hand)
    axes = np.stack([frame.heading, frame.cross, np.cross(frame.heading, frame.cross)])
    compiled_balls = jax.jit(_ends_and_centers, static_argnums=0)
    ends, center = kinematics.untraced(compiled_balls, hand, CLOSURES.astype(np.float32))
    from_center = np.asarray(ends, np.float64) - np.asarray(center, np.float64)[:, None]
    return Outline(
        points=from_center @ axes.T,
        radii=np.repeat(hand.capsule_radii, 2).astype(np.float64),
        gaps=table_of_gaps(hand),
    )


def depth_below(outline: Outline, up: np.ndarray) -> np.ndarray:
    """Depth (S, H) in metres of the hand's lowest point below its centre, in each of S poses.

    Args:
      outline: outline of the hand.
      up: (H, 3) unit, vertical of the world in the outline's frame.
    """
    heights = np.einsum("sei,hi->she", outline.points, up) - outline.radii
    return -heights.min(-1)


def _ends_and_centers(hand: Hand, closures: Array) -> tuple[Array, Array]:
    """Ends (S, E, 3) of the hand's capsules at closures (S,), and its centres (S, 3), in the wrist
    frame.
    """
    transforms = kinematics.link_transforms(hand, closure_pose(hand, closures[:, None]))
    ends = kinematics.capsules(hand, transforms)
    center = kinematics.hand_center(hand, kinematics.keypoints(hand, transforms))
    return ends.reshape(*ends.shape[:-3], -1, 3), center
