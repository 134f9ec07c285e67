"""Files of constraint sets: headings, reference poses and wrist trajectories of one object for one
hand.
"""

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from congrasp.common.config import Split
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import check_arrays, file_name, read_file
from congrasp.common.objects import store
from congrasp.common.objects.pool import object_scale, scale_objects
from congrasp.common.objects.spec import SURFACE_POINTS, GraspObject
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import OURS
from congrasp.common.task.normals import estimated_normals
from congrasp.common.task.sampling.bank import ConstraintBank, rows_of, stacked
from congrasp.common.task.sampling.build import build_bank
from congrasp.common.wire.codec import MAX_MESSAGE, Message, decode, encode

SUFFIX = ".constraints.safetensors"
REGIONS = ("whole surface", "graspable region")
"""The axis V: constraints for the whole surface, and for the graspable region only."""
FORMAT = 2
_LARGEST = 100.0  # bound of all numbers, m or rad
_MASS = 0.2  # mass in kg of an object whose set was written before sets recorded it
MEANING = {
    "surface/points": "(P, 3) m, object frame",
    "surface/normals": "(P, 3) outward unit normals at the points",
    "surface/avoid": "(P,) bool, the point belongs to the avoid region",
    "rest": (
        "(R, 7) resting poses in the world frame, position (m) and quaternion; the table's top is "
        "at z = 0"
    ),
    "heading/position": "(V, H, 3) m, object frame: target of the hand's centre",
    "heading/direction": "(V, H, 3) unit, object frame: direction in which the hand moves",
    "heading/cross": "(V, H, 3) unit, object frame: along the hand's cross-finger axis",
    "heading/allowed": "(V, R, H) bool, the heading clears the table",
    "heading/back": (
        "(V, R, H) m by which the position moves back along the direction to clear the table"
    ),
    "pose/q": "(V, M, F) rad, finger joints",
    "pose/position": "(V, M, 3) m, wrist in the object frame",
    "pose/quaternion": "(V, M, 4) wrist frame to object frame",
    "trajectory/position": (
        "(V, M, K, 3) m, wrist waypoints in the object frame; trajectory m ends at pose m"
    ),
    "trajectory/quaternion": "(V, M, K, 4) wrist frame to object frame",
    "pose/allowed": "(V, R, M) bool, the pose and its trajectory clear the table",
    "heading/training": (
        "(V, H) bool, the heading is for training (80 % are); the others are held out"
    ),
    "pose/training": (
        "(V, M) bool, the same for pose m and trajectory m (captured: 80 % of those of the data "
        "set)"
    ),
    "visual/vertices": "(n, 3) m, object frame",
    "visual/faces": "(m, 3) indices of vertices",
}
_TRAINING = 0.8


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
    for made in sets:
        for key in ("hand", "finger_joints"):
            if made.meta[key] != first.meta[key]:
                raise CongraspError(
                    f"The set of '{made.meta['object']}' is for the hand '{made.meta['hand']}', "
                    f"that of "
                    f"'{first.meta['object']}' for '{first.meta['hand']}'.",
                    "Use sets of one hand together.",
                )
        for name in ("surface/points", "trajectory/position"):
            size, wanted = (m.arrays[name].shape[-2] for m in (made, first))
            if size != wanted:
                raise CongraspError(
                    f"The sets of '{made.meta['object']}' and '{first.meta['object']}' differ in "
                    f"{name}: {size} and "
                    f"{wanted}.",
                    "Make them with the same settings.",
                )
    return stacked([_row(made, split) for made in sets])


