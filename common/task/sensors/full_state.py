"""Full state of the simulation: the plain case, in which the policy needs no sensor.

If its tracker is not perfect (`TaskSettings.sensed`), the object's pose is that of the tracker.
"""

from congrasp.common.task.sensors.tracker import Tracker
from congrasp.common.task.settings import SensingConfig, TaskSettings


class FullState(Tracker):
    """A tracker, and everything else that the simulator knows."""

    privileged = True

    def describe(self, task: TaskSettings) -> str:
        """See `Sensor.describe`."""
        pose = "exact poses"
        if task.sensing != SensingConfig():
            pose = "the object's pose from a tracker"
        return f"It observes {pose}, velocities and contact forces."
