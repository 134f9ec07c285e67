"""Visual meshes of a hand: one for each link, stored next to the hand's file.

Physics and policies use the capsules only. The meshes are for pictures, exports and measurements of
penetration.
"""

import io
import pathlib
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand, own_hands
from congrasp.common.hands.spec import Hand
from congrasp.common.io.arrays import read_npz
from congrasp.common.io.files import write_atomically

SUFFIX = ".visual.npz"
MAX_FACES = 3000
"""Most triangles of a link; finer meshes are simplified."""
MAX_BYTES = 16 << 20
"""Largest total size of all meshes in bytes."""
MAX_DISTANCE_M = 2.0
"""Greatest distance of a mesh's coordinates from the wrist's origin, m; a larger one means a file
in another unit.
"""
_REMEDY = "Run 'congrasp hands import' again, or delete the file."

Meshes = dict[str, tuple[np.ndarray, np.ndarray]]
"""Vertices (V, 3) m, wrist frame at zero, and triangles (E, 3), by link name."""


def mesh_file(path: pathlib.Path) -> pathlib.Path:
    """Returns the path of the meshes of a hand file."""
    return path.with_suffix(SUFFIX)


def load_meshes(path: pathlib.Path, hand: Hand) -> Meshes:
    """Loads the meshes of a hand file; returns none if there is no such file.

    Raises:
      CongraspError: the file is damaged, has links that the hand lacks, or is too large for a hand.
    """
    file = mesh_file(path)
    if not file.is_file():
        return {}
    arrays = read_npz(file, _REMEDY, kind="the meshes of a hand", largest=MAX_BYTES)
    meshes = {}
    for name in dict.fromkeys(key.rpartition("/")[0] for key in arrays):
        vertices = arrays.get(f"{name}/vertices", np.zeros(0))
        faces = arrays.get(f"{name}/faces", np.zeros(0))
        if not _is_mesh(vertices, faces):
            raise CongraspError(f"{file} contains no mesh of '{name[:60]}'.", _REMEDY)
        farthest = np.abs(vertices).max()
        if farthest > MAX_DISTANCE_M:
            raise CongraspError(
                f"{file} has '{name[:60]}' {farthest:.3g} m from the wrist, more than "
                f"{MAX_DISTANCE_M:g} m.",
                f"Check the file's unit. {_REMEDY}",
            )
        meshes[name] = (vertices, faces)
    unknown_links = sorted({*meshes} - {link.name for link in hand.links})
    if unknown_links:
        raise CongraspError(
            f"{file} does not belong to the hand '{hand.name}', which has no link "
            f"'{unknown_links[0][:60]}'.",
            _REMEDY,
        )
    return meshes


def _is_mesh(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """True for finite vertices (V, 3) and 1 to `MAX_FACES` triangles (E, 3) of them."""
    if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.dtype.kind != "f":
        return False
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind != "i":
        return False
    if not 0 < len(faces) <= MAX_FACES or not np.isfinite(vertices).all():
        return False
    return bool(faces.min() >= 0 and faces.max() < len(vertices))


def own_meshes(hand: Hand) -> Meshes:
    """Loads the meshes of a custom hand; returns none for any other hand, and for one changed since
    its import.

    Raises:
      CongraspError: see `load_meshes`.
    """
    file = own_hands().get(hand.name) if hand.text else None
    if file is None:
        return {}
    try:
        stored_hand = get_hand(hand.name)
    except CongraspError:  # a different hand of this name whose file cannot be read
        return {}
    if stored_hand.text != hand.text:
        return {}
    return load_meshes(file, hand)


def save_meshes(path: pathlib.Path, meshes: Meshes) -> None:
    """Writes the meshes of a hand next to its file; without any, removes an existing file."""
    if not meshes:
        mesh_file(path).unlink(missing_ok=True)
        return
    arrays: dict[str, Any] = {}
    for name, (vertices, faces) in meshes.items():
        arrays[f"{name}/vertices"] = vertices
        arrays[f"{name}/faces"] = faces
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomically(mesh_file(path), buffer.getvalue())
