"""Task of an evaluation: the settings of a policy that apply, and the label of its objects."""

import dataclasses
import pathlib

from congrasp.common.hands import get_hand
from congrasp.common.objects.mjcf import CONTACT
from congrasp.common.objects.pool import object_scale
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.task.config import SensingConfig, TaskConfig

HOLD_SECONDS = 2.0
"""Required hold of a grasp without the table, beyond the paper's quarter of a second."""
NOMINAL_FRICTION = CONTACT.friction[0]
"""Default sliding friction between hand and object in evaluations."""


def two_seconds(task: TaskConfig) -> int:
    """Control steps in `HOLD_SECONDS`."""
    return round(HOLD_SECONDS / task.control_dt)


def protocol(task: TaskConfig, hold: int, friction: float = NOMINAL_FRICTION) -> TaskConfig:
    """Returns the task with `hold` steps without the table, unscaled masses, one friction and no disturbances.

    Servo gains are nominal, and the tracker is perfect. Rates are therefore comparable between policies trained with
    different ranges.
    """
    return dataclasses.replace(
        task,
        hold_steps=min(task.hold_steps, hold),
        hold_steps_max=hold,
        end_when_fallen=False,
        mass_range=(1.0, 1.0),
        friction_range=(friction, friction),
        gain_range=(1.0, 1.0),
        sensing=SensingConfig(),
    )


def objects_label(bundle: PolicyBundle, folder: pathlib.Path | None, exam: str = "figures") -> str:
    """Name of the objects' source, with the factor on their lengths for the policy's hand."""
    scale = object_scale(get_hand(bundle.spec.hand), bundle.task)
    source = str(folder) if folder else f"procedural objects ({exam})"
    return source if scale == 1.0 else f"{source}, lengths x {scale:g} for the {bundle.spec.hand_name} hand"
