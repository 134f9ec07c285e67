"""Write-ahead log of accepted rollouts, so that an acknowledgement survives the death of both
processes.

A rollout is written before it is acknowledged: the message as received, with its checksums, in a
file that is renamed once it is complete. It is removed when a checkpoint holds its outcome. Only
rollouts that a resume could use are written: those whose policy is at most `max_staleness` versions
from that of the newest checkpoint, or of the one being written. The folder therefore holds at most
the rollouts admitted within `2 max_staleness + 1` versions, and those queued at a checkpoint.

Files survive the death of all processes. They are not flushed to disk, so a power failure may lose
them.
"""

import contextlib
import pathlib
import re
import threading
from collections.abc import Callable, Iterable
from typing import NamedTuple

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_file
from congrasp.common.io.opening import temporary_file
from congrasp.common.runtime import platforms
from congrasp.common.wire.codec import MAX_MESSAGE, Message, decode, encode
from congrasp.common.wire.messages import RolloutForm, RolloutHeader, validate_rollout
from congrasp.learner.checkpoint import set_aside

FOLDER = "accepted"
"""Folder of a run directory with a folder for each rank."""
PART_SUFFIX = ".part"
"""Suffix of a file that is being written."""
Identity = tuple[str, str, int]
"""Actor, incarnation and sequence."""
_NAME = re.compile(r"(\d{12})~([^~]+)~([^~]+)~(\d+)\.safetensors")


class Recovered(NamedTuple):
    """Rollouts of earlier sessions found by a session of the learner."""

    rollouts: list[tuple[RolloutHeader, Message]]
    """Rollouts in the order of acceptance."""
    damaged: list[Identity]
    """Rollouts with damaged files, which are kept as `*.aside`."""


class WriteAheadLog:
    """Accepted rollouts of one learner that no checkpoint covers; thread-safe."""

    def __init__(
        self,
        folder: pathlib.Path,
        max_staleness: int,
        *,
        write: bool = True,
        log_error: Callable[[str], None] = lambda text: None,
    ):
        """Uses a folder, which is created when needed.

        Args:
          folder: folder of the learner.
          max_staleness: eta, versions.
          write: writes rollouts; existing ones are recovered in any case.
          log_error: called with one line when the disk begins to refuse rollouts.
        """
        self.write = write
        self._folder = folder
        self._max_staleness = max_staleness
        self._log_error = log_error
        self._lock = threading.Lock()
        self._files: dict[Identity, pathlib.Path] = {}
        self._decided: set[Identity] = set()
        self._saved = self._next = 0
        self._number = 0
        self._full = False

    def recover(self, version: int, run_id: str, form: RolloutForm, schema: str) -> Recovered:
        """Reads the rollouts of earlier sessions; must be called once, before all other methods.

        Files of another training are removed.

        Args:
          version: version of the checkpoint from which the learner resumes, 0 without one.
          run_id: id of the run.
          form: see `validate_rollout`.
          schema: see `validate_rollout`.

        Raises:
          CongraspError: a damaged file cannot be renamed.
        """
        self._saved = self._next = version
        recovered = Recovered([], [])
        _remove(self._folder.glob(f"*{PART_SUFFIX}"))  # never acknowledged
        for path in sorted(self._folder.glob("*.safetensors")):
            if (name := _NAME.fullmatch(path.name)) is None:
                continue
            self._number = int(name[1]) + 1
            identity = name[2], name[3], int(name[4])
            try:
                message = decode(read_file(path, MAX_MESSAGE))
                header = validate_rollout(message, form, schema=schema)
                if (*header.owner, header.sequence) != identity:
                    raise CongraspError("The file's name belongs to another rollout.")
            except CongraspError:
                set_aside(path)
                recovered.damaged.append(identity)
                continue
            if header.run_id != run_id:
                _remove([path])
                continue
            self._files[identity] = path
            recovered.rollouts.append((header, message))
        return recovered

    def add(self, header: RolloutHeader, message: Message) -> bool:
        """Writes an accepted rollout if a resume could use it; returns False if that fails."""
        identity = *header.owner, header.sequence
        with self._lock:  # also while it is being written: another thread may have the same rollout
            distance = min(abs(header.version - version) for version in (self._saved, self._next))
            if not self.write or identity in self._files or distance > self._max_staleness:
                return True
            path = self._folder / f"{self._number:012d}~{'~'.join(map(str, identity))}.safetensors"
            try:
                self._folder.mkdir(parents=True, exist_ok=True)
                with temporary_file(path, PART_SUFFIX) as (part, file):
                    file.write(encode(message))
                    file.close()
                    platforms.replace(part, path)
            except OSError as error:
                is_new = not self._full
                self._full = True
                why = error.strerror
            else:
                self._files[identity] = path
                self._number += 1
                self._full = False
                return True
        if is_new:
            self._log_error(
                f"Accepted rollouts cannot be written to {self._folder} ({why}). Until they can, "
                f"they do not "
                "survive the learner."
            )
        return False

    def begin_checkpoint(self, version: int) -> None:
        """Records that a checkpoint of this version is about to be written.

        The rollouts for a resume from the checkpoint are kept.
        """
        with self._lock:
            self._next = version

    def cover(self, waiting: Iterable[Identity]) -> None:
        """Records the rollouts that the coming checkpoint covers: those stored and not queued.

        Args:
          waiting: the queued rollouts.
        """
        with self._lock:
            self._decided = self._files.keys() - set(waiting)

    def end_checkpoint(self) -> None:
        """Records that the checkpoint exists, and removes the rollouts it covers."""
        self._saved = self._next
        self.discard(self._decided)

    def discard(self, identities: Iterable[Identity]) -> None:
        """Removes rollouts that must not be recovered."""
        with self._lock:
            paths = [
                self._files.pop(identity) for identity in identities if identity in self._files
            ]
        _remove(paths)


def stored(run_dir: pathlib.Path) -> set[Identity] | None:
    """Rollouts in the folders of all learners of a run; None if it has no such folder."""
    folder = run_dir / FOLDER
    if not folder.is_dir():
        return None
    names = (_NAME.fullmatch(path.name) for path in folder.glob("*/*.safetensors"))
    return {(name[2], name[3], int(name[4])) for name in names if name}


def _remove(paths: Iterable[pathlib.Path]) -> None:
    """Removes files. A file that remains is ignored or too old when it is read again."""
    for path in paths:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
