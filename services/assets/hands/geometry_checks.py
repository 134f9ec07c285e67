"""Checks of a hand by its data: palm, closing joints, opening, strength and overlaps."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common.hands import kinematics
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.mjcf import overlapping
from congrasp.common.hands.motors import tip_forces
from congrasp.common.hands.spec import Hand, chain_of
from congrasp.common.objects import procedural
from congrasp.common.objects.pool import HELD_OUT_SEED
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task import plausibility
from congrasp.common.task.settings import GRAVITY
from congrasp.services.assets.hands.findings import Finding, Limits, finding_of, worst
from congrasp.services.assets.hands.linkages import linkage_pairs

OVERLAP = Limits(0.004, 0.012)
"""Overlap of links, m."""
_PALM_DISTANCE = Limits(0.03, 0.06)
"""Distance of a finger's first joint from the palm, m."""
_CENTER_DISTANCE = Limits(2.5, 4.0)
"""Distance of the hand centre from the wrist in finger lengths."""
_COSINE = Limits(-0.1, -0.3)
"""Cosine between a closing fingertip's motion and its opponent."""
_CLOSED_SHARE = Limits(0.3, 0.5)
"""Share of the opening to which the fingertips close."""
_FITTING_SHARE = Limits(0.9, 0.6)
"""Share of the objects spanned by the opening."""
_CARRIED_WEIGHTS = Limits(2.0, 1.0)
"""Weights of a median object that friction carries."""
_MIN_PATH = 0.01
"""Displacement of a fingertip by a closing joint, m."""
_MAX_PARALLEL_SHARE = 0.2
"""Turn of a link in the palm's frame, as a share of a follower's, below which it is a parallel pad.
"""
_PALM_SAMPLES = 20
"""Points on a capsule of the palm."""
_CLOSING_POSES = 21
"""Poses between the open and the closed one."""
_TESTED_SHARES = (0.0, 0.25)
"""Shares of the range from the open to the closed pose at which joints are tested."""
_STEP = 0.01
"""Half step of a joint for its fingertip's motion, rad."""
_OBJECTS = 48
"""Objects that the opening and the strength are compared with."""


def palm_finding(hand: Hand) -> Finding:
    """Checks that the fingers are on the palm, and the wrist is near them."""
    distances = _finger_distances(hand)
    farthest = int(np.argmax(distances))
    lengths = _finger_lengths(hand)
    center_distance = float(np.linalg.norm(grasp_frame(hand).center) / np.mean(lengths))
    return finding_of(
        "palm",
        worst(
            _PALM_DISTANCE.verdict(distances[farthest]), _CENTER_DISTANCE.verdict(center_distance)
        ),
        f"fingers begin within {100 * max(distances[farthest], 0.0):.1f} cm of it "
        f"({hand.fingers[farthest]}), the hand centre is {center_distance:.1f} fingers' lengths "
        f"from the wrist",
        f"import with --palm and the body that carries '{hand.finger_roots[farthest]}', or correct "
        f"the capsules of '{hand.links[0].name}'",
    )


def _finger_bases(hand: Hand) -> list[np.ndarray]:
    """Positions (3,) of the fingers' first joints, thumb first, m."""
    links = {link.name: link for link in hand.links}
    bases = []
    for i in hand.tip_links:
        root = chain_of(hand, hand.links[i].name)[0]
        bases.append(np.array(links[root].joints[0].anchor))
    return bases


def _finger_distances(hand: Hand) -> list[float]:
    """Distance of each finger's first joint from the palm's capsules, m; negative inside."""
    capsules = hand.links[0].capsules
    segments = [np.linspace(one.start, one.end, _PALM_SAMPLES) for one in capsules]
    points = np.concatenate(segments)
    radii = np.repeat([capsule.radius for capsule in capsules], _PALM_SAMPLES)
    distances = []
    for base in _finger_bases(hand):
        distances.append(float((np.linalg.norm(points - base, axis=-1) - radii).min()))
    return distances


def _finger_lengths(hand: Hand) -> list[float]:
    """Distance of each fingertip from the finger's first joint, m."""
    tips = hand.keypoints[len(hand.links) :]
    bases = _finger_bases(hand)
    return [float(np.linalg.norm(tip - base)) for tip, base in zip(tips, bases, strict=True)]


