"""Audit: the outcome of every rollout of a run, from the journals of its actors and its learner.

Actors record what they sent, with a checksum, and every reply; the learner records what it used,
with a checksum from the start of the update, what it dropped, and where its sessions began and
ended. Neither reads the other's journal, and this module does not use the code that decided.

The content of missing or damaged lines of a journal is unknown. Rollouts that they may concern are
no faults, but are counted as not in the journals, and reported as unjudged. A journal without its
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
"""Actor, incarnation and sequence number."""
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


class Made(NamedTuple):
    """A rollout as recorded by its actor."""

    version: int
    checksum: str
    answers: list[tuple[str, str]]
    """(outcome, session id of the learner)."""


class Report(NamedTuple):
    """Outcome of every rollout of a run."""

    counts: dict[str, int]
    """Numbers of rollouts made and accepted, and the outcomes of accepted ones; the last ones are
    faults.
    """
    faults: list[str]
    """One line for each rollout that was lost, duplicated, corrupted or unmatched."""
    lag_mean: float
    lag_max: int
    max_staleness: int
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
    learners = _learner_journals(run_dir / AUDIT)
    actors = _actor_journals(run_dir / AUDIT, learners, more)
    # In this order, since a running learner writes meanwhile: a rollout that an actor knows to be
    # accepted, and that the learner has not used, is in one of the two listings of files.
    notes = [read_journal(path, _is_entry) for path in actors]
    reached = version_of_files(run_dir)
    files = stored(run_dir)
    books = [read_uses(path) for path in learners]
    if files is not None:
        files |= stored(run_dir) or set()
    gaps = _Gaps(actors=_has_gaps(notes), learners=_has_gaps(books))
    outcomes = _outcomes(book.intact for book in books)._replace(files=files)
    report = _compare(_sent_rollouts(notes), outcomes, gaps, [*notes, *books])
    covered = _covered_version(books)
    if covered < reached and not gaps.learners:
        return report._replace(missing=report.missing + 1, unrecorded=(covered, reached))
    return report


def _learner_journals(folder: pathlib.Path) -> list[pathlib.Path]:
    """Returns the journals of a run's learners; raises a CongraspError if there are none."""
    learners = sorted(folder.glob("learner-*.jsonl"))
    if not learners:
        raise CongraspError(
            f"There is no journal of a learner in {folder}.",
            "An actor in the learner's process ('--actors 0', '--inside') and '--no-audit' write "
            "no journal.",
        )
    return learners


def _actor_journals(
    folder: pathlib.Path, learners: Sequence[pathlib.Path], more: Sequence[pathlib.Path]
) -> list[pathlib.Path]:
    """Returns the journals of a run's actors: those in its folder, this user's, and more; raises a
    CongraspError if there are none.
    """
    actors = [path for path in sorted(folder.glob("*.jsonl")) if path not in learners]
    user_folders = _user_journals([read_uses(path) for path in learners])
    for user_folder in user_folders:
        actors += sorted(user_folder.glob("*.jsonl"))
    actors += more
    if not actors:
        places = " or ".join(str(each) for each in (folder, *user_folders))
        raise CongraspError(
            f"There is no journal of an actor in {places}.",
            "Copy the journals of actors on other machines from ~/.local/state/congrasp/audit "
            "there, and pass them with --journals FILE.",
        )
    return actors


def _has_gaps(journals: Iterable[JournalLines]) -> bool:
    """True if any of the journals lacks lines."""
    return any(each.lost or each.damaged or each.missing for each in journals)


def _covered_version(books: Iterable[JournalLines]) -> int:
    """Newest version that a run can have reached by its learners' journals.

    An update leads to one more than its line says, and so may every start of a session, which skips
    versions that were lost.
    """
    newest = -1
    sessions = 0
    for book in books:
        for entry in book.intact:
            sessions += "session_id" in entry
            if "version" in entry:
                newest = max(newest, entry["version"] + ("used" in entry))
    return newest + sessions


def _user_journals(books: Iterable[JournalLines]) -> list[pathlib.Path]:
    """Folders in which actors of this user on this machine wrote the journals of these runs."""
    run_ids: set[str] = set()
    for book in books:
        run_ids |= {str(entry["run_id"]) for entry in book.intact if "run_id" in entry}
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


