"""Objects with captured constraint sets."""

import pathlib
from collections.abc import Sequence
from typing import NamedTuple

from congrasp.common.config import Split
from congrasp.common.errors import CongraspError
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.sampling.set_bank import bank_of
from congrasp.common.task.sampling.set_file import load_for
from congrasp.services.evaluate.paper.figures import CAPTURED_SETS


class CapturedObjects(NamedTuple):
    """Objects with their constraint sets."""

    objects: list[GraspObject]
    bank: ConstraintBank
    hand: str
    """Hand of the sets."""
    paper: str
    """Table of the paper for their data set (`services.evaluate.paper.figures`); empty for none."""


def captured_objects(
    folder: pathlib.Path, split: Split, objects: Sequence[GraspObject]
) -> CapturedObjects:
    """Returns the objects that have a constraint set with a heading of the split in a folder, and
    the sets.

    Raises:
      CongraspError: none has one, or a set belongs to another object.
    """
    objects_with_set, sets = load_for(folder, objects, split)
    if not sets:
        raise CongraspError(
            f"{folder} contains no constraint set ({split}) of these objects.",
            "Pass the folders of the same import, or another --split.",
        )
    sources = {constraint_set.meta.get("source", "") for constraint_set in sets}
    paper = ""
    if len(sources) == 1:
        paper = CAPTURED_SETS.get(sources.pop(), "")
    return CapturedObjects(objects_with_set, bank_of(sets, split), sets[0].meta["hand"], paper)
