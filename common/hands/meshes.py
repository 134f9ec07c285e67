"""What a hand looks like in its file: a mesh for each link, kept beside the hand's file.

Physics and policies know the capsules alone. The meshes are what pictures and exports show, and what is measured
against the object beside the capsules.
"""

import pathlib

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand, own_hands
from congrasp.common.hands.spec import Hand
from congrasp.common.io.npz import read_npz

SUFFIX = ".visual.npz"
MAX_FACES = 3000
"""Triangles of a link; finer meshes are simplified."""
MAX_BYTES = 16 << 20
"""Bytes of all meshes."""
MAX_DISTANCE = 2.0
"""Metres that each coordinate of a mesh may be from the wrist's origin: farther is a file in another unit."""
PARTS = ("vertices", "faces")
_REMEDY = "Make it anew with 'congrasp hands import', or delete it."

Meshes = dict[str, tuple[np.ndarray, np.ndarray]]
"""Vertices (V, 3) m, wrist frame at zero, and triangles (E, 3) by the names of links."""


def beside(path: pathlib.Path) -> pathlib.Path:
    """Where the meshes of a hand file are."""
    return path.with_suffix(SUFFIX)


def load_meshes(path: pathlib.Path, hand: Hand) -> Meshes:
    """The meshes beside a hand file; none where there is no such file.

    Raises:
      CongraspError: it is damaged, not of this hand's links, or larger than a hand.
    """
    file = beside(path)
    if not file.is_file():
        return {}
    arrays = read_npz(file, _REMEDY, kind="the meshes of a hand", largest=MAX_BYTES)
    found = {}
    for name in dict.fromkeys(key.rpartition("/")[0] for key in arrays):
        vertices, faces = (arrays.get(f"{name}/{part}", np.zeros(0)) for part in PARTS)
        fits = vertices.ndim == faces.ndim == 2 and vertices.shape[1] == faces.shape[1] == 3 and faces.size
        fits = fits and vertices.dtype.kind == "f" and faces.dtype.kind == "i" and np.isfinite(vertices).all()
        if not fits or faces.min() < 0 or faces.max() >= len(vertices) or len(faces) > MAX_FACES:
            raise CongraspError(f"{file} holds no mesh of '{name[:60]}'.", _REMEDY)
        if (farthest := np.abs(vertices).max()) > MAX_DISTANCE:
            raise CongraspError(
                f"{file} has '{name[:60]}' {farthest:.3g} m from the wrist; {MAX_DISTANCE:g} m is the most.",
                f"Is it in another unit? {_REMEDY}",
            )
        found[name] = vertices, faces
    if odd := sorted({*found} - {link.name for link in hand.links}):
        raise CongraspError(f"{file} is not of the hand '{hand.name}', which has no link '{odd[0][:60]}'.", _REMEDY)
    return found


def own_meshes(hand: Hand) -> Meshes:
    """The meshes of one of the user's own hands; none of any other, nor of one that has changed since its import.

    Raises:
      CongraspError: see `load_meshes`.
    """
    file = own_hands().get(hand.name) if hand.text else None
    if file is None:
        return {}
    try:
        mine = get_hand(hand.name)
    except CongraspError:  # it is another hand of this name, and its file cannot be read
        return {}
    return load_meshes(file, hand) if mine.text == hand.text else {}
