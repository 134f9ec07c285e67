"""The learner's journal: which rollouts its updates used, which it dropped, and what a resume undid.

Every session of the learner begins with a line that names the checkpoint's version. What was handed to updates of that
version or later ones, before, died with the process: these rollouts are undone. What the session takes up of them, and
of those that waited, it notes next.
"""

import pathlib
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from congrasp.common.io.journal import AUDIT, Journal, JournalLines, has_fields, is_rows, read_journal
from congrasp.common.wire.codec import Message, checksum
from congrasp.learner.hub.write_ahead import Identity

_ROWS = ("taken", "dropped", "spoilt", "unwritten", "end")


class Used(NamedTuple):
    """A rollout that was handed to an update."""

    actor: str
    incarnation: str
    sequence: int
    lag: int
    """Versions between the policy that acted and the one that learnt."""
    checksum: str
    """Of its content when it was handed over."""


class AuditLog:
    """Writes the journal of one learner."""

    def __init__(self, run_dir: pathlib.Path, name: str, log_error: Callable[[str], None] = lambda text: None):
        """Opens, or goes on with, the journal of the learner called `name`."""
        self._path = journal_path(run_dir, name)
        self._journal = Journal(self._path, log_error)

    def begin(self, session_id: str, run_id: str, version: int, max_staleness: int, *, kept: bool) -> int:
        """A session begins from a checkpoint of `version`, or 0; `kept`: what it accepts is on disk, too.

        Returns how many rollouts the run lost by undoing.
        """
        self._journal.write(life=session_id, epoch=run_id, version=version, max_staleness=max_staleness, kept=kept)
        return len(replay(read_uses(self._path).intact)[1])

    def recovered(self, taken: Sequence[Identity], stale: Sequence[Identity], damaged: Sequence[Identity]) -> None:
        """Rollouts that earlier sessions had accepted wait again, are too old by now, and are damaged on disk."""
        self._journal.write(taken=taken, dropped=stale, spoilt=damaged)

    def unwritten(self, identities: Sequence[Identity]) -> None:
        """Rollouts were accepted though the disk did not take them: they do not survive this session."""
        self._journal.write(unwritten=identities)

    def saved(self, version: int) -> None:
        """There is a checkpoint of this version."""
        self._journal.write(saved=version)

    def used(self, version: int, lags: Sequence[int], messages: Sequence[Message]) -> None:
        """Rollouts are handed to the update that follows `version`."""
        rows = [[*_identity(message), lag, checksum(message)] for lag, message in zip(lags, messages, strict=True)]
        self._journal.write(version=version, used=rows)

    def dropped(self, identities: Iterable[Identity]) -> None:
        """Accepted rollouts had grown too old."""
        self._journal.write(dropped=list(identities))

    def end(self, waiting: Iterable[Identity]) -> None:
        """The session ends in order, with these accepted rollouts unused."""
        self._journal.write(end=list(waiting))
        self._journal.close()


def journal_path(run_dir: pathlib.Path, name: str) -> pathlib.Path:
    """Where the learner called `name` keeps its journal."""
    return run_dir / AUDIT / f"learner-{name}.jsonl"


def read_uses(path: pathlib.Path) -> JournalLines:
    """The lines of a learner's journal; a CongraspError if the file cannot be read."""
    return read_journal(path, _is_entry)


def _is_entry(entry: dict[str, Any]) -> bool:
    """Whether a line is one that an `AuditLog` writes."""
    if "life" in entry:
        return has_fields(entry, life=str, epoch=str, version=int, max_staleness=int)
    if "used" in entry:
        return has_fields(entry, version=int) and is_rows(entry["used"], str, str, int, int, str)
    rows = [entry[name] for name in _ROWS if name in entry]
    return all(is_rows(each, str, str, int) for each in rows) and (bool(rows) or has_fields(entry, saved=int))


def journalled_version(run_dir: pathlib.Path) -> int:
    """The newest version that a run's journals tell of; -1 if there are none. After a use its update's may be out."""
    versions = [-1]
    for path in sorted((run_dir / AUDIT).glob("learner-*.jsonl")):
        versions += [e["version"] + ("used" in e) for e in read_uses(path).intact if "version" in e]
    return max(versions)


def replay(entries: Iterable[dict[str, Any]]) -> tuple[list[Used], list[Used]]:
    """The uses that stand, and those that resumes from checkpoints undid, in their order."""
    standing: list[tuple[int, Used]] = []
    undone: list[Used] = []
    for entry in entries:
        if "life" in entry:
            undone += [use for version, use in standing if version >= entry["version"]]
            standing = [(version, use) for version, use in standing if version < entry["version"]]
        for row in entry.get("used", ()):
            standing.append((entry["version"], Used(*row)))
    return [use for _, use in standing], undone


def _identity(message: Message) -> tuple[str, str, int]:
    return message.meta["actor"], message.meta["incarnation"], message.meta["sequence"]
