"""Registry of sensors by name, used by settings, command lines and errors.

`common.task.sensors` registers those of the project; another sensor needs one more row.
"""

from typing import Annotated, Any, Literal

import tyro

SENSORS: dict[str, Any] = {}
"""Instances of `common.task.sensors.base.Sensor` by name, the value of `TaskSettings.observation`.
"""

SensorName = Annotated[
    str,
    tyro.conf.arg(
        constructor_factory=lambda: Literal.__getitem__(tuple(SENSORS))  # type: ignore[attr-defined]
    ),
]
"""A key of `SENSORS`; a command line offers those registered when it is parsed."""
