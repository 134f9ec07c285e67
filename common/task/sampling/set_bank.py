"""Constraint banks of episodes from constraint sets."""

from collections.abc import Sequence

import numpy as np

from congrasp.common.config import Split
from congrasp.common.errors import CongraspError
from congrasp.common.task.sampling.bank import ConstraintBank, feasible_indices, stacked
from congrasp.common.task.sampling.set_file import DEFAULT_MASS, allowed_in_split
from congrasp.common.wire.codec import Message


def bank_of(sets: Sequence[Message], split: Split = "all") -> ConstraintBank:
    """Builds the constraint bank of episodes from constraint sets of one hand.

    Sets may differ in their numbers of resting poses, headings and references: shorter ones are
    repeated.

    Args:
      sets: N constraint sets.
      split: selects all constraints, those for training, or the held-out ones.

    Raises:
      CongraspError: the sets are of different hands or sizes, or one of them has no heading left.
    """
    first = sets[0]
    for constraints in sets:
        _check_hand(constraints, first)
        _check_sizes(constraints, first)
    return stacked([_row(constraints, split) for constraints in sets])


def _check_hand(constraints: Message, first: Message) -> None:
    """Raises a CongraspError for a set of another hand than the first set."""
    meta = constraints.meta
    for key in ("hand", "finger_joints"):
        if meta[key] != first.meta[key]:
            raise CongraspError(
                f"The constraint set of '{meta['object']}' is for the hand '{meta['hand']}', but "
                f"that of '{first.meta['object']}' is for '{first.meta['hand']}'.",
                "Use only constraint sets of the same hand.",
            )


def _check_sizes(constraints: Message, first: Message) -> None:
    """Raises a CongraspError for a set with other numbers of points or waypoints."""
    for name in ("surface/points", "trajectory/position"):
        size = constraints.arrays[name].shape[-2]
        first_size = first.arrays[name].shape[-2]
        if size != first_size:
            raise CongraspError(
                f"The constraint sets of '{constraints.meta['object']}' and "
                f"'{first.meta['object']}' differ in {name}: {size} and {first_size}.",
                "Generate both with the same settings.",
            )


def _row(constraints: Message, split: Split) -> ConstraintBank:
    """Converts a set to a row of a constraint bank: constraints of the split in resting poses with
    a heading.
    """
    arrays = constraints.arrays
    heading_allowed = allowed_in_split(constraints, "heading", split)
    pose_allowed = allowed_in_split(constraints, "pose", split)
    usable = np.flatnonzero(heading_allowed[0].any(-1))
    if len(usable) == 0:
        raise CongraspError(
            f"The constraint set of '{constraints.meta['object']}' has no heading ({split}) in any "
            f"resting pose.",
            "Remove the set, or use another split.",
        )
    heading_allowed = heading_allowed[:, usable]
    index = feasible_indices(heading_allowed)
    back = arrays["heading/back"][:, usable]
    mass = constraints.meta.get("object_mass", DEFAULT_MASS)
    return ConstraintBank(
        points=arrays["surface/points"],
        avoid=arrays["surface/avoid"],
        normals=arrays["surface/normals"],
        rest=arrays["rest"][usable],
        heading_position=arrays["heading/position"],
        heading_direction=arrays["heading/direction"],
        heading_cross=arrays["heading/cross"],
        heading_index=index.astype(np.int32),
        heading_back=np.take_along_axis(back, index, -1),
        pose_q=arrays["pose/q"],
        pose_position=arrays["pose/position"],
        pose_quaternion=arrays["pose/quaternion"],
        trajectory_position=arrays["trajectory/position"],
        trajectory_quaternion=arrays["trajectory/quaternion"],
        pose_valid=pose_allowed[:, usable],
        has_affordance=arrays["surface/avoid"].any() & heading_allowed[1].any(-1),
        weight=np.float32(1.0),
        mass=np.float32(mass),
        renewable=np.bool_(False),
        grasps=np.zeros(2, int),
    )
