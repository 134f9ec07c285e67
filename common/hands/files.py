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

import dataclasses
import functools
import itertools
import json
import pathlib
from collections.abc import Iterator
from typing import Any

import dacite
import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.motors import motor_limits
from congrasp.common.hands.spec import Hand, Solid, chain_of
from congrasp.common.io.inputs import LONGEST_NAME, read_file

FORMAT = 1
MAX_BYTES = 1 << 20
"""Largest size of a hand file in bytes."""
_SHIPPED = pathlib.Path(__file__).with_name("data")
_LINKS, _JOINTS, _CAPSULES = 64, 64, 16  # limits for a hand, a hand and a link
_LARGEST = 1e5  # bound of all numbers; the wrist of a real hand of 7 kg has a gain of 13,000
_REMEDY = "Make it with 'congrasp hands import', or compare it with docs/add-a-hand.md."
_ROUNDING = 1e-5  # rad, of single precision
_TAKEN = {"hand_base", "table", "anchor", "object", "hold", "world"}
_WRIST = {"wrist_x", "wrist_y", "wrist_z", "wrist_rx", "wrist_ry", "wrist_rz"}
TAKEN_JOINTS = _WRIST | {"object", "hold"}
"""Names reserved for joints, actuators and equalities of the scene: no joint or tendon may have
them.
"""


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


def hand_from_text(text: str, source: str = "the hand file") -> Hand:
    """Returns the hand described by a file's text; the same text gives the same object.

    Args:
      text: content of the file.
      source: name of the file in errors.

    Raises:
      CongraspError: it is not JSON, a field is missing or has the wrong type, or the hand is not
        valid.
    """
    try:
        fields = json.loads(text) if len(text) <= MAX_BYTES else None
    except (ValueError, RecursionError):
        fields = None
    if not isinstance(fields, dict):
        raise CongraspError(
            f"{source} is not JSON, or is longer than {MAX_BYTES} characters.", _REMEDY
        )
    found = fields.pop("format", None)
    if found != FORMAT:
        raise CongraspError(f"{source} has the format {found!r:.20}, not {FORMAT}.", _REMEDY)
    # Without spaces, since the text is sent with every episode.
    hand, wrong = _described(json.dumps({"format": FORMAT, **fields}, separators=(",", ":")))
    if hand is None or wrong:
        raise CongraspError(f"{source}: {wrong}.", _REMEDY)
    return hand


@functools.lru_cache(maxsize=16)
def _described(text: str) -> tuple[Hand | None, str]:
    """Parses a hand file's text; returns the hand, or None and the fault."""
    fields = json.loads(text)
    del fields["format"]
    try:
        hand = dacite.from_dict(
            Hand, {**fields, "text": text}, dacite.Config(strict=True, cast=[tuple, float])
        )
    except (dacite.DaciteError, TypeError, ValueError, OverflowError) as error:
        return None, f"not a hand, {str(error)[:200]}"
    return hand, next(iter(faults(hand)), "")


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


def faults(hand: Hand) -> list[str]:  # noqa: C901
    """Returns the faults of a hand, one phrase each."""
    if too_much := _out_of_bounds(hand):
        return [too_much]
    found: list[str] = []
    names = [link.name for link in hand.links]
    joints = [joint.name for joint in hand.joints]
    if not hand.name.isidentifier() or len(hand.name) > LONGEST_NAME:
        found.append(
            f"the name '{hand.name}' has characters other than letters, digits and underscores"
        )
    for name in sorted(
        {name for name in names + joints if (names + joints).count(name) > 1 or not name}
    ):
        found.append(f"the name '{name}' occurs more than once or is empty")
    found += [
        f"the name '{name}' is taken"
        for name in sorted((_TAKEN & {*names}) | (TAKEN_JOINTS & {*joints}))
    ]
    if not hand.links or hand.links[0].joints or hand.links[0].parent:
        return [*found, "the first link must be the palm, without a parent and without joints"]
    if not joints:
        return [*found, "it has no joints"]
    for i, link in enumerate(hand.links):
        if i and link.parent not in names[:i]:
            found.append(f"the parent '{link.parent}' of '{link.name}' must precede it")
        if i and not link.joints:
            found.append(f"the link '{link.name}' has no joint: make it part of its parent")
        if not link.capsules or any(capsule.radius <= 0 for capsule in link.capsules):
            found.append(f"the link '{link.name}' needs capsules with radii above zero")
        if any(min(_sizes(solid)) <= 0 for solid in link.solids):
            found.append(f"the link '{link.name}' has a solid without a size")
        if any(abs(float(np.linalg.norm(solid.quaternion)) - 1) > 1e-3 for solid in link.solids):
            found.append(f"the link '{link.name}' has a solid whose quaternion is not normalised")
        if not link.mass > 0 or link.contact_weight < 0:
            found.append(
                f"the link '{link.name}' needs a mass above zero and a contact weight of at least "
                f"zero"
            )
    for joint in hand.joints:
        if not joint.lower < joint.upper:
            found.append(
                f"the limits {joint.lower:g} and {joint.upper:g} of '{joint.name}' are in the "
                f"wrong order"
            )
        if abs(float(np.linalg.norm(joint.axis)) - 1) > 1e-3:
            found.append(f"the axis of '{joint.name}' is not a unit vector")
        if min(joint.damping, joint.armature) < 0:
            found.append(f"damping and armature of '{joint.name}' must be at least zero")
    if found := found or _coupling_faults(hand):
        return found
    for motor in hand.motors:
        if min(motor.kp, motor.torque_limit) <= 0 or motor.kv < 0:
            found.append(
                f"kp and torque limit of '{motor.name}' must be above zero, and kv at least zero"
            )
    for pose, named, q in (
        ("open", hand.open_pose, hand.q_open),
        ("closed", hand.closed_pose, hand.q_closed),
    ):
        found += [
            f"the {pose} pose names '{name}', which is not a joint"
            for name in sorted({*named} - {*joints})
        ]
        for joint, angle in zip(hand.joints, q, strict=True):
            if not joint.lower - _ROUNDING <= angle <= joint.upper + _ROUNDING:
                found.append(f"'{joint.name}' is outside its limits in the {pose} pose")
    tips = [link.name for link in hand.links if link.tip is not None]
    if hand.thumb not in tips or len(tips) < 2:
        found.append("the thumb must be a link with a tip, and at least one other link needs one")
    elif not found:
        found += [
            f"the fingertip of '{tip}' is on the finger of '{end}'"
            for tip, end in itertools.permutations(tips, 2)
            if tip in chain_of(hand, end)
        ]
    if not min(hand.object_scale, *dataclasses.astuple(hand.wrist)) > 0:
        found.append("the object scale and the numbers of the wrist must be above zero")
    return found


