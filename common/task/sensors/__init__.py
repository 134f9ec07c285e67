"""Sensors of the object: registers those of the project.

Importing this module adds them to `SENSORS`. A program outside the package adds a row of its own
before it builds anything from a task.
"""

from congrasp.common.errors import CongraspError
from congrasp.common.task.sensor_registry import SENSORS
from congrasp.common.task.sensors.base import Sensor
from congrasp.common.task.sensors.camera import Camera
from congrasp.common.task.sensors.full_state import FullState
from congrasp.common.task.sensors.tracker import Tracker
from congrasp.common.task.settings import TaskSettings

SENSORS["full"] = FullState()
SENSORS["tracked"] = Tracker()
SENSORS["camera"] = Camera()


def get_sensor(task: TaskSettings) -> Sensor:
    """Returns the sensor of a task's policy.

    Raises:
      CongraspError: there is no such sensor.
    """
    if task.observation not in SENSORS:
        raise CongraspError(
            f"There is no observation '{task.observation}'.",
            f"Choose one of: {', '.join(SENSORS)}.",
        )
    sensor: Sensor = SENSORS[task.observation]
    return sensor


__all__ = ["SENSORS", "Sensor", "get_sensor"]
