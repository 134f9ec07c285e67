"""Training set of an actor: its objects and the constraint bank of their episodes."""

import dataclasses
import functools
import pathlib
from collections.abc import Callable, Sequence

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
        self.objects, self.form, self._build = objects, form, build

    @functools.cached_property
    def bank(self) -> ConstraintBank:
        """Constraint bank of the objects, which is built on first use.

        Raises:
          CongraspError: see `build_bank`.
        """
        with stage("constraint bank"):
            return self._build()


def training_set(hand: Hand, config: RunConfig, number: int) -> TrainingSet:
    """Returns procedural objects, those of a folder, or both, with procedural constraints or those
    of constraint sets.

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
        form = functools.partial(bank_form, hand, task, pool)
        return TrainingSet(pool, form, functools.partial(build_bank, hand, task, pool, seed))
    found, sets = load_pool(objects), list[Message]()
    if objects.constraints:
        found, sets = load_for(pathlib.Path(objects.constraints), found, objects.split)
        if not sets:
            raise CongraspError(
                f"{objects.constraints} holds no constraint set ({objects.split}) of an object in "
                f"{objects.folder}.",
                "Pass folders that belong together.",
            )
        if sets[0].meta["hand"] != hand.name:
            raise CongraspError(
                f"The constraint sets in {objects.constraints} are for the hand "
                f"'{sets[0].meta['hand']}'.",
                f"Generate them for '{hand.name}', or train that hand.",
            )
    pool = scale_objects(hand, task, found)
    captured = with_columns(hand, task, bank_of(sets, objects.split)) if sets else None
    bank = captured or build_bank(hand, task, pool, seed)
    if not objects.procedural:
        return _built(pool, bank)
    more = dataclasses.replace(objects, folder="", constraints="", count=objects.procedural)
    beside = scale_objects(hand, task, load_pool(more, number))
    both = stacked([*rows_of(bank), *rows_of(build_bank(hand, task, beside, seed))])
    if share := objects.folder_share:
        weights = [share / len(pool)] * len(pool) + [(1 - share) / len(beside)] * len(beside)
        both = both._replace(weight=both.weight * np.array(weights, np.float32))
    return _built(pool + beside, with_columns(hand, task, both))


def _built(objects: list[GraspObject], bank: ConstraintBank) -> TrainingSet:
    """The training set of a bank."""
    return TrainingSet(objects, lambda: jax.eval_shape(lambda: bank), lambda: bank)


_MEMORY = 50.0
"""Average number of episodes of each object after which an outcome's weight decays by a factor
e.
"""
_PRIOR = 5.0
"""Number of episodes for which the rate of the larger group counts, in addition to those of the
object or family.
"""
_BOUND = 2.0
"""Largest factor on an object's weight, and the inverse of the smallest one."""


class FailureWeights:
    """Counts of the episodes of N objects, and the sampling weights that follow from them.

    With n episodes of an object of which f failed, both forgotten exponentially, its failure rate
    is estimated as p = (f + k p_family) / (n + k), k = 5, where the family's rate is regularised in
    the same way towards that of all objects. With its variance v = p (1 - p) and the mean of all
    objects, m, the weight is (v + m) / 2m, between a half and two: most is learnt where success is
    most uncertain.
    """

    def __init__(self, weight: np.ndarray, families: Sequence[str]):
        """Starts without episodes.

        Args:
          weight: (N,) weights while all objects have the same failure rate.
          families: families of the N objects.
        """
        self._weight = np.asarray(weight, float)
        self._families, self._family = np.unique(np.asarray(families), return_inverse=True)
        self._episodes = np.zeros(len(self._weight))
        self._failures = np.zeros(len(self._weight))

    def add(self, objects: np.ndarray, success: np.ndarray) -> None:
        """Counts E episodes with these objects (E,) int, and their success (E,)."""
        kept = np.exp(-len(objects) / (_MEMORY * len(self._weight)))
        for total, outcome in (
            (self._episodes, np.ones(len(objects))),
            (self._failures, 1.0 - np.asarray(success)),
        ):
            total *= kept
            np.add.at(total, np.asarray(objects, int), outcome)

    def metrics(self) -> dict[str, float]:
        """Failure rates by family, and the largest and least factor on an object's weight."""
        factor = self._factors
        return {
            **{
                f"failure/{name}": float(rate)
                for name, rate in zip(self._families, self._family_rates, strict=True)
            },
            "weight_most": float(factor.max()),
            "weight_least": float(factor.min()),
        }

    @property
    def weights(self) -> np.ndarray:
        """Weights (N,) float32."""
        return (self._weight * self._factors).astype(np.float32)

    @property
    def _factors(self) -> np.ndarray:
        """Factors (N,) on the weights."""
        rates = (self._failures + _PRIOR * self._family_rates[self._family]) / (
            self._episodes + _PRIOR
        )
        variance = rates * (1 - rates)
        mean = variance.mean()
        if mean == 0.0:
            return np.ones(len(self._weight))
        return np.clip((variance + mean) / (2 * mean), 1 / _BOUND, _BOUND)

    @property
    def _family_rates(self) -> np.ndarray:
        """Failure rates (families,); zero before any episode."""
        episodes, failures = (
            np.bincount(self._family, total) for total in (self._episodes, self._failures)
        )
        return (failures + _PRIOR * self._rate) / (episodes + _PRIOR)

    @property
    def _rate(self) -> float:
        """Failure rate of all objects."""
        return float(self._failures.sum() / max(self._episodes.sum(), 1.0))
