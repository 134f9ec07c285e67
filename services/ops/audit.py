"""Compares the answers that actors got with what the learner did: was every accepted rollout used once, as sent?

Actors note what they made, with a checksum, and every answer to it; the learner notes what it used, with a
checksum taken when the update began, what it dropped, and where its sessions began and ended. Neither reads the other's
journal; nothing here uses the code that decided.
"""

import collections
import pathlib
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from common.errors import CongraspError
from common.journal import AUDIT, read_journal
from learner.audit import Used, replay

Identity = tuple[str, str, int]
"""Actor, incarnation and sequence number."""
FAULTS = ("lost", "duplicated", "corrupted", "unmatched")


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
    """Lines that a full disk kept out of the journals; what they were about cannot be judged."""


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
    made, holes = _made(actors)
    books = [list(read_journal(path)) for path in learners]
    holes += sum(entry.get("lost", 0) for book in books for entry in book)
    return _compare(made, books, holes)


def _made(paths: Iterable[pathlib.Path]) -> tuple[dict[Identity, Made], int]:
    """What actors made, the answers that they got, and the holes in their journals."""
    made: dict[Identity, Made] = {}
    holes = 0
    for path in paths:
        who = ("?", "?")
        for entry in read_journal(path):
            holes += entry.get("lost", 0)
            if "actor" in entry:
                who = entry["actor"], entry["incarnation"]
            elif "made" in entry:
                made[*who, entry["made"]] = Made(entry["version"], entry["checksum"], [])
            elif (identity := (*who, entry.get("answer", -1))) in made:
                made[identity].answers.append((entry["outcome"], entry["life"]))
    return made, holes


def _compare(made: dict[Identity, Made], books: Sequence[list[dict[str, Any]]], holes: int) -> Report:
    """Judges every rollout by what its actor was told and by what the learner's sessions did with it."""
    standing: dict[Identity, list[Used]] = collections.defaultdict(list)
    undone: set[Identity] = set()
    dropped: set[Identity] = set()
    waiting: set[Identity] = set()
    sessions = [entry for book in books for entry in book if "life" in entry]
    running = {[entry["life"] for entry in book if "life" in entry][-1] for book in books if "end" not in book[-1]}
    for book in books:
        stands, lost = replay(book)
        for use in stands:
            standing[use.actor, use.incarnation, use.sequence].append(use)
        undone |= {(use.actor, use.incarnation, use.sequence) for use in lost}
        for entry in book:
            dropped |= {(a, i, s) for a, i, s in entry.get("dropped", ())}
            waiting |= {(a, i, s) for a, i, s in entry.get("end", ())}

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
            fault("unmatched", identity, "used, but never made")
        elif any(use.checksum != made[identity].checksum for use in uses):
            fault("corrupted", identity, "used with another content than it was made with")
        if len(uses) > 1:
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
        elif holes:
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
        holes,
    )


def _too_old_to_return(rollout: Made, sessions: Sequence[dict[str, Any]]) -> bool:
    """Whether the checkpoint after the session that accepted a rollout is too far from the rollout's policy."""
    order = [session["life"] for session in sessions]
    after = order.index(rollout.answers[-1][1]) + 1 if rollout.answers[-1][1] in order else len(sessions)
    return any(
        abs(rollout.version - session["version"]) > session["max_staleness"] for session in sessions[after : after + 1]
    )
