"""One episode as an MCAP file."""

import pathlib
import time

from congrasp.common.episode.episode import Episode
from congrasp.common.errors import os_errors_as
from congrasp.common.io.spelling import check_spelling
from congrasp.common.runtime import platforms
from congrasp.services.record.episode_entries import raw_entry, scene_entries
from congrasp.services.record.writer import JsonChannels, LogWriter


def save_episode(path: pathlib.Path, actor: str, episode: Episode) -> None:
    """Writes an episode, under this name of an actor, as an MCAP file.

    Raises:
      CongraspError: the file cannot be written, or the episode is that of a motion file.
    """
    with os_errors_as(f"{path} could not be written"):
        check_spelling(path)
        # The hidden file gets its name when it is complete.
        writer = LogWriter(path.parent, f".{path.stem}", run=episode.object)
        start = time.time_ns()
        raw = raw_entry(actor, episode.to_message(), start)
        try:
            writer.write(raw, *scene_entries(actor, episode, start, 0, JsonChannels()))
            writer.close()
            platforms.replace(writer.files[-1], path)
        except BaseException:  # also an interrupt
            writer.abandon()
            for file in writer.files:
                file.unlink(missing_ok=True)
            raise
