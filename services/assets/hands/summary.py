"""Text of an imported hand: its joints, motors and proposals."""

import numpy as np

from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.motors import motor_limits
from congrasp.common.hands.spec import Hand, chain_of
from congrasp.services.assets.hands.model_files import Proposal

_HEADER = "joint                     from      to    open  closed      kp      kv   limit"


def describe(proposal: Proposal) -> list[str]:
    """Describes the import and its proposals, as lines of text."""
    hand = proposal.hand
    lines = _overview(hand, proposal.palm)
    lines += ["", _HEADER]
    lines += _joint_lines(hand)
    for coupling in hand.couplings:
        lines.append(
            f"{coupling.joint:22s} = {coupling.offset:.3f} + {coupling.ratio:.3f} {coupling.leader}"
        )
    lines += _tendon_lines(hand)
    lines.append("rad, N.m/rad, N.m.s/rad, N.m")
    lines += [f"note: {note}" for note in proposal.notes]
    return lines


def _overview(hand: Hand, palm: str) -> list[str]:
    """Lines of the hand's palm, fingers and grasp frame."""
    frame = grasp_frame(hand)
    mass = sum(link.mass for link in hand.links)
    thumb, *fingers = [chain_of(hand, hand.links[i].name) for i in hand.tip_links]
    lines = [
        f"hand         {hand.name}: {len(hand.joints)} joints, {len(hand.motors)} motors, "
        f"{len(hand.links)} links, {mass:.3f} kg",
        f"palm         {palm}",
        f"thumb        {' - '.join(thumb)}",
    ]
    lines += [f"finger       {' - '.join(finger)}" for finger in fingers]
    lines += [
        f"heading v    {_vector_text(frame.heading)} in the palm's frame, cross-finger axis w "
        f"{_vector_text(frame.cross)}",
        f"hand centre  {_vector_text(frame.center)} m, opening {100 * frame.opening:.1f} cm: "
        f"objects x {hand.object_scale:g}",
    ]
    return lines


def _joint_lines(hand: Hand) -> list[str]:
    """A line for each joint, below `_HEADER`."""
    lines = []
    for joint, opened, closed in zip(hand.joints, hand.q_open, hand.q_closed, strict=True):
        figures = (joint.lower, joint.upper, opened, closed, joint.kp, joint.kv, joint.torque_limit)
        columns = "".join(f"{figure:8.3f}" for figure in figures)
        lines.append(f"{joint.name:22s}{columns}")
    return lines


def _tendon_lines(hand: Hand) -> list[str]:
    """A line for each motor of several joints."""
    lines = []
    lower, upper = motor_limits(hand)
    for motor, low, high in zip(hand.motors, lower, upper, strict=True):
        if len(motor.joints) < 2:
            continue
        pulls = " + ".join(f"{share:g} {name}" for name, share in motor.joints.items())
        gains = f"kp {motor.kp:.3f}, kv {motor.kv:.3f}, limit {motor.torque_limit:.3f}"
        lines.append(f"one motor for {pulls}, from {low:.3f} to {high:.3f}: {gains}")
    return lines


def _vector_text(vector: np.ndarray) -> str:
    """Formats a vector (3,) with three digits."""
    numbers = ", ".join(f"{x:.3f}" for x in vector)
    return f"({numbers})"
