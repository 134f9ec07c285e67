"""Reads recordings, complete, cut off or damaged: a killed writer's file is readable up to its last flush."""

import collections
import logging
import pathlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import MCAP0_MAGIC

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import open_file, parse_json
from congrasp.common.wire.codec import Message, decode
from congrasp.services.record.channels import ROLLOUT_SCHEMA, flatten
from congrasp.services.record.salvage import Dropped, read_messages
from congrasp.services.record.scene import EPISODE_SCHEMA, check_episode
from congrasp.services.record.writer import PART

_log = logging.getLogger(__name__)


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
    """The recordings at `path`, a file or a folder (with those below it), in the order of their names.

    Raises:
      CongraspError: there are no recordings.
    """
    if not path.exists():
        raise CongraspError(f"There is no file or folder {path}.", "Pass a run's folder or an MCAP file.")
    if path.is_file():
        return [path]
    found = sorted([*path.rglob("*.mcap"), *path.rglob(f"*.mcap{PART}")], key=lambda file: (file.name, file))
    if not found:
        raise CongraspError(f"There is no recording (*.mcap) in {path}.", "Pass a run's folder or an MCAP file.")
    return found


def read_records(
    path: pathlib.Path, wanted: Callable[[str], bool] = lambda topic: True, warn: Callable[[str], None] = _log.warning
) -> Iterator[Record]:
    """Yields the messages of one file in the order of writing, as far as the file is intact.

    Args:
      path: the file.
      wanted: predicate of the topics to read.
      warn: called at the end with the number and places of messages lost by damage, if any.

    Raises:
      CongraspError: the file cannot be opened, or is not an MCAP file.
    """
    dropped = Dropped()
    try:
        with open_file(path) as file:
            start = file.read(len(MCAP0_MAGIC))
            if not MCAP0_MAGIC.startswith(start):
                raise CongraspError(f"{path} is not an MCAP file.", "Pass a file written by 'congrasp record'.")
            for schema, channel, message in read_messages(file, dropped):
                if wanted(channel.topic):
                    name = schema.name if schema else ""
                    yield Record(channel.topic, name, channel.message_encoding, message.log_time, message.data)
    except OSError as error:
        raise CongraspError(f"{path} cannot be read: {error.strerror}.") from None
    if text := str(dropped):
        warn(f"{path} is {text}.")


def is_episode(topic: str) -> bool:
    """True if a topic is that of an actor's whole episodes."""
    return topic.startswith("/episode/") and topic.endswith("/raw")


def read_metrics(path: pathlib.Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Reads every metric of a run's recordings, by `<role>/<name>/<metric>`.

    Returns:
      For each metric its steps (n,), rising (updates, else versions, else seconds since the first message), and values
      (n,). If a run was resumed from a checkpoint, the later value of a step is used.
    """
    series: dict[str, dict[float, float]] = collections.defaultdict(dict)
    first: int | None = None
    for file in log_files(path):
        for record in read_records(file, lambda topic: topic.startswith("/metrics/")):
            first = record.time if first is None else first
            message = metrics_of(record)
            step = message.get("update", message.get("version", (record.time - first) / 1e9))
            for name, value in flatten(message["values"]).items():
                series[f"{record.topic.removeprefix('/metrics/')}/{name}"][step] = value
    return {
        name: (np.array(sorted(points)), np.array([points[step] for step in sorted(points)]))
        for name, points in sorted(series.items())
    }


def metrics_of(record: Record) -> dict[str, Any]:
    """Returns the object of a record of metrics: `values` {name: number, or a group}, and further numbers.

    Raises:
      CongraspError: the record is not valid.
    """
    found = parse_json(record.data, f"A record of {ascii(record.topic)[:100]}")
    values = found.get("values") if isinstance(found, dict) else None
    steps = [found.get(name, 0) for name in ("update", "version")] if isinstance(found, dict) else []
    if not isinstance(values, dict) or not all(isinstance(n, int | float) for n in [*flatten(values).values(), *steps]):
        raise CongraspError(f"A record of {ascii(record.topic)[:100]} has no metrics.")
    return found


def read_episodes(path: pathlib.Path) -> Iterator[Message]:
    """Yields the recorded episodes at `path`, a file or a folder, as sent by the actors, in the order of recording.

    Raises:
      CongraspError: an episode is not valid.
    """
    for episode in _messages(path, EPISODE_SCHEMA, is_episode):
        check_episode(episode)
        yield episode


def pick_episode(path: pathlib.Path, index: int, *, success: bool = False) -> Message:
    """Returns one of the recorded episodes at `path`.

    Args:
      path: a file or a folder.
      index: index from 0; -1 is the last.
      success: counts only successful episodes.

    Raises:
      CongraspError: there is no such index; the message gives their number.
    """
    last: collections.deque[Message] = collections.deque(maxlen=max(1, -index))
    count = 0
    for episode in read_episodes(path):
        if episode.meta["success"] or not success:
            last.append(episode)
            count += 1
            if count == index + 1:
                break
    if not -count <= index < count:
        kind = "successful episodes" if success else "episodes"
        raise CongraspError(f"{path} holds {count} {kind}, none with index {index}.")
    return last[0 if index < 0 else -1]


def read_rollouts(path: pathlib.Path) -> Iterator[Message]:
    """Yields the recorded rollouts at `path`, a file or a folder, as sent by the actors, in the order of recording.

    Axes are (T, B, ...); `meta["layout"]` lists the blocks of an observation with their sizes.
    """
    return _messages(path, ROLLOUT_SCHEMA, lambda topic: topic.startswith("/rollout/"))


def _messages(path: pathlib.Path, schema: str, wanted: Callable[[str], bool]) -> Iterator[Message]:
    """Yields decoded messages of one schema on the wanted topics."""
    for file in log_files(path):
        for record in read_records(file, wanted):
            if record.schema == schema:
                yield decode(record.data)
