"""Episodes of environment 0 for the logs, which may extend over several rollouts."""

from typing import NamedTuple

import jax
import numpy as np

from congrasp.actors.env import EnvState
from congrasp.actors.rollout import Trace
from congrasp.common.task.types import Goal, Surface


class Followed(NamedTuple):
    """An episode from its beginning."""

    goal: Goal
    """Goal and surface, without a batch axis."""
    surface: Surface
    object_index: int
    trace: Trace
    """Trace up to the episode's last step."""


class Follower:
    """Concatenates the traces of successive rollouts from the beginning of an episode on."""

    def __init__(self) -> None:
        """Creates an idle follower."""
        self._begun: Followed | None = None

    def forget(self) -> None:
        """Drops the followed episode, because the environments restart."""
        self._begun = None

    def add(self, trace: Trace, before: EnvState | None, after: EnvState, *, due: bool) -> Followed | None:
        """Adds a rollout.

        Args:
          trace: (T, ...) trace of environment 0.
          before: the environments before the rollout, if environment 0 was at the beginning of an episode.
          after: the environments after the rollout.
          due: follows an episode that begins in the rollout, if none is being followed.

        Returns:
          The episode, once its last rollout arrives; None if a later episode ends in the same rollout, since the
          rollout only has metrics of its last one.
        """
        if self._begun is not None:
            parts = zip(self._begun.trace, trace, strict=True)
            self._begun = self._begun._replace(trace=Trace(*(np.concatenate([*fields]) for fields in parts)))
        elif due and before is not None:
            self._begun = _begun(before, trace, 0)
        elif due and len(ends := np.flatnonzero(np.asarray(trace.terminal))) and ends[-1] + 1 < len(trace.terminal):
            self._begun = _begun(after, trace, int(ends[-1]) + 1)
        if self._begun is None or not len(ends := np.flatnonzero(self._begun.trace.terminal)):
            return None
        whole = self._begun._replace(trace=Trace(*(field[: ends[0] + 1] for field in self._begun.trace)))
        self._begun = None
        return whole if len(ends) == 1 else None


def _begun(state: EnvState, trace: Trace, first: int) -> Followed:
    """Returns an episode with the goal and object of a state, whose trace begins with step `first` of a rollout."""
    return Followed(
        state.goal.row(0),
        jax.tree.map(lambda array: np.asarray(array[0]), state.surface),
        int(np.asarray(state.reset_state.object_index[0])),
        Trace(*(np.asarray(field)[first:] for field in trace)),
    )