def _sent_rollouts(journals: Iterable[JournalLines]) -> dict[Identity, Made]:
    """Rollouts sent by actors, and the replies they received."""
    made: dict[Identity, Made] = {}
    for journal in journals:
        who: tuple[str, str] | None = None
        for entry in journal.entries:
            if entry is None:
                who = None  # unnamed lines that follow may belong to another incarnation
                continue
            if has_fields(entry, actor=str, incarnation=str):
                who = entry["actor"], entry["incarnation"]
            if who is None:
                continue
            if "made" in entry:
                made[*who, entry["made"]] = Made(entry["version"], entry["checksum"], [])
                continue
            answered = made.get((*who, entry.get("answer", -1)))
            if answered is not None:
                answered.answers.append((entry["outcome"], entry["session_id"]))
    return made


@dataclasses.dataclass
class _Session:
    """Initial state of a learner's session, and its record of unused rollouts."""

    session_id: str
    run_id: str
    version: int
    max_staleness: int
    kept: bool
    """Accepted rollouts were written to disk before the acknowledgement; older versions of congrasp
    did not.
    """
    falls_back: bool
    """It began from a checkpoint older than the newest, which was damaged or missing."""
    started: bool
    """It recovered rollouts from disk, after which it accepts."""
    taken: set[Identity] = dataclasses.field(default_factory=set)
    unwritten: set[Identity] = dataclasses.field(default_factory=set)
    saved: int = 0
    """Version of its newest checkpoint."""
    waiting: set[Identity] | None = None
    """Queued rollouts at its end; None while it runs, or if it was killed."""

    def had(self, identity: Identity, accepted_by: set[str]) -> bool:
        """True if it accepted a rollout, or recovered it from an earlier session."""
        return self.session_id in accepted_by or identity in self.taken


class _Outcomes(NamedTuple):
    """Actions of the learners on rollouts."""

    books: list[list[_Session]]
    """Sessions of each learner."""
    standing: dict[Identity, list[Used]]
    undone: set[Identity]
    dropped: set[Identity]
    spoilt: set[Identity]
    files: set[Identity] | None = None
    """Accepted rollouts on disk; None if the run has no folder of them."""


def _outcomes(books: Iterable[list[dict[str, Any]]]) -> _Outcomes:
    """Collects outcomes from the learners' journals."""
    outcomes = _Outcomes([], collections.defaultdict(list), set(), set(), set())
    for book in books:
        outcomes.books.append(_sessions(book))
        stands, lost = replay(book)
        for use in stands:
            outcomes.standing[use.actor, use.incarnation, use.sequence].append(use)
        outcomes.undone.update((use.actor, use.incarnation, use.sequence) for use in lost)
        for entry in book:
            outcomes.dropped.update(_rows(entry, "dropped"))
            outcomes.spoilt.update(_rows(entry, "spoilt"))
    return outcomes


def _sessions(book: list[dict[str, Any]]) -> list[_Session]:
    """Sessions of one learner, in order, without those killed before they recovered anything."""
    sessions: list[_Session] = []
    saved = -1
    for entry in book:
        if "session_id" in entry:
            writes_ahead = entry.get("kept") is True
            session = _Session(
                session_id=entry["session_id"],
                run_id=entry["run_id"],
                version=entry["version"],
                max_staleness=entry["max_staleness"],
                kept=writes_ahead,
                falls_back=entry["version"] < saved,
                started=not writes_ahead,
            )
            sessions.append(session)
            saved = entry["version"]
        saved = entry.get("saved", saved)
        if not sessions:
            continue
        session = sessions[-1]
        session.saved = saved
        session.started |= "taken" in entry
        session.taken.update(_rows(entry, "taken"))
        session.unwritten.update(_rows(entry, "unwritten"))
        if "end" in entry:
            session.waiting = _rows(entry, "end")
    return [session for session in sessions if session.started]


