"""A sensor from outside the package: a tracker, and contact switches in the links of the hand."""

from typing import NamedTuple

import jax.numpy as jnp

from congrasp.common.task.constraints.specs import ObservationField
from congrasp.common.task.sensors.base import robot_inputs
from congrasp.common.task.sensors.tracker import Tracker, TrackerState
from congrasp.common.task.types import Array

SWITCH_FORCE_N = 0.3
"""Force at which a link's switch closes."""


class TactileState(NamedTuple):
    """State of the sensors after a control step."""

    tracker: TrackerState
    touching: Array
    """(B, L) 1 where the switch of a link is closed, else 0."""


class Tactile(Tracker):
    """Pose of the object, some control steps old, and a contact switch in each link."""

    def begin(self, parameters, start):
        open_switches = jnp.zeros((len(start.pose), len(start.hand.links)))
        return TactileState(super().begin(parameters, start), open_switches)

    def step(self, parameters, state, moment):
        contacts = moment.state.contact_force * moment.state.contact_found[..., None]
        force = jnp.linalg.norm(contacts.sum(-2), axis=-1)
        tracker = super().step(parameters, state.tracker, moment)
        return TactileState(tracker, (force > SWITCH_FORCE_N).astype(jnp.float32))

    def pose(self, state, lift):
        return super().pose(state.tracker, lift)

    def first_pose(self, state):
        return super().first_pose(state.tracker)

    def measure(self, state):
        return {"touching": state.touching}

    def query(self, hand, task):
        return {"touching": (len(hand.links),)}

    def fields(self, hand, task):
        switches = ObservationField("switches", len(hand.links), "1 if a link's switch is closed")
        return {"state": (switches,)}

    def observe(self, scene):
        return {"state": [scene.measured["touching"]]}

    def describe(self, task):
        return f"{robot_inputs(task)}, the object's pose from a tracker, and contact switches."
