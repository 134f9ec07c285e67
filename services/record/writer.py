"""MCAP files that survive: flushed often, rotated, named `*.mcap` only when they are finished."""

import contextlib
import datetime
import pathlib
from collections.abc import Callable
from typing import IO

from mcap.writer import CompressionType, IndexType, Writer

from congrasp.common.errors import CongraspError
from congrasp.services.record.channels import CONVENTIONS, Channel, Entry

PART = ".part"
"""Suffix of a file that is being written, or whose writer was killed."""
CHUNK = 1 << 20
"""Bytes of a chunk before compression."""
_INDEXES = IndexType.CHUNK | IndexType.MESSAGE | IndexType.METADATA


class LogWriter:
    """Writes entries to `<directory>/<name>-<UTC time>-<number>.mcap`, one file after another.

    Every file holds all channels and schemas it needs. Not safe for several threads.
    """

    def __init__(
        self,
        directory: pathlib.Path,
        name: str,
        *,
        run: str = "",
        max_bytes: int = 256 << 20,
        max_seconds: float = 600.0,
        open_file: Callable[[pathlib.Path], IO[bytes]] = lambda path: path.open("xb"),
    ):
        """Makes the directory; the first file begins with the first entry.

        Args:
          directory: where files go.
          name: how their names begin.
          run: name of the run, kept in every file.
          max_bytes: size at which a file is finished and the next begins.
          max_seconds: age of a file's first entry at which the same happens.
          open_file: opens a new file for writing.

        Raises:
          CongraspError: the directory cannot be made.
        """
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise CongraspError(f"The folder {directory} cannot be made: {error.strerror}.") from None
        self._directory, self._name, self._run = directory, name, run
        self._max_bytes, self._max_ns, self._open_file = max_bytes, round(1e9 * max_seconds), open_file
        self._number = 0
        self._file: IO[bytes] | None = None
        self._path = directory
        self.files: list[pathlib.Path] = []

    def write(self, *entries: Entry) -> None:
        """Adds entries that belong together: they come into one file.

        Raises:
          OSError: the disk is full or broken; what was flushed before stays readable.
        """
        if not entries:
            return
        if self._file is not None and self._is_over(self._file, entries[0].time):
            self.close()
        if self._file is None:
            self._begin(entries[0].time)
        for entry in entries:
            channel = self._channels.get(entry.channel)
            if channel is None:
                channel = self._channels[entry.channel] = self._register(entry.channel)
            self._sequences[channel] = sequence = self._sequences.get(channel, 0) + 1
            self._writer.add_message(channel, entry.time, entry.data, entry.time, sequence)

    def _is_over(self, file: IO[bytes], time: int) -> bool:
        """Whether an entry of this time (ns) belongs into the next file."""
        # A clock that was set back must not keep a file open for ever.
        return file.tell() > self._max_bytes or abs(time - self._first) > self._max_ns

    def flush(self) -> None:
        """Hands everything so far to the operating system; a killed writer loses only what comes after.

        Raises:
          OSError: as `write`.
        """
        if self._file is not None:
            self._writer.flush()

    def close(self) -> None:
        """Finishes the file and gives it its final name; the next entry begins a new one.

        Raises:
          OSError: as `write`; the unfinished file stays, with its suffix `.part`.
        """
        file, self._file = self._file, None
        if file is None:
            return
        with file:
            self._writer.finish()
        final = self._path.with_suffix("")
        self._path.rename(final)
        self.files[-1] = final

    def abandon(self) -> None:
        """After an OSError: lets go of the file without writing more to it."""
        file, self._file = self._file, None
        if file is not None:
            with contextlib.suppress(OSError):
                file.close()

    def _begin(self, time: int) -> None:
        """Opens a new file under a name that no other recorder has taken."""
        stamp = datetime.datetime.fromtimestamp(time / 1e9, datetime.UTC).strftime("%Y%m%dT%H%M%SZ")
        while self._file is None:
            self._path = self._directory / f"{self._name}-{stamp}-{self._number:03d}.mcap{PART}"
            self._number += 1
            with contextlib.suppress(FileExistsError):  # another recorder's
                file = self._open_file(self._path)
                if not self._path.with_suffix("").exists():
                    self._file = file
                else:  # that of another recorder of this second, which is finished
                    file.close()
                    self._path.unlink()
        self._first = time
        self._writer = Writer(self._file, CHUNK, CompressionType.ZSTD, _INDEXES)
        self._channels: dict[Channel, int] = {}
        self._schemas: dict[tuple[str, bytes], int] = {}
        self._sequences: dict[int, int] = {}
        self.files.append(self._path)
        self._writer.start(profile="", library="congrasp")
        self._writer.add_metadata("congrasp", {"run": self._run, **CONVENTIONS})
        self._writer.flush()

    def _register(self, channel: Channel) -> int:
        """The file's id of a channel, whose schema is written with it."""
        known = (channel.schema_name, channel.schema)
        if known not in self._schemas:
            self._schemas[known] = self._writer.register_schema(
                channel.schema_name, channel.schema_encoding, channel.schema
            )
        return self._writer.register_channel(channel.topic, channel.encoding, self._schemas[known])
