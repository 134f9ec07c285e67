"""Episodes in the recordings of a run, searched by their time."""

import heapq
import logging
import pathlib
import threading
from collections.abc import Iterable, Iterator
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
from congrasp.services.record.writer import EPISODE_SCHEMA, PART

MAX_EPISODES = 60
"""Maximum number of episodes of one search: those nearest to the time."""
SEARCH_FACTORS = (1.0, 5.0, 25.0)
"""Factors on the searched radius, tried in turn until there is an episode."""
_log = logging.getLogger(__name__)


class _RecordedEpisode(NamedTuple):
    """An encoded episode of a file."""

    time_ns: int
    """Nanoseconds since 1970."""
    topic: str
    """`/episode/ACTOR/raw`."""
    data: bytes

    @property
    def id(self) -> str:
        """Identifier for the page, unique in a run."""
        return f"{self.time_ns}{self.topic}"

    @property
    def actor(self) -> str:
        """Name of the actor."""
        return self.topic.split("/")[2]


class _Interval(NamedTuple):
    """The times of a search, in nanoseconds since 1970, inclusive."""

    begin_ns: int
    end_ns: int

    def includes(self, time_ns: int) -> bool:
        """Returns True if a time is in the interval."""
        return self.begin_ns <= time_ns <= self.end_ns


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
        # Episodes of the last search by `_RecordedEpisode.id`
        self._messages: dict[str, Message] = {}

    def around(self, time_s: float, radius_s: float) -> tuple[float, list[dict[str, Any]]]:
        """Searches the episodes that were recorded around a time.

        Args:
          time_s: seconds since 1970.
          radius_s: half the width of the searched interval, s. It is multiplied by each of
            `SEARCH_FACTORS` until there is an episode.

        Returns:
          The searched radius, s, and the list entry of each episode, in the order of their times.
          `episode` takes the `id` of an entry.

        Raises:
          CongraspError: there are no recordings, or a file cannot be read.
        """
        searched_s, episodes = _search(log_files(self.path), time_s, radius_s)
        nearest = _nearest(episodes, time_s)
        nearest.sort(key=lambda episode: episode.time_ns)
        messages = {}
        entries = []
        for episode in nearest:
            message = decode(episode.data)
            messages[episode.id] = message
            entries.append(_list_entry(episode, message))
        with self._lock:
            self._messages = messages
        return searched_s, entries

    def episode(self, episode_id: str) -> Episode:
        """Returns an episode of the last search.

        Raises:
          CongraspError: the last search has no episode with this id, or the episode is not valid.
        """
        with self._lock:
            message = self._messages.get(episode_id)
        if message is None:
            raise CongraspError(
                "This episode is not in the current list.", "Click the curve again."
            )
        return Episode.from_message(message)


def _list_entry(episode: _RecordedEpisode, message: Message) -> dict[str, Any]:
    """Returns the entry of an episode in the page's list."""
    return {
        "id": episode.id,
        "time": episode.time_ns / 1e9,
        "actor": episode.actor,
        "object": message.meta.get("object"),
        "version": message.meta.get("version"),
        "success": bool(message.meta.get("success")),
    }


def _search(
    files: list[pathlib.Path], time_s: float, radius_s: float
) -> tuple[float, list[_RecordedEpisode]]:
    """Returns the radius in which there are episodes, s, and these episodes; the largest radius and
    no episode if there are none.
    """
    largest_s = SEARCH_FACTORS[-1] * radius_s
    nearest_of_unindexed: dict[pathlib.Path, list[_RecordedEpisode]] = {}
    for factor in SEARCH_FACTORS:
        searched_s = factor * radius_s
        interval = _interval(time_s, searched_s)
        episodes: list[_RecordedEpisode] = []
        for file in files:
            indexed = None
            if file not in nearest_of_unindexed:
                indexed = _read_by_index(file, interval)
            if indexed is not None:
                episodes += indexed
                continue
            # A file without an index is read whole, so only once, for all radii
            if file not in nearest_of_unindexed:
                in_largest = _read_whole(file, _interval(time_s, largest_s))
                nearest_of_unindexed[file] = _nearest(in_largest, time_s)
            nearest = nearest_of_unindexed[file]
            episodes += [episode for episode in nearest if interval.includes(episode.time_ns)]
        if episodes:
            return searched_s, episodes
    return largest_s, []


def _interval(time_s: float, radius_s: float) -> _Interval:
    """Returns the interval around a time."""
    return _Interval(_nanoseconds(time_s - radius_s), _nanoseconds(time_s + radius_s))


def _nearest(episodes: Iterable[_RecordedEpisode], time_s: float) -> list[_RecordedEpisode]:
    """Returns at most `MAX_EPISODES` episodes, nearest to a time first."""
    time_ns = _nanoseconds(time_s)
    return heapq.nsmallest(
        MAX_EPISODES, episodes, key=lambda episode: abs(episode.time_ns - time_ns)
    )


def _nanoseconds(seconds: float) -> int:
    """Converts seconds to nanoseconds."""
    return int(1e9 * seconds)


def _read_whole(file: pathlib.Path, interval: _Interval) -> Iterator[_RecordedEpisode]:
    """Yields the episodes of an interval from a file that may be unfinished or damaged."""
    warn = _log.warning
    if file.name.endswith(PART):  # unfinished is normal for a file that is being written
        warn = _log.debug
    for record in read_records(file, is_episode, warn):
        if record.schema == EPISODE_SCHEMA and interval.includes(record.time):
            yield _RecordedEpisode(record.time, record.topic, record.data)


def _read_by_index(file: pathlib.Path, interval: _Interval) -> list[_RecordedEpisode] | None:
    """Returns the episodes of an interval, which the index of a finished file locates. None if the
    file has no index, or a chunk of the interval is damaged: `_read_whole` skips the damage.
    """
    with os_errors_as(f"{file} cannot be read"), file.open("rb") as stream:
        summary = intact_summary(stream)
        if summary is None or summary.statistics is None:
            return None
        statistics = summary.statistics
        starts_after = statistics.message_start_time > interval.end_ns
        ends_before = statistics.message_end_time < interval.begin_ns
        if starts_after or ends_before:
            return []
        channels = summary.channels.values()
        topics = [channel.topic for channel in channels if is_episode(channel.topic)]
        episodes: list[_RecordedEpisode] = []
        try:
            for schema, channel, message in messages_between(stream, summary, topics, *interval):
                if schema is not None and schema.name == EPISODE_SCHEMA:
                    episodes.append(_RecordedEpisode(message.log_time, channel.topic, message.data))
        except DamagedChunkError:
            return None
        return episodes
