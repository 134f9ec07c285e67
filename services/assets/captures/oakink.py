"""OakInk-Image: annotations of frames as pickles, in metres, in a world frame; affordance from
OakBase's parts.

`anno/seq_all.json` lists [sequence, subject, frame, camera]; `anno/general_info/<those joined by
__>.pkl` holds `hand_anno` (`hand_pose (16, 4)` quaternions (w, x, y, z), `hand_shape (10,)`, and
`hand_tsl (3,)`, the position of the wrist) and `obj_anno (4, 4)`. The same frames are annotated for
several cameras, of which one is used; frames are sorted. An object's mesh is centred on its
bounding box before the annotated pose moves it. `OakBase/<category>/<object>` holds `part_*.ply`
with `part_*.json`.
"""

import collections
import functools
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
_HAND_SHAPES = {
    "hand_anno/hand_pose": (16, 4),
    "hand_anno/hand_shape": (10,),
    "hand_anno/hand_tsl": (3,),
}
"""Shapes of the arrays of a hand."""
_Frames = list[tuple[int, str]]
"""Frame and file stem of each annotation, sorted."""


class _Frame(NamedTuple):
    """Annotation of a frame."""

    hand_pose: np.ndarray
    """(16, 4) quaternions."""
    hand_shape: np.ndarray
    """(10,)."""
    wrist: np.ndarray
    """(3,) m."""
    object_pose: np.ndarray
    """(4, 4)."""


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
        sequences = _sequences(read_json(index, _MAX_JSON_BYTES, _REMEDY))
    except (TypeError, ValueError):
        raise CongraspError(
            f"{index} has rows that are not [sequence, subject, frame, camera].", _REMEDY
        ) from None
    all_meshes = meshes.beside(root / "obj", path / "obj")
    names = _names(path)
    folder = root / "anno" / "general_info"
    for (name, _), frames in sorted(sequences.items()):
        yield read_or_drop(name, _sequence, name, frames, folder, all_meshes, model, names, path)


def _sequences(rows: list[list[Any]]) -> dict[tuple[str, int], _Frames]:
    """Frames of each sequence and subject, of the camera with the lowest number."""
    cameras: dict[tuple[str, int], dict[int, _Frames]] = collections.defaultdict(
        lambda: collections.defaultdict(list)
    )
    for sequence, subject, frame, camera in rows:
        words = [str(sequence).replace("/", "__"), str(subject), str(frame), str(camera)]
        stem = "__".join(words)
        cameras[str(sequence), int(subject)][int(camera)].append((int(frame), stem))
    return {key: sorted(of_camera[min(of_camera)]) for key, of_camera in cameras.items()}


def _names(path: pathlib.Path) -> dict[str, str]:
    """Names of objects by id."""
    names: dict[str, str] = {}
    for file in sorted(path.glob("**/metaV2/*object_id.json")):
        for key, value in read_json(file, _MAX_JSON_BYTES, _REMEDY).items():
            names[key] = str(value.get("name", key))
    return names


def _sequence(
    name: str,
    frames: _Frames,
    folder: pathlib.Path,
    meshes: Meshes,
    model: ManoModel | None,
    names: dict[str, str],
    root: pathlib.Path,
) -> Sequence:
    """Reads the sequence of some frames' annotations."""
    object_id = name.split("_")[0]
    object_name = names.get(object_id, object_id)
    mesh = meshes.find(name, object_id, object_name)
    files = [folder / f"{file_name(stem, 'a frame')}.pkl" for _, stem in frames]
    annotations = _annotations(name, files)
    reference = next((frame for frame in annotations if frame is not None), None)
    if reference is None:
        raise Dropped(name, "frames missing", "no frame has both a right hand and an object")
    filled = [frame or reference for frame in annotations]
    pose = np.stack([frame.hand_pose for frame in filled])
    object_pose = np.stack([frame.object_pose for frame in filled])
    _check_unit(name, pose)
    palm = Rotation.from_quat(pose[:, 0], scalar_first=True)
    fingers = Rotation.from_quat(pose[:, 1:], scalar_first=True)
    skeleton = human.skeleton(model, filled[0].hand_shape)
    wrist_rotation, joints = skeleton.posed(palm, fingers)
    object_rotation = object_pose[:, :3, :3]
    return Sequence(
        name=name,
        object_name=object_name,
        mesh=mesh,
        wrist_position=np.stack([frame.wrist for frame in filled]),
        wrist_rotation=wrist_rotation,
        joints=joints,
        object_position=object_pose[:, :3, 3] - object_rotation @ _middle(mesh),
        object_rotation=object_rotation,
        present=np.array([frame is not None for frame in annotations]),
        parts=_parts(root, object_name, object_id),
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


def _check_unit(name: str, pose: np.ndarray) -> None:
    """Drops a sequence of hand poses (T, 16, 4) whose quaternions are not of length one."""
    is_wrong = np.isfinite(pose).all(-1) & ~is_unit(pose)
    if is_wrong.any():
        length = np.linalg.norm(pose[is_wrong][0])
        raise Dropped(
            name, "wrong layout", f"a quaternion of 'hand_pose' has the length {length:.3g}"
        )


def _frame(name: str, file: str, content: dict[str, np.ndarray]) -> _Frame | None:
    """The annotation in a file; None without a hand or object."""
    bodies = {key.partition("/")[0] for key in content}
    for key in ("hand_anno", _OBJECT_POSE):
        if key not in bodies:
            raise Dropped(name, "wrong layout", f"{file} has no '{key}'")
        if key in content and not content[key].size:
            return None
    hand = [array_of(name, file, content, key, *shape) for key, shape in _HAND_SHAPES.items()]
    hand_pose, hand_shape, wrist = hand
    object_pose = array_of(name, file, content, _OBJECT_POSE, 4, 4)
    return _Frame(hand_pose, hand_shape, wrist, object_pose)


@functools.lru_cache(maxsize=64)
def _middle(mesh: pathlib.Path) -> np.ndarray:
    """Centre (3,) of the bounding box of a mesh."""
    return np.asarray(read_mesh(mesh, up="z").bounds, float).mean(0)


@functools.lru_cache(maxsize=64)
def _parts(root: pathlib.Path, *names: str) -> tuple[Part, ...]:
    """Labelled parts of an object in OakBase; empty if it is missing."""
    folder = _part_folder(root, names)
    if folder is None:
        return ()
    parts = []
    for file in sorted(folder.glob("part_*.ply")):
        labels = file.with_suffix(".json")
        label = file.stem
        if labels.is_file():
            label = str(read_json(labels, _MAX_JSON_BYTES, _REMEDY).get("name", file.stem))
        parts.append(Part(label, human.read_vertices(file)))
    return tuple(parts) if len(parts) > 1 else ()


def _part_folder(root: pathlib.Path, names: tuple[str, ...]) -> pathlib.Path | None:
    """Folder of an object's parts, by the first of its names that has one."""
    for name in names:
        for folder in sorted(root.glob(f"**/OakBase/*/{name}")):
            if folder.is_dir():
                return folder
    return None
