"""Compares the answers that actors got with what the learner did: was every accepted rollout used once, as sent?

Actors note what they made, with a checksum, and every answer to it; the learner notes what it used, with a
checksum taken when the update began, what it dropped, and where its sessions began and ended. Neither reads the other's
journal; nothing here uses the code that decided.

What a journal's missing or damaged lines told cannot be known: what they may have been about is no fault, but counted
as not in the journals.
"""

import collections
import pathlib
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from common.errors import CongraspError
from common.journal import AUDIT, JournalLines, has_fields, read_journal
from learner.audit import Used, read_uses, replay

Identity = tuple[str, str, int]
"""Actor, incarnation and sequence number."""
FAULTS = {"lost": "loss", "duplicated": "surplus", "corrupted": "damage", "unmatched": "surplus"}
"""Faults of rollouts, and their kinds."""
EXIT_CODES = {"loss": 1, "surplus": 5, "damage": 6}
"""What `congrasp audit` exits with, by the gravest kind of what it found; 2 to 4 are those of errors."""


class Made(NamedTuple):
    """A rollout as its actor saw it."""

    version: int
    checksum: str
    answers: list[tuple[str, str]]
    """(outcome, session of the learner that gave it)."""


class Report(NamedTuple):
    """Outcome of every rollout of a run."""

    counts: dict[str, int]
    """How many were made and accepted, and the outcomes of those that were accepted; the last ones are faults."""
    faults: list[str]
    """A line for each rollout that was lost, duplicated, corrupted or unmatched."""
    lag_mean: float
    lag_max: int
    max_staleness: int
    holes: int
    """Lines that a full disk kept out of the journals, or that were cut at the end."""
    damaged: int
    """Lines of the journals that are not what was written."""
    unchecked: int
    """Lines without a checksum, of older versions of congrasp: damage to them may look like any fault."""

    @property
    def exit_code(self) -> int:
        """0 if nothing was found, else that of the gravest kind."""
        kinds = {FAULTS[name] for name in FAULTS if self.counts[name]} | ({"damage"} if self.damaged else set())
        return next((code for kind, code in EXIT_CODES.items() if kind in kinds), 0)


class _Gaps(NamedTuple):
    """Whether lines are missing in the journals."""

    actors: bool
    learners: bool


def audit(run_dir: pathlib.Path, more: Sequence[pathlib.Path] = ()) -> Report:
    """Compares the journals of a run.

    Args:
      run_dir: the run's directory.
      more: journals of actors that are elsewhere.

    Raises:
      CongraspError: there are no journals.
    """
    folder = run_dir / AUDIT
    learners = sorted(folder.glob("learner-*.jsonl"))
    actors = [*(path for path in sorted(folder.glob("*.jsonl")) if path not in learners), *more]
    if not learners or not actors:
        kind = "actor" if learners else "learner"
        raise CongraspError(
            f"There is no journal of {'an' if kind == 'actor' else 'a'} {kind} in {folder}.",
            "Actors elsewhere write theirs with 'congrasp actor --audit FILE'; name these files.",
        )
    notes = [read_journal(path, _is_entry) for path in actors]
    books = [read_uses(path) for path in learners]
    gaps = _Gaps(*(any(each.lost or each.damaged for each in group) for group in (notes, books)))
    return _compare(_made(notes), _outcomes(book.intact for book in books), gaps, [*notes, *books])


def _is_entry(entry: dict[str, Any]) -> bool:
    """Whether a line is one that an actor writes."""
    if "made" in entry:
        return has_fields(entry, made=int, version=int, checksum=str)
    if "answer" in entry:
        return has_fields(entry, answer=int, outcome=str, life=str)
    return has_fields(entry, actor=str, incarnation=str)


def _made(journals: Iterable[JournalLines]) -> dict[Identity, Made]:
    """What actors made, and the answers that they got."""
    made: dict[Identity, Made] = {}
    for journal in journals:
        who: tuple[str, str] | None = None
        for entry in journal.entries:
            if entry is None:
                who = None  # the lines that follow may be another incarnation's, if they do not name it
                continue
            if has_fields(entry, actor=str, incarnation=str):
                who = entry["actor"], entry["incarnation"]
            if who is not None and "made" in entry:
                made[*who, entry["made"]] = Made(entry["version"], entry["checksum"], [])
            elif who is not None and (identity := (*who, entry.get("answer", -1))) in made:
                made[identity].answers.append((entry["outcome"], entry["life"]))
    return made


