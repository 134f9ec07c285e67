"""Audit: the outcome of every rollout of a run, from the journals of its actors and its learner.

An actor's journal lists the rollouts that it sent, with checksums, and every reply. The learner's
journal lists the rollouts that it used, with checksums from the start of the update, those that it
dropped, and where its sessions began and ended. Neither process reads the other's journal, and this
module uses the learner's code to read its files, but none that accepts or drops rollouts.

The content of missing or damaged lines of a journal is unknown. Rollouts that they may concern are
not faults, but are counted as not in the journals, and reported as unjudged. A journal without its
last lines is recognised by the note next to it (`common.io.journal_end`), by the newest version of
the run's files, and by accepted rollouts without a file.
"""

import collections
import contextlib
import dataclasses
import pathlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from rich.table import Table

from congrasp.common.errors import CongraspError
from congrasp.common.io.journal import (
    AUDIT,
    JournalLines,
    has_fields,
    read_journal,
    user_journals,
)
from congrasp.learner.hub.used_rollouts import Used, read_uses, replay
from congrasp.learner.hub.write_ahead import stored
from congrasp.learner.run_directory import version_of_files

Identity = tuple[str, str, int]
"""Actor, incarnation and sequence number of a rollout."""
FAULTS = {
    "lost": "loss",
    "duplicated": "surplus",
    "corrupted": "damage",
    "unmatched": "surplus",
    "above the limit on lag": "surplus",
}
"""Faults of rollouts, and their kinds."""
EXIT_CODES = {"loss": 1, "surplus": 5, "damage": 6, "unjudged": 7}
"""Exit codes of `congrasp audit` by kind, the most serious first; 2 to 4 are those of errors."""
UNJUDGED = "not in the journals"
"""Outcome of accepted rollouts that cannot be judged."""


class SentRollout(NamedTuple):
    """A rollout as recorded by its actor."""

    version: int
    """Version of its policy."""
    checksum: str
    replies: list[tuple[str, str]]
    """Outcome and the learner's session id, for each reply."""


class Report(NamedTuple):
    """Outcome of every rollout of a run."""

    counts: dict[str, int]
    """Number of rollouts by outcome; `made` and `accepted` are totals, the last are `FAULTS`."""
    faults: list[str]
    """One line for each rollout that was lost, duplicated, corrupted or unmatched."""
    lag_mean: float
    """Mean lag of all used rollouts, versions."""
    lag_max: int
    """Largest lag of a used rollout, versions."""
    max_staleness: int
    """Largest limit on lag, versions."""
    holes: int
    """Lines missing from the journals because of a full disk, or cut at the end."""
    damaged: int
    """Damaged lines of the journals."""
    missing: int
    """Places in the journals from which lines were removed, and journals without a line."""
    unchecked: int
    """Lines of older versions of congrasp, between which missing ones cannot be detected."""
    unrecorded: tuple[int, int] | None = None
    """Newest version of the learners' journals, and that of the run's files, if it is newer."""

    @property
    def exit_code(self) -> int:
        """0 without findings, else that of the most serious kind."""
        kinds = {kind for name, kind in FAULTS.items() if self.counts[name]}
        if self.damaged or self.counts.get("damaged on disk"):
            kinds.add("damage")
        if self.missing or self.counts.get(UNJUDGED) or not self.counts["made"]:
            kinds.add("unjudged")
        for kind, code in EXIT_CODES.items():
            if kind in kinds:
                return code
        return 0


class _Gaps(NamedTuple):
    """True for kinds of journals with missing lines."""

    actors: bool
    learners: bool


def compare(run_dir: pathlib.Path, more: Sequence[pathlib.Path] = ()) -> Report:
    """Compares the journals of a run.

    Args:
      run_dir: directory of the run.
      more: journals of actors on other machines.

    Raises:
      CongraspError: there are no journals.
    """
    if not run_dir.is_dir():
        raise CongraspError(f"There is no folder {run_dir}.", "Pass the folder of a run.")
    learner_files = _learner_files(run_dir / AUDIT)
    actor_files = _actor_files(run_dir / AUDIT, learner_files, more)
    # In this order, since a running learner writes meanwhile: a rollout that an actor knows to be
    # accepted, and that the learner has not used, is in one of the two listings of files.
    of_actors = [read_journal(path, _is_entry) for path in actor_files]
    reached = version_of_files(run_dir)
    files = stored(run_dir)
    of_learners = [read_uses(path) for path in learner_files]
    if files is not None:
        files |= stored(run_dir) or set()
    gaps = _Gaps(actors=_has_gaps(of_actors), learners=_has_gaps(of_learners))
    outcomes = _outcomes(journal.intact for journal in of_learners)._replace(files=files)
    report = _compare(_sent_rollouts(of_actors), outcomes, gaps, [*of_actors, *of_learners])
    covered = _covered_version(of_learners)
    if covered < reached and not gaps.learners:
        return report._replace(missing=report.missing + 1, unrecorded=(covered, reached))
    return report


