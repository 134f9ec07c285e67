"""The task of an evaluation: which of a policy's settings count in it, and what its objects are called."""

import dataclasses
import pathlib

from congrasp.common.config import SensingConfig, TaskConfig
from congrasp.common.hands import get_hand
from congrasp.common.objects.mjcf import CONTACT
from congrasp.common.objects.pool import object_scale
from congrasp.common.policy.bundle import PolicyBundle

HOLD_SECONDS = 2.0
"""How long a grasp should last without the table, beyond the paper's quarter of a second."""
NOMINAL_FRICTION = CONTACT.friction[0]
"""Sliding friction between hand and object, of evaluations that name no other."""


def two_seconds(task: TaskConfig) -> int:
    """Control steps in `HOLD_SECONDS`."""
    return round(HOLD_SECONDS / task.control_dt)


def protocol(task: TaskConfig, hold: int, friction: float = NOMINAL_FRICTION) -> TaskConfig:
    """The task with `hold` control steps without the table, objects of their own mass and of one sliding friction,
    nominal gains, and a perfect tracker.

    So rates compare between policies, whatever ranges they were trained with.
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
