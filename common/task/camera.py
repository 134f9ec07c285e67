"""Depth camera instead of a tracker: a cloud of the visible part of an object's surface, and no
pose of the object.

An image is taken periodically or once, before the reach (`SensingConfig`). Its points are the
object's surface points that no other part of the object hides (z-buffer on a coarse grid) nor the
hand's capsules, with errors. The policy's object frame is the world frame: surface and goal of its
scene are the cloud and the goal as stated at the start, both with the camera's constant error. The
true pose is not part of that scene.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from congrasp.common import rotations
from congrasp.common.hands import kinematics
from congrasp.common.hands.spec import Hand
from congrasp.common.task.constraints import known
from congrasp.common.task.normals import estimated_normals
from congrasp.common.task.sensing import Sensors, arrival
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array, Goal, Surface

IMAGES_TOGETHER = 512
"""Images that are taken together: few of a batch are due in one control step."""
_LEAST_DEPTH = 1e-6
"""Distance and width that a division may have at least, m."""


class Camera(NamedTuple):
    """State of the cameras of B episodes after a control step; world frame."""

    sensors: Sensors
    origin: Array
    """(B, 3) true position of the object at the start; the constant rotation error is about it."""
    poses: Array
    """(B, K, 7) true poses of the object in the last K control steps, newest first."""
    goal: Goal
    """Goal of the episode, with the constant error."""
    cloud: Surface
    """Latest cloud, N points with labels, and normals estimated from them if the policy observes
    normals.
    """


class Capsules(NamedTuple):
    """Capsules that hide what is behind them; world frame."""

    ends: Array
    """(B, C, 2, 3) m."""
    radii: Array
    """(C,) m."""


class Images(NamedTuple):
    """Images of B cameras."""

    time: Array
    """(B,) int control steps since the start of the episodes."""
    pose: Array
    """(B, 7) poses of the objects in the images."""
    surface: Surface
    """Labelled surface points of the objects, object frame."""


def begin(
    task: TaskSettings, sensors: Sensors, steps: int, pose: Array, surface: Surface, goal: Goal
) -> Camera:
    """Returns cameras with one image before the reach, in which the hand hides nothing.

    Args:
      task: the task.
      sensors: cameras and their errors.
      steps: control steps K for which a pose may be in transit.
      pose: (B, 7) resting poses of the objects.
      surface: their labelled surface points, object frame.
      goal: goals, object frame.
    """
    batch = len(pose)
    origin = pose[:, :3]
    position = origin + sensors.position_bias
    turn = rotations.from_rotation_vector(sensors.rotation_bias)
    quaternion = rotations.multiply(turn, pose[:, 3:])
    empty_cloud = Surface(
        points=jnp.broadcast_to(position[:, None], surface.points.shape),
        avoid=jnp.zeros_like(surface.avoid),
    )
    if surface.normals is not None:
        empty_cloud = empty_cloud._replace(normals=jnp.zeros_like(surface.normals))
    camera = Camera(
        sensors=sensors,
        origin=origin,
        poses=jnp.broadcast_to(pose[:, None], (batch, steps, 7)),
        goal=goal_in_world(task, goal, position, quaternion),
        cloud=empty_cloud,
    )
    images = Images(time=jnp.zeros(batch, jnp.int32), pose=pose, surface=surface)
    return with_images(camera, images, jnp.ones(batch, bool), None)


def look(
    hand: Hand, camera: Camera, time: Array, state: Any, start: Any, surface: Surface
) -> Camera:
    """Advances the cameras by one control step.

    An image that arrives shows the object as it was `Sensors.delay` steps ago, behind the hand of
    this step.

    Args:
      hand: the hand.
      camera: state after the previous step.
      time: (B,) int control steps since the start of the episodes, including this one.
      state: true state of the engine after the step (`actors.physics.engine.PhysicsState`).
      start: initial state of the episodes (`actors.physics.engine.ResetState`), for the wrist's
        base.
      surface: labelled surface points, object frame.
    """
    pose = jnp.concatenate([state.object_position, state.object_quaternion], -1)
    poses, arrived, due = arrival(camera.sensors, camera.poses, time, pose)
    turn = rotations.euler_to_quaternion(state.u[:, 3:])
    position, quaternion = rotations.compose_pose(
        start.base_position, start.base_quaternion, state.u[:, :3], turn
    )

    def capsules(rows: Array) -> Capsules:
        return hand_capsules(hand, state.q[rows], position[rows], quaternion[rows])

    images = Images(time=time, pose=arrived, surface=surface)
    return with_images(camera._replace(poses=poses), images, due, capsules)


def world(batch: int) -> Array:
    """Returns the pose (B, 7) of the policy's object frame: position, m, and quaternion."""
    return jnp.broadcast_to(jnp.array((0.0, 0, 0, 1, 0, 0, 0)), (batch, 7))


