"""Rows of one task, simulated in common batches.

An engine on a device needs nearly as long for a few hundred worlds as for thousands. Episodes do
not depend on the others of their batch, so a row has the same episodes as in batches of its own.
"""

import functools
from collections.abc import Callable, Iterator, Sequence

import jax
import numpy as np

from congrasp.actors.initial import InitialConditions
from congrasp.services.evaluate.episodes import Episodes, Sample, identity, join_samples, reference


def run_rows(
    simulator: Episodes,
    rows: Sequence[InitialConditions],
    *,
    stressed: bool,
    progress: Callable[[int], None],
) -> list[Sample]:
    """Simulates the episodes of several rows.

    Args:
      simulator: simulator of the rows' task, with the objects of all rows.
      rows: initial conditions of the episodes of each row.
      stressed: also simulates the stress test of all episodes (`actors.stress`).
      progress: called with the number of simulated episodes; those of the running batch count by
        their share of control steps.

    Returns:
      The sample of each row.
    """
    lengths = [len(row.hold) for row in rows]
    row_of_episode = np.repeat(np.arange(len(rows)), lengths)
    samples: list[list[Sample]] = [[] for _ in rows]
    finished = 0
    for conditions, count in _batches(rows, simulator.batch):
        report = functools.partial(report_share, progress, finished, count)
        batch = simulator.run(conditions, stressed=stressed, progress=report)
        row_in_batch = np.full(simulator.batch, -1)
        row_in_batch[:count] = row_of_episode[finished : finished + count]
        for row in np.unique(row_in_batch[:count]):
            samples[row].append(batch.sample.where(row_in_batch == row))
        finished += count
        progress(finished)
    return [join_samples(of_row) for of_row in samples]


def with_first_object(conditions: InitialConditions, first: int) -> InitialConditions:
    """Returns episodes of a row whose objects begin at number `first` among those of all rows."""
    start = conditions.reset_state
    start = start._replace(object_index=start.object_index + first)
    return conditions._replace(reset_state=start)


def sample_of_row(sample: Sample, conditions: InitialConditions) -> Sample:
    """Returns a row's sample with indices of the row's own objects.

    Args:
      sample: the row's episodes among those of all rows.
      conditions: the same episodes before `with_first_object`.
    """
    index = np.asarray(conditions.reset_state.object_index)
    of_row = {
        "object_index": index.astype(sample.values["object_index"].dtype),
        "identity": identity(conditions),
        "reference": reference(conditions),
    }
    return Sample({**sample.values, **of_row}, sample.link_force, sample.torque)


def report_share(progress: Callable[[int], None], finished: int, count: int, share: float) -> None:
    """Counts the `count` episodes of a running batch by their share of control steps, in addition
    to those that are finished.
    """
    progress(finished + int(share * count))


def _batches(
    rows: Sequence[InitialConditions], size: int
) -> Iterator[tuple[InitialConditions, int]]:
    """Yields the episodes of all rows in batches of `size`, each with the number of its episodes
    that count: the last batch is padded with repetitions of the last episode.
    """
    episodes = jax.tree.map(lambda *columns: np.concatenate(columns), *rows)
    total = len(episodes.hold)
    for start in range(0, total, size):
        indices = np.minimum(np.arange(start, start + size), total - 1)
        conditions = jax.tree.map(lambda column, indices=indices: column[indices], episodes)
        yield conditions, min(size, total - start)
