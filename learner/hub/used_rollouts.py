"""The learner's journal: rollouts used by updates, dropped, and undone by resumes.

Every session of the learner begins with a line that gives the checkpoint's version. Earlier updates
of that version or later ones were lost with their process: the rollouts that they used are undone.
The next line lists which of these, and of the queued ones, the session recovers.
"""

import pathlib
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from congrasp.common.io.journal import (
    AUDIT,
    Journal,
    JournalLines,
    has_fields,
    is_rows,
    read_journal,
)
from congrasp.common.wire.codec import Message, checksum
from congrasp.learner.hub.write_ahead import Identity

_ROWS = ("taken", "dropped", "spoilt", "unwritten", "end")


class Used(NamedTuple):
    """A rollout used by an update."""

    actor: str
    incarnation: str
    sequence: int
    lag: int
    """Versions between its policy and the one updated."""
    checksum: str
    """Checksum of its content when it was used."""


class AuditLog:
    """Writes the journal of one learner."""

    def __init__(
        self, run_dir: pathlib.Path, name: str, log_error: Callable[[str], None] = lambda text: None
    ):
        """Opens the journal of the learner called `name`, appending to an existing one."""
        self._path = journal_path(run_dir, name)
        self._journal = Journal(self._path, log_error)

    def begin(
        self, session_id: str, run_id: str, version: int, max_staleness: int, *, kept: bool
    ) -> int:
        """Records the start of a session from a checkpoint of `version`, or 0.

        Args:
          session_id: id of the session.
          run_id: id of the run.
          version: version of the checkpoint.
          max_staleness: eta, versions.
          kept: True if accepted rollouts are written to disk.

        Returns:
          The number of rollouts lost by undoing updates.
        """
        self._journal.write(
            session_id=session_id,
            run_id=run_id,
            version=version,
            max_staleness=max_staleness,
            kept=kept,
        )
        return len(replay(read_uses(self._path).intact)[1])

    def record_recovered(
        self, taken: Sequence[Identity], stale: Sequence[Identity], damaged: Sequence[Identity]
    ) -> None:
        """Records rollouts of earlier sessions that are queued again, too old, or damaged on
        disk.
        """
        self._journal.write(taken=taken, dropped=stale, spoilt=damaged)

    def record_unwritten(self, identities: Sequence[Identity]) -> None:
        """Records accepted rollouts that could not be written to disk; a resume cannot recover
        them.
        """
        self._journal.write(unwritten=identities)

    def record_checkpoint(self, version: int) -> None:
        """Records a checkpoint of this version."""
        self._journal.write(saved=version)

    def record_uses(self, version: int, lags: Sequence[int], messages: Sequence[Message]) -> None:
        """Records rollouts passed to the update that follows `version`."""
        rows = [
            [*_identity(message), lag, checksum(message)]
            for lag, message in zip(lags, messages, strict=True)
        ]
        self._journal.write(version=version, used=rows)

    def record_dropped(self, identities: Iterable[Identity]) -> None:
        """Records accepted rollouts that became too old."""
        self._journal.write(dropped=list(identities))

    def end(self, waiting: Iterable[Identity]) -> None:
        """Records the orderly end of the session, with these accepted rollouts unused."""
        self._journal.write(end=list(waiting))
        self._journal.close()


def journal_path(run_dir: pathlib.Path, name: str) -> pathlib.Path:
    """Path of the journal of the learner called `name`."""
    return run_dir / AUDIT / f"learner-{name}.jsonl"


def read_uses(path: pathlib.Path) -> JournalLines:
    """Reads the lines of a learner's journal; raises a CongraspError if the file cannot be read."""
    return read_journal(path, _is_entry)


def _is_entry(entry: dict[str, Any]) -> bool:
    """True if a line is a valid entry of an `AuditLog`."""
    if "session_id" in entry:
        return has_fields(entry, session_id=str, run_id=str, version=int, max_staleness=int)
    if "used" in entry:
        return has_fields(entry, version=int) and is_rows(entry["used"], str, str, int, int, str)
    rows = [entry[name] for name in _ROWS if name in entry]
    return all(is_rows(each, str, str, int) for each in rows) and (
        bool(rows) or has_fields(entry, saved=int)
    )


def journalled_version(run_dir: pathlib.Path) -> int:
    """Newest version that a run may have published, by its journals; -1 without journals.

    Rollouts used at a version lead to the next version.
    """
    versions = [-1]
    for path in sorted((run_dir / AUDIT).glob("learner-*.jsonl")):
        versions += [e["version"] + ("used" in e) for e in read_uses(path).intact if "version" in e]
    return max(versions)


def replay(entries: Iterable[dict[str, Any]]) -> tuple[list[Used], list[Used]]:
    """Returns the valid uses, and those undone by resumes from checkpoints, in order."""
    standing: list[tuple[int, Used]] = []
    undone: list[Used] = []
    for entry in entries:
        if "session_id" in entry:
            undone += [use for version, use in standing if version >= entry["version"]]
            standing = [(version, use) for version, use in standing if version < entry["version"]]
        for row in entry.get("used", ()):
            standing.append((entry["version"], Used(*row)))
    return [use for _, use in standing], undone


def _identity(message: Message) -> tuple[str, str, int]:
    return message.meta["actor"], message.meta["incarnation"], message.meta["sequence"]