def hand_capsules(hand: Hand, q: Array, position: Array, quaternion: Array) -> Capsules:
    """Returns the capsules of hands with fingers at q (B, F) and wrists at (B, 3), (B, 4)."""
    turn, shift = kinematics.link_transforms(hand, q)
    links = hand.capsule_links
    ends = rotations.apply(turn[:, links], jnp.asarray(hand.capsules)) + shift[:, links, None]
    in_world = rotations.transform(position, quaternion, ends.reshape(len(q), -1, 3))
    return Capsules(in_world.reshape(ends.shape), jnp.asarray(hand.capsule_radii))


def with_images(
    camera: Camera,
    images: Images,
    due: Array,
    hand: Callable[[Array], Capsules] | None,
) -> Camera:
    """Replaces the clouds of cameras with a due image (B,) in which any point is visible, a small
    batch at a time.

    Args:
      camera: the cameras.
      images: images of all B cameras, of which the due ones are taken.
      due: (B,) bool.
      hand: returns the capsules of these environments' hands; None if the hands hide nothing.
    """
    # Rows of NumPy arrays cannot be selected by traced indices.
    camera, images = jax.tree.map(jnp.asarray, (camera, images))
    batch = len(due)
    together = min(batch, IMAGES_TOGETHER)

    def take_some(carry: tuple[Surface, Array]) -> tuple[Surface, Array]:
        """Takes a batch of the images that are left; returns the clouds and which are left."""
        cloud, left = carry
        rows = jnp.nonzero(left, size=together, fill_value=batch)[0]
        capsules = None if hand is None else hand(rows)
        inputs = camera.sensors, camera.origin, images
        sensors, origin, selected = jax.tree.map(lambda array: array[rows], inputs)
        visible, fresh = _taken(capsules, sensors, origin, selected)
        replaced = jnp.where(jnp.any(visible, -1), rows, batch)
        cloud = jax.tree.map(
            lambda array, new: array.at[replaced].set(new, mode="drop"), cloud, fresh
        )
        return cloud, left.at[rows].set(False, mode="drop")

    def is_any_left(carry: tuple[Surface, Array]) -> Array:
        _, left = carry
        return jnp.any(left)

    cloud, _ = jax.lax.while_loop(is_any_left, take_some, (camera.cloud, due))
    return camera._replace(cloud=cloud)


def _taken(
    hand: Capsules | None, sensors: Sensors, origin: Array, images: Images
) -> tuple[Array, Surface]:
    """Returns which points (B, N) are visible, and the clouds of B images, world frame."""
    surface = images.surface
    pose = images.pose
    depth_noise, luck = _image_noise(sensors.key, images.time, surface.points.shape[1])
    eye = origin + sensors.eye
    points = rotations.transform(pose[:, :3], pose[:, 3:], surface.points)
    visible = facing(eye, points) & (luck >= sensors.dropout[:, None])
    if hand is not None:
        visible &= ~behind(eye, points, hand)
    ray = points - eye[:, None]
    ray = ray / jnp.maximum(jnp.linalg.norm(ray, axis=-1, keepdims=True), _LEAST_DEPTH)
    measured = points + (sensors.position_noise[:, None] * depth_noise)[..., None] * ray
    shift = origin + sensors.position_bias
    turn = rotations.from_rotation_vector(sensors.rotation_bias)
    measured = rotations.transform(shift, turn, measured - origin[:, None])
    index = _filled(visible)
    cloud = Surface(
        points=jnp.take_along_axis(measured, index[..., None], 1),
        avoid=jnp.take_along_axis(surface.avoid, index, 1),
    )
    if surface.normals is not None:
        biased_eye = rotations.transform(shift, turn, sensors.eye[:, None])[:, 0]
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


def goal_in_world(task: TaskSettings, goal: Goal, position: Array, quaternion: Array) -> Goal:
    """Returns goals of the object frame in the world frame, for objects at (B, 3), (B, 4)."""

    def turned(value: Array, turn: Callable[[Array, Array], Array]) -> Array:
        """Applies a rotation function to the objects' orientations and a goal array."""
        orientation = jnp.broadcast_to(_rows(quaternion, value), (*value.shape[:-1], 4))
        return turn(orientation, value)

    for constraint in known(task):
        moved = {}
        for name, array in constraint.arrays.items():
            value = getattr(goal[constraint.name], name)
            if array.kind == "position":
                moved[name] = _rows(position, value) + turned(value, rotations.rotate)
            elif array.kind == "direction":
                moved[name] = turned(value, rotations.rotate)
            elif array.kind == "quaternion":
                moved[name] = turned(value, rotations.multiply)
        goal = goal.replace(constraint.name, **moved)
    return goal


def _rows(array: Array, like: Array) -> Array:
    """An array (B, n) as (B, 1, ..., n), with as many axes as another (B, ..., m)."""
    return jnp.expand_dims(array, tuple(range(1, like.ndim - 1)))
