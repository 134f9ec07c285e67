"""Generates constraint sets: headings, reference poses and wrist trajectories of one object for one
hand.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from congrasp.common.hands.spec import Hand
from congrasp.common.objects import store
from congrasp.common.objects.pool import object_scale, scale_objects
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import OURS
from congrasp.common.task.sampling.bank import ConstraintBank, rows_of
from congrasp.common.task.sampling.build import build_bank
from congrasp.common.task.sampling.set_file import FORMAT, MEANING, REGIONS
from congrasp.common.wire.codec import Message

_TRAINING_SHARE = 0.8
"""Share of the constraints that are for training; the others are held out."""


def make_sets(
    hand: Hand,
    task: TaskConfig,
    objects: Sequence[GraspObject],
    seed: int,
    bank: ConstraintBank | None = None,
) -> list[Message]:
    """Generates the constraint set of each object in the same way as training and evaluation.

    Args:
      hand: the hand.
      task: geometry of the approach.
      objects: the objects.
      seed: seed of the constraints.
      bank: an existing bank of these objects, scaled for the hand, whose reference poses are used.
        None builds one.

    Raises:
      CongraspError: see `build_bank`.
    """
    scaled_objects = scale_objects(hand, task, objects)
    if bank is None:
        all_constraints = dataclasses.replace(task, constraints=OURS)
        bank = build_bank(hand, all_constraints, scaled_objects, seed)
    scale = object_scale(hand, task)
    sets = []
    for obj, scaled, row in zip(objects, scaled_objects, rows_of(bank), strict=True):
        about = {"object_scale": scale, "object_digest": store.digest(obj)}
        sets.append(set_of(hand, row, scaled, seed, about))
    return sets


def set_of(
    hand: Hand,
    row: ConstraintBank,
    obj: GraspObject,
    seed: int,
    about: dict[str, Any] | None = None,
    *,
    pose_training: np.ndarray | None = None,
    heading_training: np.ndarray | None = None,
) -> Message:
    """Returns the constraint set of one object.

    Args:
      hand: the hand.
      row: row of the constraint bank, without the axis of the objects.
      obj: the object.
      seed: seed of the constraints.
      about: additional metadata of the file.
      pose_training: (M,) bool, references for training; by default the first 80 %, as references
        are arranged (`services.evaluate.references`).
      heading_training: (H,) bool, headings for training; by default 80 % drawn with the seed.
    """
    rests = _count_rests(row)
    allowed, back = _allowed_headings(row, rests)
    if pose_training is None:
        pose_training = for_training(row.pose_q.shape[1])
    if heading_training is None:
        heading_training = for_training(row.heading_position.shape[1], seed)
    arrays = {
        "surface/points": row.points,
        "surface/normals": row.normals,
        "surface/avoid": row.avoid,
        "rest": row.rest[:rests],
        "heading/position": row.heading_position,
        "heading/direction": row.heading_direction,
        "heading/cross": row.heading_cross,
        "heading/allowed": allowed,
        "heading/back": back,
        "pose/q": row.pose_q,
        "pose/position": row.pose_position,
        "pose/quaternion": row.pose_quaternion,
        "trajectory/position": row.trajectory_position,
        "trajectory/quaternion": row.trajectory_quaternion,
        "pose/allowed": row.pose_valid[:, :rests],
        "heading/training": _twice(heading_training),
        "pose/training": _twice(pose_training),
        "visual/vertices": np.asarray(obj.visual_vertices, np.float32),
        "visual/faces": np.asarray(obj.visual_faces, np.int32),
    }
    return Message(arrays, {**_description(hand, obj, seed), **(about or {})})


def _count_rests(row: ConstraintBank) -> int:
    """Number of an object's resting poses: the bank repeats them up to the most of any object."""
    repetitions = np.flatnonzero((row.rest[1:] == row.rest[0]).all(-1))
    if len(repetitions):
        return int(repetitions[0]) + 1
    return len(row.rest)


def _allowed_headings(row: ConstraintBank, rests: int) -> tuple[np.ndarray, np.ndarray]:
    """Headings that a row allows in its first R resting poses: (V, R, H) bool, and the distances
    back in m.
    """
    allowed = np.zeros((len(REGIONS), rests, row.heading_position.shape[1]), bool)
    back = np.zeros(allowed.shape, np.float32)
    for v, r in np.ndindex(allowed.shape[:2]):
        if v == 0 or row.has_affordance[r] or not row.avoid.any():
            allowed[v, r, row.heading_index[v, r]] = True
            back[v, r, row.heading_index[v, r]] = row.heading_back[v, r]
    return allowed, back


def _description(hand: Hand, obj: GraspObject, seed: int) -> dict[str, Any]:
    """Metadata of a set of an object that was not scaled."""
    return {
        "kind": "constraints",
        "format": FORMAT,
        "hand": hand.name,
        "hand_reference": hand.reference,
        "object": obj.name,
        "object_digest": store.digest(obj),
        "object_scale": 1.0,
        "object_mass": float(obj.mass),
        "seed": seed,
        "variants": list(REGIONS),
        "finger_joints": [joint.name for joint in hand.joints],
        "quaternions": "(w, x, y, z)",
        "object_frame": (
            "origin at the centre of mass, orientation of the object file, lengths times "
            "object_scale"
        ),
        "arrays": MEANING,
    }


def for_training(count: int, seed: int | None = None) -> np.ndarray:
    """(count,) bool, True for 80 % (rounded up): drawn with the seed or, without a seed, the first
    ones.
    """
    order = np.arange(count)
    if seed is not None:
        order = np.random.default_rng(seed).permutation(count)
    return np.asarray(order < np.ceil(_TRAINING_SHARE * count))


def _twice(training: np.ndarray) -> np.ndarray:
    """Repeats (M,) for both regions: (V, M)."""
    return np.tile(training, (len(REGIONS), 1))
