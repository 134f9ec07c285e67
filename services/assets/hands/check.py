"""Self-check of a hand before training: tests by geometry and physics whether it can grasp.

Every check is a line with a measurement and, if in doubt or failed, the field or option to change.
Palm, joints, opening and strength are computed from the hand's data; servos, overlaps and grips are
simulated (`trials`) in the physics of the full task.
"""

import functools
import json
import pathlib
from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.actors import stress as protocols
from congrasp.common.errors import CongraspError
from congrasp.common.hands import kinematics
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.mjcf import overlapping
from congrasp.common.hands.motors import tip_forces
from congrasp.common.hands.spec import Hand, chain_of
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import read_json
from congrasp.common.objects import procedural
from congrasp.common.objects.pool import HELD_OUT_SEED
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task import plausibility
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.settings import GRAVITY
from congrasp.services.assets.hands.trials import Grip, Response, closed_overlap, grips, responses

Verdict = Literal["passed", "doubt", "failed"]
# Distance of a finger's first joint from the palm, m: limits for doubt and failure
_APART = (
    0.03,
    0.06,
)
# Distance of the hand centre from the wrist in finger lengths: limits for doubt and failure
_REACH = (
    2.5,
    4.0,
)
_STAYS = 0.01  # least displacement of a fingertip by a closing joint, m
# Cosine between a closing fingertip's motion and its opponent: limits for doubt and failure
_ALONG = (
    -0.1,
    -0.3,
)
# Of a follower's turn: turn of its link in the palm's frame below which that is a parallel pad
_PARALLEL = 0.2
_GAP = 0.3, 0.5  # shares of the opening to which the fingertips close
_FITTING = 0.9, 0.6  # shares of the objects spanned by the opening
_CARRIED = 2.0, 1.0  # weights of a median object that friction carries
_OVERSHOOT = 0.25, 0.6  # shares of a step
_UNREST = 0.05, 0.5  # rad/s
_ERROR = 0.1, 0.6  # shares of a step, 0.6 s after it
_OVERLAP = 0.004, 0.012  # m
_POOL = 48
_LARGEST = 1 << 20  # limit of a file of findings, bytes
_NEAR = 0.25  # share of the range from the open to the closed pose at which joints are tested


class Finding(NamedTuple):
    """Result of one check."""

    check: str
    verdict: Verdict
    measured: str
    remedy: str = ""
    """Remedy; empty if it passed."""

    def __str__(self) -> str:
        """Formats it as one line."""
        remedy = f" -> {self.remedy}" if self.remedy else ""
        return f"{self.verdict:7s} {self.check:9s} {self.measured}{remedy}"


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
    found = [_palm(hand), *_joints(hand), _opening(hand), _strength(hand)]
    found += [*_servos(hand, responses(hand, task, threads)), _open_overlap(hand)]
    found.append(_closed_overlap(closed_overlap(hand, task, threads)))
    held = grips(hand, task, threads)
    sound = all(finding.verdict != "failed" for finding in found)
    return Checked(found + [_grip(grip, sound) for grip in held], held)


def write_findings(path: pathlib.Path, findings: Sequence[Finding]) -> None:
    """Writes findings as JSON for `read_findings`."""
    write_atomically(
        path,
        json.dumps({"findings": [finding._asdict() for finding in findings]}, indent=1).encode(),
    )


def read_findings(path: pathlib.Path) -> list[Finding]:
    """Reads a file of `write_findings`; raises a CongraspError if it cannot be read."""
    remedy = "Create it with 'congrasp hands check --json'."
    try:
        return [Finding(**fields) for fields in read_json(path, _LARGEST, remedy)["findings"]]
    except (LookupError, TypeError) as error:
        raise CongraspError(f"{path} holds no self-check: {error}.", remedy) from None


def _verdict(value: float, doubt: float, fail: float) -> Verdict:
    """Verdict by two limits, of which `fail` is the stricter."""
    worse = (lambda limit: value > limit) if fail > doubt else (lambda limit: value < limit)
    return "failed" if worse(fail) else "doubt" if worse(doubt) else "passed"


def _worst(*verdicts: Verdict) -> Verdict:
    """Returns the worst of some verdicts."""
    order: tuple[Verdict, ...] = ("failed", "doubt", "passed")
    return min(verdicts, key=order.index)


