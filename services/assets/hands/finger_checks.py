"""Checks that every last link and every motor belongs to a finger, and moves as the hand closes."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common.hands import kinematics
from congrasp.common.hands.motors import transmission
from congrasp.common.hands.spec import Hand, chain_of
from congrasp.services.assets.hands.findings import Finding, Verdict
from congrasp.services.assets.hands.linkages import linkage_pairs

_SIDE_BRANCH = 0.5
"""Links of a branch without a tip, as a share of those of the finger next to it, up to which it is
part of a linkage.
"""
_MIN_PATH = 0.01
"""Displacement of a fingertip between the open and the closed pose, m."""
_STILL = 0.05
"""Motion of a joint between the two poses, as a share of its range, up to which it rests."""
_PARALLEL = 0.9
"""Cosine between the axes of two joints above which they bend a finger in the same plane."""
_CLOSING_POSES = 21
"""Poses between the open and the closed one."""


def finger_findings(hand: Hand) -> list[Finding]:
    """Checks that last links carry tips, motors move tips, and fingers close with all their joints.

    Joints that spread or turn a finger may rest.
    """
    findings = _links_without_tip(hand)
    findings += _motors_without_tip(hand)
    findings += _tips_at_rest(hand)
    findings += _bending_joints_at_rest(hand)
    if not findings:
        measured = (
            f"{len(hand.fingers)} with a tip on every last link; each of the {len(hand.motors)} "
            f"motors moves one, and all bend as the hand closes"
        )
        findings.append(Finding("fingers", "passed", measured))
    return findings


def _links_without_tip(hand: Hand) -> list[Finding]:
    """Findings on last links that carry no tip; short branches of a finger are doubtful.

    Links that drive a finger from beside it need none.
    """
    driving = {link for link, _ in linkage_pairs(hand)}
    parents = {link.parent for link in hand.links}
    tips = [hand.links[i].name for i in hand.tip_links]
    findings = []
    for link in hand.links:
        if link.name in parents or link.name in tips or link.name in driving:
            continue
        verdict: Verdict = "doubt" if _is_side_branch(hand, link.name) else "failed"
        findings.append(
            Finding(
                "finger",
                verdict,
                f"the last link '{link.name}' belongs to no finger: it has no tip",
                "give it a 'tip' in the hand file if it is a finger's",
            )
        )
    return findings


def _is_side_branch(hand: Hand, link: str) -> bool:
    """True if a link's branch, from where it leaves a finger, is much shorter than that finger."""
    chain = chain_of(hand, link)
    tip_chains = [chain_of(hand, hand.links[i].name) for i in hand.tip_links]
    shared = max(_common_length(chain, tip_chain) for tip_chain in tip_chains)
    beyond = [
        len(tip_chain) - shared
        for tip_chain in tip_chains
        if _common_length(chain, tip_chain) == shared
    ]
    return shared > 0 and len(chain) - shared <= _SIDE_BRANCH * max(beyond)


def _common_length(first: tuple[str, ...], second: tuple[str, ...]) -> int:
    """Number of links that two chains have in common, from the palm."""
    pairs = itertools.takewhile(lambda pair: pair[0] == pair[1], zip(first, second, strict=False))
    return len(list(pairs))


def _moved_tips(hand: Hand) -> np.ndarray:
    """(M, G) bool: the tips that each motor moves."""
    motor_of_joint = transmission(hand).motor
    moved = np.zeros((len(hand.motors), len(hand.fingers)), bool)
    for joint, motor in enumerate(motor_of_joint):
        moved[motor] |= hand.moved_tips[joint]
    return moved


def _motors_without_tip(hand: Hand) -> list[Finding]:
    """Findings on motors that move no tip."""
    findings = []
    for motor, moved in zip(hand.motors, _moved_tips(hand), strict=True):
        if moved.any():
            continue
        findings.append(
            Finding(
                "motor",
                "failed",
                f"'{motor.name}' belongs to no finger: it moves no tip",
                "give the last link that it moves a 'tip', or let its joint lead those of a finger "
                "in couplings",
            )
        )
    return findings


def _tips_at_rest(hand: Hand) -> list[Finding]:
    """Findings on fingertips that do not move from the open to the closed pose."""
    way = hand.q_closed - hand.q_open
    shares = np.linspace(0, 1, _CLOSING_POSES)[:, None]
    tips = _tips(hand, hand.q_open + shares * way)
    paths = np.linalg.norm(np.diff(tips, axis=0), axis=-1).sum(0)
    findings = []
    for finger, path in zip(hand.fingers, paths, strict=True):
        if path >= _MIN_PATH:
            continue
        findings.append(
            Finding(
                "finger",
                "failed",
                f"the tip of '{finger}' moves {1e3 * path:.0f} mm from the open to the closed pose",
                "close its joints in closed_pose",
            )
        )
    return findings


def _bending_joints_at_rest(hand: Hand) -> list[Finding]:
    """Findings on joints that rest as the hand closes, while parallel ones bend their finger."""
    way = hand.q_closed - hand.q_open
    rests = np.abs(way) <= _STILL * (hand.upper - hand.lower)
    findings = []
    for j in np.flatnonzero(rests):
        joint = hand.joints[j]
        for k in _parallel_joints(hand, int(j)):
            if rests[k]:
                continue
            turn = float(np.sign(way[k]) * np.sign(np.dot(joint.axis, hand.joints[k].axis)))
            limit = hand.upper[j] if turn > 0 else hand.lower[j]
            path = abs(float(limit - hand.q_open[j])) * _lever(hand, int(j))
            if path < _MIN_PATH:
                continue
            findings.append(
                Finding(
                    "joint",
                    "failed",
                    f"'{joint.name}' rests as the hand closes, though its axis is parallel to that "
                    f"of '{hand.joints[k].name}', which bends the same finger",
                    f"close it towards {limit:.2f} in closed_pose",
                )
            )
            break
    return findings


def _parallel_joints(hand: Hand, joint: int) -> list[int]:
    """Other joints of the same finger with parallel axes, in the straight hand."""
    finger_of_joint = hand.link_fingers[hand.joint_links]
    finger = finger_of_joint[joint]
    if finger < 0:
        return []
    axis = np.array(hand.joints[joint].axis)
    parallel = []
    for other in np.flatnonzero(finger_of_joint == finger):
        if other != joint and abs(axis @ np.array(hand.joints[other].axis)) > _PARALLEL:
            parallel.append(int(other))
    return parallel


def _lever(hand: Hand, joint: int) -> float:
    """Greatest distance of a fingertip from the axis of a joint that moves it, straight hand, m."""
    tips = hand.keypoints[len(hand.links) :][hand.moved_tips[joint]]
    offsets = tips - np.array(hand.joints[joint].anchor)
    distances = np.linalg.norm(np.cross(hand.joints[joint].axis, offsets), axis=-1)
    return float(distances.max(initial=0.0))


def _tips(hand: Hand, q: np.ndarray) -> np.ndarray:
    """Fingertips (N, G, 3), thumb first, for finger angles (N, F), wrist frame, m."""
    return np.asarray(_compiled_tips(hand, jnp.asarray(q, jnp.float32)))


@functools.partial(jax.jit, static_argnums=0)
def _compiled_tips(hand: Hand, q: jax.Array) -> jax.Array:
    """The same as one program."""
    return kinematics.keypoints(hand, kinematics.link_transforms(hand, q))[:, len(hand.links) :]
