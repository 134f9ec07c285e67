"""Depth camera: a cloud of the visible part of an object's surface, and no pose of the object.

An image is taken periodically or once, before the reach (`SensingConfig`). Its points are the
object's visible surface points (`common.task.sensors.images`), with errors. The policy's object
frame is the world frame: surface and goal of its scene are the cloud and the goal as stated at the
start, both with the camera's constant error. The true pose is not part of that scene.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from congrasp.common import rotations
from congrasp.common.hands.spec import Hand
from congrasp.common.runtime.lazy_jax import jnp
from congrasp.common.task.constraints import known
from congrasp.common.task.constraints.specs import ObservationField
from congrasp.common.task.geometry import flat
from congrasp.common.task.scene import Scene
from congrasp.common.task.sensors.base import (
    EpisodeStart,
    Moment,
    Sensor,
    robot_inputs,
    world_pose,
)
from congrasp.common.task.sensors.images import Capsules, Images, hand_capsules, with_images
from congrasp.common.task.sensors.parameters import SensorParameters, arrival, longest
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array, Goal, Surface


class CameraState(NamedTuple):
    """State of the cameras of B episodes after a control step; world frame."""

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


class Camera(Sensor):
    """Cloud of the visible part of the object's surface."""

    shows_pose = False
    points = "cloud"

    def begin(self, parameters: SensorParameters, start: EpisodeStart) -> CameraState:
        """Returns cameras with one image before the reach, in which the hand hides nothing."""
        batch = len(start.pose)
        surface = start.surface
        origin = start.pose[:, :3]
        position = origin + parameters.position_bias
        turn = rotations.from_rotation_vector(parameters.rotation_bias)
        quaternion = rotations.multiply(turn, start.pose[:, 3:])
        empty_cloud = Surface(
            points=jnp.broadcast_to(position[:, None], surface.points.shape),
            avoid=jnp.zeros_like(surface.avoid),
        )
        if surface.normals is not None:
            empty_cloud = empty_cloud._replace(normals=jnp.zeros_like(surface.normals))
        images = Images(
            parameters=parameters,
            origin=origin,
            time=jnp.zeros(batch, jnp.int32),
            pose=start.pose,
            surface=surface,
        )
        steps = longest(start.task.sensing, start.task.control_dt)
        return CameraState(
            origin=origin,
            poses=jnp.broadcast_to(start.pose[:, None], (batch, steps, 7)),
            goal=goal_in_world(start.task, start.goal, position, quaternion),
            cloud=with_images(empty_cloud, images, jnp.ones(batch, bool), None),
        )

    def step(self, parameters: SensorParameters, state: CameraState, moment: Moment) -> CameraState:
        """Returns the cameras after a control step.

        An image that arrives shows the object as it was `SensorParameters.delay` steps ago, behind
        the hand of this step.
        """
        true = moment.state
        pose = jnp.concatenate([true.object_position, true.object_quaternion], -1)
        poses, arrived, due = arrival(parameters, state.poses, moment.time, pose)
        turn = rotations.euler_to_quaternion(true.u[:, 3:])
        position, quaternion = rotations.compose_pose(
            true.base_position, true.base_quaternion, true.u[:, :3], turn
        )

        def capsules(rows: Array) -> Capsules:
            return hand_capsules(moment.hand, true.q[rows], position[rows], quaternion[rows])

        images = Images(
            parameters=parameters,
            origin=state.origin,
            time=moment.time,
            pose=arrived,
            surface=moment.surface,
        )
        cloud = with_images(state.cloud, images, due, capsules)
        return state._replace(poses=poses, cloud=cloud)

    def pose(self, state: CameraState, lift: Array) -> Array:
        """See `Sensor.pose`."""
        return world_pose(len(state.origin))

    def first_pose(self, state: CameraState) -> Array:
        """See `Sensor.first_pose`."""
        return world_pose(len(state.origin))

    def view(self, state: CameraState, surface: Surface, goal: Goal) -> tuple[Surface, Goal]:
        """See `Sensor.view`."""
        return state.cloud, state.goal

    def query(self, hand: Hand, task: TaskSettings) -> Mapping[str, tuple[int, ...]]:
        """Position of the camera, toward which estimated normals point."""
        if not task.surface_normals:
            return {}
        return {"camera_position": (3,)}

    def fields(self, hand: Hand, task: TaskSettings) -> Mapping[str, tuple[ObservationField, ...]]:
        """See `Sensor.fields`."""
        cloud = ObservationField(
            "cloud",
            4 * task.surface_points,
            "m, points of the camera's cloud, wrist frame, each with 1 if an active affordance "
            "avoids it, else 0",
        )
        return {"cloud": (cloud,)}

    def observe(self, scene: Scene) -> Mapping[str, Sequence[Array]]:
        """Points of the cloud in the wrist frame, each followed by its label: (B, 4 N)."""
        features = scene.features
        points = rotations.inverse_transform(
            features.wrist_position, features.wrist_quaternion, scene.surface.points
        )
        labels = jnp.zeros(scene.surface.avoid.shape)
        for constraint in known(scene.task):
            constraint_labels = constraint.cloud_labels(scene)
            if constraint_labels is not None:
                labels = jnp.maximum(labels, constraint_labels)
        return {"cloud": [flat(jnp.concatenate([points, labels[..., None]], -1))]}

    def describe(self, task: TaskSettings) -> str:
        """See `Sensor.describe`."""
        return (
            f"{robot_inputs(task)}, and a partial cloud of the object from a depth camera; no "
            f"pose, velocities or contact forces."
        )


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