def _finding(check: str, verdict: Verdict, measured: str, remedy: str) -> Finding:
    """Returns a finding, with its remedy if it needs one."""
    return Finding(check, verdict, measured, "" if verdict == "passed" else remedy)


@functools.partial(jax.jit, static_argnums=0)
def _tips(hand: Hand, q: jax.Array) -> jax.Array:
    """Fingertips (N, G, 3), thumb first, for finger angles (N, F), wrist frame, m."""
    return kinematics.keypoints(hand, kinematics.link_transforms(hand, q))[:, len(hand.links) :]


@functools.cache
def _objects() -> list[GraspObject]:
    """Objects typical for the hand, at the human hand's scale."""
    seeds = range(HELD_OUT_SEED, HELD_OUT_SEED + _POOL)
    return list(map(procedural.generate, seeds, procedural.family_turns(_POOL, HELD_OUT_SEED)))


def _palm(hand: Hand) -> Finding:
    """Checks that the fingers are on the palm, and the wrist is near them."""
    capsules = hand.links[0].capsules
    points = np.concatenate([np.linspace(one.start, one.end, 20) for one in capsules])
    radii = np.repeat([one.radius for one in capsules], 20)
    links = {link.name: link for link in hand.links}
    apart, lengths = [], []
    for i, tip in zip(hand.tip_links, hand.keypoints[len(hand.links) :], strict=True):
        root = np.array(links[chain_of(hand, hand.links[i].name)[0]].joints[0].anchor)
        apart.append(float((np.linalg.norm(points - root, axis=-1) - radii).min()))
        lengths.append(float(np.linalg.norm(tip - root)))
    reach = float(np.linalg.norm(grasp_frame(hand).center) / np.mean(lengths))
    farthest = int(np.argmax(apart))
    return _finding(
        "palm",
        _worst(_verdict(apart[farthest], *_APART), _verdict(reach, *_REACH)),
        f"fingers begin within {100 * max(apart[farthest], 0.0):.1f} cm of it "
        f"({hand.fingers[farthest]}), the hand "
        f"centre is {reach:.1f} fingers' lengths from the wrist",
        f"import with --palm and the body that carries '{hand.finger_roots[farthest]}', or correct "
        f"the capsules "
        f"of '{hand.links[0].name}'",
    )


def _joints(hand: Hand) -> list[Finding]:
    """Checks that closing brings the fingertips together, as a whole and joint by joint."""
    way = hand.q_closed - hand.q_open
    shares = np.linspace(0, 1, 21)
    tips = np.asarray(_tips(hand, jnp.asarray(hand.q_open + shares[:, None] * way, jnp.float32)))
    gaps = np.linalg.norm(tips[:, 1:].mean(1) - tips[:, 0], axis=-1)
    found = [
        _finding(
            "closing",
            _verdict(float(gaps.min() / gaps[0]), *_GAP),
            f"thumb and fingers close from {100 * gaps[0]:.1f} to {100 * gaps.min():.1f} cm",
            "close further: increase the angles of closed_pose, and turn the thumb towards the "
            "fingers in open_pose",
        )
    ]
    leaders = {coupling.joint: coupling.leader for coupling in hand.couplings}
    moved = 0
    for j, joint in enumerate(hand.joints):
        finger = int(hand.link_fingers[hand.joint_links[j]])
        cosine, path = _approach(hand, j, finger) if finger >= 0 else (0.0, 0.0)
        if path < _STAYS:
            continue
        moved += 1
        if (verdict := _verdict(cosine, *_ALONG)) != "passed":
            limit = hand.lower[j] if way[j] > 0 else hand.upper[j]
            parallel = joint.name in leaders and _keeps_parallel(hand, j, leaders)
            found.append(
                Finding(
                    "joint",
                    "doubt" if parallel else verdict,
                    f"closing '{joint.name}' moves the tip of '{hand.fingers[finger]}' "
                    f"{100 * path:.1f} cm, at a "
                    f"cosine of {cosine:.2f} to its opponent",
                    "change its ratio or its leader in couplings"
                    + ", unless it keeps a pad parallel" * parallel
                    if joint.name in leaders
                    else (
                        f"turn its axis, or close it towards {limit:.2f} in closed_pose; omit it "
                        f"if it spreads"
                    ),
                )
            )
    if not moved:
        found.append(
            Finding("joints", "failed", "no joint closes", "give closed_pose the angles of a fist")
        )
    elif len(found) == 1:
        found.append(
            Finding(
                "joints", "passed", f"each of the {moved} that close brings its fingertip nearer"
            )
        )
    return found


