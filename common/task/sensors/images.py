"""Images of depth cameras: the part of an object's surface that neither the object itself nor the
hand hides.

A point is visible if no other part of the object hides it (z-buffer on a coarse grid) nor the
hand's capsules.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

from congrasp.common import rotations
from congrasp.common.hands import kinematics
from congrasp.common.hands.spec import Hand
from congrasp.common.runtime.lazy_jax import jax, jnp
from congrasp.common.task.sensors.parameters import SensorParameters
from congrasp.common.task.types import Array, Surface

IMAGES_TOGETHER = 512
"""Images that are taken together: few of a batch are due in one control step."""
_LEAST_DEPTH = 1e-6
"""Distance and width that a division may have at least, m."""


class Capsules(NamedTuple):
    """Capsules that hide what is behind them; world frame."""

    ends: Array
    """(B, C, 2, 3) m."""
    radii: Array
    """(C,) m."""


class Images(NamedTuple):
    """Images of B cameras."""

    parameters: SensorParameters
    """Cameras and their errors."""
    origin: Array
    """(B, 3) true position of the object at the start; the constant rotation error is about it."""
    time: Array
    """(B,) int control steps since the start of the episodes."""
    pose: Array
    """(B, 7) poses of the objects in the images."""
    surface: Surface
    """Labelled surface points of the objects, object frame."""


def hand_capsules(hand: Hand, q: Array, position: Array, quaternion: Array) -> Capsules:
    """Returns the capsules of hands with fingers at q (B, F) and wrists at (B, 3), (B, 4)."""
    turn, shift = kinematics.link_transforms(hand, q)
    links = hand.capsule_links
    ends = rotations.apply(turn[:, links], jnp.asarray(hand.capsules)) + shift[:, links, None]
    in_world = rotations.transform(position, quaternion, ends.reshape(len(q), -1, 3))
    return Capsules(in_world.reshape(ends.shape), jnp.asarray(hand.capsule_radii))


def with_images(
    cloud: Surface,
    images: Images,
    due: Array,
    hand: Callable[[Array], Capsules] | None,
) -> Surface:
    """Replaces the clouds of cameras with a due image (B,) in which any point is visible, a small
    batch at a time.

    Args:
      cloud: latest clouds of the B cameras.
      images: images of all B cameras, of which the due ones are taken.
      due: (B,) bool.
      hand: returns the capsules of these environments' hands; None if the hands hide nothing.
    """
    # Rows of NumPy arrays cannot be selected by traced indices.
    cloud, images = jax.tree.map(jnp.asarray, (cloud, images))
    batch = len(due)
    together = min(batch, IMAGES_TOGETHER)

    def take_some(carry: tuple[Surface, Array]) -> tuple[Surface, Array]:
        """Takes a batch of the images that are left; returns the clouds and which are left."""
        cloud, left = carry
        rows = jnp.nonzero(left, size=together, fill_value=batch)[0]
        capsules = None if hand is None else hand(rows)
        selected = jax.tree.map(lambda array: array[rows], images)
        visible, fresh = _taken(capsules, selected)
        replaced = jnp.where(jnp.any(visible, -1), rows, batch)
        cloud = jax.tree.map(
            lambda array, new: array.at[replaced].set(new, mode="drop"), cloud, fresh
        )
        return cloud, left.at[rows].set(False, mode="drop")

    def is_any_left(carry: tuple[Surface, Array]) -> Array:
        _, left = carry
        return jnp.any(left)

    cloud, _ = jax.lax.while_loop(is_any_left, take_some, (cloud, due))
    return cloud


def _taken(hand: Capsules | None, images: Images) -> tuple[Array, Surface]:
    """Returns which points (B, N) are visible, and the clouds of B images, world frame."""
    from congrasp.common.task.normals import estimated_normals  # imports JAX

    parameters = images.parameters
    origin = images.origin
    surface = images.surface
    pose = images.pose
    depth_noise, luck = _image_noise(parameters.key, images.time, surface.points.shape[1])
    eye = origin + parameters.eye
    points = rotations.transform(pose[:, :3], pose[:, 3:], surface.points)
    visible = facing(eye, points) & (luck >= parameters.dropout[:, None])
    if hand is not None:
        visible &= ~behind(eye, points, hand)
    ray = points - eye[:, None]
    ray = ray / jnp.maximum(jnp.linalg.norm(ray, axis=-1, keepdims=True), _LEAST_DEPTH)
    measured = points + (parameters.position_noise[:, None] * depth_noise)[..., None] * ray
    shift = origin + parameters.position_bias
    turn = rotations.from_rotation_vector(parameters.rotation_bias)
    measured = rotations.transform(shift, turn, measured - origin[:, None])
    index = _filled(visible)
    cloud = Surface(
        points=jnp.take_along_axis(measured, index[..., None], 1),
        avoid=jnp.take_along_axis(surface.avoid, index, 1),
    )
    if surface.normals is not None:
        biased_eye = rotations.transform(shift, turn, parameters.eye[:, None])[:, 0]
        cloud = cloud._replace(normals=estimated_normals(cloud.points, biased_eye))
    return visible, cloud


def _image_noise(keys: Array, time: Array, count: int) -> tuple[Array, Array]:
    """Normal numbers and uniform ones (B, N) for the N points of an image."""

    def of_image(key: Array, time: Array) -> tuple[Array, Array]:
        noise, loss = jax.random.split(jax.random.fold_in(jax.random.wrap_key_data(key), time))
        return jax.random.normal(noise, (count,)), jax.random.uniform(loss, (count,))

    return jax.vmap(of_image)(keys, time)


def facing(eye: Array, points: Array) -> Array:
    """(B, N) bool: points (B, N, 3) that no other point hides from cameras at (B, 3).

    The image of the points is divided into sqrt(N) / 2 by as many cells. Visible are the points of
    a cell that are no farther than its nearest one by more than the longer side of a cell at the
    points' middle.
    """
    middle = jnp.mean(points, 1)
    quaternion = rotations.frame_from_axes(middle - eye, jnp.array((0.0, 0.0, 1.0)))
    depth, *across = jnp.moveaxis(rotations.inverse_transform(eye, quaternion, points), -1, 0)
    cells = max(int(points.shape[1] ** 0.5 / 2), 1)
    cell = jnp.zeros(depth.shape, jnp.int32)
    sides = []
    for coordinate in across:
        tangent = coordinate / depth
        low = jnp.min(tangent, -1, keepdims=True)
        extent = jnp.maximum(jnp.max(tangent, -1, keepdims=True) - low, _LEAST_DEPTH)
        side = extent / cells
        column = jnp.clip(jnp.floor((tangent - low) / side), 0, cells - 1).astype(jnp.int32)
        cell = cell * cells + column
        sides.append(side)
    row = jnp.arange(len(points))[:, None]
    nearest = jnp.full((len(points), cells**2), jnp.inf).at[row, cell].min(depth)
    tolerance = jnp.maximum(*sides) * jnp.linalg.norm(middle - eye, axis=-1, keepdims=True)
    return depth <= jnp.take_along_axis(nearest, cell, 1) + tolerance


def behind(eye: Array, points: Array, capsules: Capsules) -> Array:
    """(B, N) bool: points (B, N, 3) whose ray from the camera (B, 3) meets a capsule.

    The least distance between ray and axis follows Ericson 2005, Real-Time Collision Detection,
    section 5.1.9.
    """
    start = capsules.ends[:, :, 0]
    ray = points - eye[:, None]
    axis = capsules.ends[:, :, 1] - start
    away = eye[:, None] - start
    product = functools.partial(
        jnp.einsum, "bni,bci->bnc", ray, precision=jax.lax.Precision.HIGHEST
    )
    # Letters as in the source, with s along the ray and t along the axis.
    a = jnp.sum(ray * ray, -1)[:, :, None]
    e = jnp.maximum(jnp.sum(axis * axis, -1), 1e-12)[:, None]
    f = jnp.sum(axis * away, -1)[:, None]
    b = product(axis)
    c = product(away)
    s = jnp.clip((b * f - c * e) / jnp.maximum(a * e - b * b, 1e-12), 0.0, 1.0)
    t = jnp.clip((b * s + f) / e, 0.0, 1.0)
    s = jnp.clip((b * t - c) / a, 0.0, 1.0)
    squared = (
        jnp.sum(away * away, -1)[:, None]
        + s * (s * a + 2.0 * c)
        + t * (t * e - 2.0 * f - 2.0 * s * b)
    )
    return jnp.any(squared <= capsules.radii**2, -1)


def _filled(flags: Array) -> Array:
    """Indices (B, N) of the true flags (B, N), repeated evenly until there are N; zeros if there is
    none.
    """
    size = flags.shape[1]
    row = jnp.arange(len(flags))[:, None]
    rank = jnp.where(flags, jnp.cumsum(flags, -1) - 1, size)
    numbers = jnp.broadcast_to(jnp.arange(size), flags.shape)
    true_first = jnp.zeros(flags.shape, jnp.int32).at[row, rank].set(numbers, mode="drop")
    spread = jnp.arange(size) * jnp.sum(flags, -1, keepdims=True) // size
    return jnp.take_along_axis(true_first, spread, 1)