def _learner_files(folder: pathlib.Path) -> list[pathlib.Path]:
    """Returns the journals of a run's learners; raises a CongraspError if there are none."""
    files = sorted(folder.glob("learner-*.jsonl"))
    if not files:
        raise CongraspError(
            f"There is no journal of a learner in {folder}.",
            "An actor in the learner's process ('--actors 0', '--inside') and '--no-audit' write "
            "no journal.",
        )
    return files


def _actor_files(
    folder: pathlib.Path, learner_files: Sequence[pathlib.Path], more: Sequence[pathlib.Path]
) -> list[pathlib.Path]:
    """Returns the journals of a run's actors: those in its folder, this user's, and more; raises a
    CongraspError if there are none.
    """
    files = [path for path in sorted(folder.glob("*.jsonl")) if path not in learner_files]
    user_folders = _user_folders([read_uses(path) for path in learner_files])
    for user_folder in user_folders:
        files += sorted(user_folder.glob("*.jsonl"))
    files += more
    if not files:
        places = " or ".join(str(place) for place in (folder, *user_folders))
        raise CongraspError(
            f"There is no journal of an actor in {places}.",
            "Copy the journals of actors on other machines from ~/.local/state/congrasp/audit "
            "there, and pass them with --journals FILE.",
        )
    return files


def _has_gaps(journals: Iterable[JournalLines]) -> bool:
    """True if any of the journals lacks lines."""
    return any(journal.lost or journal.damaged or journal.missing for journal in journals)


def _covered_version(journals: Iterable[JournalLines]) -> int:
    """Newest version that a run can have reached by its learners' journals.

    An update leads to one more than its line says, and so may every start of a session, which skips
    versions that were lost.
    """
    newest = -1
    sessions = 0
    for journal in journals:
        for entry in journal.intact:
            sessions += "session_id" in entry
            if "version" in entry:
                newest = max(newest, entry["version"] + ("used" in entry))
    return newest + sessions


def _user_folders(journals: Iterable[JournalLines]) -> list[pathlib.Path]:
    """Folders in which actors of this user on this machine keep the journals of a run, by the run
    ids in its learners' journals.
    """
    run_ids: set[str] = set()
    for journal in journals:
        run_ids |= {str(entry["run_id"]) for entry in journal.intact if "run_id" in entry}
    folders: list[pathlib.Path] = []
    for run_id in sorted(run_ids):
        with contextlib.suppress(CongraspError):  # a damaged journal may name anything
            folders.append(user_journals(run_id))
    return folders


def _is_entry(entry: dict[str, Any]) -> bool:
    """True if a line is a valid entry of an actor."""
    if "made" in entry:
        return has_fields(entry, made=int, version=int, checksum=str)
    if "answer" in entry:
        return has_fields(entry, answer=int, outcome=str, session_id=str)
    return has_fields(entry, actor=str, incarnation=str)


def _sent_rollouts(journals: Iterable[JournalLines]) -> dict[Identity, SentRollout]:
    """Rollouts sent by actors, and the replies they received."""
    sent: dict[Identity, SentRollout] = {}
    for journal in journals:
        sender: tuple[str, str] | None = None
        for entry in journal.entries:
            if entry is None:
                sender = None  # unnamed lines that follow may belong to another incarnation
                continue
            if has_fields(entry, actor=str, incarnation=str):
                sender = entry["actor"], entry["incarnation"]
            if sender is None:
                continue
            if "made" in entry:
                sent[*sender, entry["made"]] = SentRollout(entry["version"], entry["checksum"], [])
                continue
            rollout = sent.get((*sender, entry.get("answer", -1)))
            if rollout is not None:
                rollout.replies.append((entry["outcome"], entry["session_id"]))
    return sent


