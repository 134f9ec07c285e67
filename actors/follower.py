"""Follows the episodes of one environment across rollouts, for logs and pictures."""

from typing import NamedTuple

import jax
import numpy as np

from congrasp.actors.env_state import EnvState
from congrasp.actors.rollout import Trace
from congrasp.common.task.types import Goal, Surface


class TracedEpisode(NamedTuple):
    """An episode from its beginning, without a batch axis."""

    goal: Goal
    surface: Surface
    object_index: int
    trace: Trace
    """Trace up to the episode's last step."""


class Follower:
    """Concatenates the traces of successive rollouts from the beginning of an episode on."""

    def __init__(self) -> None:
        """Creates an idle follower."""
        self._followed: TracedEpisode | None = None

    def forget(self) -> None:
        """Drops the followed episode, because the environments restart."""
        self._followed = None

    def add(
        self, trace: Trace, before: EnvState | None, after: EnvState, *, due: bool
    ) -> TracedEpisode | None:
        """Adds a rollout.

        Args:
          trace: (T, ...) trace of environment 0.
          before: the environments before the rollout, if environment 0 was at the beginning of an
            episode.
          after: the environments after the rollout.
          due: follows an episode that begins in the rollout, if none is being followed.

        Returns:
          The episode, once its last rollout arrives; None if a later episode ends in the same
          rollout, since the rollout only has metrics of its last one.
        """
        if self._followed is not None:
            self._followed = _continue_episode(self._followed, trace)
        elif due:
            self._followed = _first_part(trace, before, after)
        if self._followed is None:
            return None
        ends = np.flatnonzero(self._followed.trace.terminal)
        if not len(ends):
            return None
        finished = Trace(*(field[: ends[0] + 1] for field in self._followed.trace))
        episode = self._followed._replace(trace=finished)
        self._followed = None
        if len(ends) > 1:
            return None
        return episode


def _continue_episode(episode: TracedEpisode, trace: Trace) -> TracedEpisode:
    """Returns the episode with the trace of the next rollout."""
    fields = []
    for before, new in zip(episode.trace, trace, strict=True):
        fields.append(np.concatenate([before, new]))
    return episode._replace(trace=Trace(*fields))


def _first_part(trace: Trace, before: EnvState | None, after: EnvState) -> TracedEpisode | None:
    """Returns the first part of an episode that begins in a rollout; None if none begins.

    If the rollout starts at the beginning of an episode, it is that episode, otherwise the last one
    that begins in the rollout. See `Follower.add` for the arguments.
    """
    if before is not None:
        return _begin(before, trace, 0)
    ends = np.flatnonzero(np.asarray(trace.terminal))
    if not len(ends):
        return None
    first = int(ends[-1]) + 1
    if first >= len(trace.terminal):
        return None
    return _begin(after, trace, first)


def _begin(state: EnvState, trace: Trace, first: int) -> TracedEpisode:
    """Returns an episode with the goal and object of a state, whose trace begins with step `first`
    of a rollout.
    """
    return TracedEpisode(
        goal=state.goal.row(0),
        surface=jax.tree.map(lambda array: np.asarray(array[0]), state.surface),
        object_index=int(np.asarray(state.reset_state.object_index[0])),
        trace=Trace(*(np.asarray(field)[first:] for field in trace)),
    )
