"""DexYCB: `<date>-subject-XX/<session>` with `meta.yml` and `pose.npz`, in metres, in the master
camera's frame.

`pose_y (F, n, 7)`: quaternion (x, y, z, w) and position of each object; `pose_m (F, 1, 51)`: MANO's
root axis-angle, 45 coefficients of its principal components, and a translation that is added to the
vertices. Unobserved values are zeros, or the identity. Only the grasped object is used; `meta.yml`
names the hand's side.
"""

import pathlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.common.hands.mano import VARIABLE, ManoModel
from congrasp.common.io.inputs import file_name, read_file
from congrasp.common.io.pickles import read_archive
from congrasp.services.assets.captures import human
from congrasp.services.assets.captures.sequence import (
    Dropped,
    Meshes,
    Sequence,
    frames_of,
    is_unit,
    read_or_drop,
    with_gaps_filled,
)

_MAX_YAML_BYTES = 64 << 10
_MAX_YAML_DEPTH = 16
HOLDS = "<date>-subject-01/<session>/meta.yml"
OBJECTS = (
    "002_master_chef_can",
    "003_cracker_box",
    "004_sugar_box",
    "005_tomato_soup_can",
    "006_mustard_bottle",
    "007_tuna_fish_can",
    "008_pudding_box",
    "009_gelatin_box",
    "010_potted_meat_can",
    "011_banana",
    "019_pitcher_base",
    "021_bleach_cleanser",
    "024_bowl",
    "025_mug",
    "035_power_drill",
    "036_wood_block",
    "037_scissors",
    "040_large_marker",
    "051_large_clamp",
    "052_extra_large_clamp",
    "061_foam_brick",
)
"""Names by DexYCB's ids, from 1."""


class _DataSet(NamedTuple):
    """Inputs that all sequences share."""

    root: pathlib.Path
    """Folder that holds `calibration`."""
    meshes: Meshes
    model: ManoModel


def read(
    path: pathlib.Path, meshes: Meshes, model: ManoModel | None
) -> Iterator[Sequence | Dropped]:
    """Yields the sequences of a session's folder, or of all of them in a folder.

    Raises:
      CongraspError: there is no MANO file.
    """
    if model is None:
        raise CongraspError(
            "DexYCB's hand poses require the file MANO_RIGHT.pkl.",
            f"Download it from MANO's site, and pass it with --mano or set {VARIABLE}.",
        )
    root = _root(path)
    all_meshes = meshes.beside(root / "models")
    data_set = _DataSet(root, all_meshes, model)
    for file in sorted(path.glob("**/meta.yml")):
        name = f"{file.parent.parent.name}/{file.parent.name}"
        yield read_or_drop(name, _read_sequence, name, file.parent, data_set)


def _root(path: pathlib.Path) -> pathlib.Path:
    """Folder that holds `calibration`, at or above the path."""
    for folder in (path, *path.parents):
        if (folder / "calibration").is_dir():
            return folder
    return path


def _read_sequence(name: str, folder: pathlib.Path, data_set: _DataSet) -> Sequence:
    """Reads the sequence of a session's folder."""
    model = data_set.model
    meta = _yaml(name, folder / "meta.yml")
    sides = _value(name, meta, "mano_sides")
    if sides != ["right"]:
        raise Dropped(name, "left hand", f"the hand is the {', '.join(map(str, sides))} one")
    ids = _value(name, meta, "ycb_ids")
    grasped = int(_value(name, meta, "ycb_grasp_ind"))
    if not 0 <= grasped < len(ids) or not 1 <= ids[grasped] <= len(OBJECTS):
        raise Dropped(
            name,
            "wrong layout",
            f"'ycb_grasp_ind' {grasped} is not the index of an object of {ids}",
        )
    objects, hands = frames_of(
        name,
        "pose.npz",
        read_archive(folder / "pose.npz"),
        {"pose_y": ("n", 7), "pose_m": ("n", 51)},
    )
    if objects.shape[1] != len(ids) or hands.shape[1] != 1:
        raise Dropped(
            name,
            "wrong layout",
            f"'pose_y' {objects.shape} and 'pose_m' {hands.shape} do not match meta.yml",
        )
    object_pose = objects[:, grasped]
    hand = hands[:, 0]
    has_position = (object_pose[:, 4:] != 0).any(-1)
    has_object = np.isfinite(object_pose).all(-1) & has_position & is_unit(object_pose[:, :4])
    has_hand = np.isfinite(hand).all(-1) & (hand != 0).any(-1)
    present = has_object & has_hand
    object_pose, hand = with_gaps_filled(name, present, object_pose, hand)
    calibration = _value(name, meta, "mano_calib")[0]
    skeleton = human.skeleton(model, calibrated_shape(name, data_set.root, calibration))
    angles = model.hand_mean + hand[:, 3:48] @ model.components
    wrist, joints = skeleton.posed(
        Rotation.from_rotvec(hand[:, :3]), Rotation.from_rotvec(angles.reshape(-1, 15, 3))
    )
    object_name = OBJECTS[ids[grasped] - 1]
    return Sequence(
        name=name,
        object_name=object_name,
        mesh=data_set.meshes.find(name, object_name, inside="textured_simple.obj"),
        wrist_position=skeleton.wrist + hand[:, 48:],
        wrist_rotation=wrist,
        joints=joints,
        object_position=object_pose[:, 4:],
        object_rotation=Rotation.from_quat(object_pose[:, :4]).as_matrix(),
        present=present,
    )


def _yaml(name: str, path: pathlib.Path) -> dict[str, Any]:
    """Reads the settings of a YAML file."""
    if not path.is_file():
        raise Dropped(name, "wrong layout", f"there is no {path.name} in {path.parent}")
    try:
        text = read_file(path, _MAX_YAML_BYTES)
        _check_structure(text)
        content = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise Dropped(name, "unreadable", " ".join(str(error).split())) from None
    if not isinstance(content, dict):
        raise Dropped(name, "wrong layout", f"{path} contains no settings")
    return content


def _check_structure(text: bytes) -> None:
    """Refuses YAML that takes a parser disproportionately long: aliases and deep nesting."""
    depth = 0
    for event in yaml.parse(text, yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            raise ValueError("it repeats its values")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > _MAX_YAML_DEPTH:
            raise ValueError(f"its values are more than {_MAX_YAML_DEPTH} deep inside one another")


def _value(name: str, meta: dict[str, Any], key: str) -> Any:
    """Returns a value of `meta.yml`."""
    if key not in meta:
        raise Dropped(name, "wrong layout", f"meta.yml has no '{key}'")
    return meta[key]


def calibrated_shape(name: str, root: pathlib.Path, calibration: str) -> np.ndarray:
    """Returns the shape parameters (10,) of a subject's calibration.

    Args:
      name: name of the sequence.
      root: folder of the data set.
      calibration: name of the calibration, from the sequence's `meta.yml`.

    Raises:
      CongraspError: the name leads out of the folder of calibrations.
      Dropped: the file is missing, or has another layout.
    """
    folder = root / "calibration" / file_name(f"mano_{calibration}", "a calibration")
    content = _yaml(name, folder / "mano.yml")
    betas = np.array(content.get("betas", []), float)
    if betas.shape != (10,):
        raise Dropped(
            name, "wrong layout", f"mano.yml of {calibration} has {betas.size} 'betas', not 10"
        )
    return betas
