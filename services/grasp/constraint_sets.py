"""Constraint sets as files: headings, reference poses and wrist trajectories of one object for one hand."""

import pathlib
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from actors.bank import build_bank
from common.config import TaskConfig
from common.errors import CongraspError
from common.files import write_atomically
from common.hands.spec import Hand
from common.inputs import file_name, read_file
from common.objects import store
from common.objects.pool import object_scale, scale_objects
from common.objects.spec import GraspObject
from common.task.bank import ConstraintBank
from common.wire.codec import MAX_MESSAGE, Message, decode, encode
from services.described import check_arrays

SUFFIX = ".constraints.safetensors"
REGIONS = ("whole surface", "graspable region")
"""The axis V: constraints for the whole surface, and for the graspable region alone."""
Split = Literal["all", "training", "held-out"]
_FORMAT = 2
_TRAINING = 0.8
_LARGEST = 100.0  # m or rad
_MEANING = {
    "surface/points": "(P, 3) m, object frame",
    "surface/minus": "(P,) bool, the point belongs to the avoid region",
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
    "heading/training": "(V, H) bool, the heading is among the 80 % for training; the others are held out",
    "pose/training": "(V, M) bool, the same for pose m and trajectory m",
    "visual/vertices": "(n, 3) m, object frame",
    "visual/faces": "(m, 3) indices of vertices",
}


