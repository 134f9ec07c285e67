"""An episode of environment 0 for the logs, which begins within one rollout and may end some rollouts later."""

from typing import NamedTuple

import numpy as np

from congrasp.actors.env import EnvState
from congrasp.actors.rollout import Trace
from congrasp.common.task.types import Goal, Surface


class Followed(NamedTuple):
    """An episode from its beginning on."""

    goal: Goal
    """Without a batch axis, as the surface."""
    surface: Surface
    object_index: int
    trace: Trace
    """To the episode's last step."""


class Follower:
    """Puts the traces of successive rollouts together, from the beginning of an episode on."""

    def __init__(self) -> None:
        """Follows nothing yet."""
        self._begun: Followed | None = None

    def forget(self) -> None:
        """Drops what is followed: the environments start anew."""
        self._begun = None

    def add(self, trace: Trace, before: EnvState | None, after: EnvState, *, due: bool) -> Followed | None:
        """Takes a rollout.

        Args:
          trace: (T, ...) of environment 0.
          before: the environments before it, if environment 0 was at an episode's beginning.
          after: the environments after it.
          due: whether to follow an episode that begins in it, where none is followed.

        Returns:
          The episode with the rollout in which it ends, unless another one ends in it, too: what the rollout says of
          its last episode would be said of the wrong one.
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
    """An episode whose goal and object a state has, and whose trace begins with step `first` of a rollout."""
    return Followed(
        state.goal.row(0),
        Surface(*(np.asarray(field[0]) for field in state.surface)),
        int(np.asarray(state.reset_state.object_index[0])),
        Trace(*(np.asarray(field)[first:] for field in trace)),
    )