def _rows(entry: dict[str, Any], name: str) -> set[Identity]:
    """Rollouts named by a field of a line."""
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
    made: dict[Identity, Made], outcomes: _Outcomes, gaps: _Gaps, journals: Sequence[JournalLines]
) -> Report:
    """Compares every rollout's replies with the actions of the learner's sessions."""
    findings = _Findings()
    findings.counts["made"] = len(made)
    max_staleness = _max_staleness(outcomes.books)
    for identity, text in _too_late(outcomes.standing, max_staleness):
        findings.add_fault("above the limit on lag", identity, text)
    _check_uses(findings, made, outcomes, gaps)
    _check_acceptances(findings, made, outcomes, gaps)
    lags = _lags(outcomes.standing)
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
    findings: _Findings, made: dict[Identity, Made], outcomes: _Outcomes, gaps: _Gaps
) -> None:
    """Compares the rollouts that the learners used with those that actors sent."""
    incarnations = {identity[:2] for identity in made}
    for identity, uses in outcomes.standing.items():
        if identity[:2] not in incarnations:
            findings.counts["of actors without a journal"] += 1
            continue
        rollout = made.get(identity)
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
    findings: _Findings, made: dict[Identity, Made], outcomes: _Outcomes, gaps: _Gaps
) -> None:
    """Counts the outcomes of the rollouts that actors sent, and finds accepted ones that were
    lost.
    """
    for identity, rollout in made.items():
        answers = [outcome for outcome, _ in rollout.answers]
        if "accepted" not in answers and "duplicate" not in answers:
            used = identity in outcomes.standing
            findings.counts[_not_accepted(answers, used=used)] += 1
            continue
        findings.counts["accepted"] += 1
        outcome = _judge(identity, rollout, outcomes, gaps)
        if outcome == "lost":
            findings.add_fault("lost", identity, "accepted, but missing afterwards")
        else:
            findings.counts[outcome] += 1


def _not_accepted(outcomes: Sequence[str], *, used: bool) -> str:
    """Outcome of a rollout whose actor received no acceptance."""
    if used:
        return "used, answer lost"
    return outcomes[-1] if outcomes else "unanswered"


def _lags(standing: Mapping[Identity, list[Used]]) -> list[int]:
    """Lags of all uses, versions."""
    lags: list[int] = []
    for uses in standing.values():
        lags += [use.lag for use in uses]
    return lags


def _too_late(
    standing: Mapping[Identity, list[Used]], limit: int
) -> Iterator[tuple[Identity, str]]:
    """Yields the rollouts that were used more than `limit` versions after their policies."""
    for identity, uses in standing.items():
        lag = max(use.lag for use in uses)
        if lag > limit:
            yield identity, f"used {lag} versions after its policy; the limit is {limit}"


def _max_staleness(books: Iterable[list[_Session]]) -> int:
    """Largest limit on lag of all sessions, versions."""
    limits = [0]
    for book in books:
        limits += [session.max_staleness for session in book]
    return max(limits)


def _judge(identity: Identity, rollout: Made, outcomes: _Outcomes, gaps: _Gaps) -> str:
    """Outcome of an accepted rollout; a loss cannot be judged while lines are missing."""
    outcome = _outcome(identity, rollout, outcomes)
    return UNJUDGED if outcome == "lost" and any(gaps) else outcome


def _outcome(identity: Identity, rollout: Made, outcomes: _Outcomes) -> str:
    """Outcome of an accepted rollout, from the last session that had it and the next one."""
    if identity in outcomes.standing:
        return "used"
    if identity in outcomes.dropped:
        return "dropped"
    if identity in outcomes.spoilt:
        return "damaged on disk"
    accepted_by = {
        session for outcome, session in rollout.answers if outcome in ("accepted", "duplicate")
    }
    for book in outcomes.books:
        had = [n for n, session in enumerate(book) if session.had(identity, accepted_by)]
        if not had:
            continue
        newest = had[-1]
        last = book[newest]
        if newest + 1 == len(book):
            return _at_the_end(identity, rollout.version, last, outcomes.files)
        undone = identity in outcomes.undone
        return _without_trace(identity, rollout.version, last, book[newest + 1], undone=undone)
    return UNJUDGED


def _at_the_end(
    identity: Identity, version: int, last: _Session, files: set[Identity] | None
) -> str:
    """Outcome of a rollout that the last session neither used nor dropped.

    Without the session's end, its file shows that it waits. Rollouts that no resume could use have
    no file: those of versions too far from that of the newest checkpoint.
    """
    if last.waiting is not None:
        if identity in last.waiting:
            return "waiting"
        return "lost"
    has_file = files is None or identity in files
    needs_file = last.kept and identity not in last.unwritten
    if has_file or not needs_file or abs(version - last.saved) > last.max_staleness:
        return "waiting"
    return UNJUDGED


def _without_trace(
    identity: Identity, version: int, last: _Session, after: _Session, *, undone: bool
) -> str:
    """Reason why the session after the last that had a rollout did not recover it; "lost" without a
    reason.
    """
    if abs(version - after.version) > after.max_staleness or after.run_id != last.run_id:
        return "undone" if undone else "too old after a restart"
    if not last.kept or identity in last.unwritten or after.falls_back:
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