def joint_findings(hand: Hand) -> list[Finding]:
    """Checks that closing brings the fingertips together, as a whole and joint by joint."""
    findings = [_closing_finding(hand)]
    closing = 0
    for j in range(len(hand.joints)):
        finger = int(hand.link_fingers[hand.joint_links[j]])
        if finger < 0:
            continue
        cosine, path = _approach(hand, j, finger)
        if path < _MIN_PATH:
            continue
        closing += 1
        if _COSINE.verdict(cosine) != "passed":
            findings.append(_opening_joint(hand, j, cosine, path))
    if not closing:
        findings.append(
            Finding("joints", "failed", "no joint closes", "give closed_pose the angles of a fist")
        )
    elif len(findings) == 1:
        findings.append(
            Finding(
                "joints", "passed", f"each of the {closing} that close brings its fingertip nearer"
            )
        )
    return findings


def _closing_finding(hand: Hand) -> Finding:
    """Checks that closing brings thumb and fingers together."""
    way = hand.q_closed - hand.q_open
    shares = np.linspace(0, 1, _CLOSING_POSES)[:, None]
    tips = np.asarray(_tips(hand, jnp.asarray(hand.q_open + shares * way, jnp.float32)))
    gaps = np.linalg.norm(tips[:, 1:].mean(1) - tips[:, 0], axis=-1)
    return finding_of(
        "closing",
        _CLOSED_SHARE.verdict(float(gaps.min() / gaps[0])),
        f"thumb and fingers close from {100 * gaps[0]:.1f} to {100 * gaps.min():.1f} cm",
        "close further: increase the angles of closed_pose, and turn the thumb towards the "
        "fingers in open_pose",
    )


def _opening_joint(hand: Hand, j: int, cosine: float, path: float) -> Finding:
    """The finding on a joint that moves its fingertip away from its opponent.

    Args:
      hand: the hand.
      j: the joint.
      cosine: between the motion and the direction to the opponent.
      path: length of the motion, m.
    """
    joint = hand.joints[j]
    finger = hand.fingers[int(hand.link_fingers[hand.joint_links[j]])]
    leaders = {coupling.joint: coupling.leader for coupling in hand.couplings}
    verdict = _COSINE.verdict(cosine)
    if joint.name in leaders:
        remedy = "change its ratio or its leader in couplings"
        if _keeps_parallel(hand, j, leaders):
            verdict = "doubt"
            remedy += ", unless it keeps a pad parallel"
    else:
        other_limit = hand.lower[j] if hand.q_closed[j] > hand.q_open[j] else hand.upper[j]
        remedy = (
            f"turn its axis, or close it towards {other_limit:.2f} in closed_pose; omit it if it "
            f"spreads"
        )
    return Finding(
        "joint",
        verdict,
        f"closing '{joint.name}' moves the tip of '{finger}' {100 * path:.1f} cm, at a cosine of "
        f"{cosine:.2f} to its opponent",
        remedy,
    )


def _keeps_parallel(hand: Hand, follower: int, leaders: dict[str, str]) -> bool:
    """True if the turns of a follower's link by the motor of its leader cancel.

    Args:
      hand: the hand.
      follower: the joint that follows another.
      leaders: leader of each follower.
    """
    way = hand.q_closed - hand.q_open
    leader = leaders[hand.joints[follower].name]
    chain = chain_of(hand, hand.links[hand.joint_links[follower]].name)
    turns = []
    for j, joint in enumerate(hand.joints):
        is_in_chain = hand.links[hand.joint_links[j]].name in chain
        if is_in_chain and leaders.get(joint.name, joint.name) == leader:
            turns.append(way[j] * np.array(joint.axis))
    total = np.linalg.norm(np.sum(turns, axis=0))
    return bool(total < _MAX_PARALLEL_SHARE * abs(way[follower]))


def _approach(hand: Hand, joint: int, finger: int) -> tuple[float, float]:
    """Closing direction of a joint: cosine to the opponent of its fingertip, and path length.

    The cosine is that between the motion of a fingertip as one joint begins to close and the
    direction to its opponent (for the thumb the mean of the others). The path length in m covers
    the whole closing motion.
    """
    way = hand.q_closed - hand.q_open
    joint_way = float(way[joint])
    cosines = []
    levers = []
    for share in _TESTED_SHARES:
        q = np.tile(hand.q_open + share * way, (2, 1))
        q[:, joint] += np.sign(joint_way) * np.array([-_STEP, _STEP])
        tips = np.asarray(_tips(hand, jnp.asarray(q, jnp.float32)))
        middle = tips.mean(0)
        opponent = middle[1:].mean(0) if finger == 0 else middle[0]
        towards = opponent - middle[finger]
        motion = tips[1, finger] - tips[0, finger]
        length = float(np.linalg.norm(motion))
        product = max(length * float(np.linalg.norm(towards)), 1e-12)
        cosines.append(float(motion @ towards) / product)
        levers.append(length / (2 * _STEP))
    return float(np.mean(cosines)), abs(joint_way) * float(np.mean(levers))


