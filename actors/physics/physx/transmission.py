"""Motors and couplings of a compiled hand: the servo of each joint, and joints that follow
others.
"""

from typing import NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.runtime.physics_library import mujoco


class Servo(NamedTuple):
    """A position servo that pulls a joint, alone or as one of a tendon's joints."""

    actuator: int
    """Index of the actuator, whose target it follows."""
    coefficient: float
    """Position of the actuator per position of the joint."""
    kp: float
    kv: float
    limit: float
    """Greatest force or torque of the actuator."""


class Coupling(NamedTuple):
    """A joint that follows another: q = offset + ratio * q of the leader."""

    follower: int
    """Index of the joint."""
    leader: int
    ratio: float
    offset: float
    """rad."""


def check_transmission(model: mujoco.MjModel) -> None:
    """Raises a CongraspError if PhysX cannot simulate a motor or a coupling of the hand."""
    servos_of(model)
    couplings_of(model)


def servos_of(model: mujoco.MjModel) -> dict[int, Servo]:
    """Returns the servos by the indices of the joints that they pull.

    Raises:
      CongraspError: two motors pull one joint.
    """
    servos: dict[int, Servo] = {}
    for actuator in range(model.nu):
        for joint, coefficient in _pulled_joints(model, actuator).items():
            if joint in servos:
                raise CongraspError(
                    f"The 'physx' engine drives a joint by one motor, but two pull "
                    f"'{model.joint(joint).name}'.",
                    "Pass --physics native.",
                )
            servos[joint] = Servo(
                actuator,
                coefficient,
                kp=float(model.actuator_gainprm[actuator, 0]),
                kv=float(-model.actuator_biasprm[actuator, 2]),
                limit=float(model.actuator_forcerange[actuator, 1]),
            )
    return servos


def couplings_of(model: mujoco.MjModel) -> list[Coupling]:
    """Returns the couplings of joints, which are linear, each between neighbours.

    Raises:
      CongraspError: other joints are between a follower and its leader, where PhysX's tendons are
        wrong during motions.
    """
    couplings = []
    for equality in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT):
        offset, ratio = model.eq_data[equality, :2].tolist()
        follower = int(model.eq_obj1id[equality])
        leader = int(model.eq_obj2id[equality])
        if not _are_neighbours(model, follower, leader):
            raise CongraspError(
                f"The 'physx' engine couples neighbouring joints only, but "
                f"'{model.joint(follower).name}' follows '{model.joint(leader).name}'.",
                "Pass --physics native.",
            )
        couplings.append(Coupling(follower, leader, ratio, offset))
    return couplings


def _are_neighbours(model: mujoco.MjModel, first: int, second: int) -> bool:
    """True if one of two joints carries the other, or one link carries both."""
    carrier_of_first = _carrier(model, first)
    carrier_of_second = _carrier(model, second)
    if carrier_of_first == carrier_of_second:
        return True
    return carrier_of_first == ("joint", second) or carrier_of_second == ("joint", first)


def _carrier(model: mujoco.MjModel, joint: int) -> tuple[str, int]:
    """The joint that moves the link on which a joint is mounted, or the body if none does."""
    body = model.jnt_bodyid[joint]
    if joint > model.body_jntadr[body]:
        return "joint", joint - 1
    parent = int(model.body_parentid[body])
    if model.body_jntnum[parent] == 0:
        return "body", parent
    return "joint", int(model.body_jntadr[parent] + model.body_jntnum[parent] - 1)


def _pulled_joints(model: mujoco.MjModel, actuator: int) -> dict[int, float]:
    """Joints that an actuator pulls, with their coefficients."""
    target = int(model.actuator_trnid[actuator, 0])
    if model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT:
        return {target: 1.0}
    first = model.tendon_adr[target]
    wraps = slice(first, first + model.tendon_num[target])
    joints = model.wrap_objid[wraps].tolist()
    coefficients = model.wrap_prm[wraps].tolist()
    return dict(zip(joints, coefficients, strict=True))