@dataclasses.dataclass
class _Session:
    """Initial state of a learner's session, and its record of unused rollouts."""

    session_id: str
    run_id: str
    version: int
    max_staleness: int
    """Limit on lag, versions."""
    writes_ahead: bool
    """Accepted rollouts were written to disk before the acknowledgement; older versions of congrasp
    did not do so.
    """
    fell_back: bool
    """It began from a checkpoint older than the newest, which was damaged or missing."""
    has_recovered: bool
    """It has recovered the rollouts on disk, after which it accepts new ones."""
    recovered: set[Identity] = dataclasses.field(default_factory=set)
    """Rollouts of earlier sessions that it queued again."""
    unwritten: set[Identity] = dataclasses.field(default_factory=set)
    """Accepted rollouts that could not be written to disk."""
    checkpoint_version: int = 0
    """Version of its newest checkpoint."""
    waiting: set[Identity] | None = None
    """Queued rollouts at its end; None while it runs, or if it was killed."""

    def has_accepted(self, identity: Identity, accepted_by: set[str]) -> bool:
        """True if it accepted a rollout, or recovered it from an earlier session.

        Args:
          identity: the rollout.
          accepted_by: ids of the sessions that accepted it, by its actor's journal.
        """
        return self.session_id in accepted_by or identity in self.recovered


class _Outcomes(NamedTuple):
    """Actions of the learners on rollouts."""

    sessions_of_learners: list[list[_Session]]
    """Sessions of each learner, in order."""
    uses: dict[Identity, list[Used]]
    """Uses by updates that no resume undid."""
    undone: set[Identity]
    """Rollouts with a use that a resume undid."""
    dropped: set[Identity]
    """Accepted rollouts that became too old."""
    damaged_on_disk: set[Identity]
    files: set[Identity] | None = None
    """Accepted rollouts on disk; None if the run has no folder of them."""


def _outcomes(journals: Iterable[list[dict[str, Any]]]) -> _Outcomes:
    """Collects outcomes from the intact lines of each learner's journal."""
    outcomes = _Outcomes(
        sessions_of_learners=[],
        uses=collections.defaultdict(list),
        undone=set(),
        dropped=set(),
        damaged_on_disk=set(),
    )
    for entries in journals:
        outcomes.sessions_of_learners.append(_sessions(entries))
        uses, undone_uses = replay(entries)
        for use in uses:
            outcomes.uses[use.actor, use.incarnation, use.sequence].append(use)
        for use in undone_uses:
            outcomes.undone.add((use.actor, use.incarnation, use.sequence))
        for entry in entries:
            outcomes.dropped.update(_identities(entry, "dropped"))
            outcomes.damaged_on_disk.update(_identities(entry, "spoilt"))
    return outcomes


def _sessions(entries: list[dict[str, Any]]) -> list[_Session]:
    """Sessions of one learner, in order, without those killed before they had recovered the
    rollouts on disk.

    Args:
      entries: lines of its journal, as `used_rollouts.AuditLog` writes them.
    """
    sessions: list[_Session] = []
    newest_checkpoint = -1
    for entry in entries:
        if "session_id" in entry:
            writes_ahead = entry.get("kept") is True
            session = _Session(
                session_id=entry["session_id"],
                run_id=entry["run_id"],
                version=entry["version"],
                max_staleness=entry["max_staleness"],
                writes_ahead=writes_ahead,
                fell_back=entry["version"] < newest_checkpoint,
                has_recovered=not writes_ahead,
            )
            sessions.append(session)
            newest_checkpoint = entry["version"]
        newest_checkpoint = entry.get("saved", newest_checkpoint)
        if not sessions:
            continue
        session = sessions[-1]
        session.checkpoint_version = newest_checkpoint
        session.has_recovered |= "taken" in entry
        session.recovered.update(_identities(entry, "taken"))
        session.unwritten.update(_identities(entry, "unwritten"))
        if "end" in entry:
            session.waiting = _identities(entry, "end")
    return [session for session in sessions if session.has_recovered]


def _identities(entry: dict[str, Any], name: str) -> set[Identity]:
    """Rollouts in the field `name` of a line."""
    return {(actor, incarnation, sequence) for actor, incarnation, sequence in entry.get(name, ())}


class _Findings:
    """Counts of outcomes, and faults."""

    def __init__(self) -> None:
        self.counts: collections.Counter[str] = collections.Counter()
        self.faults: list[str] = []

    def add_fault(self, kind: str, identity: Identity, text: str) -> None:
        """Counts a fault, and records the rollout."""
        self.counts[kind] += 1
        name = "/".join(map(str, identity))
        self.faults.append(f"{name}: {text}")


