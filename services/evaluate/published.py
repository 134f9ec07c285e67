"""Published results: the files of `docs/results`."""

import dataclasses
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_json
from congrasp.services.evaluate.scores import Row

ROOT = pathlib.Path(__file__).resolve().parents[2]
FOLDER = pathlib.Path("docs", "results")
HANDS_FOLDER = FOLDER / "hands"
"""Records of hands of others (`hand_records`)."""
_MAX_FILE_BYTES = 1 << 26
_REQUIRED = (
    "command",
    "heading_rules",
    "machine",
    "objects",
    "physics",
    "policies",
    "version",
)
"""Required content of a file of `congrasp evaluate --json` in addition to its rows."""


@dataclasses.dataclass(frozen=True)
class Results:
    """A file of results."""

    rows: Sequence[Row]
    about: Mapping[str, Any]
    """Further content of the file."""

    @property
    def policies(self) -> dict[str, str]:
        """SHA-256 of each policy by file name."""
        return {policy["file"]: policy["sha256"] for policy in self.about["policies"]}


def read_results(file: pathlib.Path, required: Sequence[str] = _REQUIRED) -> Results:
    """Reads the rows of a file and their provenance.

    Args:
      file: of `congrasp evaluate --json`, or of another command that writes rows.
      required: names of required content.

    Raises:
      CongraspError: the file cannot be read, or another version of the project wrote it.
    """
    remedy = "Run the command that wrote it again."
    try:
        about = read_json(file, _MAX_FILE_BYTES, remedy)
        rows = [Row.from_json(row) for row in about.pop("rows")]
    except (LookupError, TypeError, AttributeError):
        raise CongraspError(
            f"{file} is not a results file of this version of congrasp.", remedy
        ) from None
    for name in required:
        if name not in about:
            raise CongraspError(f"{file} lacks '{name}'.", remedy)
    return Results(rows, about)


def read_all_results(root: pathlib.Path = ROOT) -> dict[str, Results]:
    """Reads all files of results, by their path in the folder without `.json`, except the records
    of hands of others.
    """
    results = {}
    for file in sorted((root / FOLDER).rglob("*.json")):
        if file.is_relative_to(root / HANDS_FOLDER):
            continue
        name = file.relative_to(root / FOLDER).with_suffix("").as_posix()
        results[name] = read_results(file)
    return results
