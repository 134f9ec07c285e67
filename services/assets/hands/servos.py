"""Motors of the joints and tendons in a model."""

import dataclasses

import numpy as np

from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.assets.hands.tendons import fixed_tendon, spatial_tendon, tendon_slopes


@dataclasses.dataclass(frozen=True)
class Servo:
    """A motor of the file, with gains of its joint or tendon; 0 where the file has none."""

    joints: dict[int, float]
    kp: float
    limit: float
    reach: tuple[float, float] | None
    """Range of its targets, for a position servo that has one."""


def servos(model: mujoco.MjModel, notes: list[str]) -> list[Servo]:
    """Returns the motors of joints and of tendons.

    Args:
      model: the model.
      notes: replacements and simplifications are appended.
    """
    slopes = tendon_slopes(model)
    servos = []
    muscles = 0
    through_space = 0
    for a in range(model.nu):
        if model.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_MUSCLE:
            muscles += 1
            continue
        target = int(model.actuator_trnid[a, 0])
        if _pulls_joint(model, a):
            joints = {target: 1.0}
        elif model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_TENDON:
            joints = fixed_tendon(model, target)
            if not joints:
                through_space += 1
                joints = spatial_tendon(slopes[target])
        else:
            continue
        servos.append(_servo(model, a, joints))
    if muscles:
        notes.append(f"{muscles} muscles move it in the file: here every joint has a motor")
    if through_space:
        notes.append(f"{through_space} motors pull spatial tendons, which are linearised")
    return servos


def _pulls_joint(model: mujoco.MjModel, actuator: int) -> bool:
    """True for an actuator of a joint."""
    kinds = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    return mujoco.mjtTrn(model.actuator_trntype[actuator]) in kinds


def _servo(model: mujoco.MjModel, actuator: int, joints: dict[int, float]) -> Servo:
    """The motor of an actuator that pulls joints by these coefficients."""
    gear = float(model.actuator_gear[actuator, 0])
    kp = max(0.0, -float(model.actuator_biasprm[actuator, 1])) * gear**2
    has_range = bool(model.actuator_ctrllimited[actuator])
    gain = model.actuator_gainprm[actuator, 0]
    limit = 0.0
    if model.actuator_forcelimited[actuator]:
        limit = float(np.abs(model.actuator_forcerange[actuator]).max())
    if not limit and not kp and has_range:
        limit = float(np.abs(model.actuator_ctrlrange[actuator]).max() * abs(gain))
    reach = None
    is_position_servo = kp > 0 and gear == 1 and np.isclose(gain, kp)
    if is_position_servo and has_range and _pulls_joint(model, actuator):
        joint = int(model.actuator_trnid[actuator, 0])
        lower, upper = model.actuator_ctrlrange[actuator] - model.qpos0[model.jnt_qposadr[joint]]
        reach = (lower, upper)
    return Servo(joints, kp, limit * abs(gear), reach)
