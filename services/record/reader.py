"""Reads what a run recorded: metrics, episodes and rollouts.

A killed writer's file is readable up to its last flush, a damaged one without its damaged chunks.
"""

import collections
import logging
import pathlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, TypeVar

import numpy as np
from mcap.writer import MCAP0_MAGIC

from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError, os_errors_as
from congrasp.common.io.inputs import open_file, parse_json
from congrasp.common.wire.codec import Message, decode
from congrasp.services.record.mcap_messages import Dropped, read_messages
from congrasp.services.record.writer import EPISODE_SCHEMA, PART, ROLLOUT_SCHEMA, flatten

_METRICS_PREFIX = "/metrics/"
_MAX_TOPIC_CHARACTERS = 100  # in messages
_log = logging.getLogger(__name__)
_T = TypeVar("_T")


class Record(NamedTuple):
    """One message of a file."""

    topic: str
    schema: str
    """Name of its schema."""
    encoding: str
    time: int
    """Nanoseconds since 1970."""
    data: bytes


def log_files(path: pathlib.Path) -> list[pathlib.Path]:
    """The recordings at `path`, a file or a folder (with those below it), in the order of their
    names.

    Raises:
      CongraspError: there are no recordings.
    """
    if not path.exists():
        raise CongraspError(
            f"There is no file or folder {path}.", "Pass a run's folder or an MCAP file."
        )
    if path.is_file():
        return [path]
    files = [*path.rglob("*.mcap"), *path.rglob(f"*.mcap{PART}")]
    if not files:
        raise CongraspError(
            f"There is no recording (*.mcap) in {path}.", "Pass a run's folder or an MCAP file."
        )
    return sorted(files, key=lambda file: (file.name, file))


def read_records(
    path: pathlib.Path,
    topic_filter: Callable[[str], bool] = lambda topic: True,
    warn: Callable[[str], None] = _log.warning,
) -> Iterator[Record]:
    """Yields the messages of one file in the order of writing, as far as the file is intact.

    Args:
      path: the file.
      topic_filter: returns True for the topics to read.
      warn: called at the end with the number and places of messages lost by damage, and for a file
        that lacks its end with the seconds that may be missing.

    Raises:
      CongraspError: the file cannot be opened, or is not an MCAP file.
    """
    dropped = Dropped()
    with os_errors_as(f"{path} cannot be read"), open_file(path) as file:
        start = file.read(len(MCAP0_MAGIC))
        if not MCAP0_MAGIC.startswith(start):  # a file may also be cut within these bytes
            raise CongraspError(
                f"{path} is not an MCAP file.", "Pass a file written by 'congrasp record'."
            )
        for schema, channel, message in _with_file_in_errors(path, read_messages(file, dropped)):
            if not topic_filter(channel.topic):
                continue
            yield Record(
                topic=channel.topic,
                schema=schema.name if schema else "",
                encoding=channel.message_encoding,
                time=message.log_time,
                data=message.data,
            )
    loss = str(dropped)
    if loss:
        warn(f"{path} is {loss}.")


def _with_file_in_errors(path: pathlib.Path, messages: Iterator[_T]) -> Iterator[_T]:
    """Yields the messages, and names the file in errors of the iterator."""
    try:
        yield from messages
    except CongraspError as error:
        raise CongraspError(f"{path} cannot be read: {error}") from None


def is_episode(topic: str) -> bool:
    """True if a topic is that of an actor's whole episodes."""
    return topic.startswith("/episode/") and topic.endswith("/raw")


def read_metrics(path: pathlib.Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Reads every metric of a run's recordings, by `<role>/<name>/<metric>`.

    Returns:
      For each metric its steps (n,), rising (updates, else versions, else seconds since the first
      message), and values (n,). If a run was resumed from a checkpoint, the later value of a step
      is used.
    """
    series: dict[str, dict[float, float]] = collections.defaultdict(dict)
    first_time: int | None = None
    for file in log_files(path):
        for record in read_records(file, lambda topic: topic.startswith(_METRICS_PREFIX)):
            if first_time is None:
                first_time = record.time
            message = metrics_of(record)
            seconds = (record.time - first_time) / 1e9
            step = message.get("update", message.get("version", seconds))
            process = record.topic.removeprefix(_METRICS_PREFIX)
            for name, value in flatten(message["values"]).items():
                series[f"{process}/{name}"][step] = value
    metrics = {}
    for name, points in sorted(series.items()):
        steps = sorted(points)
        metrics[name] = (np.array(steps), np.array([points[step] for step in steps]))
    return metrics


def metrics_of(record: Record) -> dict[str, Any]:
    """Returns the object of a record of metrics: `values` {name: number, or a group}, and further
    numbers.

    Raises:
      CongraspError: the record is not valid.
    """
    description = f"A record of {ascii(record.topic)[:_MAX_TOPIC_CHARACTERS]}"
    message = parse_json(record.data, description)
    if not _has_metrics(message):
        raise CongraspError(f"{description} has no metrics.")
    return message


def _has_metrics(message: Any) -> bool:
    """True for an object with a group of numbers `values`, whose steps, if any, are numbers."""
    if not isinstance(message, dict):
        return False
    values = message.get("values")
    if not isinstance(values, dict):
        return False
    steps = [message.get(name, 0) for name in ("update", "version")]
    return all(isinstance(number, int | float) for number in [*flatten(values).values(), *steps])


def read_episodes(path: pathlib.Path) -> Iterator[Episode]:
    """Yields the recorded episodes at `path`, a file or a folder, in the order of recording.

    Raises:
      CongraspError: an episode is not valid.
    """
    for message in _messages(path, EPISODE_SCHEMA, is_episode):
        yield Episode.from_message(message)


def pick_episode(path: pathlib.Path, index: int, *, success: bool = False) -> Episode:
    """Returns one of the recorded episodes at `path`.

    Args:
      path: a file or a folder.
      index: index from 0; -1 is the last.
      success: counts only successful episodes.

    Raises:
      CongraspError: there is no such index; the message gives their number.
    """
    # For a negative index, the last -index episodes, of which the first is the requested one.
    last: collections.deque[Episode] = collections.deque(maxlen=max(1, -index))
    count = 0
    for episode in read_episodes(path):
        if success and not episode.success:
            continue
        last.append(episode)
        count += 1
        if count == index + 1:
            break
    if not -count <= index < count:
        kind = "successful episodes" if success else "episodes"
        remedy = "Pass one of 'congrasp record'."
        if count:
            remedy = f"Choose from {-count} to {count - 1}."
        elif success:
            remedy = "Leave out success=True."
        raise CongraspError(f"{path} contains {count} {kind}, none with index {index}.", remedy)
    return last[0] if index < 0 else last[-1]


def read_rollouts(path: pathlib.Path) -> Iterator[Message]:
    """Yields the recorded rollouts at `path`, a file or a folder, as sent by the actors, in the
    order of recording.

    Axes are (T, B, ...); `meta["layout"]` lists the blocks of an observation with their sizes.
    """
    return _messages(path, ROLLOUT_SCHEMA, lambda topic: topic.startswith("/rollout/"))


def _messages(
    path: pathlib.Path, schema: str, topic_filter: Callable[[str], bool]
) -> Iterator[Message]:
    """Yields the decoded messages of one schema on the topics for which `topic_filter` is True."""
    for file in log_files(path):
        for record in read_records(file, topic_filter):
            if record.schema == schema:
                yield decode(record.data)
