"""A second reading of a run's journals, to confirm the verdict of `congrasp audit`; it shares no code with it.

The audit asks of each rollout where its trace ends. This goes through the learner's lines in their order instead, and
checks at each begin and end of a session that what the session before had in hand was taken over or accounted for.
"""

import json
import pathlib
import zlib
from typing import Any, NamedTuple

Rollout = tuple[str, str, int]


class Verdict(NamedTuple):
    """How many rollouts have each fault."""

    lost: int
    duplicated: int
    unmatched: int
    corrupted: int
    unreadable: int
    """Lines that are cut or damaged, or that a full disk refused: then what no line tells of is no evidence."""


class _Actors(NamedTuple):
    """What the actors' journals hold."""

    made: dict[Rollout, tuple[int, str]]
    """Version of the policy, and checksum."""
    kept_by: dict[str, set[Rollout]]
    """By the learner's session, what it said that it has."""
    starts: set[tuple[str, str]]


def read_again(run_dir: pathlib.Path) -> Verdict:
    """Judges a run by the raw journals in its folder `audit`."""
    made: dict[Rollout, tuple[int, str]] = {}
    kept_by: dict[str, set[Rollout]] = {}
    starts: set[tuple[str, str]] = set()
    books, unreadable = [], 0
    for path in (run_dir / "audit").iterdir():
        lines, bad = _lines(path)
        unreadable += bad
        if path.name.startswith("learner-"):
            books.append(lines)
            continue
        who = "", ""
        for line in lines:
            who = (line["actor"], line["incarnation"]) if "actor" in line else who
            starts.add(who)
            if "made" in line:
                made[*who, line["made"]] = line["version"], line["checksum"]
            if line.get("outcome") in ("accepted", "duplicate"):
                kept_by.setdefault(line["session_id"], set()).add((*who, line["answer"]))
    lost: set[Rollout] = set()
    used: dict[Rollout, list[str]] = {}
    for book in books:
        lost |= _walk(book, _Actors(made, kept_by, starts), used)
    known = {rollout: sums for rollout, sums in used.items() if rollout[:2] in starts}
    return Verdict(
        0 if unreadable else len(lost),
        0 if unreadable else sum(len(sums) > 1 for sums in used.values()),
        0 if unreadable else sum(rollout not in made for rollout in known),
        sum(any(check != made[rollout][1] for check in sums) for rollout, sums in known.items() if rollout in made),
        unreadable,
    )


def _lines(path: pathlib.Path) -> tuple[list[dict[str, Any]], int]:
    """The lines of a journal whose checksum is right, and the number of the others."""
    lines, bad = [], 0
    for raw in path.read_bytes().split(b"\n"):
        body, mark, check = raw.rpartition(b', "crc32": "')
        if not raw:
            continue
        if not mark or check != b'%08x"}' % zlib.crc32(body):
            bad += 1
            continue
        line = json.loads(body + b"}")
        bad += line.get("lost", 0)
        lines.append(line)
    return lines, bad


def _walk(book: list[dict[str, Any]], actors: _Actors, used: dict[Rollout, list[str]]) -> set[Rollout]:
    """Goes through one learner's journal; adds the uses that stand to `used`, and returns what is lost."""
    uses: list[tuple[int, Rollout, str]] = []
    settled: set[Rollout] = set()
    unwritten: set[Rollout] = set()
    hand: set[Rollout] = set()
    lost: set[Rollout] = set()
    session: dict[str, Any] = {}
    newest, falls_back = -1, False
    begun: dict[str, Any] = {}
    for line in book:
        if "session_id" in line:
            uses = [use for use in uses if use[0] < line["version"]]
            begun, falls_back = line, line["version"] < newest
            newest = line["version"]
        if "taken" in line:  # the first line of a session that was not killed as it started
            over = _named(line, "taken") | _named(line, "dropped") | _named(line, "spoilt")
            missing = hand - over - settled - unwritten - {rollout for _, rollout, _ in uses}
            if session.get("kept") and session["run_id"] == begun.get("run_id") and not falls_back:
                near = {r for r in missing if abs(actors.made[r][0] - begun["version"]) <= begun["max_staleness"]}
                lost |= near
            session, unwritten = begun, set()
            before = settled | {rollout for _, rollout, _ in uses}
            hand = (
                actors.kept_by.get(begun.get("session_id", ""), set()) | _named(line, "taken")
            ) & actors.made.keys() - before
        newest = line.get("saved", newest)
        unwritten |= _named(line, "unwritten")
        settled |= _named(line, "dropped") | _named(line, "spoilt")
        uses += [(line["version"], (row[0], row[1], row[2]), row[4]) for row in line.get("used", ())]
        if "end" in line:
            lost |= hand - settled - {rollout for _, rollout, _ in uses} - _named(line, "end")
    for _, rollout, check in uses:
        used.setdefault(rollout, []).append(check)
    return lost - used.keys()


def _named(line: dict[str, Any], field: str) -> set[Rollout]:
    """The rollouts that a field of a line names."""
    return {(row[0], row[1], row[2]) for row in line.get(field, ())}
