"""Frames and distances shared by control, features, observation and metrics."""

from congrasp.common import rotations
from congrasp.common.hands import kinematics
from congrasp.common.hands.spec import Hand
from congrasp.common.runtime.lazy_jax import jax, jnp
from congrasp.common.task.types import Array, SceneState

NO_POINT_DISTANCE = 0.3
"""Distance that represents "no such surface point", m."""
FORCE_SCALE = 5.0
"""Force at which the squashed force is one half, N."""


def hand_center(hand: Hand, points: Array, fingers: Array | None = None) -> Array:
    """Hand centre (B, 3): midpoint of the thumb's tip and the mean of the other selected tips.

    Args:
      hand: the hand.
      points: (B, P, 3) keypoints of the hand.
      fingers: (B, G) bool, selected fingers, thumb first; all by default.
    """
    of_all_fingers = kinematics.hand_center(hand, points)
    if fingers is None:
        return of_all_fingers
    tips = points[..., len(hand.links) :, :]
    thumb = tips[..., 0, :]
    counted = fingers[..., 1:, None].astype(jnp.float32)
    others = jnp.sum(tips[..., 1:, :] * counted, -2) / jnp.maximum(jnp.sum(counted, -2), 1.0)
    # If all fingers are selected, the result is bitwise the same as without a selection.
    are_all = jnp.all(fingers, -1, keepdims=True)
    return jnp.where(are_all, of_all_fingers, 0.5 * (thumb + others))


def wrist_pose(state: SceneState) -> tuple[Array, Array]:
    """Position (B, 3) and quaternion (B, 4) of the wrist frame in the world frame."""
    return rotations.compose_pose(
        state.base_position,
        state.base_quaternion,
        state.u[..., :3],
        rotations.euler_to_quaternion(state.u[..., 3:]),
    )


def wrist_to_joints(state: SceneState, position: Array, quaternion: Array) -> Array:
    """Virtual wrist joints (B, ..., 6) that put the wrist at world poses (B, ..., 3), (B, ..., 4).

    Among equivalent angles these are nearest to the current ones: no hinge differs from the state's
    by more than pi.
    """
    extra = position.ndim - 2
    base_position = state.base_position.reshape(-1, *([1] * extra), 3)
    base_quaternion = state.base_quaternion.reshape(-1, *([1] * extra), 4)
    local, turned = rotations.relative_pose(
        base_position, jnp.broadcast_to(base_quaternion, quaternion.shape), position, quaternion
    )
    present = state.u[..., 3:].reshape(-1, *([1] * extra), 3)
    return jnp.concatenate([local, rotations.quaternion_to_euler(turned, present)], -1)


def in_world(
    object_position: Array, object_quaternion: Array, position: Array, quaternion: Array
) -> tuple[Array, ...]:
    """Transforms poses (B, ..., 3), (B, ..., 4) from object to world frame, for object poses (B,
    3), (B, 4).
    """
    extra = position.ndim - 2
    origin = object_position.reshape(-1, *([1] * extra), 3)
    turn = jnp.broadcast_to(object_quaternion.reshape(-1, *([1] * extra), 4), quaternion.shape)
    return rotations.compose_pose(origin, turn, position, quaternion)


def squared_distances(a: Array, b: Array) -> Array:
    """Squared distances (B, M, N) between points (B, M, 3) and (B, N, 3)."""
    x, y, z = jnp.moveaxis(a[..., :, None, :] - b[..., None, :, :], -1, 0)
    return x * x + y * y + z * z


def nearest_index(squared: Array) -> Array:
    """Index (B, M) of the least of N squared distances (B, N, M); ties within 0.01 % are broken
    arbitrarily.

    Non-negative floats are ordered like their bits, and the last bits hold the index: one minimum
    along a vector's lanes, several times faster than `argmin`.
    """
    count = squared.shape[-2]
    index_bits = (1 << (count - 1).bit_length()) - 1
    distance_bits = jax.lax.bitcast_convert_type(squared, jnp.int32) & ~index_bits
    key = distance_bits | jnp.arange(count)[:, None]
    return jnp.min(key, -2) & index_bits


def least_distance(points: Array, selected: Array, target: Array) -> Array:
    """Least distance (B,) from targets (B, 3) to the `selected` (B, N) points (B, N, 3); inf if
    none is.
    """
    distance = jnp.linalg.norm(points - target[:, None], axis=-1)
    return jnp.min(jnp.where(selected, distance, jnp.inf), -1)


def least_distance_to_segment(points: Array, selected: Array, start: Array, end: Array) -> Array:
    """Least distance (B,) from the selected points to segments from start to end (B, 3); inf if
    none is selected.
    """
    along = end - start
    length = jnp.sum(along**2, -1)[:, None]
    t = jnp.clip(jnp.einsum("bni,bi->bn", points - start[:, None], along) / length, 0.0, 1.0)
    closest = start[:, None] + t[..., None] * along[:, None]
    distance = jnp.linalg.norm(points - closest, axis=-1)
    return jnp.min(jnp.where(selected, distance, jnp.inf), -1)


def square(x: Array) -> Array:
    """Sum of squares over the last axis."""
    return jnp.sum(x * x, -1)


def squash(force: Array) -> Array:
    """Squashes forces (..., 3) in newtons to vectors shorter than one: f / (|f| + 5 N)."""
    return force / (jnp.linalg.norm(force, axis=-1, keepdims=True) + FORCE_SCALE)


def share(part: Array, total: Array) -> tuple[Array, Array]:
    """Numerator and denominator (B,) of a ratio error: numbers of true flags in a part (B, N) and
    in total.
    """
    numerator = jnp.sum(part, -1).astype(jnp.float32)
    denominator = jnp.sum(total, -1).astype(jnp.float32)
    return numerator, denominator


def flat(x: Array) -> Array:
    """Reshapes an array (B, ...) to (B, n)."""
    return x.reshape(x.shape[0], -1)
