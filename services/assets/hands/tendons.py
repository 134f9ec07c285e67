"""Tendons of a model as linear combinations of its joints."""

import numpy as np

from congrasp.common.runtime.physics_library import mujoco

_MIN_LEVER_SHARE = 0.05
"""Share of a spatial tendon's largest lever that counts."""


def relative_limits(model: mujoco.MjModel, joint: int) -> np.ndarray:
    """Returns limits (2,) of a joint relative to the file's pose, rad."""
    return np.asarray(model.jnt_range[joint] - model.qpos0[model.jnt_qposadr[joint]])


def fixed_tendon(model: mujoco.MjModel, tendon: int) -> dict[int, float]:
    """Returns coefficients of a fixed tendon by joint; empty for a spatial one."""
    start = model.tendon_adr[tendon]
    wraps = range(start, start + model.tendon_num[tendon])
    coefficients = {}
    for wrap in wraps:
        if model.wrap_type[wrap] != mujoco.mjtWrap.mjWRAP_JOINT:
            return {}
        coefficients[int(model.wrap_objid[wrap])] = float(model.wrap_prm[wrap])
    return coefficients


def spatial_tendon(slopes: np.ndarray) -> dict[int, float]:
    """Returns coefficients of a spatial tendon by joint, without negligible ones.

    Args:
      slopes: (njnt,) its row of `tendon_slopes`.
    """
    smallest = _MIN_LEVER_SHARE * np.abs(slopes).max(initial=0.0)
    return {int(j): float(slopes[j]) for j in np.flatnonzero(np.abs(slopes) > smallest)}


def tendon_slopes(model: mujoco.MjModel) -> np.ndarray:
    """Returns changes (ntendon, njnt) of tendon lengths per joint angle, m/rad.

    Each is the mean over the joint's range, with the other joints at their centres.
    """
    slopes = np.zeros((model.ntendon, model.njnt))
    if not model.ntendon:
        return slopes
    data = mujoco.MjData(model)
    is_hinge = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    joints = np.flatnonzero(is_hinge & (model.jnt_limited > 0))
    addresses = model.jnt_qposadr[joints]
    data.qpos[addresses] = model.jnt_range[joints].mean(1)
    middle = data.qpos.copy()
    for joint, address in zip(joints, addresses, strict=True):
        span = np.ptp(model.jnt_range[joint])
        for end, sign in zip(model.jnt_range[joint], (-1, 1), strict=True):
            data.qpos[:] = middle
            data.qpos[address] = end
            mujoco.mj_fwdPosition(model, data)
            slopes[:, joint] += sign * data.ten_length / span
    return slopes
