"""Episodes in the recordings of a run, searched by their time."""

import contextlib
import pathlib
import threading
from typing import Any, NamedTuple

from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError, os_errors_as
from congrasp.common.wire.codec import Message, decode
from congrasp.services.record.chunks import DamagedChunkError
from congrasp.services.record.mcap_messages import intact_summary, messages_between
from congrasp.services.record.reader import (
    is_episode,
    log_files,
    read_records,
)
from congrasp.services.record.writer import EPISODE_SCHEMA

MOST = 60
"""Maximum number of episodes of one search: those nearest to the time."""
FARTHER = (1.0, 5.0, 25.0)
"""Factors on the time searched, tried in turn until there is an episode."""


class _RecordedEpisode(NamedTuple):
    """An encoded episode of a file."""

    time: int
    """Nanoseconds since 1970."""
    topic: str
    data: bytes


class Recordings:
    """The episodes in a folder of recordings.

    Episodes of the last search stay in memory, for the player.
    """

    def __init__(self, path: pathlib.Path):
        """Reads nothing until the first search, because files may appear and grow.

        Raises:
          CongraspError: there is no folder or recording of this name.
        """
        remedy = "Name a run's folder, or its recordings."
        if not path.exists():
            raise CongraspError(f"There is no file or folder {path}.", remedy)
        if not path.is_dir() and ".mcap" not in path.suffixes:
            raise CongraspError(f"{path} is not a recording (*.mcap).", remedy)
        self.path = path
        self._lock = threading.Lock()
        self._messages: dict[str, Message] = {}

    def around(self, time: float, seconds: float) -> tuple[float, list[dict[str, Any]]]:
        """Episodes that were recorded around a time, in the order of their times.

        Args:
          time: seconds since 1970.
          seconds: largest distance from it; the search widens by `FARTHER` while it finds none.

        Returns:
          The distance searched (s), and the list entry of each episode; its `id` is for `episode`.

        Raises:
          CongraspError: there are no recordings, or a file cannot be read.
        """
        files = log_files(self.path)
        for farther in FARTHER:
            distance_s = farther * seconds
            begin = int(1e9 * (time - distance_s))
            end = int(1e9 * (time + distance_s))
            recorded: list[_RecordedEpisode] = []
            for file in files:
                recorded += _within(file, begin, end)
            if recorded:
                break
        nearest = sorted(recorded, key=lambda item: abs(item.time - 1e9 * time))[:MOST]
        nearest.sort(key=lambda item: item.time)
        messages = {f"{item.time}{item.topic}": decode(item.data) for item in nearest}
        with self._lock:
            self._messages = messages
        return distance_s, [_row(key, message) for key, message in messages.items()]

    def episode(self, key: str) -> Episode:
        """An episode of the last search.

        Raises:
          CongraspError: the last search did not find it, or it is not valid.
        """
        with self._lock:
            message = self._messages.get(key)
        if message is None:
            raise CongraspError(
                "This episode is not in the current list.", "Click the curve again."
            )
        return Episode.from_message(message)


def _row(key: str, message: Message) -> dict[str, Any]:
    """List entry of an episode."""
    time, _, topic = key.partition("/")
    return {
        "id": key,
        "time": int(time) / 1e9,
        "actor": topic.split("/")[1],
        "object": message.meta.get("object"),
        "version": message.meta.get("version"),
        "success": bool(message.meta.get("success")),
    }


def _within(file: pathlib.Path, begin: int, end: int) -> list[_RecordedEpisode]:
    """Episodes of a file between two times, ns."""
    indexed = _by_index(file, begin, end)
    if indexed is not None:
        return indexed
    episodes: list[_RecordedEpisode] = []
    for record in read_records(file, is_episode):
        if record.schema == EPISODE_SCHEMA and begin <= record.time <= end:
            episodes.append(_RecordedEpisode(record.time, record.topic, record.data))
    return episodes


def _by_index(file: pathlib.Path, begin: int, end: int) -> list[_RecordedEpisode] | None:
    """Does the work of `_within` by the index of a finished file; None if it is unfinished, or
    damaged where read.
    """
    with (
        os_errors_as(f"{file} cannot be read"),
        contextlib.suppress(DamagedChunkError),
        file.open("rb") as stream,
    ):
        summary = intact_summary(stream)
        if summary is None or summary.statistics is None:
            return None
        statistics = summary.statistics
        if statistics.message_start_time > end or statistics.message_end_time < begin:
            return []
        topics = [
            channel.topic for channel in summary.channels.values() if is_episode(channel.topic)
        ]
        episodes: list[_RecordedEpisode] = []
        for schema, channel, message in messages_between(stream, summary, topics, begin, end):
            if schema is not None and schema.name == EPISODE_SCHEMA:
                episodes.append(_RecordedEpisode(message.log_time, channel.topic, message.data))
        return episodes
    return None
