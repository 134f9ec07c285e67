"""An importer that nobody ships: one NPZ file a sequence, whose arrays have the names of
`Sequence`'s fields.
"""

import pathlib
from collections.abc import Iterator

import numpy as np

from congrasp.common.hands.mano import ManoModel
from congrasp.services.assets.captures.sequence import Dropped, Meshes, Sequence, read_or_drop

HOLDS = "*.capture.npz"


def read(
    path: pathlib.Path, meshes: Meshes, mano: ManoModel | None
) -> Iterator[Sequence | Dropped]:
    for file in sorted(path.glob(HOLDS)):
        yield read_or_drop(file.stem, _sequence, file, meshes)


def _sequence(file: pathlib.Path, meshes: Meshes) -> Sequence:
    name = file.name.split(".")[0]
    object_name = name.split("_")[0]
    with np.load(file) as arrays:
        return Sequence(
            name=name, object_name=object_name, mesh=meshes.find(name, object_name), **arrays
        )
