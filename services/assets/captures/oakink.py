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
from typing import Any

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
_LARGEST_JSON = 256 << 20
_REMEDY = "Download the file again."
_Frames = list[tuple[int, str]]


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
            f"There is no {index}.", "Pass the folder that holds OakInk-Image's 'anno'."
        )
    try:
        sequences = _sequences(read_json(index, _LARGEST_JSON, _REMEDY))
    except (TypeError, ValueError):
        raise CongraspError(
            f"{index} holds other rows than [sequence, subject, frame, camera].", _REMEDY
        ) from None
    found = meshes.beside(root / "obj", path / "obj")
    names = _names(path)
    for (name, _), frames in sorted(sequences.items()):
        folder = root / "anno" / "general_info"
        yield read_or_drop(name, _sequence, name, frames, folder, found, model, names, path)


def _sequences(rows: list[list[Any]]) -> dict[tuple[str, int], _Frames]:
    """(frame, file stem) of each sequence and subject, sorted, of the camera with the lowest
    number.
    """
    cameras: dict[tuple[str, int], dict[int, _Frames]] = collections.defaultdict(
        lambda: collections.defaultdict(list)
    )
    for sequence, subject, frame, camera in rows:
        stem = "__".join([str(sequence).replace("/", "__"), str(subject), str(frame), str(camera)])
        cameras[str(sequence), int(subject)][int(camera)].append((int(frame), stem))
    return {key: sorted(of_camera[min(of_camera)]) for key, of_camera in cameras.items()}


def _names(path: pathlib.Path) -> dict[str, str]:
    """Names of objects by id."""
    names: dict[str, str] = {}
    for file in sorted(path.glob("**/metaV2/*object_id.json")):
        names |= {
            key: str(value.get("name", key))
            for key, value in read_json(file, _LARGEST_JSON, _REMEDY).items()
        }
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
    there = [file for file in files if file.is_file()]
    contents = dict(
        zip(
            there,
            read_pickles((str(file), read_file(file, MAX_BYTES)) for file in there),
            strict=True,
        )
    )
    rows = [_frame(name, file.name, contents[file]) if file in contents else None for file in files]
    known = next((row for row in rows if row is not None), None)
    if known is None:
        raise Dropped(name, "frames missing", "none of its frames has a right hand and an object")
    pose, shape, wrist, place = (np.stack([(row or known)[i] for row in rows]) for i in range(4))
    if (wrong := np.isfinite(pose).all(-1) & ~is_unit(pose)).any():
        length = np.linalg.norm(pose[wrong][0])
        raise Dropped(
            name, "wrong layout", f"a quaternion of 'hand_pose' has the length {length:.3g}"
        )
    palm, fingers = (
        Rotation.from_quat(part, scalar_first=True) for part in (pose[:, 0], pose[:, 1:])
    )
    wrist_turn, joints = human.skeleton(model, shape[0]).posed(palm, fingers)
    turn = place[:, :3, :3]
    return Sequence(
        name=name,
        object_name=object_name,
        mesh=mesh,
        wrist_position=wrist,
        wrist_rotation=wrist_turn,
        joints=joints,
        object_position=place[:, :3, 3] - turn @ _middle(mesh),
        object_rotation=turn,
        present=np.array([row is not None for row in rows]),
        parts=_parts(root, object_name, object_id),
    )


_HAND = {"hand_anno/hand_pose": (16, 4), "hand_anno/hand_shape": (10,), "hand_anno/hand_tsl": (3,)}


def _frame(name: str, file: str, content: dict[str, np.ndarray]) -> tuple[np.ndarray, ...] | None:
    """Hand pose (16, 4), shape (10,), wrist (3,) and object pose (4, 4); None without a hand or
    object.
    """
    known = {key.partition("/")[0] for key in content}
    for key in ("hand_anno", "obj_anno"):
        if key not in known:
            raise Dropped(name, "wrong layout", f"{file} has no '{key}'")
        if key in content and not content[key].size:
            return None
    return tuple(
        array_of(name, file, content, key, *shape)
        for key, shape in (_HAND | {"obj_anno": (4, 4)}).items()
    )


@functools.lru_cache(maxsize=64)
def _middle(mesh: pathlib.Path) -> np.ndarray:
    """Centre (3,) of the bounding box of a mesh."""
    return np.asarray(read_mesh(mesh, up="z").bounds, float).mean(0)


@functools.lru_cache(maxsize=64)
def _parts(root: pathlib.Path, *names: str) -> tuple[Part, ...]:
    """Labelled parts of an object in OakBase; empty if it is missing."""
    folder = next(
        (f for name in names for f in sorted(root.glob(f"**/OakBase/*/{name}")) if f.is_dir()), None
    )
    if folder is None:
        return ()
    parts = []
    for file in sorted(folder.glob("part_*.ply")):
        labels = file.with_suffix(".json")
        label = (
            read_json(labels, _LARGEST_JSON, _REMEDY).get("name", file.stem)
            if labels.is_file()
            else file.stem
        )
        parts.append(Part(str(label), human.read_vertices(file)))
    return tuple(parts) if len(parts) > 1 else ()
