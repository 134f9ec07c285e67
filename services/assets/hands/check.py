"""Self-check of a hand before training: tests by geometry and physics whether it can grasp.

Every check is a line with a measurement and, if in doubt or failed, the field or option to change.
Fingers (`finger_checks`), palm, joints, opening and strength (`geometry_checks`) are computed from
the hand's data. Servos, overlaps and grips are simulated (`trials`) in the physics of the full task
(`physics_checks`).
"""

from typing import NamedTuple

from congrasp.common.hands.spec import Hand
from congrasp.common.task.config import TaskConfig
from congrasp.services.assets.hands import finger_checks, geometry_checks, physics_checks
from congrasp.services.assets.hands.findings import Finding
from congrasp.services.assets.hands.trials import Grip, closed_overlap, grips, responses


class Checked(NamedTuple):
    """Self-check of a hand."""

    findings: list[Finding]
    grips: list[Grip]

    @property
    def failed(self) -> bool:
        """True if any check failed."""
        return any(finding.verdict == "failed" for finding in self.findings)


def check_hand(hand: Hand, task: TaskConfig, threads: int) -> Checked:
    """Checks a hand.

    Args:
      hand: the hand.
      task: the full task for it (`services.train.presets`), whose physics is used.
      threads: threads of the physics.
    """
    findings = [geometry_checks.palm_finding(hand)]
    findings += finger_checks.finger_findings(hand)
    findings += geometry_checks.joint_findings(hand)
    findings.append(geometry_checks.opening_finding(hand))
    findings.append(geometry_checks.strength_finding(hand))
    findings += physics_checks.servo_findings(hand, responses(hand, task, threads))
    findings.append(geometry_checks.open_overlap_finding(hand))
    overlap = closed_overlap(hand, task, threads)
    findings.append(physics_checks.closed_overlap_finding(overlap))
    best_grips = grips(hand, task, threads)
    is_sound = all(finding.verdict != "failed" for finding in findings)
    for grip in best_grips:
        findings.append(physics_checks.grip_finding(grip, is_sound=is_sound))
    return Checked(findings, best_grips)