def _compare(
    sent: dict[Identity, SentRollout],
    outcomes: _Outcomes,
    gaps: _Gaps,
    journals: Sequence[JournalLines],
) -> Report:
    """Compares every rollout's replies with the actions of the learner's sessions."""
    findings = _Findings()
    findings.counts["made"] = len(sent)
    max_staleness = _max_staleness(outcomes.sessions_of_learners)
    for identity, text in _too_late(outcomes.uses, max_staleness):
        findings.add_fault("above the limit on lag", identity, text)
    _check_uses(findings, sent, outcomes, gaps)
    _check_acceptances(findings, sent, outcomes, gaps)
    lags = _lags(outcomes.uses)
    counts = dict(findings.counts) | {name: findings.counts[name] for name in FAULTS}
    return Report(
        counts=counts,
        faults=findings.faults,
        lag_mean=sum(lags) / max(1, len(lags)),
        lag_max=max(lags, default=0),
        max_staleness=max_staleness,
        holes=sum(journal.lost for journal in journals),
        damaged=sum(journal.damaged for journal in journals),
        missing=sum(journal.missing for journal in journals),
        unchecked=sum(journal.unchecked for journal in journals),
    )


def _check_uses(
    findings: _Findings, sent: dict[Identity, SentRollout], outcomes: _Outcomes, gaps: _Gaps
) -> None:
    """Compares the rollouts that the learners used with those that actors sent."""
    incarnations = {identity[:2] for identity in sent}
    for identity, uses in outcomes.uses.items():
        if identity[:2] not in incarnations:
            findings.counts["of actors without a journal"] += 1
            continue
        rollout = sent.get(identity)
        if rollout is None and gaps.actors:
            findings.counts["used, not in the journals"] += 1
        elif rollout is None:
            findings.add_fault("unmatched", identity, "used, but never sent")
        elif any(use.checksum != rollout.checksum for use in uses):
            findings.add_fault("corrupted", identity, "used with different content than sent")
        # With gaps, the line with which a resume undid one of them may be missing.
        if len(uses) > 1 and not gaps.learners:
            findings.add_fault("duplicated", identity, f"used {len(uses)} times")


def _check_acceptances(
    findings: _Findings, sent: dict[Identity, SentRollout], outcomes: _Outcomes, gaps: _Gaps
) -> None:
    """Counts the outcomes of the rollouts that actors sent, and finds accepted ones that were
    lost.
    """
    for identity, rollout in sent.items():
        replies = [outcome for outcome, _ in rollout.replies]
        if "accepted" not in replies and "duplicate" not in replies:
            used = identity in outcomes.uses
            findings.counts[_outcome_without_acceptance(replies, used=used)] += 1
            continue
        findings.counts["accepted"] += 1
        outcome = _judge(identity, rollout, outcomes, gaps)
        if outcome == "lost":
            findings.add_fault("lost", identity, "accepted, but missing afterwards")
        else:
            findings.counts[outcome] += 1


def _outcome_without_acceptance(replies: Sequence[str], *, used: bool) -> str:
    """Outcome of a rollout whose actor received no acceptance."""
    if used:
        return "used, answer lost"
    return replies[-1] if replies else "unanswered"


def _lags(uses: Mapping[Identity, list[Used]]) -> list[int]:
    """Lags of all uses, versions."""
    lags: list[int] = []
    for uses_of_rollout in uses.values():
        lags += [use.lag for use in uses_of_rollout]
    return lags


def _too_late(uses: Mapping[Identity, list[Used]], limit: int) -> Iterator[tuple[Identity, str]]:
    """Yields the rollouts that were used more than `limit` versions after their policies, each
    with the fault in words.
    """
    for identity, uses_of_rollout in uses.items():
        lag = max(use.lag for use in uses_of_rollout)
        if lag > limit:
            yield identity, f"used {lag} versions after its policy; the limit is {limit}"


def _max_staleness(sessions_of_learners: Iterable[list[_Session]]) -> int:
    """Largest limit on lag of all sessions, versions."""
    limits = [0]
    for sessions in sessions_of_learners:
        limits += [session.max_staleness for session in sessions]
    return max(limits)