def _coupling_faults(hand: Hand) -> list[str]:
    """Returns the faults of couplings and tendons."""
    joints = [joint.name for joint in hand.joints]
    followers = [coupling.joint for coupling in hand.couplings]
    pulled = [name for tendon in hand.tendons for name in tendon.joints]
    tendons = [tendon.name for tendon in hand.tendons]
    found = []
    for x in hand.couplings:
        if (
            x.joint not in joints
            or x.leader not in joints
            or x.leader in followers
            or followers.count(x.joint) > 1
        ):
            found.append(
                f"'{x.joint}' cannot follow '{x.leader}': one is not a joint, or follows another"
            )
        if not x.ratio:
            found.append(f"'{x.joint}' follows '{x.leader}' with the ratio zero")
    for tendon in hand.tendons:
        odd = [
            name
            for name in tendon.joints
            if name not in joints or name in followers or pulled.count(name) > 1
        ]
        if odd:
            found.append(
                f"the tendon '{tendon.name}' pulls '{odd[0]}', which is not a joint, follows "
                f"another, or has two "
                "tendons"
            )
        if len(tendon.joints) < 2 or not all(tendon.joints.values()):
            found.append(
                f"the tendon '{tendon.name}' needs at least two joints and nonzero coefficients"
            )
        if (
            tendon.name in TAKEN_JOINTS | {*joints}
            or tendons.count(tendon.name) > 1
            or not tendon.name
        ):
            found.append(f"the name '{tendon.name}' of a tendon is taken, or empty")
    if not found:
        lower, upper = motor_limits(hand)
        found += [
            f"the limits of the joints that '{motor.name}' moves leave it no range"
            for motor, low, high in zip(hand.motors, lower, upper, strict=True)
            if not low < high
        ]
    return found


def _out_of_bounds(hand: Hand) -> str:
    """Returns why a hand is not valid at all (numbers that are not finite, too many parts), or an
    empty string.
    """
    if len(hand.links) > _LINKS or len(hand.joints) > _JOINTS:
        return f"it has more than {_LINKS} links or {_JOINTS} joints"
    if (
        max(
            len(hand.couplings), *(len(tendon.joints) for tendon in hand.tendons), len(hand.tendons)
        )
        > _JOINTS
    ):
        return f"it has more than {_JOINTS} couplings, tendons or joints of a tendon"
    if any(max(len(link.capsules), len(link.solids)) > _CAPSULES for link in hand.links):
        return f"it has a link of more than {_CAPSULES} capsules or solids"
    fields = dataclasses.asdict(hand)
    del fields["text"]
    for number in _numbers(fields):
        if not abs(number) <= _LARGEST:
            return f"it holds {number:g}, which is not a finite number of at most {_LARGEST:g}"
    return ""


def _sizes(solid: Solid) -> tuple[float, ...]:
    """Returns the entries of a solid's size that its shape uses."""
    return solid.size[:2] if solid.kind in ("cylinder", "capsule") else solid.size


def _numbers(value: Any) -> Iterator[float]:
    """Yields the numbers in fields, at any depth."""
    if isinstance(value, (int, float)):
        yield value
    elif isinstance(value, (dict, list, tuple)):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _numbers(item)


HUMAN = shipped_hand("human")
"""The human right hand."""
