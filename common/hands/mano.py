"""The MANO right hand: 20 anatomical joints on the skeleton of the user's copy of `MANO_RIGHT.pkl`.

MANO may not be redistributed, so no part of it is in this package: this hand always needs the file
(from mano.is.tue.mpg.de, after registration). Wrist frame: that of MANO, with the wrist joint as
origin; fingers towards -x, back of the hand +y, thumb side +z.
"""

import dataclasses
import os
import pathlib

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.files import HUMAN
from congrasp.common.hands.spec import Capsule, Hand, Link, chain, vector
from congrasp.common.io.pickles import read_archive, read_pickle

VARIABLE = "CONGRASP_MANO"
"""Environment variable with the path of the user's file."""
MANO_FINGERS = ("index", "middle", "little", "ring", "thumb")
"""Order of the fingers in MANO's arrays; each has three joints from the palm to the tip."""
TIP_VERTICES = {"thumb": 745, "index": 317, "middle": 444, "ring": 556, "little": 673}
"""Vertices of the right hand at the fingertips."""
_SHAPES = {
    "v_template": (778, 3),
    "shapedirs": (778, 3, 10),
    "J_regressor": (16, 778),
    "hands_mean": (45,),
    "hands_components": (45, 45),
}
_REMEDY = "Use MANO_RIGHT.pkl of mano_v1_2 (mano.is.tue.mpg.de)."

_SKIN_RADII_M = {
    "thumb": (0.0100, 0.0095, 0.0085),
    "index": (0.0090, 0.0080, 0.0070),
    "middle": (0.0090, 0.0080, 0.0070),
    "ring": (0.0085, 0.0075, 0.0068),
    "little": (0.0080, 0.0070, 0.0060),
}
_LINK_MASSES_KG = {
    "thumb": (0.0139, 0.0082, 0.0075),
    "index": (0.0089, 0.0043, 0.0031),
    "middle": (0.0104, 0.0041, 0.0030),
    "ring": (0.0076, 0.0050, 0.0029),
    "little": (0.0043, 0.0028, 0.0016),
}
_PALM_MASS_KG = 0.250
"""kg."""
_METACARPAL_RADIUS_M = 0.0100
"""m."""
_FINGER_LIMITS_DEG = {
    "mcp_abduction": (-20, 20),
    "mcp_flexion": (-20, 90),
    "pip": (0, 105),
    "dip": (-5, 85),
}
_THUMB_LIMITS_DEG = {
    "cmc_abduction": (-15, 50),
    "cmc_flexion": (-20, 50),
    "mp_flexion": (-10, 75),
    "ip_flexion": (-15, 85),
}


