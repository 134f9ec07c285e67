"""Constraint sets as files: headings, reference poses and wrist trajectories of one object for one hand."""

import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from actors.taskset import TaskSet, build_taskset
from common.config import TaskConfig
from common.errors import CongraspError
from common.files import write_atomically
from common.hands.spec import Hand
from common.objects import store
from common.objects.spec import GraspObject
from common.wire.codec import Message, decode, encode

SUFFIX = ".constraints.safetensors"
VARIANTS = ("whole surface", "O+")
"""The axis V: constraints for the whole surface, and for the graspable region alone."""
_FORMAT = 1
_MEANING = {
    "surface/points": "(P, 3) m, object frame",
    "surface/minus": "(P,) bool, the point belongs to the non-graspable region O-",
    "rest": "(R, 7) resting poses in the world, position (m) and quaternion; the table's top is at z = 0",
    "heading/position": "(V, H, 3) m, object frame: where the hand's centre should be",
    "heading/direction": "(V, H, 3) unit, object frame: the way the hand moves",
    "heading/cross": "(V, H, 3) unit, object frame: along the hand's cross-finger axis",
    "heading/allowed": "(V, R, H) bool, the table leaves room for the heading",
    "heading/back": "(V, R, H) m by which the position moves back along the direction to stay clear of the table",
    "pose/q": "(V, M, F) rad, finger joints",
    "pose/position": "(V, M, 3) m, wrist in the object frame",
    "pose/quaternion": "(V, M, 4) wrist frame to object frame",
    "trajectory/position": "(V, M, K, 3) m, wrist waypoints in the object frame; trajectory m ends at pose m",
    "trajectory/quaternion": "(V, M, K, 4) wrist frame to object frame",
    "pose/allowed": "(V, R, M) bool, the table leaves room for the pose and its trajectory",
    "visual/vertices": "(n, 3) m, object frame",
    "visual/faces": "(m, 3) indices of vertices",
}


def make_sets(hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], seed: int) -> list[Message]:
    """The constraint set of each object, as training and evaluation make it.

    Raises:
      CongraspError: an object has no heading that the hand can reach in any resting pose.
    """
    taskset = TaskSet(*(np.asarray(field) for field in build_taskset(hand, task, objects, seed)))
    return [_of_object(hand, taskset, n, obj, seed) for n, obj in enumerate(objects)]


def _of_object(hand: Hand, taskset: TaskSet, n: int, obj: GraspObject, seed: int) -> Message:
    row = TaskSet(*(field[n] for field in taskset))
    # The task set fills an object's resting poses up to the most of any object by repeating them.
    again = np.flatnonzero((row.rest[1:] == row.rest[0]).all(-1))
    rests = int(again[0]) + 1 if len(again) else len(row.rest)
    allowed = np.zeros((len(VARIANTS), rests, row.heading_position.shape[1]), bool)
    back = np.zeros(allowed.shape, np.float32)
    for v, r in np.ndindex(allowed.shape[:2]):
        if v == 0 or row.has_affordance[r] or not row.minus.any():
            allowed[v, r, row.heading_index[v, r]] = True
            back[v, r, row.heading_index[v, r]] = row.heading_back[v, r]
    arrays = {
        "surface/points": row.points,
        "surface/minus": row.minus,
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
        "visual/vertices": np.asarray(obj.visual_vertices, np.float32),
        "visual/faces": np.asarray(obj.visual_faces, np.int32),
    }
    meta: dict[str, Any] = {
        "kind": "constraints",
        "format": _FORMAT,
        "hand": hand.name,
        "object": obj.name,
        "object_digest": store.digest(obj),
        "seed": seed,
        "variants": list(VARIANTS),
        "finger_joints": [joint.name for joint in hand.joints],
        "quaternions": "(w, x, y, z)",
        "object_frame": "origin at the centre of mass, orientation of the object file",
        "arrays": _MEANING,
    }
    return Message(arrays, meta)


def save(constraints: Message, folder: pathlib.Path) -> pathlib.Path:
    """Writes a set under its object's name; returns the file."""
    path = folder / f"{constraints.meta['object']}{SUFFIX}"
    write_atomically(path, encode(constraints))
    return path


def load(path: pathlib.Path) -> Message:
    """Reads a set.

    Raises:
      CongraspError: no such file, another kind of file, or damaged content.
    """
    remedy = "Make it anew with 'congrasp constraints generate'."
    try:
        message = decode(path.read_bytes())
    except OSError as error:
        raise CongraspError(f"The constraint set {path} cannot be read: {error.strerror}.", remedy) from None
    except CongraspError as error:
        raise CongraspError(f"{path} cannot be read as a constraint set: {error}", remedy) from None
    if message.meta.get("kind") != "constraints" or message.meta.get("format") != _FORMAT:
        raise CongraspError(f"{path} is not a constraint set of this version of congrasp.", remedy)
    if missing := sorted(_MEANING.keys() - message.arrays.keys()):
        raise CongraspError(f"The constraint set {path} lacks '{missing[0]}'.", remedy)
    return message


def describe(constraints: Message) -> dict[str, str]:
    """What a set holds, in words."""
    arrays, meta = constraints.arrays, constraints.meta
    allowed, poses = arrays["heading/allowed"], arrays["pose/allowed"]
    waypoints = arrays["trajectory/position"]
    length = np.linalg.norm(np.diff(waypoints, axis=2), axis=-1).sum(-1)
    rows = {
        "hand": f"{meta['hand']}, {len(meta['finger_joints'])} finger joints",
        "object": f"{meta['object']} ({meta['object_digest']})",
        "O-": f"{arrays['surface/minus'].mean():.0%} of {len(arrays['surface/points'])} surface points",
        "headings": f"{allowed.shape[2]} for each of: {', '.join(meta['variants'])}",
        "reference poses": f"{poses.shape[2]} for each",
        "wrist trajectories": f"as many, {waypoints.shape[2]} waypoints, "
        f"{100 * length.min():.0f} to {100 * length.max():.0f} cm long; each ends at its pose",
    }
    for r, rest in enumerate(arrays["rest"]):
        counts = [
            f"{variant}: {int(allowed[v, r].sum())} headings, {int(poses[v, r].sum())} poses"
            for v, variant in enumerate(meta["variants"])
        ]
        rows[f"resting pose {r + 1}"] = f"{100 * rest[2]:.1f} cm high; the table leaves on the {'; '.join(counts)}"
    return rows
