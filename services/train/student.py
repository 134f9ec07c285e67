"""Runs that distil a policy into one with a robot's sensors: joints, wrist, and a tracker's object poses."""

import dataclasses
import pathlib

from congrasp.common.config import RunConfig
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import named_policy
from congrasp.common.task.config import SensingConfig
from congrasp.common.task.methods import STUDENT, with_method

TRACKERS = SensingConfig(
    period=(0.0, 0.1),
    delay=(0.0, 0.1),
    position_noise=(0.0, 0.01),
    rotation_noise=(0.0, 0.105),
    dropout=(0.0, 0.3),
    position_bias=(0.0, 0.005),
    rotation_bias=(0.0, 0.035),
    settle=0.04,
)
"""From a perfect tracker to one with 10 Hz, 0.1 s latency, errors of 1 cm and 6°, and 30 % lost samples.

All samples of an episode share a further error of up to 5 mm and 2° (standard deviations, like the others)."""


def student_of(config: RunConfig, teacher: str) -> RunConfig:
    """Returns the run that distils a teacher, with a robot's sensors and random tracker, mass, friction and gains.

    Args:
      config: numbers, objects and networks.
      teacher: a policy file, or the hand of a pretrained policy.

    Raises:
      CongraspError: there is no such policy.
    """
    file = named_policy(teacher)
    task = dataclasses.replace(
        bundles.load(file).task,
        sensing=TRACKERS,
        mass_range=(0.7, 1.4),
        friction_range=(0.5, 1.2),
        gain_range=(0.8, 1.2),
    )
    return with_method(
        dataclasses.replace(
            config,
            name=f"{config.name}-{STUDENT}",
            task=task,
            algorithm="distill",
            distill=dataclasses.replace(
                config.distill, teacher=str(file.resolve()) if pathlib.Path(teacher) == file else teacher
            ),
        ),
        STUDENT,
    )
