"""MCAP files that survive a kill: flushed often, rotated, and renamed to `*.mcap` only when finished."""

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

    Every file holds all channels and schemas it needs. Not thread-safe.
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
        """Creates the directory; the first entry opens the first file.

        Args:
          directory: folder for the files.
          name: prefix of their names.
          run: name of the run, stored in every file.
          max_bytes: size at which a file is finished and the next begins.
          max_seconds: age of a file's first entry at which the next file begins.
          open_file: opens a new file for writing.

        Raises:
          CongraspError: the directory cannot be created.
        """
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise CongraspError(f"The folder {directory} cannot be created: {error.strerror}.") from None
        self._directory, self._name, self._run = directory, name, run
        self._max_bytes, self._max_ns, self._open_file = max_bytes, round(1e9 * max_seconds), open_file
        self._number = 0
        self._file: IO[bytes] | None = None
        self._path = directory
        self.files: list[pathlib.Path] = []

    def write(self, *entries: Entry) -> None:
        """Writes entries that belong together to one file.

        Raises:
          OSError: the disk is full or broken; flushed entries stay readable.
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
        """True if an entry of this time (ns) belongs to the next file."""
        # A clock that was set back must not keep a file open forever.
        return file.tell() > self._max_bytes or abs(time - self._first) > self._max_ns

    def flush(self) -> None:
        """Flushes to the operating system; a killed writer loses only later entries.

        Raises:
          OSError: see `write`.
        """
        if self._file is not None:
            self._writer.flush()

    def close(self) -> None:
        """Finishes the file and gives it its final name; the next entry begins a new one.

        Raises:
          OSError: see `write`; the unfinished file keeps its suffix `.part`.
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
        """Drops the file after an OSError, without writing to it."""
        file, self._file = self._file, None
        if file is not None:
            with contextlib.suppress(OSError):
                file.close()

    def _begin(self, time: int) -> None:
        """Opens a new file under an unused name."""
        stamp = datetime.datetime.fromtimestamp(time / 1e9, datetime.UTC).strftime("%Y%m%dT%H%M%SZ")
        while self._file is None:
            self._path = self._directory / f"{self._name}-{stamp}-{self._number:03d}.mcap{PART}"
            self._number += 1
            with contextlib.suppress(FileExistsError):  # of another recorder
                file = self._open_file(self._path)
                if not self._path.with_suffix("").exists():
                    self._file = file
                else:  # finished by another recorder within this second
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
        """Returns the file's id of a channel, writing its schema first if needed."""
        known = (channel.schema_name, channel.schema)
        if known not in self._schemas:
            self._schemas[known] = self._writer.register_schema(
                channel.schema_name, channel.schema_encoding, channel.schema
            )
        return self._writer.register_channel(channel.topic, channel.encoding, self._schemas[known])