class _Outcomes(NamedTuple):
    """What the learner's sessions did with rollouts."""

    sessions: list[dict[str, Any]]
    running: set[str]
    """Sessions that have not noted their end."""
    standing: dict[Identity, list[Used]]
    undone: set[Identity]
    dropped: set[Identity]
    waiting: set[Identity]


def _outcomes(books: Iterable[list[dict[str, Any]]]) -> _Outcomes:
    """The outcomes of which the learners' journals tell."""
    found = _Outcomes([], set(), collections.defaultdict(list), set(), set(), set())
    for book in books:
        begun = [entry for entry in book if "life" in entry]
        found.sessions.extend(begun)
        if begun and "end" not in book[-1]:
            found.running.add(begun[-1]["life"])
        stands, lost = replay(book)
        for use in stands:
            found.standing[use.actor, use.incarnation, use.sequence].append(use)
        found.undone.update((use.actor, use.incarnation, use.sequence) for use in lost)
        for entry in book:
            found.dropped.update((a, i, s) for a, i, s in entry.get("dropped", ()))
            found.waiting.update((a, i, s) for a, i, s in entry.get("end", ()))
    return found


def _compare(made: dict[Identity, Made], found: _Outcomes, gaps: _Gaps, journals: Sequence[JournalLines]) -> Report:
    """Judges every rollout by what its actor was told and by what the learner's sessions did with it."""
    sessions, running, standing, undone, dropped, waiting = found
    begun = {session["life"] for session in sessions}
    counts = collections.Counter({"made": len(made)})
    faults: list[str] = []

    def fault(kind: str, identity: Identity, text: str) -> None:
        """Counts a fault, and notes which rollout has it."""
        counts[kind] += 1
        faults.append(f"{'/'.join(map(str, identity))}: {text}")

    known = {identity[:2] for identity in made}
    for identity, uses in standing.items():
        if identity[:2] not in known:
            counts["of actors without a journal"] += 1
            continue
        if identity not in made:
            if gaps.actors:
                counts["used, not in the journals"] += 1
            else:
                fault("unmatched", identity, "used, but never made")
        elif any(use.checksum != made[identity].checksum for use in uses):
            fault("corrupted", identity, "used with another content than it was made with")
        if len(uses) > 1 and not gaps.learners:  # the line may be missing by which a resume undid one of them
            fault("duplicated", identity, f"used {len(uses)} times")
    for identity, rollout in made.items():
        outcomes = [outcome for outcome, _ in rollout.answers]
        if "accepted" not in outcomes and "duplicate" not in outcomes:
            counts["used, answer lost" if identity in standing else outcomes[-1] if outcomes else "unanswered"] += 1
            continue
        counts["accepted"] += 1
        if identity in standing:
            counts["used"] += 1
        elif identity in dropped:
            counts["dropped as too old"] += 1
        elif outcomes[-1] == "stale" or _too_old_to_return(rollout, sessions):
            counts["undone" if identity in undone else "too old after a restart"] += 1
        elif identity in undone:
            counts["undone"] += 1
        elif identity in waiting or rollout.answers[-1][1] in running:
            counts["waiting"] += 1
        elif any(gaps) or not {session for _, session in rollout.answers} <= begun:
            counts["not in the journals"] += 1
        else:
            fault("lost", identity, "accepted, and never seen again")
    lags = [use.lag for uses in standing.values() for use in uses]
    return Report(
        dict(counts) | {name: counts[name] for name in FAULTS},
        faults,
        sum(lags) / max(1, len(lags)),
        max(lags, default=0),
        max((session["max_staleness"] for session in sessions), default=0),
        sum(journal.lost for journal in journals),
        sum(journal.damaged for journal in journals),
        sum(journal.unchecked for journal in journals),
    )


def _too_old_to_return(rollout: Made, sessions: Sequence[dict[str, Any]]) -> bool:
    """Whether the checkpoint after the session that accepted a rollout is too far from the rollout's policy."""
    order = [session["life"] for session in sessions]
    after = order.index(rollout.answers[-1][1]) + 1 if rollout.answers[-1][1] in order else len(sessions)
    return any(
        abs(rollout.version - session["version"]) > session["max_staleness"] for session in sessions[after : after + 1]
    )