@functools.partial(jax.jit, static_argnums=0)
def _tips(hand: Hand, q: jax.Array) -> jax.Array:
    """Fingertips (N, G, 3), thumb first, for finger angles (N, F), wrist frame, m."""
    return kinematics.keypoints(hand, kinematics.link_transforms(hand, q))[:, len(hand.links) :]


@functools.cache
def _objects() -> list[GraspObject]:
    """Objects typical for the hand, at the human hand's scale."""
    seeds = range(HELD_OUT_SEED, HELD_OUT_SEED + _OBJECTS)
    families = procedural.family_turns(_OBJECTS, HELD_OUT_SEED)
    return list(map(procedural.generate, seeds, families))


def opening_finding(hand: Hand) -> Finding:
    """Checks that the open hand spans its objects."""
    radii = hand.keypoint_radii[len(hand.links) :]
    clear = grasp_frame(hand).opening - float(radii[0] + radii[1:].mean())
    narrow_sides = np.array([np.ptp(obj.points, axis=0).min() for obj in _objects()])
    widths = hand.object_scale * narrow_sides
    share = float((widths < clear).mean())
    scale = hand.object_scale * clear / float(np.quantile(widths, _FITTING_SHARE.doubt))
    proposed_scale = max(np.floor(10 * scale) / 10, 0.1)
    return finding_of(
        "opening",
        _FITTING_SHARE.verdict(share),
        f"{100 * clear:.1f} cm clear; {100 * share:.0f} % of the objects (x {hand.object_scale:g}) "
        f"have a narrower side, {100 * np.median(widths):.1f} cm in the middle",
        f"object_scale {proposed_scale:.1f} (import with --object-scale), or widen the open_pose",
    )


def strength_finding(hand: Hand) -> Finding:
    """Checks that the fingertips press hard enough to carry a median object by friction."""
    forces = tip_forces(hand)
    mass = hand.object_scale**3 * float(np.median([obj.mass for obj in _objects()]))
    weight = GRAVITY * mass
    carried = 2 * float(min(forces[0], forces[1:].sum()))
    return finding_of(
        "strength",
        _CARRIED_WEIGHTS.verdict(carried / weight),
        f"fingertips press with {forces.min():.1f} to {forces.max():.1f} N and carry {carried:.1f} "
        f"N by friction; a median object weighs {weight:.1f} N",
        "check torque_limit (N.m) of the motors, or use a smaller object_scale",
    )


def open_overlap_finding(hand: Hand) -> Finding:
    """Checks that different fingers of the open hand do not overlap.

    Housings of one finger may nest at knuckles, and a linkage at its pins.
    """
    pinned = linkage_pairs(hand)
    names = [link.name for link in hand.links]
    depths = np.asarray(_depths(hand, np.array(hand.q_open, np.float32)))
    deepest = 0.0
    pair = ""
    for first, second in overlapping(hand):
        is_pinned = (first, second) in pinned or (second, first) in pinned
        if is_pinned or _are_of_one_finger(hand, first, second):
            continue
        first_capsules = np.flatnonzero(hand.capsule_links == names.index(first))
        second_capsules = np.flatnonzero(hand.capsule_links == names.index(second))
        depth = float(depths[np.ix_(first_capsules, second_capsules)].max())
        if depth > deepest:
            deepest = depth
            pair = f" ({first} and {second}, which then do not collide)"
    return finding_of(
        "open",
        OVERLAP.verdict(deepest),
        f"fingers overlap by at most {1e3 * deepest:.1f} mm{pair}",
        "widen the open_pose, or make the capsules of the two smaller",
    )


def _are_of_one_finger(hand: Hand, first: str, second: str) -> bool:
    """True if one of two links carries the other, or is the palm."""
    palm = hand.links[0].name
    if {first, second} & {"", palm}:
        return True
    return first in chain_of(hand, second) or second in chain_of(hand, first)


@functools.partial(jax.jit, static_argnums=0)
def _depths(hand: Hand, q: jax.Array) -> jax.Array:
    """Overlaps (C, C) in m of all pairs of capsules at finger angles (F,), as one program."""
    start, end = jnp.moveaxis(kinematics.capsules(hand, kinematics.link_transforms(hand, q)), -2, 0)
    distances = plausibility.segment_distance(start[:, None], end[:, None], start, end)
    return hand.capsule_radii[:, None] + hand.capsule_radii - distances
