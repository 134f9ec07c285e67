"""A hand as one JSON file with every field of `Hand`: written by `congrasp hands import`, editable
by the user.

The hands of the package are such files in `data/`. Their sources:

* `human`: joint centres, axes and capsule radii are MyoHand's (Apache-2.0, MyoHub;
  OpenSim-derived); so are its limits, widened where anatomy allows; phalanx masses of a mean adult
  hand. 20 anatomical finger joints, four for each finger. Wrist frame: origin at the lunate,
  fingers towards -y, thumb side +x, back of the hand +z. Fingers flex with positive angles, the
  thumb's `mp` and `ip` with negative ones.
* `allegro`: the right Allegro hand V3 by the maker's published models (BSD-2, SimLab 2016), with
  the maker's boxes and round fingertips as collision shapes and capsules of 23 mm for rewards and
  features. Gains of a PD controller that is common for this hand. Wrist frame: origin at the palm's
  mounting end, fingers towards +z, closing side +x, index finger on the side of +y; index and ring
  finger lean outwards by 5 degrees.
* `sharpa`: the right Sharpa Wave hand by the maker's published models (Apache-2.0, Sharpa Group),
  without their joint friction; capsules follow the published fits. Wrist frame: fingers towards +z,
  closing side +x, thumb and index finger on the side of +y. Positive `fe` angles flex.

Names of fields, units and frames are those of `common.hands.spec`. The file's text is part of the
run's configuration, of policies and of recorded episodes.
"""

import contextlib
import dataclasses
import functools
import hashlib
import itertools
import json
import pathlib
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.motors import motor_limits
from congrasp.common.hands.spec import Hand, Joint, Motor, Solid, chain_of
from congrasp.common.io.inputs import LONGEST_NAME, read_file
from congrasp.common.io.records import record_of

FORMAT = 1
MAX_BYTES = 1 << 20
"""Largest size of a hand file in bytes, and of its text in characters."""
_SHIPPED = pathlib.Path(__file__).with_name("data")
_MAX_LINKS = 64
_MAX_JOINTS = 64
"""Most joints, couplings or tendons of a hand, or joints of a tendon."""
_MAX_SHAPES = 16
"""Most capsules, or solids, of a link."""
_MAX_MAGNITUDE = 1e5
"""Largest magnitude of a number in its unit; the wrist of a real hand of 7 kg has a gain of 13,000
N/m.
"""
_REMEDY = "Make it with 'congrasp hands import', or compare it with docs/add-a-hand.md."
_ANGLE_TOLERANCE_RAD = 1e-5
"""Tolerance of angles in single precision, rad."""
_NORM_TOLERANCE = 1e-3
"""Tolerance of the norm of axes and quaternions."""
_RESERVED_LINKS = {"hand_base", "table", "anchor", "object", "hold", "world"}
"""Names of bodies of the scene, which no link may have."""
_WRIST_JOINTS = {"wrist_x", "wrist_y", "wrist_z", "wrist_rx", "wrist_ry", "wrist_rz"}
RESERVED_JOINTS = _WRIST_JOINTS | {"object", "hold"}
"""Names of joints, actuators and equalities of the scene, which no joint or tendon may have."""


def hand_text(hand: Hand) -> str:
    """Returns the text of the hand's file; `wide_pose`, `anatomical` and `solids` of links have no
    key if the hand has none.
    """
    fields = dataclasses.asdict(hand)
    del fields["text"]
    if hand.wide_pose is None:
        del fields["wide_pose"]
    if not hand.anatomical:
        del fields["anatomical"]
    for link in fields["links"]:
        if not link["solids"]:
            del link["solids"]
    return json.dumps({"format": FORMAT, **fields}, indent=1)


def hand_sha256(hand: Hand) -> str:
    """Returns the SHA-256 of the text of the hand's file (`hand_text`), in hexadecimal digits."""
    return hashlib.sha256(hand_text(hand).encode()).hexdigest()


