"""Tracker of the object's pose.

It samples the pose periodically. A sample arrives some control steps later, with errors, or is
lost; the newest arrived sample is shown until the next one. The policy observes the last control
steps of it, with its joints and their targets, which substitute for contact forces and velocities.
"""

from typing import NamedTuple

from congrasp.common import rotations
from congrasp.common.runtime.lazy_jax import jax, jnp
from congrasp.common.task.resting import resting_mean
from congrasp.common.task.sensors.base import EpisodeStart, Moment, Sensor, robot_inputs
from congrasp.common.task.sensors.parameters import SensorParameters, arrival, longest
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array


class TrackerState(NamedTuple):
    """State of the trackers after a control step; world frame."""

    poses: Array
    """(B, K, 7) true positions and quaternions of the object in the last K control steps, newest
    first.
    """
    first: Array
    """(B, 7) resting pose of the object: the pose shown at the start of the episode, or the mean
    since then.
    """
    rested: Array
    """(B,) number of readings in that mean; 0 once the object has moved or the table is removed."""
    shown: Array
    """(B, 7) pose shown now."""


class Tracker(Sensor):
    """Pose of the object, some control steps old."""

    def begin(self, parameters: SensorParameters, start: EpisodeStart) -> TrackerState:
        """Returns trackers of objects that have rested since before their oldest sample in
        transit.
        """
        batch = len(start.pose)
        steps = longest(start.task.sensing, start.task.control_dt)
        first, _ = _sampled(parameters, jnp.zeros(batch, jnp.int32), start.pose)
        return TrackerState(
            poses=jnp.broadcast_to(start.pose[:, None], (batch, steps, 7)),
            first=first,
            rested=jnp.ones(batch, jnp.int32),
            shown=first,
        )

    def step(
        self, parameters: SensorParameters, state: TrackerState, moment: Moment
    ) -> TrackerState:
        """Returns the trackers after a control step; `SensingConfig.settle` says when the object
        has moved.
        """
        pose = jnp.concatenate([moment.object_position, moment.state.object_quaternion], -1)
        poses, arrived, due = arrival(parameters, state.poses, moment.time, pose)
        sample, lost = _sampled(parameters, moment.time, arrived)
        shown = jnp.where((due & ~lost)[:, None], sample, state.shown)
        settle = moment.task.sensing.settle
        if settle:
            table = jnp.asarray(moment.state.table)
            first, rested = resting_mean(jnp, state.first, state.rested, shown, table, settle)
            state = state._replace(first=first, rested=rested)
        return state._replace(poses=poses, shown=shown)

    def pose(self, state: TrackerState, lift: Array) -> Array:
        """See `Sensor.pose`."""
        return state.shown - jnp.pad(lift, ((0, 0), (0, 4)))

    def first_pose(self, state: TrackerState) -> Array:
        """See `Sensor.first_pose`."""
        return state.first

    def describe(self, task: TaskSettings) -> str:
        """See `Sensor.describe`."""
        return (
            f"{robot_inputs(task)} and the object's pose from a tracker; no velocities and no "
            f"contact forces."
        )


def _sampled(parameters: SensorParameters, time: Array, pose: Array) -> tuple[Array, Array]:
    """Samples (B, 7) of true poses with errors, and a mask (B,) of lost ones."""

    def noise(key: Array, time: Array) -> tuple[Array, Array]:
        errors, loss = jax.random.split(jax.random.fold_in(jax.random.wrap_key_data(key), time))
        return jax.random.normal(errors, (6,)), jax.random.uniform(loss)

    errors, luck = jax.vmap(noise)(parameters.key, time)
    position = (
        pose[:, :3] + parameters.position_bias + parameters.position_noise[:, None] * errors[:, :3]
    )
    noise_turn = rotations.from_rotation_vector(parameters.rotation_noise[:, None] * errors[:, 3:])
    turn = rotations.multiply(noise_turn, rotations.from_rotation_vector(parameters.rotation_bias))
    sample = jnp.concatenate([position, rotations.multiply(turn, pose[:, 3:])], -1)
    return sample, luck < parameters.dropout
