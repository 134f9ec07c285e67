"""Metrics of learners for TensorBoard and Weights & Biases."""

import json
import pathlib
import secrets
import sys
from collections.abc import Callable, Mapping
from typing import Any, Literal, Protocol

from congrasp.services.record.writer import Entry, flatten

_TOPIC = "/metrics/learner/"
"""Prefix of the topics of learners' metrics."""
_W_AND_B_START_S = 20
"""Deadline of the start of Weights & Biases."""


class ScalarWriter(Protocol):
    """Writer of a learner's metrics."""

    def write(self, learner: str, seconds: float, step: int, values: Mapping[str, float]) -> None:
        """Writes the scalars of an update, `seconds` since 1970."""

    def close(self) -> None:
        """Finishes."""


class MetricWriters:
    """A sink of `services.record.recorder.Recorder` for learners' metrics; a failed writer is not
    used again.
    """

    def __init__(self, writers: Mapping[str, ScalarWriter]):
        """Creates a sink with writers by name."""
        self._writers = dict(writers)

    def write(self, entry: Entry) -> None:
        """Accepts an entry; entries that are not metrics of a learner are ignored."""
        if not entry.channel.topic.startswith(_TOPIC):
            return
        message = json.loads(entry.data)
        values = {name: float(value) for name, value in flatten(message["values"]).items()}
        step = int(message.get("update", message.get("version", 0)))
        learner = entry.channel.topic.removeprefix(_TOPIC)
        self._for_each(lambda writer: writer.write(learner, 1e-9 * entry.time, step, values))

    def close(self) -> None:
        """Finishes every writer."""
        self._for_each(lambda writer: writer.close())

    def _for_each(self, action: Callable[[ScalarWriter], None]) -> None:
        """Calls `action` with every writer; one that fails is removed, with a warning."""
        for name, writer in list(self._writers.items()):
            try:
                action(writer)
            except Exception as error:  # a failed writer must not end the training
                del self._writers[name]
                text = (
                    f"congrasp: {name} receives no more metrics ({type(error).__name__}: {error}); "
                    f"the run continues."
                )
                print(text, file=sys.stderr, flush=True)


class TensorBoard:
    """Event files, one folder per learner; written synchronously, so that there is no thread to
    wait for.
    """

    def __init__(self, folder: pathlib.Path):
        """Writes nothing yet; `folder` gets a folder for each learner."""
        self._folder = folder
        self._files: dict[str, Any] = {}

    def write(self, learner: str, seconds: float, step: int, values: Mapping[str, float]) -> None:
        """Writes the scalars of an update."""
        from tensorboardX.proto.event_pb2 import Event, SessionLog
        from tensorboardX.proto.summary_pb2 import Summary

        file = self._files.get(learner)
        if file is None:
            file = self._open_events(learner)
            self._files[learner] = file
            # A resumed run repeats steps: TensorBoard purges those of an earlier file from here on.
            file.write_event(
                Event(wall_time=seconds, step=step, session_log=SessionLog(status=SessionLog.START))
            )
        summary = Summary(
            value=[Summary.Value(tag=name, simple_value=value) for name, value in values.items()]
        )
        file.write_event(Event(wall_time=seconds, step=step, summary=summary))
        file.flush()

    def _open_events(self, learner: str) -> Any:
        """Opens a new event file of a learner."""
        from tensorboardX.event_file_writer import EventsWriter

        folder = self._folder / f"learner-{learner}"
        folder.mkdir(parents=True, exist_ok=True)
        # The writer's names only differ by the second, and it overwrites a file of the same name.
        return EventsWriter(str(folder / "events"), f".{secrets.token_hex(4)}")

    def close(self) -> None:
        """Finishes."""
        for file in self._files.values():
            file.close()


class WeightsAndBiases:
    """A run of Weights & Biases; offline it is stored in the run's folder and uploaded with `wandb
    sync`.
    """

    def __init__(self, folder: pathlib.Path, run: str, config: Mapping[str, Any], *, offline: bool):
        """Starts the run of this name and configuration; its files are in `folder`."""
        import wandb

        mode: Literal["offline", "online"] = "offline" if offline else "online"
        settings = wandb.Settings(
            console="off", silent=True, x_disable_stats=True, init_timeout=_W_AND_B_START_S
        )
        self._run = wandb.init(
            project="congrasp",
            name=run,
            group=run,
            dir=str(folder),
            config=dict(config),
            mode=mode,
            settings=settings,
        )
        self._run.define_metric("*", step_metric="update")

    def write(self, learner: str, seconds: float, step: int, values: Mapping[str, float]) -> None:
        """Writes the scalars of an update."""
        prefix = "" if learner == "0" else f"learner-{learner}/"
        scalars = {f"{prefix}{name}": value for name, value in values.items()}
        self._run.log({**scalars, "update": step})

    def close(self) -> None:
        """Finishes."""
        import wandb

        self._run.finish()
        wandb.teardown()  # waits for the process that writes the file
