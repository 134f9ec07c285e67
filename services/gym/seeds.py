"""Seeds of parallel environments, each with a stream of episodes of its own."""

import functools
import operator
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from congrasp.actors import draws
from congrasp.actors.initial import InitialConditions
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling.bank import ConstraintBank

Seed = int | Sequence[int | None] | None
"""One for all environments, of which number i gets i more, or one for each; None keeps a stream."""


class EpisodeStreams:
    """Initial conditions of B environments, by a seed and a count of episodes for each.

    What an environment draws depends neither on the other ones nor on when these end.
    """

    def __init__(self, hand: Hand, task: TaskConfig, bank: ConstraintBank, count: int):
        """Seeds the streams of `count` environments with entropy of the system."""
        self._hand = hand
        self._task = task
        self._bank = bank
        entropy = np.random.SeedSequence()
        self._keys = entropy.generate_state(2 * count).reshape(count, 2)
        self._drawn = np.zeros(count, np.uint32)

    def seed(self, seed: Seed) -> None:
        """Restarts the streams with these seeds, non-negative integers of any size.

        Raises:
          CongraspError: a seed is negative or not an integer, or there is not one for each
            environment.
        """
        for index, one in enumerate(self._each(seed)):
            if one is None:
                continue
            self._keys[index] = np.random.SeedSequence(_checked(one)).generate_state(2)
            self._drawn[index] = 0

    def draw(self, mask: np.ndarray) -> InitialConditions:
        """Draws the next episodes of the masked environments (B,); other rows hold any."""
        conditions = _draw(self._hand, self._task, self._bank, self._keys, self._drawn)
        self._drawn = self._drawn + mask.astype(np.uint32)
        return conditions

    def _each(self, seed: Seed) -> list[int | None]:
        """Returns the seed of each environment."""
        count = len(self._keys)
        if seed is None:
            return [None] * count
        if isinstance(seed, Sequence | np.ndarray):
            if len(seed) != count:
                raise CongraspError(
                    f"There are {len(seed)} seeds for {count} environments.",
                    "Pass one for each, or a single integer.",
                )
            return list(seed)
        first = _checked(seed)
        return [first + index for index in range(count)]


def _checked(seed: Any) -> int:
    """Returns a seed as an integer; raises a CongraspError for another value."""
    try:
        number = operator.index(seed)
    except TypeError:
        number = -1
    if number < 0:
        raise CongraspError(f"The seed is {seed!r}.", "It must be a non-negative integer.")
    return number


@functools.partial(jax.jit, static_argnums=(0, 1))
def _draw(
    hand: Hand, task: TaskConfig, bank: ConstraintBank, keys: jax.Array, numbers: jax.Array
) -> InitialConditions:
    """Draws an episode for each of B environments, by its key (B, 2) and number (B,)."""

    def one(key_data: jax.Array, number: jax.Array) -> InitialConditions:
        """Draws a batch of a single episode."""
        key = jax.random.fold_in(jax.random.wrap_key_data(key_data), number)
        return draws.sample(hand, task, bank, key, 1)

    batches = jax.vmap(one)(keys, numbers)
    return jax.tree.map(lambda array: array[:, 0], batches)