def make_sets(
    hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], seed: int, bank: ConstraintBank | None = None
) -> list[Message]:
    """The constraint set of each object, as training and evaluation make it.

    Args:
      hand: the hand.
      task: geometry of the approach.
      objects: the objects.
      seed: of the constraints.
      bank: of these objects in the hand's size, where it is there already; its reference poses are kept.

    Raises:
      CongraspError: an object has no heading that the hand can reach in any resting pose.
    """
    fitting = scale_objects(hand, task, objects)
    bank = ConstraintBank(*(np.asarray(field) for field in bank or build_bank(hand, task, fitting, seed)))
    scale = object_scale(hand, task)
    return [
        set_of(
            hand,
            ConstraintBank(*(field[n] for field in bank)),
            fitting[n],
            seed,
            {"object_scale": scale, "object_digest": store.digest(obj)},
            shuffled=False,
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
    shuffled: bool = True,
) -> Message:
    """The constraint set of one object.

    Args:
      hand: the hand.
      row: of the constraint bank, without the axis of the objects.
      obj: the object.
      seed: of the constraints; the split into training and held-out is drawn from it.
      about: further facts for the file.
      shuffled: whether any references may be held out; otherwise they are the last ones, as in evaluations
        (`services.evaluate.references`).
    """
    # The bank fills an object's resting poses up to the most of any object by repeating them.
    again = np.flatnonzero((row.rest[1:] == row.rest[0]).all(-1))
    rests = int(again[0]) + 1 if len(again) else len(row.rest)
    allowed = np.zeros((len(REGIONS), rests, row.heading_position.shape[1]), bool)
    back = np.zeros(allowed.shape, np.float32)
    for v, r in np.ndindex(allowed.shape[:2]):
        if v == 0 or row.has_affordance[r] or not row.avoid.any():
            allowed[v, r, row.heading_index[v, r]] = True
            back[v, r, row.heading_index[v, r]] = row.heading_back[v, r]
    arrays = {
        "surface/points": row.points,
        "surface/minus": row.avoid,
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
        "heading/training": _split(row.heading_position.shape[:2], seed),
        "pose/training": _split(row.pose_q.shape[:2], seed if shuffled else None),
        "visual/vertices": np.asarray(obj.visual_vertices, np.float32),
        "visual/faces": np.asarray(obj.visual_faces, np.int32),
    }
    meta: dict[str, Any] = {
        "kind": "constraints",
        "format": _FORMAT,
        "hand": hand.name,
        "hand_reference": hand.reference,
        "object": obj.name,
        "object_digest": store.digest(obj),
        "object_scale": 1.0,
        "seed": seed,
        "variants": list(REGIONS),
        "finger_joints": [joint.name for joint in hand.joints],
        "quaternions": "(w, x, y, z)",
        "object_frame": "origin at the centre of mass, orientation of the object file, lengths times object_scale",
        "arrays": _MEANING,
        **(about or {}),
    }
    return Message(arrays, meta)


def _split(shape: tuple[int, ...], seed: int | None) -> np.ndarray:
    """(V, M) bool, true for 80 % of M (rounded up), the same in both regions; the first ones without a seed."""
    order = np.arange(shape[1]) if seed is None else np.random.default_rng(seed).permutation(shape[1])
    return np.broadcast_to(order < np.ceil(_TRAINING * shape[1]), shape).copy()


def bank_of(sets: Sequence[Message], split: Split = "all") -> ConstraintBank:
    """The constraint bank that episodes are drawn from, of constraint sets of one hand.

    Sets may differ in their numbers of resting poses, headings and references: they are repeated to the largest.

    Args:
      sets: N constraint sets.
      split: takes all constraints, those for training, or those that are held out.

    Raises:
      CongraspError: the sets are of different hands or sizes, or one of them has no heading left.
    """
    first = sets[0]
    for made in sets:
        for key in ("hand", "finger_joints"):
            if made.meta[key] != first.meta[key]:
                raise CongraspError(
                    f"The set of '{made.meta['object']}' is for the hand '{made.meta['hand']}', that of "
                    f"'{first.meta['object']}' for '{first.meta['hand']}'.",
                    "Use sets of one hand together.",
                )
        for name in ("surface/points", "trajectory/position"):
            size, wanted = (m.arrays[name].shape[-2] for m in (made, first))
            if size != wanted:
                raise CongraspError(
                    f"The sets of '{made.meta['object']}' and '{first.meta['object']}' differ in {name}: {size} and "
                    f"{wanted}.",
                    "Make them with the same settings.",
                )
    rows = [_row(made, split) for made in sets]
    most = {axis: max(row.pose_valid.shape[axis] for row in rows) for axis in (1, 2)}
    return ConstraintBank(
        *(np.stack(column) for column in zip(*(_filled(row, *most.values()) for row in rows), strict=True))
    )


def _row(made: Message, split: Split) -> ConstraintBank:
    """One set as a row of a constraint bank: what belongs to the split, in resting poses that allow a heading."""
    arrays = made.arrays
    heading, pose = (
        arrays[f"{kind}/allowed"] & _belongs(arrays[f"{kind}/training"], split)[:, None] for kind in ("heading", "pose")
    )
    usable = np.flatnonzero(heading[0].any(-1))
    if len(usable) == 0:
        raise CongraspError(
            f"The constraint set of '{made.meta['object']}' has no heading ({split}) in any resting pose.",
            "Leave it out, or take another split.",
        )
    heading, back = heading[:, usable], arrays["heading/back"][:, usable]
    count = heading.shape[-1]
    index = np.array([[np.resize(np.flatnonzero(row) if row.any() else [0], count) for row in v] for v in heading])
    return ConstraintBank(
        points=arrays["surface/points"],
        avoid=arrays["surface/minus"],
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
        has_affordance=arrays["surface/minus"].any() & heading[1].any(-1),
    )


def _belongs(training: np.ndarray, split: Split) -> np.ndarray:
    """(V, M) bool, what belongs to a split, of what is for training (V, M)."""
    return {"all": np.ones_like(training), "training": training, "held-out": ~training}[split]


def _filled(row: ConstraintBank, rests: int, poses: int) -> ConstraintBank:
    """The row with its resting poses and references repeated to these numbers."""
    r = np.resize(np.arange(len(row.rest)), rests)
    m = np.resize(np.arange(row.pose_q.shape[1]), poses)
    per_pose = [
        name for name in ConstraintBank._fields if name.startswith(("pose_", "trajectory_")) and name != "pose_valid"
    ]
    return row._replace(
        rest=row.rest[r],
        has_affordance=row.has_affordance[r],
        heading_index=row.heading_index[:, r],
        heading_back=row.heading_back[:, r],
        pose_valid=row.pose_valid[:, r][:, :, m],
        **{name: getattr(row, name)[:, m] for name in per_pose},
    )


def save(constraints: Message, folder: pathlib.Path) -> pathlib.Path:
    """Writes a set under its object's name; returns the file."""
    path = folder / f"{file_name(constraints.meta['object'], 'a constraint set')}{SUFFIX}"
    write_atomically(path, encode(constraints))
    return path


def load(path: pathlib.Path) -> Message:
    """Reads a set.

    Raises:
      CongraspError: no such file, another kind of file, or damaged content.
    """
    remedy = "Make it anew with 'congrasp constraints generate'."
    try:
        message = decode(read_file(path, MAX_MESSAGE))
    except OSError as error:
        raise CongraspError(f"The constraint set {path} cannot be read: {error.strerror}.", remedy) from None
    except CongraspError as error:
        raise CongraspError(f"{path} cannot be read as a constraint set: {error}", remedy) from None
    if message.meta.get("kind") != "constraints" or message.meta.get("format") != _FORMAT:
        raise CongraspError(f"{path} is not a constraint set of this version of congrasp.", remedy)
    if missing := sorted(_MEANING.keys() - message.arrays.keys()):
        raise CongraspError(f"The constraint set {path} lacks '{missing[0]}'.", remedy)
    try:
        _check(message)
    except (CongraspError, ValueError) as error:
        raise CongraspError(f"The constraint set {path} is damaged: {str(error).split('. ')[0]}.", remedy) from None
    return message


def _check(message: Message) -> None:
    """An error for facts of another kind, and for arrays that are not what `_MEANING` says."""
    meta, sizes = message.meta, {"V": len(REGIONS), "F": len(_names(message.meta.get("finger_joints")))}
    for name in ("object", "hand"):
        file_name(meta.get(name), f"the {name} of a constraint set")
    scale = meta.get("object_scale")
    if not isinstance(scale, (int, float)) or not 0 < scale <= 100 or not isinstance(meta.get("object_digest"), str):
        raise ValueError("its object_scale or object_digest is none")
    if len(_names(meta.get("variants"))) != len(REGIONS):
        raise ValueError(f"it has other variants than {', '.join(REGIONS)}")
    sizes = check_arrays(message.arrays, _MEANING, indices=("visual/faces",), largest=_LARGEST, sizes=sizes)
    faces = message.arrays["visual/faces"]
    if faces.min() < 0 or faces.max() >= sizes["n"]:
        raise ValueError("visual/faces names vertices that are not there")


def _names(value: Any) -> list[str]:
    return value if isinstance(value, list) and all(isinstance(name, str) for name in value) else []


def load_for(folder: pathlib.Path, objects: Sequence[GraspObject]) -> tuple[list[GraspObject], list[Message]]:
    """The objects that have a set in a folder, and their sets.

    Raises:
      CongraspError: a set cannot be read, or was made for another object of the same name.
    """
    chosen, sets = [], []
    for obj in objects:
        path = folder / f"{obj.name}{SUFFIX}"
        if path.is_file():
            made = load(path)
            if made.meta["object_digest"] != store.digest(obj):
                raise CongraspError(f"{path} was made for another object '{obj.name}'.", "Name that object's folder.")
            chosen.append(obj)
            sets.append(made)
    return chosen, sets


def _scale_text(scale: float) -> str:
    """How much larger than its file the object is; empty where it is not."""
    return "" if scale == 1.0 else f", {scale:g} times as large, for this hand"


def describe(constraints: Message) -> dict[str, str]:
    """What a set holds, as text by name."""
    arrays, meta = constraints.arrays, constraints.meta
    allowed, poses = arrays["heading/allowed"], arrays["pose/allowed"]
    waypoints = arrays["trajectory/position"]
    length = np.linalg.norm(np.diff(waypoints, axis=2), axis=-1).sum(-1)
    rows = {
        "hand": f"{meta['hand']}, {len(meta['finger_joints'])} finger joints",
        "object": f"{meta['object']} ({meta['object_digest']}){_scale_text(meta['object_scale'])}",
        "avoid region": f"{arrays['surface/minus'].mean():.0%} of {len(arrays['surface/points'])} surface points",
        "headings": f"{allowed.shape[2]} for each of: {', '.join(meta['variants'])}",
        "reference poses": f"{poses.shape[2]} for each",
        "wrist trajectories": f"as many, {waypoints.shape[2]} waypoints, "
        f"{100 * length.min():.0f} to {100 * length.max():.0f} cm long; each ends at its pose",
    }
    if "source" in meta:
        rows["captured"] = f"{meta['source']}: {', '.join(meta['demonstrations'])}"
    for r, rest in enumerate(arrays["rest"]):
        counts = [
            f"{region}: {int(allowed[v, r].sum())} headings, {int(poses[v, r].sum())} poses"
            for v, region in enumerate(meta["variants"])
        ]
        rows[f"resting pose {r + 1}"] = f"{100 * rest[2]:.1f} cm high; the table leaves on the {'; '.join(counts)}"
    return rows
