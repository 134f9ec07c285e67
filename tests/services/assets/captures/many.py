"""Writes many sequences of a format, to time their import: `python -m tests.services.assets.captures.many grab many`.

Each moves one of ten boxes of different lengths (of DexYCB, whose objects are fixed, the mug alone).
"""

import dataclasses
import pathlib
from typing import Annotated, Literal

import tyro

from congrasp.services.assets.captures.human import MEAN_WRIST
from tests.mano_file import mano_pickle
from tests.services.assets.captures import known, test_dexycb, test_grab, test_myohand, test_oakink


def write(
    format: Annotated[Literal["grab", "oakink", "dexycb", "myohand"], tyro.conf.Positional],
    folder: Annotated[pathlib.Path, tyro.conf.Positional],
    count: int = 100,
) -> None:
    """Writes sequences, their meshes, and MANO_RIGHT.pkl.

    Args:
      format: whose layout.
      folder: to write to; it holds the data set, and for myohand the meshes in `meshes`.
      count: of the sequences.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "MANO_RIGHT.pkl").write_bytes(mano_pickle())
    for i in range(count):
        box = i % 10
        if format == "dexycb":
            case = known.make("", "025_mug", i)
            test_dexycb.write(case, folder, f"20200709_{i:06d}")
            continue
        case = known.make("", f"B{box:05d}", i, tail=0.01 * box)
        if format == "grab":
            case = dataclasses.replace(case, name=f"{case.object_name}_lift_{i}")
            test_grab.write(case, folder, MEAN_WRIST)
        elif format == "oakink":
            case = dataclasses.replace(case, name=f"{case.object_name}_0001_{i:04d}")
            test_oakink.write(case, folder)
        else:
            case = dataclasses.replace(case, name=f"MyoHand_{case.object_name}_lift{i}")
            test_myohand.write(case, folder / "data" / f"{case.name}.npz")
            known.write_mesh(case, folder / "meshes" / f"{case.object_name}.stl")


if __name__ == "__main__":
    tyro.cli(write, description=__doc__)
