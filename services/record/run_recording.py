"""The recording of a run: MCAP files, and metrics for other programs."""

import contextlib
import dataclasses
import pathlib
from collections.abc import Iterator, Sequence

from congrasp.common.config import MetricWriter, RunConfig
from congrasp.common.transport.base import Transport
from congrasp.services.record.metric_writers import (
    MetricWriters,
    ScalarWriter,
    TensorBoard,
    WeightsAndBiases,
)
from congrasp.services.record.recorder import Recorder


@contextlib.contextmanager
def recorded(
    transport: Transport,
    config: RunConfig,
    run_dir: pathlib.Path,
    logs: pathlib.Path,
    names: Sequence[MetricWriter],
) -> Iterator[Recorder]:
    """Context that records a run, and passes its metrics to writers.

    Args:
      transport: an endpoint of the run.
      config: the run's configuration.
      run_dir: the run's folder; TensorBoard's files go to `tensorboard` in it, those of Weights &
        Biases to `wandb`.
      logs: folder of the recordings.
      names: names of the writers.

    Raises:
      ModuleNotFoundError: a writer's package is not installed.
    """
    writers: dict[str, ScalarWriter] = {}
    for name in dict.fromkeys(names):
        if name == "tensorboard":
            writers[name] = TensorBoard(run_dir / name)
        else:
            offline = name == "wandb-offline"
            writers[name] = WeightsAndBiases(
                run_dir, config.name, dataclasses.asdict(config), offline=offline
            )
    combined = MetricWriters(writers)
    with (
        contextlib.closing(combined),
        Recorder(transport, config.name, logs, sinks=[combined]) as recorder,
    ):
        yield recorder
