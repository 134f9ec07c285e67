"""Training set of an actor: its objects and the constraint bank of their episodes."""

import dataclasses
import pathlib
from typing import NamedTuple

import numpy as np

from congrasp.common.config import RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.pool import load_pool, scale_objects
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.stages import stage
from congrasp.common.task.sampling.bank import ConstraintBank, rows_of, stacked, with_columns
from congrasp.common.task.sampling.build import build_bank
from congrasp.common.task.sampling.sets import bank_of, load_for
from congrasp.common.wire.codec import Message


class TrainingSet(NamedTuple):
    """N objects scaled for the hand, and their constraints."""

    objects: list[GraspObject]
    bank: ConstraintBank


def training_set(hand: Hand, config: RunConfig, number: int) -> TrainingSet:
    """Returns procedural objects, those of a folder, or both, with procedural constraints or those of constraint sets.

    Args:
      hand: the hand.
      config: configuration of the run.
      number: number of the actor, which selects its procedural objects.

    Raises:
      CongraspError: a folder has no usable objects, or a set is for another hand.
    """
    objects, task, seed = config.objects, config.task, config.seed + number
    if not objects.folder:
        with stage("objects"):
            pool = scale_objects(hand, task, load_pool(objects, number))
        with stage("constraint bank"):
            return TrainingSet(pool, build_bank(hand, task, pool, seed))
    found, sets = load_pool(objects), list[Message]()
    if objects.constraints:
        found, sets = load_for(pathlib.Path(objects.constraints), found, objects.split)
        if not sets:
            raise CongraspError(
                f"{objects.constraints} holds no constraint set ({objects.split}) of an object in {objects.folder}.",
                "Pass folders that belong together.",
            )
        if sets[0].meta["hand"] != hand.name:
            raise CongraspError(
                f"The constraint sets in {objects.constraints} are for the hand '{sets[0].meta['hand']}'.",
                f"Generate them for '{hand.name}', or train that hand.",
            )
    pool = scale_objects(hand, task, found)
    captured = with_columns(hand, task, bank_of(sets, objects.split)) if sets else None
    bank = captured or build_bank(hand, task, pool, seed)
    if not objects.procedural:
        return TrainingSet(pool, bank)
    more = dataclasses.replace(objects, folder="", constraints="", count=objects.procedural)
    beside = scale_objects(hand, task, load_pool(more, number))
    both = stacked([*rows_of(bank), *rows_of(build_bank(hand, task, beside, seed))])
    if share := objects.folder_share:
        weights = [share / len(pool)] * len(pool) + [(1 - share) / len(beside)] * len(beside)
        both = both._replace(weight=both.weight * np.array(weights, np.float32))
    return TrainingSet(pool + beside, with_columns(hand, task, both))
