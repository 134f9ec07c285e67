"""Training set of an actor: its objects and the constraint bank of their episodes."""

import dataclasses
import functools
import pathlib
from collections.abc import Callable

import jax
import numpy as np

from congrasp.common.config import RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.pool import load_pool, scale_objects
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.stages import stage
from congrasp.common.task.sampling.bank import ConstraintBank, rows_of, stacked
from congrasp.common.task.sampling.build import bank_form, build_bank, with_columns
from congrasp.common.task.sampling.set_bank import bank_of
from congrasp.common.task.sampling.set_file import load_for
from congrasp.common.wire.codec import Message


class TrainingSet:
    """N objects scaled for the hand, and their constraints.

    Attributes:
      objects: the objects.
      form: returns shapes and types of the bank (`bank_form`), which are known before it.
    """

    def __init__(
        self,
        objects: list[GraspObject],
        form: Callable[[], ConstraintBank],
        build: Callable[[], ConstraintBank],
    ):
        """Keeps the functions; nothing is built yet."""
        self.objects = objects
        self.form = form
        self._build = build

    @functools.cached_property
    def bank(self) -> ConstraintBank:
        """Constraint bank of the objects, which is built on first use.

        Raises:
          CongraspError: see `build_bank`.
        """
        with stage("constraint bank"):
            return self._build()


def training_set(hand: Hand, config: RunConfig, number: int) -> TrainingSet:
    """Returns the objects of a run and their constraints.

    The objects are procedural, from a folder, or both; the constraints are procedural, or from
    constraint sets.

    Args:
      hand: the hand.
      config: configuration of the run.
      number: number of the actor, which selects its procedural objects.

    Raises:
      CongraspError: a folder has no usable objects, or a set is for another hand.
    """
    objects = config.objects
    task = config.task
    seed = config.seed + number
    if not objects.folder:
        with stage("objects"):
            pool = scale_objects(hand, task, load_pool(objects, number))
        form = functools.partial(bank_form, hand, task, pool)
        return TrainingSet(pool, form, functools.partial(build_bank, hand, task, pool, seed))
    unscaled = load_pool(objects)
    sets: list[Message] = []
    if objects.constraints:
        folder = pathlib.Path(objects.constraints)
        unscaled, sets = load_for(folder, unscaled, objects.split)
        if not sets:
            raise CongraspError(
                f"{objects.constraints} contains no constraint set ({objects.split}) of an object "
                f"in {objects.folder}.",
                "Pass the folders of the same import.",
            )
        if sets[0].meta["hand"] != hand.name:
            raise CongraspError(
                f"The constraint sets in {objects.constraints} are for the hand "
                f"'{sets[0].meta['hand']}'.",
                f"Generate them for '{hand.name}', or train that hand.",
            )
    pool = scale_objects(hand, task, unscaled)
    captured = with_columns(hand, task, bank_of(sets, objects.split)) if sets else None
    bank = captured or build_bank(hand, task, pool, seed)
    if not objects.procedural:
        return _training_set_of(pool, bank)
    more = dataclasses.replace(objects, folder="", constraints="", count=objects.procedural)
    procedural = scale_objects(hand, task, load_pool(more, number))
    procedural_bank = build_bank(hand, task, procedural, seed)
    both = stacked([*rows_of(bank), *rows_of(procedural_bank)])
    share = objects.folder_share
    if share:
        weights = [share / len(pool)] * len(pool)
        weights += [(1 - share) / len(procedural)] * len(procedural)
        both = both._replace(weight=both.weight * np.array(weights, np.float32))
    return _training_set_of(pool + procedural, with_columns(hand, task, both))


def _training_set_of(objects: list[GraspObject], bank: ConstraintBank) -> TrainingSet:
    """The training set of a bank."""
    return TrainingSet(objects, lambda: jax.eval_shape(lambda: bank), lambda: bank)