def hand_from_text(text: str, source: str = "the hand file") -> Hand:
    """Returns the hand described by a file's text.

    Hands are compared by identity: the last 16 texts give the same object again.

    Args:
      text: content of the file.
      source: name of the file in errors.

    Raises:
      CongraspError: it is not JSON, a field is missing or has the wrong type, or the hand is not
        valid.
    """
    fields = None
    if len(text) <= MAX_BYTES:
        with contextlib.suppress(ValueError, RecursionError):
            fields = json.loads(text)
    if not isinstance(fields, dict):
        raise CongraspError(
            f"{source} is not JSON, or is longer than {MAX_BYTES} characters.", _REMEDY
        )
    version = fields.pop("format", None)
    if version != FORMAT:
        raise CongraspError(f"{source} has the format {version!r:.20}, not {FORMAT}.", _REMEDY)
    # Without spaces, since the text is sent with every episode.
    compact = json.dumps({"format": FORMAT, **fields}, separators=(",", ":"))
    try:
        return _parse_text(compact)
    except _HandFault as fault:
        raise CongraspError(f"{source}: {fault}.", _REMEDY) from None


class _HandFault(Exception):
    """First fault of a hand file, as a phrase."""


@functools.lru_cache(maxsize=16)
def _parse_text(text: str) -> Hand:
    """Parses the text of a hand file.

    Raises:
      _HandFault: it does not describe a valid hand.
    """
    fields = json.loads(text)
    del fields["format"]
    if "text" in fields:  # a field of `Hand`, not of its file
        raise _HandFault("not a hand, it has an unknown field 'text'")
    try:
        hand = record_of(Hand, {**fields, "text": text})
    except ValueError as error:
        raise _HandFault(f"not a hand, {str(error)[:200]}") from None
    faults = hand_faults(hand)
    if faults:
        raise _HandFault(faults[0])
    return hand


def read_hand(path: pathlib.Path) -> Hand:
    """Reads a hand file; see `hand_from_text`."""
    try:
        return hand_from_text(read_file(path, MAX_BYTES, _REMEDY).decode(), str(path))
    except UnicodeDecodeError:
        raise CongraspError(f"{path} is not JSON.", _REMEDY) from None


@functools.cache
def shipped_hand(name: str) -> Hand:
    """Returns a hand of the package, which is referenced by its name; always the same object."""
    return dataclasses.replace(read_hand(_SHIPPED / f"{name}.json"), text="")


def hand_faults(hand: Hand) -> list[str]:
    """Returns the faults of a hand, one phrase each.

    A fault that makes further checks impossible is the last of the list.
    """
    out_of_bounds = _out_of_bounds(hand)
    if out_of_bounds:
        return [out_of_bounds]
    faults = _name_faults(hand)
    if not hand.links or hand.links[0].joints or hand.links[0].parent:
        return [*faults, "the first link must be the palm, without a parent and without joints"]
    if not hand.joints:
        return [*faults, "it has no joints"]
    for i in range(len(hand.links)):
        faults += _link_faults(hand, i)
    for joint in hand.joints:
        faults += _joint_faults(joint)
    if not faults:
        faults += _coupling_faults(hand)
    if faults:
        return faults
    faults += _motor_faults(hand)
    faults += _pose_faults(hand, "open", hand.open_pose, hand.q_open)
    faults += _pose_faults(hand, "closed", hand.closed_pose, hand.q_closed)
    if hand.wide_pose is not None:
        faults += _pose_faults(hand, "wide", hand.wide_pose, hand.posed(hand.wide_pose))
    faults += _tip_faults(hand)
    if min(hand.object_scale, *dataclasses.astuple(hand.wrist)) <= 0:
        faults.append("the object scale and the numbers of the wrist must be above zero")
    return faults