def _keeps_parallel(hand: Hand, follower: int, leaders: dict[str, str]) -> bool:
    """True if the turns of the joints with a follower's leader, up to its link, cancel, as those of
    a parallel pad.
    """
    way, leader = hand.q_closed - hand.q_open, leaders[hand.joints[follower].name]
    chain = chain_of(hand, hand.links[hand.joint_links[follower]].name)
    turns = [
        way[j] * np.array(joint.axis)
        for j, joint in enumerate(hand.joints)
        if hand.links[hand.joint_links[j]].name in chain
        and leaders.get(joint.name, joint.name) == leader
    ]
    return bool(np.linalg.norm(np.sum(turns, axis=0)) < _PARALLEL * abs(way[follower]))


def _approach(hand: Hand, joint: int, finger: int) -> tuple[float, float]:
    """Closing direction of a joint: cosine to the opponent of its fingertip, and path length.

    The cosine is that between the motion of a fingertip as one joint begins to close and the
    direction to its opponent (for the thumb the mean of the others). The path length in m covers
    the whole closing motion.
    """
    way, small = float(hand.q_closed[joint] - hand.q_open[joint]), 0.01
    cosines, levers = [], []
    for share in (0.0, _NEAR):
        q = np.tile(hand.q_open + share * (hand.q_closed - hand.q_open), (2, 1))
        q[:, joint] += np.sign(way) * np.array([-small, small])
        tips = np.asarray(_tips(hand, jnp.asarray(q, jnp.float32)))
        middle = tips.mean(0)
        opponent = middle[1:].mean(0) if finger == 0 else middle[0]
        towards, step = opponent - middle[finger], tips[1, finger] - tips[0, finger]
        length = float(np.linalg.norm(step))
        levers.append(length / (2 * small))
        cosines.append(float(step @ towards) / max(length * float(np.linalg.norm(towards)), 1e-12))
    return float(np.mean(cosines)), abs(way) * float(np.mean(levers))


def _opening(hand: Hand) -> Finding:
    """Checks that the open hand spans its objects."""
    radii = hand.keypoint_radii[len(hand.links) :]
    clear = grasp_frame(hand).opening - float(radii[0] + radii[1:].mean())
    widths = hand.object_scale * np.array([np.ptp(obj.points, axis=0).min() for obj in _objects()])
    share = float((widths < clear).mean())
    scale = hand.object_scale * clear / float(np.quantile(widths, _FITTING[0]))
    return _finding(
        "opening",
        _verdict(share, *_FITTING),
        f"{100 * clear:.1f} cm clear; {100 * share:.0f} % of the objects (x {hand.object_scale:g}) "
        f"have a narrower "
        f"side, {100 * np.median(widths):.1f} cm in the middle",
        f"object_scale {max(np.floor(10 * scale) / 10, 0.1):.1f} (import with --object-scale), or "
        f"widen the open_pose",
    )


def _strength(hand: Hand) -> Finding:
    """Checks that the fingertips press hard enough to carry a median object by friction."""
    forces = tip_forces(hand)
    mass = hand.object_scale**3 * float(np.median([obj.mass for obj in _objects()]))
    weight, carried = GRAVITY * mass, 2 * float(min(forces[0], forces[1:].sum()))
    return _finding(
        "strength",
        _verdict(carried / weight, *_CARRIED),
        f"fingertips press with {forces.min():.1f} to {forces.max():.1f} N and carry {carried:.1f} "
        f"N by friction; "
        f"a median object weighs {weight:.1f} N",
        "check torque_limit (N.m) of the motors, or use a smaller object_scale",
    )


