"""OakInk-Image: annotations of frames as pickles, in metres, in a world frame; affordance from
OakBase's parts.

`anno/seq_all.json` lists [sequence, subject, frame, camera]; `anno/general_info/<those joined by
__>.pkl` holds `hand_anno` (`hand_pose (16, 4)` quaternions (w, x, y, z), `hand_shape (10,)`, and
`hand_tsl (3,)`, the position of the wrist) and `obj_anno (4, 4)`. The same frames are annotated for
several cameras, of which one is used; frames are sorted. An object's mesh is centred on its
bounding box before the annotated pose moves it.

A sequence's name begins with the id of its object. Any `metaV2/*object_id.json` in the data set
gives an object's name by its id. Any `OakBase/<category>/<object>` holds `part_*.ply` with
`part_*.json`.
"""

import collections
import functools
import os
import pathlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.common.hands.mano import ManoModel
from congrasp.common.io.inputs import file_name, read_file, read_json
from congrasp.common.io.pickles import MAX_BYTES, read_pickles
from congrasp.services.assets.captures import human
from congrasp.services.assets.captures.sequence import (
    Dropped,
    Meshes,
    Part,
    Sequence,
    array_of,
    is_unit,
    read_or_drop,
)
from congrasp.services.assets.objects.mesh_files import read_mesh

HOLDS = "anno/seq_all.json"
_MAX_JSON_BYTES = 256 << 20
_REMEDY = "Download the file again."
_OBJECT_POSE = "obj_anno"
_HAND = "hand_anno"
_HAND_POSE = "hand_anno/hand_pose"
_HAND_SHAPE = "hand_anno/hand_shape"
_WRIST = "hand_anno/hand_tsl"


class _Recording(NamedTuple):
    """The annotated frames of a subject in a sequence, by one camera."""

    name: str
    object_id: str
    file_stems: list[str]
    """Stems of the annotation files in `general_info`, in the order of the frames."""


class _ObjectFiles(NamedTuple):
    """Names and parts of the data set's objects."""

    names: dict[str, str]
    """Names of objects by id."""
    part_folders: dict[str, pathlib.Path]
    """Folders with the parts of an object, by its name or id."""


class _DataSet(NamedTuple):
    """Inputs that all sequences share."""

    annotations: pathlib.Path
    """Folder of the annotation files."""
    meshes: Meshes
    model: ManoModel | None
    objects: _ObjectFiles


class _Frame(NamedTuple):
    """Annotation of a frame."""

    hand_pose: np.ndarray
    """(16, 4) quaternions (w, x, y, z) of the palm and 15 finger joints."""
    hand_shape: np.ndarray
    """(10,) MANO's shape parameters."""
    wrist: np.ndarray
    """(3,) m, world frame."""
    object_pose: np.ndarray
    """(4, 4) m, from the frame of the centred mesh to the world frame."""


def read(
    path: pathlib.Path, meshes: Meshes, model: ManoModel | None
) -> Iterator[Sequence | Dropped]:
    """Yields the sequences of the folder that holds `anno`.

    Raises:
      CongraspError: there is no list of sequences, or it has another layout.
    """
    root = next((folder for folder in (path, path / "image") if (folder / "anno").is_dir()), path)
    index = root / "anno" / "seq_all.json"
    if not index.is_file():
        raise CongraspError(
            f"There is no {index}.", "Pass the folder that contains OakInk-Image's 'anno'."
        )
    try:
        recordings = _recordings(read_json(index, _MAX_JSON_BYTES, _REMEDY))
    except (TypeError, ValueError):
        raise CongraspError(
            f"{index} has rows that are not [sequence, subject, frame, camera].", _REMEDY
        ) from None
    data_set = _DataSet(
        annotations=root / "anno" / "general_info",
        meshes=meshes.beside(root / "obj", path / "obj"),
        model=model,
        objects=_find_object_files(path),
    )
    for recording in recordings:
        yield read_or_drop(recording.name, _read_sequence, recording, data_set)


def _recordings(rows: list[list[Any]]) -> list[_Recording]:
    """Recordings of each sequence and subject, by the camera with the lowest number.

    Args:
      rows: [sequence, subject, frame, camera] of each annotation file.
    """
    files: dict[tuple[str, int, int], list[tuple[int, str]]] = collections.defaultdict(list)
    """Frame and file stem of each annotation, by sequence, subject and camera."""
    for sequence, subject, frame, camera in rows:
        words = [str(sequence).replace("/", "__"), str(subject), str(frame), str(camera)]
        files[str(sequence), int(subject), int(camera)].append((int(frame), "__".join(words)))
    lowest_camera: dict[tuple[str, int], int] = {}
    for sequence, subject, camera in sorted(files):
        lowest_camera.setdefault((sequence, subject), camera)
    subjects = collections.Counter(sequence for sequence, _ in lowest_camera)
    recordings = []
    for (sequence, subject), camera in lowest_camera.items():
        name = sequence
        if subjects[sequence] > 1:  # such as the giver and the receiver of an object
            name = f"{sequence}/{subject}"
        stems = [stem for _, stem in sorted(files[sequence, subject, camera])]
        recordings.append(_Recording(name, sequence.split("_")[0], stems))
    return recordings