def _name_faults(hand: Hand) -> list[str]:
    """Returns the faults of the names of the hand, its links and its joints."""
    faults = []
    links = [link.name for link in hand.links]
    joints = [joint.name for joint in hand.joints]
    if not hand.name.isidentifier() or len(hand.name) > LONGEST_NAME:
        faults.append(
            f"the name '{hand.name[: LONGEST_NAME + 1]}' must have letters, digits and underscores "
            f"alone, {LONGEST_NAME} at most, and not begin with a digit"
        )
    counts = Counter(links + joints)
    for name in sorted(counts):
        if counts[name] > 1 or not name:
            faults.append(f"the name '{name}' occurs more than once or is empty")
    reserved = (_RESERVED_LINKS & {*links}) | (RESERVED_JOINTS & {*joints})
    for name in sorted(reserved):
        faults.append(f"the name '{name}' is taken")
    return faults


def _link_faults(hand: Hand, i: int) -> list[str]:
    """Returns the faults of the link with this index."""
    faults = []
    link = hand.links[i]
    is_palm = i == 0
    names_before = [other.name for other in hand.links[:i]]
    if not is_palm and link.parent not in names_before:
        faults.append(f"the parent '{link.parent}' of '{link.name}' must precede it")
    if not is_palm and not link.joints:
        faults.append(f"the link '{link.name}' has no joint: make it part of its parent")
    if not link.capsules or any(capsule.radius <= 0 for capsule in link.capsules):
        faults.append(f"the link '{link.name}' needs capsules with radii above zero")
    if any(min(_sizes(solid)) <= 0 for solid in link.solids):
        faults.append(f"the link '{link.name}' has a solid without a size")
    if not all(_is_unit(solid.quaternion) for solid in link.solids):
        faults.append(f"the link '{link.name}' has a solid whose quaternion is not normalised")
    if link.mass <= 0 or link.contact_weight < 0:
        faults.append(
            f"the link '{link.name}' needs a mass above zero and a contact weight of at least zero"
        )
    return faults


def _joint_faults(joint: Joint) -> list[str]:
    """Returns the faults of a joint."""
    faults = []
    if joint.lower >= joint.upper:
        faults.append(
            f"the limits {joint.lower:g} and {joint.upper:g} of '{joint.name}' are in the wrong "
            f"order"
        )
    if not _is_unit(joint.axis):
        faults.append(f"the axis of '{joint.name}' is not a unit vector")
    if min(joint.damping, joint.armature) < 0:
        faults.append(f"damping and armature of '{joint.name}' must be at least zero")
    return faults


def _is_unit(numbers: Sequence[float]) -> bool:
    """True for a vector or quaternion of length one."""
    return abs(float(np.linalg.norm(numbers)) - 1) <= _NORM_TOLERANCE


def _motor_faults(hand: Hand) -> list[str]:
    """Returns the faults of the motors' gains."""
    faults = []
    for motor in hand.motors:
        if min(motor.kp, motor.torque_limit) <= 0 or motor.kv < 0:
            faults.append(
                f"kp and torque limit of '{motor.name}' must be above zero, and kv at least zero"
            )
    return faults


def _pose_faults(hand: Hand, pose: str, angles: dict[str, float], q: np.ndarray) -> list[str]:
    """Returns the faults of a pose.

    Args:
      hand: the hand.
      pose: name of the pose.
      angles: its angles by names of joints, rad.
      q: (F,) all angles, rad.
    """
    faults = []
    joints = {joint.name for joint in hand.joints}
    for name in sorted({*angles} - joints):
        faults.append(f"the {pose} pose names '{name}', which is not a joint")
    for joint, angle in zip(hand.joints, q, strict=True):
        if not joint.lower - _ANGLE_TOLERANCE_RAD <= angle <= joint.upper + _ANGLE_TOLERANCE_RAD:
            faults.append(f"'{joint.name}' is outside its limits in the {pose} pose")
    return faults


def _tip_faults(hand: Hand) -> list[str]:
    """Returns the faults of the fingertips."""
    tips = [link.name for link in hand.links if link.tip is not None]
    if hand.thumb not in tips or len(tips) < 2:
        return ["the thumb must be a link with a tip, and at least one other link needs one"]
    faults = []
    for tip, end in itertools.permutations(tips, 2):
        if tip in chain_of(hand, end):
            faults.append(f"the fingertip of '{tip}' is on the finger of '{end}'")
    return faults


