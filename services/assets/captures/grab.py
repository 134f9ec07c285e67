"""GRAB: one NPZ file a sequence, `grab/s1/mug_drink_1.npz`, in metres, 120 frames a second.

MANO's translation is added to the vertices, so the wrist is at the rest shape's wrist joint plus
the translation. GRAB multiplies an object's vertices from the right: its rotation is the transpose
of the stored one. If the folder has GrabNet's `frame_names.npz`, its first frame of a sequence is
the grasping frame; otherwise the labels of the object's contacts give the touching fingers.
"""

import functools
import pathlib
from collections.abc import Iterator

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
    known_frames,
    read_or_drop,
)

HOLDS = "s1/*.npz and the other subjects"
_LABELS = {
    "thumb": (53, 55),
    "index": (41, 43),
    "middle": (44, 46),
    "ring": (50, 52),
    "little": (47, 49),
}
"""First and last contact label of each right finger."""


def read(
    path: pathlib.Path, meshes: Meshes, model: ManoModel | None
) -> Iterator[Sequence | Dropped]:
    """Yields the sequences of a file, or of all subjects' folders in a folder."""
    root = _root(path)
    found = meshes.beside(root / "tools" / "object_meshes" / "contact_meshes")
    files = sorted(file for file in path.glob("**/s*/*.npz")) if path.is_dir() else [path]
    named = _grasping_frames(root)
    for file in files:
        yield read_or_drop(file.stem, _sequence, file, root, found, model, named)


def _root(path: pathlib.Path) -> pathlib.Path:
    """Folder that holds `tools`, at or above the path."""
    return next((folder for folder in (path, *path.parents) if (folder / "tools").is_dir()), path)


def _grasping_frames(root: pathlib.Path) -> dict[tuple[str, str], int]:
    """First grasping frame of each (subject, sequence) named by GrabNet."""
    first: dict[tuple[str, str], int] = {}
    for file in sorted(root.glob("**/frame_names.npz")) if root.is_dir() else []:
        for name in np.ravel(read_archive(file).get("frame_names", [])):
            *_, subject, sequence, frame = str(name).split("/")
            number = int("".join(filter(str.isdigit, frame.removesuffix(".npz"))))
            key = subject, sequence
            first[key] = min(first.get(key, number), number)
    return first


def _sequence(
    file: pathlib.Path,
    root: pathlib.Path,
    meshes: Meshes,
    model: ManoModel | None,
    named: dict[tuple[str, str], int],
) -> Sequence:
    """Reads the sequence of a file."""
    name = f"{file.parent.name}/{file.stem}"
    data = read_archive(file)
    parts = {key.partition("/")[0] for key in data}
    if "rhand" not in parts and "lhand" in parts:
        raise Dropped(name, "left hand", "it has no right hand")
    arrays = frames_of(name, "the file", data, {key: (width,) for key, width in _WIDTHS.items()})
    object_name = str(data.get("obj_name", file.stem.split("_")[0]))
    skeleton = _skeleton(model, _template(root, data))
    frames, grasp = len(arrays[0]), named.get((file.parent.name, file.stem))
    present = np.isfinite(np.concatenate(arrays, 1)).all(-1)
    turn, shift, fingers, object_shift, object_turn = known_frames(name, present, *arrays)
    wrist, joints = skeleton.posed(*map(Rotation.from_rotvec, (turn, fingers.reshape(-1, 15, 3))))
    return Sequence(
        name=name,
        object_name=object_name,
        mesh=meshes.find(name, object_name),
        wrist_position=skeleton.wrist + shift,
        wrist_rotation=wrist,
        joints=joints,
        object_position=object_shift,
        object_rotation=Rotation.from_rotvec(object_turn).inv().as_matrix(),
        present=present,
        grasp=grasp if grasp is not None and grasp < frames else None,
        touching=_touching(data, frames),
    )


_WIDTHS = {
    **{"rhand/params/global_orient": 3, "rhand/params/transl": 3, "rhand/params/fullpose": 45},
    **{"object/params/transl": 3, "object/params/global_orient": 3},
}


def _template(root: pathlib.Path, data: dict[str, np.ndarray]) -> pathlib.Path | None:
    """Mesh of the subject's right hand, if it exists."""
    text = data.get("rhand/vtemp")
    path = root / str(text) if text is not None else None
    inside = path is not None and path.resolve().is_relative_to(root.resolve())
    return path if path is not None and inside and path.is_file() else None


@functools.lru_cache(maxsize=32)
def _skeleton(model: ManoModel | None, template: pathlib.Path | None) -> human.Skeleton:
    """Skeleton of a subject, from the template of the hand at rest."""
    return human.skeleton(model, template=template)


def _touching(data: dict[str, np.ndarray], frames: int) -> np.ndarray | None:
    """Contact flags (T, 5), from the labels of the object's contacts."""
    labels = data.get("contact/object")
    if labels is None or labels.ndim != 2 or len(labels) != frames:
        return None
    return np.stack(
        [
            ((labels >= low) & (labels <= high)).any(-1)
            for low, high in (_LABELS[f] for f in FINGERS)
        ],
        -1,
    )
