"""Findings of a hand's self-check: verdicts by limits, and their file."""

import json
import pathlib
import types
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import read_json

Verdict = Literal["passed", "doubt", "failed"]
_MAX_FILE_BYTES = 1 << 20


class Finding(NamedTuple):
    """Result of one check."""

    check: str
    verdict: Verdict
    measured: str
    remedy: str = ""
    """Remedy; empty if it passed."""

    def __str__(self) -> str:
        """Formats it as one line."""
        remedy = f" -> {self.remedy}" if self.remedy else ""
        return f"{self.verdict:7s} {self.check:9s} {self.measured}{remedy}"


class Limits(NamedTuple):
    """Limits of a measured value, both upper or both lower ones; `failure` is the stricter."""

    doubt: float
    failure: float

    def verdict(self, value: float) -> Verdict:
        """Returns the verdict on a value."""
        if self._is_beyond(value, self.failure):
            return "failed"
        if self._is_beyond(value, self.doubt):
            return "doubt"
        return "passed"

    def _is_beyond(self, value: float, limit: float) -> bool:
        """True for a value on the wrong side of a limit."""
        are_upper = self.failure > self.doubt
        return value > limit if are_upper else value < limit


def worst(*verdicts: Verdict) -> Verdict:
    """Returns the worst of some verdicts."""
    order: tuple[Verdict, ...] = ("failed", "doubt", "passed")
    return min(verdicts, key=order.index)


def finding_of(check: str, verdict: Verdict, measured: str, remedy: str) -> Finding:
    """Returns a finding, with its remedy if it needs one."""
    return Finding(check, verdict, measured, "" if verdict == "passed" else remedy)


def write_findings(
    path: pathlib.Path,
    findings: Sequence[Finding],
    about: Mapping[str, Any] = types.MappingProxyType({}),
) -> None:
    """Writes findings as JSON for `read_findings`, with the provenance `about` in front."""
    rows = [finding._asdict() for finding in findings]
    write_atomically(path, json.dumps({**about, "findings": rows}, indent=1).encode())


def read_findings(path: pathlib.Path) -> list[Finding]:
    """Reads a file of `write_findings`.

    Raises:
      CongraspError: it cannot be read.
    """
    remedy = "Create it with 'congrasp hands check --json'."
    try:
        rows = read_json(path, _MAX_FILE_BYTES, remedy)["findings"]
        return [Finding(**fields) for fields in rows]
    except (LookupError, TypeError) as error:
        raise CongraspError(f"{path} is not a self-check: {error}.", remedy) from None