@dataclasses.dataclass(frozen=True, eq=False)
class ManoModel:
    """Arrays used from a MANO file; lengths in m, in MANO's frame."""

    vertices: np.ndarray
    """(778, 3) of the mean shape, m."""
    shape_directions: np.ndarray
    """(778, 3, 10) change of the vertices with each shape parameter."""
    regressor: np.ndarray
    """(16, 778) from vertices to joints."""
    hand_mean: np.ndarray
    """(45,) mean axis-angles of the finger joints, in the order of `MANO_FINGERS`."""
    components: np.ndarray
    """(45, 45) principal components of the finger joints' axis-angles, one per row."""

    def skeleton(self, betas: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Returns joints (16, 3), the wrist and then three for each of `MANO_FINGERS`, and the five
        fingertips (5, 3).

        Args:
          betas: (up to 10,) shape parameters; None is the mean shape.
        """
        vertices = self.vertices
        if betas is not None:
            directions = self.shape_directions[..., : len(betas)]
            vertices = vertices + directions @ np.asarray(betas, float)
        tip_vertices = [TIP_VERTICES[finger] for finger in MANO_FINGERS]
        return self.regressor @ vertices, vertices[tip_vertices]


def read_mano(path: pathlib.Path) -> ManoModel:
    """Reads a MANO file: the pickle of mano.is.tue.mpg.de, one with other kinds of its arrays, or
    an NPZ file of them.

    Raises:
      CongraspError: the file is missing, is not a MANO file, or is that of a left hand.
    """
    start = b""
    if path.is_file():
        with path.open("rb") as file:
            start = file.read(4)
    content = read_archive(path) if start == b"PK\x03\x04" else read_pickle(path)
    arrays = []
    for name, shape in _SHAPES.items():
        array = content.get(name)
        if array is None or not _has_finite_numbers(array, shape):
            raise CongraspError(f"{path} has no array '{name}' {shape} of finite numbers.", _REMEDY)
        arrays.append(array.astype(float))
    model = ManoModel(*arrays)
    joints, _ = model.skeleton()
    if (joints[1:, 0] - joints[0, 0]).mean() > 0:
        raise CongraspError(f"{path} is a left hand.", _REMEDY)
    return model


def _has_finite_numbers(array: np.ndarray, shape: tuple[int, ...]) -> bool:
    """True for an array of this shape without infinite values or NaN."""
    if array.dtype.kind not in "iuf" or array.shape != shape:
        return False
    return bool(np.isfinite(array).all())


def mano_axes(joints: np.ndarray, tips: np.ndarray) -> np.ndarray:
    """Anatomical axes (15, 3, 3) of the finger joints at zero: rows are twist, spread and bend,
    unit and orthogonal.

    The twist points from the child to the joint, along the bone that the joint moves. The bend is
    orthogonal to it and to the back of the hand, and flexes with positive angles; positive spread
    is towards the thumb.

    Args:
      joints: (16, 3) from `ManoModel.skeleton`.
      tips: (5, 3) from `ManoModel.skeleton`.
    """
    fingers = joints[1:].reshape(5, 3, 3)
    child = np.concatenate([fingers[:, 1:], tips[:, None]], 1)
    up = np.array([[0.0, 1.0, 0.0]] * 4 + [[1.0, 1.0, 1.0]])[:, None]
    twist = _unit(fingers - child)
    bend = _unit(np.cross(twist, np.broadcast_to(up, twist.shape)))
    return np.stack([twist, np.cross(bend, twist), bend], -2).reshape(15, 3, 3)


def mano_hand(model: ManoModel) -> Hand:
    """Returns the hand of a MANO model, of its mean shape."""
    joints, tips = model.skeleton()
    axes = mano_axes(joints, tips).reshape(5, 3, 3, 3)
    anchors = (joints[1:] - joints[0]).reshape(5, 3, 3)
    tips = tips - joints[0]
    links: list[Link] = []
    metacarpals: list[Capsule] = []
    for finger in ("thumb", "index", "middle", "ring", "little"):
        i = MANO_FINGERS.index(finger)
        links += _finger(finger, axes[i], anchors[i], tips[i])
        if finger != "thumb":
            start = vector(0.2 * anchors[i, 0])
            metacarpals.append(Capsule(start, vector(anchors[i, 0]), _METACARPAL_RADIUS_M))
    palm = Link(
        "palm",
        parent="",
        joints=(),
        capsules=tuple(metacarpals),
        mass=_PALM_MASS_KG,
        contact_weight=1.0,
    )
    return Hand(
        name="mano",
        links=(palm, *links),
        thumb="thumb_distal",
        open_pose={
            "thumb_cmc_abduction": 0.55,
            "thumb_cmc_flexion": 0.35,
            "thumb_ip_flexion": 0.20,
            **_each(mcp_flexion=0.25, pip=0.25, dip=0.15),
        },
        closed_pose={
            "thumb_cmc_abduction": 0.75,
            "thumb_cmc_flexion": 0.75,
            "thumb_mp_flexion": 0.60,
            "thumb_ip_flexion": 0.90,
            **_each(mcp_flexion=1.35, pip=1.2, dip=1.2),
        },
        wrist=HUMAN.wrist,
        anatomical=True,
    )


def _finger(
    finger: str, axes: np.ndarray, anchors: np.ndarray, tip: np.ndarray
) -> tuple[Link, ...]:
    """Returns the links of a finger.

    Args:
      finger: its name.
      axes: (3, 3, 3) of its joints, from `mano_axes`.
      anchors: (3, 3) of its joints, wrist frame, m.
      tip: (3,) its fingertip, wrist frame, m.
    """
    is_thumb = finger == "thumb"
    radii = _SKIN_RADII_M[finger]
    # The skin ends at the fingertip, a capsule's axis one radius before it.
    end = tip - radii[2] * _unit(tip - anchors[2])
    points = [vector(point) for point in (*anchors, end)]
    limits = _THUMB_LIMITS_DEG if is_thumb else _FINGER_LIMITS_DEG
    bones = (0, 0, 1, 2)
    joint_axes = (axes[0, 1], axes[0, 2], axes[1, 2], axes[2, 2])
    joints = []
    for name, bone, axis in zip(limits, bones, joint_axes, strict=True):
        lower, upper = np.radians(limits[name])
        joint = dataclasses.replace(
            HUMAN.joints[0],
            name=f"{finger}_{name}",
            axis=vector(axis),
            anchor=points[bone],
            lower=float(lower),
            upper=float(upper),
        )
        joints.append(joint)
    names = ("metacarpal", "proximal", "distal") if is_thumb else ("proximal", "middle", "distal")
    return chain(
        [f"{finger}_{name}" for name in names],
        joints=[(joints[0], joints[1]), (joints[2],), (joints[3],)],
        points=points,
        radii=radii,
        masses=_LINK_MASSES_KG[finger],
        weights=(2.0, 2.0, 6.0) if is_thumb else (1.0, 1.0, 3.0),
    )


def own_mano_model(path: pathlib.Path | None = None) -> ManoModel | None:
    """Returns the user's MANO model from `path` or the environment variable `CONGRASP_MANO`; None
    if neither is set.

    Raises:
      CongraspError: see `read_mano`.
    """
    file = path or os.environ.get(VARIABLE)
    if not file:
        return None
    return read_mano(pathlib.Path(file))


def own_mano_hand() -> Hand:
    """Returns the hand of the user's MANO file, named by the environment variable `CONGRASP_MANO`.

    Raises:
      CongraspError: the variable is not set; or see `read_mano`.
    """
    model = own_mano_model()
    if model is None:
        raise CongraspError(
            "The hand 'mano' requires the file MANO_RIGHT.pkl, whose licence does not permit its "
            "redistribution.",
            f"Download it from mano.is.tue.mpg.de, and set {VARIABLE}=/path/to/MANO_RIGHT.pkl.",
        )
    return mano_hand(model)


def _each(**angles: float) -> dict[str, float]:
    """Returns the same angles for the joints of the four fingers."""
    pose = {}
    for finger in ("index", "middle", "ring", "little"):
        for name, angle in angles.items():
            pose[f"{finger}_{name}"] = angle
    return pose


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) normalised to length one."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
