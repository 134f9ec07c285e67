"""Students: policies with the sensors of a robot, distilled from a teacher."""

import dataclasses
import pathlib

from congrasp.common.config import RunConfig
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import named_policy
from congrasp.common.task.config import SensingConfig
from congrasp.common.task.methods import CAMERA, STUDENT, with_method

TRACKERS = SensingConfig(
    period=(0.0, 0.1),
    delay=(0.0, 0.1),
    position_noise=(0.0, 0.01),
    rotation_noise=(0.0, 0.105),
    latency=(0.0, 0.04),
    dropout=(0.0, 0.3),
    position_bias=(0.0, 0.005),
    rotation_bias=(0.0, 0.035),
    settle=0.04,
)
"""From a perfect tracker to one with 10 Hz, 0.1 s latency, errors of 1 cm and 6°, and 30 % lost
samples.

All samples of an episode share a further error of up to 5 mm and 2° (standard deviations, like the
others). Servos follow targets up to 40 ms late."""


CAMERAS = SensingConfig(
    period=(0.1, 0.1),
    delay=(0.0, 0.1),
    position_noise=(0.0, 0.004),
    latency=(0.0, 0.04),
    dropout=(0.0, 0.5),
    position_bias=(0.0, 0.005),
    rotation_bias=(0.0, 0.035),
    single_image=0.5,
)
"""A depth camera on one side: an image before the reach, in half of the episodes another at 10 Hz.

The points' depth has errors of up to 4 mm, half of them may be missing, and the hand-eye
calibration is off by up to 5 mm and 2° (standard deviations), constant in an episode."""
_SENSING = {STUDENT: TRACKERS, CAMERA: CAMERAS}
_LEAST_STD = 0.15
"""Least standard deviation of a student's action: a teacher's is 0.1 once it has settled."""


def student_of(config: RunConfig, teacher: str, method: str = STUDENT) -> RunConfig:
    """Returns the run that distils a teacher, with twice its time and random sensors, mass,
    friction and gains.

    Args:
      config: numbers, objects and networks.
      teacher: a policy file, or the hand of a pretrained policy.
      method: `student`, with a tracker, or `camera`.

    Raises:
      CongraspError: there is no such policy.
    """
    file = named_policy(teacher)
    task = bundles.load(file).task
    task = dataclasses.replace(
        task,
        # Servos that follow up to 40 ms late reach half as fast; a policy observes the time as a
        # share of the episode.
        approach_steps=2 * task.approach_steps,
        sensing=_SENSING[method],
        mass_range=(0.7, 1.4),
        friction_range=(0.5, 1.2),
        gain_range=(0.8, 1.2),
    )
    # PPO after the distillation begins with a policy that obeys all constraints, and with its
    # teacher's noise.
    curriculum = dataclasses.replace(config.curriculum, ramp=(0, int(config.curriculum.ramped)))
    # A file is named by its absolute path, since other processes read it; a hand by its name.
    source = str(file.resolve()) if pathlib.Path(teacher) == file else teacher
    student = dataclasses.replace(
        config,
        name=f"{config.name}-{method}",
        task=task,
        curriculum=curriculum,
        ppo=dataclasses.replace(config.ppo, least_std=_LEAST_STD),
        algorithm="distill",
        distill=dataclasses.replace(config.distill, teacher=source),
    )
    return with_method(student, method)
