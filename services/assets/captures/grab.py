"""GRAB: one NPZ file a sequence, `grab/s1/mug_drink_1.npz`, in metres, 120 frames a second.

MANO's translation is added to the vertices, so the wrist is at the rest shape's wrist joint plus
the translation. GRAB multiplies an object's vertices from the right: its rotation is the transpose
of the stored one. If the folder has GrabNet's `frame_names.npz`, its first frame of a sequence is
the grasping frame; otherwise the labels of the object's contacts give the touching fingers.
"""

import functools
import pathlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands.mano import ManoModel
from congrasp.common.io.pickles import read_archive
from congrasp.services.assets.captures import human
from congrasp.services.assets.captures.sequence import (
    FINGERS,
    Dropped,
    Meshes,
    Sequence,
    frames_of,
    read_or_drop,
    with_gaps_filled,
)

HOLDS = "s1/*.npz and the other subjects"
_CONTACT_LABELS = {
    "thumb": (53, 55),
    "index": (41, 43),
    "middle": (44, 46),
    "ring": (50, 52),
    "little": (47, 49),
}
"""First and last contact label of each right finger."""
_WRIST_ROTATION = "rhand/params/global_orient"
_WRIST_TRANSLATION = "rhand/params/transl"
_FINGER_ROTATIONS = "rhand/params/fullpose"
_OBJECT_TRANSLATION = "object/params/transl"
_OBJECT_ROTATION = "object/params/global_orient"
_FIELD_WIDTHS = {
    _WRIST_ROTATION: 3,
    _WRIST_TRANSLATION: 3,
    _FINGER_ROTATIONS: 45,
    _OBJECT_TRANSLATION: 3,
    _OBJECT_ROTATION: 3,
}
"""Numbers of a frame in each array that is read."""
_GraspingFrames = dict[tuple[str, str], int]
"""First grasping frame of each (subject, sequence)."""


class _DataSet(NamedTuple):
    """Inputs that all sequences share."""

    root: pathlib.Path
    """Folder that holds `tools`."""
    meshes: Meshes
    model: ManoModel | None
    grasping_frames: _GraspingFrames


def read(
    path: pathlib.Path, meshes: Meshes, model: ManoModel | None
) -> Iterator[Sequence | Dropped]:
    """Yields the sequences of a file, or of all subjects' folders in a folder."""
    root = _root(path)
    all_meshes = meshes.beside(root / "tools" / "object_meshes" / "contact_meshes")
    grasping_frames = _grasping_frames(root)
    files = sorted(path.glob("**/s*/*.npz")) if path.is_dir() else [path]
    data_set = _DataSet(root, all_meshes, model, grasping_frames)
    for file in files:
        name = f"{file.parent.name}/{file.stem}"
        yield read_or_drop(name, _read_sequence, name, file, data_set)


def _root(path: pathlib.Path) -> pathlib.Path:
    """Folder that holds `tools`, at or above the path."""
    for folder in (path, *path.parents):
        if (folder / "tools").is_dir():
            return folder
    return path


def _grasping_frames(root: pathlib.Path) -> _GraspingFrames:
    """The grasping frames named by GrabNet."""
    if not root.is_dir():
        return {}
    first: _GraspingFrames = {}
    for file in sorted(root.glob("**/frame_names.npz")):
        for name in np.ravel(read_archive(file).get("frame_names", [])):
            *_, subject, sequence, frame = str(name).split("/")
            digits = filter(str.isdigit, frame.removesuffix(".npz"))
            number = int("".join(digits))
            key = (subject, sequence)
            first[key] = min(first.get(key, number), number)
    return first


def _read_sequence(name: str, file: pathlib.Path, data_set: _DataSet) -> Sequence:
    """Reads the sequence of a file."""
    data = read_archive(file)
    bodies = {key.partition("/")[0] for key in data}
    if "rhand" not in bodies and "lhand" in bodies:
        raise Dropped(name, "left hand", "the sequence has no right hand")
    shapes = {field: (width,) for field, width in _FIELD_WIDTHS.items()}
    arrays = frames_of(name, "the file", data, shapes)
    object_name = str(data.get("obj_name", file.stem.split("_")[0]))
    skeleton = _skeleton(data_set.model, hand_template(data_set.root, data))
    frame_count = len(arrays[0])
    present = np.isfinite(np.concatenate(arrays, 1)).all(-1)
    fields = dict(zip(shapes, with_gaps_filled(name, present, *arrays), strict=True))
    finger_rotations = fields[_FINGER_ROTATIONS].reshape(-1, 15, 3)
    wrist, joints = skeleton.posed(
        Rotation.from_rotvec(fields[_WRIST_ROTATION]), Rotation.from_rotvec(finger_rotations)
    )
    grasp = data_set.grasping_frames.get((file.parent.name, file.stem))
    if grasp is not None and grasp >= frame_count:
        grasp = None
    return Sequence(
        name=name,
        object_name=object_name,
        mesh=data_set.meshes.find(name, object_name),
        wrist_position=skeleton.wrist + fields[_WRIST_TRANSLATION],
        wrist_rotation=wrist,
        joints=joints,
        object_position=fields[_OBJECT_TRANSLATION],
        object_rotation=Rotation.from_rotvec(fields[_OBJECT_ROTATION]).inv().as_matrix(),
        present=present,
        grasp=grasp,
        touching=_touching_fingers(data, frame_count),
    )


def hand_template(root: pathlib.Path, data: dict[str, np.ndarray]) -> pathlib.Path | None:
    """Returns the mesh of the subject's right hand; None if the folder does not contain it.

    Args:
      root: folder of the data set.
      data: arrays of a sequence, by name.
    """
    if "rhand/vtemp" not in data:
        return None
    path = root / str(data["rhand/vtemp"])
    is_inside = path.resolve().is_relative_to(root.resolve())
    return path if is_inside and path.is_file() else None


@functools.lru_cache(maxsize=32)
def _skeleton(model: ManoModel | None, template: pathlib.Path | None) -> human.Skeleton:
    """Skeleton of a subject, from the template of the hand at rest."""
    return human.skeleton(model, template=template)


def _touching_fingers(data: dict[str, np.ndarray], frame_count: int) -> np.ndarray | None:
    """Contact flags (T, 5), from the labels of the object's contacts; None without labels."""
    labels = data.get("contact/object")
    if labels is None or labels.ndim != 2 or len(labels) != frame_count:
        return None
    touching = []
    for finger in FINGERS:
        low, high = _CONTACT_LABELS[finger]
        touching.append(((labels >= low) & (labels <= high)).any(-1))
    return np.stack(touching, -1)