def _judge(identity: Identity, rollout: SentRollout, outcomes: _Outcomes, gaps: _Gaps) -> str:
    """Outcome of an accepted rollout; a loss cannot be judged while lines are missing."""
    outcome = _outcome(identity, rollout, outcomes)
    if outcome == "lost" and any(gaps):
        return UNJUDGED
    return outcome


def _outcome(identity: Identity, rollout: SentRollout, outcomes: _Outcomes) -> str:
    """Outcome of an accepted rollout, from the last session that accepted it and the next one."""
    if identity in outcomes.uses:
        return "used"
    if identity in outcomes.dropped:
        return "dropped"
    if identity in outcomes.damaged_on_disk:
        return "damaged on disk"
    accepted_by = set()
    for reply, session_id in rollout.replies:
        if reply in ("accepted", "duplicate"):
            accepted_by.add(session_id)
    for sessions in outcomes.sessions_of_learners:
        accepting = [
            n for n, session in enumerate(sessions) if session.has_accepted(identity, accepted_by)
        ]
        if not accepting:
            continue
        n = accepting[-1]
        if n + 1 == len(sessions):
            return _outcome_in_last_session(identity, rollout.version, sessions[n], outcomes.files)
        undone = identity in outcomes.undone
        return _outcome_after_restart(
            identity, rollout.version, sessions[n], sessions[n + 1], undone=undone
        )
    return UNJUDGED


def _outcome_in_last_session(
    identity: Identity, version: int, last: _Session, files: set[Identity] | None
) -> str:
    """Outcome of a rollout that the last session accepted and neither used nor dropped.

    If the session runs, or was killed, the rollout's file shows that it waits. Rollouts that no
    resume could use have no file: their versions are too far from that of the newest checkpoint.

    Args:
      identity: the rollout.
      version: version of its policy.
      last: the learner's last session.
      files: rollouts on disk; None if the run has no folder of them.
    """
    if last.waiting is not None:
        if identity in last.waiting:
            return "waiting"
        return "lost"
    has_file = files is None or identity in files
    needs_file = last.writes_ahead and identity not in last.unwritten
    if has_file or not needs_file or abs(version - last.checkpoint_version) > last.max_staleness:
        return "waiting"
    return UNJUDGED


def _outcome_after_restart(
    identity: Identity, version: int, last: _Session, after: _Session, *, undone: bool
) -> str:
    """Outcome of a rollout that the next session did not recover; "lost" without a reason.

    Args:
      identity: the rollout.
      version: version of its policy.
      last: the last session that had accepted it.
      after: the session after that.
      undone: True if an update used it and a resume undid the update.
    """
    if abs(version - after.version) > after.max_staleness or after.run_id != last.run_id:
        return "undone" if undone else "too old after a restart"
    if not last.writes_ahead or identity in last.unwritten or after.fell_back:
        return "undone" if undone else "not kept on disk"
    return "lost"


def outcome_table(run_dir: pathlib.Path, report: Report) -> Table:
    """Table of the outcomes and of the journals' lines."""
    table = Table("rollouts", "number", "kind", title=f"Audit of {run_dir}")
    for name, value in report.counts.items():
        style = "bold red" if name in FAULTS and value else ""
        table.add_row(name, str(value), FAULTS.get(name, ""), style=style)
    table.add_section()
    style = "bold red" if report.damaged else ""
    table.add_row("damaged lines", str(report.damaged), "damage", style=style)
    kind = "unchecked" if report.unchecked else ""
    table.add_row("lines of older versions", str(report.unchecked), kind)
    return table


def remarks(report: Report) -> Iterator[str]:
    """Yields lines about lag, and about what the journals lack."""
    yield (
        f"Lag: mean {report.lag_mean:.2f}, maximum {report.lag_max} of {report.max_staleness} "
        f"versions."
    )
    if report.holes:
        yield (
            f"{report.holes} line(s) are missing in the journals: the disk was full, or their end "
            f"was cut."
        )
    if report.unrecorded:
        covered, reached = report.unrecorded
        yield (
            f"The run reached version {reached}, but the learner's journal ends at version "
            f"{covered}: its end is missing."
        )
    if report.missing:
        yield (
            f"Lines are missing at {report.missing} place(s) of the journals: they were emptied or "
            f"cut."
        )
    if report.exit_code == EXIT_CODES["unjudged"]:
        count = report.counts.get(UNJUDGED, 0)
        accepted = report.counts.get("accepted", 0)
        yield (f"The run cannot be judged: {count} of {accepted} accepted rollouts are {UNJUDGED}.")