def _row(made: Message, split: Split) -> ConstraintBank:
    """Converts a set to a row of a constraint bank: constraints of the split in resting poses with
    a heading.
    """
    arrays = made.arrays
    heading, pose = (_allowed(made, kind, split) for kind in ("heading", "pose"))
    usable = np.flatnonzero(heading[0].any(-1))
    if len(usable) == 0:
        raise CongraspError(
            f"The constraint set of '{made.meta['object']}' has no heading ({split}) in any "
            f"resting pose.",
            "Remove it or use another split.",
        )
    heading, back = heading[:, usable], arrays["heading/back"][:, usable]
    count = heading.shape[-1]
    index = np.array(
        [
            [np.resize(np.flatnonzero(row) if row.any() else [0], count) for row in v]
            for v in heading
        ]
    )
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
        pose_valid=pose[:, usable],
        has_affordance=arrays["surface/avoid"].any() & heading[1].any(-1),
        weight=np.float32(1.0),
        mass=np.float32(made.meta.get("object_mass", _MASS)),
        renewable=np.bool_(False),
        grasps=np.zeros(2, int),
    )


def _allowed(made: Message, kind: Literal["heading", "pose"], split: Split) -> np.ndarray:
    """(V, R, H or M) bool: headings or references of a split that clear the table."""
    allowed, training = made.arrays[f"{kind}/allowed"], made.arrays[f"{kind}/training"]
    belongs = {"all": np.ones_like(training), "training": training, "held-out": ~training}[split]
    return allowed & belongs[:, None]


def load(path: pathlib.Path) -> Message:
    """Reads a set.

    Raises:
      CongraspError: the file is missing, of another kind, or damaged.
    """
    remedy = "Run 'congrasp constraints generate' again."
    data = read_file(path, MAX_MESSAGE, remedy)
    try:
        message = decode(data)
    except CongraspError as error:
        raise CongraspError(f"{path} cannot be read as a constraint set: {error}", remedy) from None
    if message.meta.get("kind") != "constraints" or message.meta.get("format") != FORMAT:
        raise CongraspError(f"{path} is not a constraint set of this version of congrasp.", remedy)
    if "surface/points" in message.arrays and "surface/normals" not in message.arrays:
        message = _with_normals(message)
    if missing := sorted(MEANING.keys() - message.arrays.keys()):
        raise CongraspError(f"The constraint set {path} lacks '{missing[0]}'.", remedy)
    try:
        _check(message)
    except (CongraspError, ValueError) as error:
        raise CongraspError(
            f"The constraint set {path} is damaged: {str(error).split('. ')[0]}.", remedy
        ) from None
    return message


def _with_normals(message: Message) -> Message:
    """Returns a set of an earlier version with estimated normals; unchanged if its points are not
    an array (P, 3).
    """
    points = message.arrays["surface/points"]
    if points.ndim != 2 or points.shape[1] != 3 or not 1 <= len(points) <= SURFACE_POINTS:
        return message
    normals = np.array(estimated_normals(points[None])[0])
    return Message({**message.arrays, "surface/normals": normals}, message.meta)


def _check(message: Message) -> None:
    """Raises an error for invalid metadata, and for arrays that do not match `MEANING`."""
    meta, sizes = (
        message.meta,
        {"V": len(REGIONS), "F": len(_names(message.meta.get("finger_joints")))},
    )
    for name in ("object", "hand"):
        file_name(meta.get(name), f"the {name} of a constraint set")
    scale = meta.get("object_scale")
    if (
        not isinstance(scale, (int, float))
        or not 0 < scale <= 100
        or not isinstance(meta.get("object_digest"), str)
    ):
        raise ValueError("its object_scale or object_digest is invalid")
    mass = meta.get("object_mass", _MASS)
    if isinstance(mass, bool) or not isinstance(mass, (int, float)) or not 0 < mass <= 1000:
        raise ValueError("its object_mass is invalid")
    if len(_names(meta.get("variants"))) != len(REGIONS):
        raise ValueError(f"it has other variants than {', '.join(REGIONS)}")
    sizes = check_arrays(
        message.arrays, MEANING, indices=("visual/faces",), largest=_LARGEST, sizes=sizes
    )
    faces = message.arrays["visual/faces"]
    if faces.min() < 0 or faces.max() >= sizes["n"]:
        raise ValueError("visual/faces names vertices that do not exist")