def _coupling_faults(hand: Hand) -> list[str]:
    """Returns the faults of couplings and tendons."""
    faults = []
    joints = [joint.name for joint in hand.joints]
    followers = [coupling.joint for coupling in hand.couplings]
    for coupling in hand.couplings:
        are_joints = coupling.joint in joints and coupling.leader in joints
        has_one_leader = followers.count(coupling.joint) == 1
        leader_has_motor = coupling.leader not in followers
        if not are_joints or not has_one_leader or not leader_has_motor:
            faults.append(
                f"'{coupling.joint}' cannot follow '{coupling.leader}': one is not a joint, or "
                f"follows another"
            )
        if not coupling.ratio:
            faults.append(f"'{coupling.joint}' follows '{coupling.leader}' with the ratio zero")
    for tendon in hand.tendons:
        faults += _tendon_faults(hand, tendon)
    if faults:
        return faults
    lower, upper = motor_limits(hand)
    for motor, low, high in zip(hand.motors, lower, upper, strict=True):
        if not low < high:
            faults.append(f"the limits of the joints that '{motor.name}' moves leave it no range")
    return faults


def _tendon_faults(hand: Hand, tendon: Motor) -> list[str]:
    """Returns the faults of one of the hand's tendons."""
    faults = []
    joints = [joint.name for joint in hand.joints]
    followers = [coupling.joint for coupling in hand.couplings]
    pulled = Counter(itertools.chain.from_iterable(other.joints for other in hand.tendons))
    for name in tendon.joints:
        if name not in joints or name in followers or pulled[name] > 1:
            faults.append(
                f"the tendon '{tendon.name}' pulls '{name}', which is not a joint, follows "
                f"another, or has two tendons"
            )
            break
    if len(tendon.joints) < 2 or not all(tendon.joints.values()):
        faults.append(
            f"the tendon '{tendon.name}' needs at least two joints and nonzero coefficients"
        )
    names = [other.name for other in hand.tendons]
    is_taken = tendon.name in RESERVED_JOINTS | {*joints} or names.count(tendon.name) > 1
    if is_taken or not tendon.name:
        faults.append(f"the name '{tendon.name}' of a tendon is taken, or empty")
    return faults


def _out_of_bounds(hand: Hand) -> str:
    """Returns the fault of a hand that makes other checks impossible: too many parts, or a number
    that is not finite; empty without one.
    """
    if len(hand.links) > _MAX_LINKS or len(hand.joints) > _MAX_JOINTS:
        return f"it has more than {_MAX_LINKS} links or {_MAX_JOINTS} joints"
    counts = [len(hand.couplings), len(hand.tendons)]
    counts += [len(tendon.joints) for tendon in hand.tendons]
    if max(counts) > _MAX_JOINTS:
        return f"it has more than {_MAX_JOINTS} couplings, tendons or joints of a tendon"
    if any(max(len(link.capsules), len(link.solids)) > _MAX_SHAPES for link in hand.links):
        return f"it has a link of more than {_MAX_SHAPES} capsules or solids"
    fields = dataclasses.asdict(hand)
    del fields["text"]
    for number in _numbers(fields):
        if not abs(number) <= _MAX_MAGNITUDE:  # also true for NaN
            return (
                f"it holds {number:g}, which is not a finite number of at most {_MAX_MAGNITUDE:g}"
            )
    return ""


def _sizes(solid: Solid) -> tuple[float, ...]:
    """Returns the entries of a solid's size that its shape uses."""
    if solid.kind in ("cylinder", "capsule"):
        return solid.size[:2]
    return solid.size


def _numbers(value: Any) -> Iterator[float]:
    """Yields the numbers in fields, at any depth."""
    if isinstance(value, (int, float)):
        yield value
        return
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, (list, tuple)):
        for item in value:
            yield from _numbers(item)


HUMAN = shipped_hand("human")
"""The human right hand."""
