"""Episodes around a time, from a run's MCAP files."""

import pathlib
import threading
from typing import Any

from mcap.reader import make_reader

from congrasp.common.errors import CongraspError
from congrasp.common.wire.codec import Message, decode
from congrasp.services.record.reader import is_episode, log_files, read_records
from congrasp.services.record.salvage import DAMAGE, intact_summary
from congrasp.services.record.scene import EPISODE_SCHEMA

MOST = 60
"""Maximum number of episodes of one search: those nearest to the time."""
FARTHER = (1.0, 5.0, 25.0)
"""Factors on the time searched, tried in turn until there is an episode."""


class Recordings:
    """The episodes in a folder of recordings, found by their time.

    Episodes of the last search stay in memory, for the player.
    """

    def __init__(self, path: pathlib.Path):
        """Reads nothing until the first search, because files may appear and grow."""
        self.path = path
        self._lock = threading.Lock()
        self._found: dict[str, Message] = {}

    def check(self) -> None:
        """Raises a CongraspError if there is no folder or recording of this name."""
        remedy = "Name a run's folder, or its recordings."
        if not self.path.exists():
            raise CongraspError(f"There is no file or folder {self.path}.", remedy)
        if not self.path.is_dir() and ".mcap" not in self.path.suffixes:
            raise CongraspError(f"{self.path} is no recording (*.mcap).", remedy)

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
            begin, end = (int(1e9 * (time + sign * farther * seconds)) for sign in (-1, 1))
            found = [item for file in files for item in _within(file, begin, end)]
            if found:
                break
        found = sorted(found, key=lambda item: abs(item[0] - 1e9 * time))[:MOST]
        kept = {f"{when}{topic}": decode(data) for when, topic, data in sorted(found, key=lambda item: item[0])}
        with self._lock:
            self._found = kept
        return farther * seconds, [_row(key, message) for key, message in kept.items()]

    def episode(self, key: str) -> Message:
        """An episode of the last search.

        Raises:
          CongraspError: the last search did not find it.
        """
        with self._lock:
            if key not in self._found:
                raise CongraspError("This episode is not among those found last.", "Click the curve again.")
            return self._found[key]


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


def _within(file: pathlib.Path, begin: int, end: int) -> list[tuple[int, str, bytes]]:
    """Time (ns), topic and bytes of a file's raw episodes between two times."""
    if (found := _by_index(file, begin, end)) is not None:
        return found
    return [
        (record.time, record.topic, record.data)
        for record in read_records(file, is_episode)
        if record.schema == EPISODE_SCHEMA and begin <= record.time <= end
    ]


def _by_index(file: pathlib.Path, begin: int, end: int) -> list[tuple[int, str, bytes]] | None:
    """Does the work of `_within` by the index of a finished file; None if it is unfinished, or damaged where read."""
    try:
        with file.open("rb") as stream:
            if (summary := intact_summary(stream)) is None or (statistics := summary.statistics) is None:
                return None
            if statistics.message_start_time > end or statistics.message_end_time < begin:
                return []
            topics = [channel.topic for channel in summary.channels.values() if is_episode(channel.topic)]
            messages = (
                make_reader(stream, validate_crcs=True).iter_messages(topics, starting_at=begin, ending_before=end)
                if topics
                else ()
            )
            return [
                (message.log_time, channel.topic, message.data)
                for schema, channel, message in messages
                if schema is not None and schema.name == EPISODE_SCHEMA
            ]
    except DAMAGE:
        return None
    except OSError as error:
        raise CongraspError(f"{file} cannot be read: {error.strerror}.") from None