def _find_object_files(path: pathlib.Path) -> _ObjectFiles:
    """Finds names and parts of objects anywhere in a folder, which is walked once."""
    names: dict[str, str] = {}
    part_folders: dict[str, pathlib.Path] = {}
    for folder_name, subfolders, _ in os.walk(path):
        subfolders.sort()
        folder = pathlib.Path(folder_name)
        if folder.name == "metaV2":
            names |= _object_names(folder)
        if folder.name == "OakBase":
            for part_folder in sorted(folder.glob("*/*/")):
                part_folders.setdefault(part_folder.name, part_folder)
            subfolders.clear()
    return _ObjectFiles(names, part_folders)


def _object_names(folder: pathlib.Path) -> dict[str, str]:
    """Names of objects by id, from the files of a folder `metaV2`."""
    names = {}
    for file in sorted(folder.glob("*object_id.json")):
        for object_id, description in read_json(file, _MAX_JSON_BYTES, _REMEDY).items():
            names[object_id] = str(description.get("name", object_id))
    return names


def _read_sequence(recording: _Recording, data_set: _DataSet) -> Sequence:
    """Reads the annotations of a recording."""
    name = recording.name
    object_id = recording.object_id
    object_name = data_set.objects.names.get(object_id, object_id)
    mesh = data_set.meshes.find(name, object_id, object_name)
    files = []
    for stem in recording.file_stems:
        files.append(data_set.annotations / f"{file_name(stem, 'a frame')}.pkl")
    annotations = _annotations(name, files)
    first_known = next((frame for frame in annotations if frame is not None), None)
    if first_known is None:
        raise Dropped(name, "frames missing", "no frame has both a right hand and an object")
    frames = [frame or first_known for frame in annotations]
    hand_pose = np.stack([frame.hand_pose for frame in frames])
    object_pose = np.stack([frame.object_pose for frame in frames])
    _check_unit(name, hand_pose)
    palm = Rotation.from_quat(hand_pose[:, 0], scalar_first=True)
    fingers = Rotation.from_quat(hand_pose[:, 1:], scalar_first=True)
    skeleton = human.skeleton(data_set.model, frames[0].hand_shape)
    wrist_rotation, joints = skeleton.posed(palm, fingers)
    object_rotation = object_pose[:, :3, :3]
    return Sequence(
        name=name,
        object_name=object_name,
        mesh=mesh,
        wrist_position=np.stack([frame.wrist for frame in frames]),
        wrist_rotation=wrist_rotation,
        joints=joints,
        object_position=object_pose[:, :3, 3] - object_rotation @ _mesh_center(mesh),
        object_rotation=object_rotation,
        present=np.array([frame is not None for frame in annotations]),
        parts=_parts(data_set.objects, object_name, object_id),
    )


def _annotations(name: str, files: list[pathlib.Path]) -> list[_Frame | None]:
    """Annotations of a sequence's frames; None for missing ones."""
    existing = [file for file in files if file.is_file()]
    pickles = read_pickles((str(file), read_file(file, MAX_BYTES)) for file in existing)
    contents = dict(zip(existing, pickles, strict=True))
    annotations = []
    for file in files:
        frame = None
        if file in contents:
            frame = _frame(name, file.name, contents[file])
        annotations.append(frame)
    return annotations


def _check_unit(name: str, hand_pose: np.ndarray) -> None:
    """Drops a sequence of hand poses (T, 16, 4) whose quaternions are not of length one."""
    is_wrong = np.isfinite(hand_pose).all(-1) & ~is_unit(hand_pose)
    if is_wrong.any():
        length = np.linalg.norm(hand_pose[is_wrong][0])
        raise Dropped(
            name, "wrong layout", f"a quaternion of 'hand_pose' has the length {length:.3g}"
        )


def _frame(name: str, file: str, content: dict[str, np.ndarray]) -> _Frame | None:
    """The annotation in a file; None without a hand or object."""
    bodies = {key.partition("/")[0] for key in content}
    for key in (_HAND, _OBJECT_POSE):
        if key not in bodies:
            raise Dropped(name, "wrong layout", f"{file} has no '{key}'")
        if key in content and not content[key].size:
            return None
    return _Frame(
        hand_pose=array_of(name, file, content, _HAND_POSE, 16, 4),
        hand_shape=array_of(name, file, content, _HAND_SHAPE, 10),
        wrist=array_of(name, file, content, _WRIST, 3),
        object_pose=array_of(name, file, content, _OBJECT_POSE, 4, 4),
    )


@functools.lru_cache(maxsize=64)
def _mesh_center(mesh: pathlib.Path) -> np.ndarray:
    """Centre (3,) of the bounding box of a mesh, m."""
    return np.asarray(read_mesh(mesh, up="z").bounds, float).mean(0)


def _parts(objects: _ObjectFiles, *names: str) -> tuple[Part, ...]:
    """Labelled parts of an object by the first of its names with a folder; empty without one."""
    for name in names:
        folder = objects.part_folders.get(name)
        if folder is not None:
            return _read_parts(folder)
    return ()


@functools.lru_cache(maxsize=64)
def _read_parts(folder: pathlib.Path) -> tuple[Part, ...]:
    """Labelled parts in a folder of OakBase; empty if there are less than two."""
    parts = []
    for file in sorted(folder.glob("part_*.ply")):
        label_file = file.with_suffix(".json")
        label = file.stem
        if label_file.is_file():
            label = str(read_json(label_file, _MAX_JSON_BYTES, _REMEDY).get("name", file.stem))
        parts.append(Part(label, human.read_vertices(file)))
    return tuple(parts) if len(parts) > 1 else ()