def _servos(hand: Hand, found: list[Response]) -> list[Finding]:
    """Checks that motors reach their targets and come to rest."""
    bad = []
    for motor, one in zip(hand.motors, found, strict=True):
        shakes = _worst(_verdict(one.overshoot, *_OVERSHOOT), _verdict(one.unrest, *_UNREST))
        misses = _verdict(one.error, *_ERROR)
        verdict: Verdict = "failed" if one.diverged else _worst(shakes, misses)
        if verdict != "passed":
            remedy = (
                f"raise kv ({motor.kv:g}) or the armature of what it moves, or lower kp "
                f"({motor.kp:g})"
            )
            if shakes == "passed" and not one.diverged:
                remedy = (
                    f"raise kp ({motor.kp:g}), or lower kv ({motor.kv:g}) and the damping of what "
                    f"it moves"
                )
            text = "breaks the simulation" if one.diverged else _response(one)
            bad.append(Finding("servo", verdict, f"'{motor.name}' {text}", remedy))
    overshoot, error = max(one.overshoot for one in found), max(one.error for one in found)
    return bad or [
        Finding(
            "servos",
            "passed",
            f"{len(found)} motors follow a step, overshoot {100 * overshoot:.0f} %, "
            f"{100 * error:.0f} % off in the end",
        )
    ]


def _response(one: Response) -> str:
    """Describes a response."""
    return (
        f"overshoots a step by {100 * one.overshoot:.0f} %, oscillates at {one.unrest:.2f} rad/s "
        f"half a second "
        f"later, and is then {100 * one.error:.0f} % off"
    )


def _open_overlap(hand: Hand) -> Finding:
    """Checks that different fingers of the open hand do not overlap; housings of one finger may
    nest at knuckles.
    """
    names = [link.name for link in hand.links]
    depths = np.asarray(_depths(hand, np.array(hand.q_open, np.float32)))
    deepest, pair = 0.0, ""
    for pair_of in overlapping(hand):
        if any(
            one in ("", names[0], *chain_of(hand, other)) for one, other in (pair_of, pair_of[::-1])
        ):
            continue
        first, second = (
            np.flatnonzero(hand.capsule_links == names.index(name)) for name in pair_of
        )
        depth = float(depths[np.ix_(first, second)].max())
        if depth > deepest:
            deepest, pair = depth, f" ({pair_of[0]} and {pair_of[1]}, which then do not collide)"
    return _finding(
        "open",
        _verdict(deepest, *_OVERLAP),
        f"fingers overlap by at most {1e3 * deepest:.1f} mm{pair}",
        "widen the open_pose, or make the capsules of the two smaller",
    )


@functools.partial(jax.jit, static_argnums=0)
def _depths(hand: Hand, q: jax.Array) -> jax.Array:
    """Overlaps (C, C) in m of all pairs of capsules at finger angles (F,), compiled as one
    program.
    """
    start, end = jnp.moveaxis(kinematics.capsules(hand, kinematics.link_transforms(hand, q)), -2, 0)
    apart = plausibility.segment_distance(start[:, None], end[:, None], start, end)
    return hand.capsule_radii[:, None] + hand.capsule_radii - apart


def _closed_overlap(depth: float) -> Finding:
    """Checks that links of the closing empty hand do not penetrate each other."""
    return _finding(
        "closed",
        _verdict(depth, *_OVERLAP),
        f"links of the closing hand overlap by {1e3 * depth:.1f} mm",
        "end the closed_pose earlier, or reduce torque_limit or the capsules that meet",
    )


def _grip(grip: Grip, sound: bool) -> Finding:
    """Checks that an object is held, lifted, and survives six pushes."""
    lifted, half, newton = (grip.survived[name] for name in protocols.SURVIVAL)
    verdict: Verdict = "passed" if half else "doubt" if grip.held else "failed"
    fate = (
        "falls"
        if not grip.held
        else "is held, but lost when lifted"
        if not lifted
        else "is lifted, but lost in six pushes of half its weight"
        if not half
        else (
            f"survives lift and six pushes of half its weight{', and six of 1 N' if newton else ''}"
        )
    )
    size = f"{100 * grip.width:.1f} cm wide, {1e3 * grip.obj.mass:.0f} g"
    return _finding(
        grip.obj.name,
        verdict,
        f"{size}: {fate}; {int(grip.touching.sum())} links touch it",
        "close further (closed_pose), turn the thumb towards the fingers (open_pose), or use a "
        "smaller object_scale"
        if sound
        else "repair the failures above first",
    )