def _names(value: Any) -> list[str]:
    return value if isinstance(value, list) and all(isinstance(name, str) for name in value) else []


def load_for(
    folder: pathlib.Path, objects: Sequence[GraspObject], split: Split = "all"
) -> tuple[list[GraspObject], list[Message]]:
    """Returns the objects that have a set in a folder with a heading of the split, and their sets.

    Raises:
      CongraspError: a set cannot be read, or was made for another object of the same name.
    """
    chosen, sets = [], []
    for obj in objects:
        path = folder / f"{obj.name}{SUFFIX}"
        if path.is_file():
            made = load(path)
            if made.meta["object_digest"] != store.digest(obj):
                raise CongraspError(
                    f"{path} was made for another object '{obj.name}'.",
                    "Pass the folder of that object.",
                )
            if _allowed(made, "heading", split)[0].any():
                chosen.append(obj)
                sets.append(made)
    return chosen, sets


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
    fitting = scale_objects(hand, task, objects)
    rows = rows_of(
        bank or build_bank(hand, dataclasses.replace(task, constraints=OURS), fitting, seed)
    )
    scale = object_scale(hand, task)
    return [
        set_of(
            hand,
            rows[n],
            fitting[n],
            seed,
            {"object_scale": scale, "object_digest": store.digest(obj)},
        )
        for n, obj in enumerate(objects)
    ]


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
    # The bank pads an object's resting poses to the most of any object by repetition.
    again = np.flatnonzero((row.rest[1:] == row.rest[0]).all(-1))
    rests = int(again[0]) + 1 if len(again) else len(row.rest)
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
    order = np.arange(count) if seed is None else np.random.default_rng(seed).permutation(count)
    return np.asarray(order < np.ceil(_TRAINING * count))


def _twice(training: np.ndarray) -> np.ndarray:
    """Repeats (M,) for both regions: (V, M)."""
    return np.tile(training, (len(REGIONS), 1))


def save(constraints: Message, folder: pathlib.Path) -> pathlib.Path:
    """Writes a set to a file named after its object; returns the file."""
    path = folder / f"{file_name(constraints.meta['object'], 'a constraint set')}{SUFFIX}"
    write_atomically(path, encode(constraints))
    return path


def describe(constraints: Message) -> dict[str, str]:
    """Describes the content of a set as text by name."""
    arrays, meta = constraints.arrays, constraints.meta
    allowed, poses = arrays["heading/allowed"], arrays["pose/allowed"]
    waypoints = arrays["trajectory/position"]
    length = np.linalg.norm(np.diff(waypoints, axis=2), axis=-1).sum(-1)
    scale = meta["object_scale"]  # relative to the object's file
    scaled = "" if scale == 1.0 else f", {scale:g} times as large, for this hand"
    rows = {
        "hand": f"{meta['hand']}, {len(meta['finger_joints'])} finger joints",
        "object": f"{meta['object']} ({meta['object_digest']}){scaled}",
        "avoid region": (
            f"{arrays['surface/avoid'].mean():.0%} of {len(arrays['surface/points'])} surface "
            f"points"
        ),
        "headings": f"{allowed.shape[2]} for each of: {', '.join(meta['variants'])}",
        "reference poses": f"{poses.shape[2]} for each",
        "wrist trajectories": f"equally many, {waypoints.shape[2]} waypoints, "
        f"{100 * length.min():.0f} to {100 * length.max():.0f} cm long; "
        "each ends at its pose",
    }
    if "source" in meta:
        rows["captured"] = f"{meta['source']}: {', '.join(meta['demonstrations'])}"
    for r, rest in enumerate(arrays["rest"]):
        counts = [
            f"{region}: {int(allowed[v, r].sum())} headings, {int(poses[v, r].sum())} poses"
            for v, region in enumerate(meta["variants"])
        ]
        rows[f"resting pose {r + 1}"] = (
            f"{100 * rest[2]:.1f} cm high; clear of the table on the {'; '.join(counts)}"
        )
    return rows
