"""Checks of a hand by its trials in the physics of the full task: servos, closing and grips."""

from congrasp.actors import stress as protocols
from congrasp.common.hands.spec import Hand, Motor
from congrasp.services.assets.hands.findings import Finding, Limits, Verdict, finding_of, worst
from congrasp.services.assets.hands.geometry_checks import OVERLAP
from congrasp.services.assets.hands.trials import Grip, Response

_OVERSHOOT = Limits(0.25, 0.6)
"""Overshoot as a share of a step."""
_UNREST = Limits(0.05, 0.5)
"""Speed at rest, rad/s."""
_ERROR = Limits(0.1, 0.6)
"""Error 0.6 s after a step, as a share of it."""


def servo_findings(hand: Hand, responses: list[Response]) -> list[Finding]:
    """Checks that motors reach their targets and come to rest.

    Args:
      hand: the hand.
      responses: response of each motor to a step.

    Returns:
      A finding for each motor that does not; or one that all do.
    """
    findings = []
    for motor, response in zip(hand.motors, responses, strict=True):
        finding = _servo_finding(motor, response)
        if finding.verdict != "passed":
            findings.append(finding)
    if findings:
        return findings
    overshoot = max(response.overshoot for response in responses)
    error = max(response.error for response in responses)
    return [
        Finding(
            "servos",
            "passed",
            f"{len(responses)} motors follow a step, overshoot {100 * overshoot:.0f} %, "
            f"{100 * error:.0f} % off in the end",
        )
    ]


def _servo_finding(motor: Motor, response: Response) -> Finding:
    """The finding on one motor."""
    stiffen = (
        f"raise kv ({motor.kv:g}) or the armature of what it moves, or lower kp ({motor.kp:g})"
    )
    if response.diverged:
        return Finding("servo", "failed", f"'{motor.name}' breaks the simulation", stiffen)
    shaking = worst(_OVERSHOOT.verdict(response.overshoot), _UNREST.verdict(response.unrest))
    remedy = stiffen
    if shaking == "passed":
        remedy = (
            f"raise kp ({motor.kp:g}), or lower kv ({motor.kv:g}) and the damping of what it moves"
        )
    return finding_of(
        "servo",
        worst(shaking, _ERROR.verdict(response.error)),
        f"'{motor.name}' overshoots a step by {100 * response.overshoot:.0f} %, oscillates at "
        f"{response.unrest:.2f} rad/s half a second later, and is then "
        f"{100 * response.error:.0f} % off",
        remedy,
    )


def closed_overlap_finding(depth: float) -> Finding:
    """Checks that links of the closing empty hand do not penetrate each other.

    Args:
      depth: the largest overlap, m.
    """
    return finding_of(
        "closed",
        OVERLAP.verdict(depth),
        f"links of the closing hand overlap by {1e3 * depth:.1f} mm",
        "end the closed_pose earlier, or reduce torque_limit or the capsules that meet",
    )


def grip_finding(grip: Grip, *, is_sound: bool) -> Finding:
    """Checks that an object is held, lifted, and survives six pushes.

    Args:
      grip: the best grip of the object.
      is_sound: False if another check failed, which explains this failure.
    """
    lifted, survives_half_weight, survives_newton = (
        grip.survived[name] for name in protocols.SURVIVAL_NAMES
    )
    verdict: Verdict
    if not grip.held:
        verdict = "failed"
        fate = "falls"
    elif not lifted:
        verdict = "doubt"
        fate = "is held, but lost when lifted"
    elif not survives_half_weight:
        verdict = "doubt"
        fate = "is lifted, but lost in six pushes of half its weight"
    else:
        verdict = "passed"
        fate = "survives lift and six pushes of half its weight"
        if survives_newton:
            fate += ", and six of 1 N"
    remedy = "repair the failures above first"
    if is_sound:
        remedy = (
            "close further (closed_pose), turn the thumb towards the fingers (open_pose), or use a "
            "smaller object_scale"
        )
    return finding_of(
        grip.obj.name,
        verdict,
        f"{100 * grip.width:.1f} cm wide, {1e3 * grip.obj.mass:.0f} g: {fate}; "
        f"{int(grip.touching.sum())} links touch it",
        remedy,
    )
