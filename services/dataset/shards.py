"""Files of a dataset: shards of grasps and of their objects, each written atomically, and their
comparison with the card and with the columns.
"""

import functools
import hashlib
import io
import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.services.dataset.columns import Column, field

CARD = "card.json"


class Shards(NamedTuple):
    """Files of the shards of one dataset."""

    folder: pathlib.Path
    total: int
    """Number of shards of the whole dataset, including missing ones."""
    columns: Mapping[str, Sequence[Column]]
    """Columns of `grasps` and of `objects`."""

    def file(self, kind: str, number: int) -> pathlib.Path:
        """File of a shard of `grasps` or of `objects`."""
        return self.folder / kind / f"{number:05d}-of-{self.total:05d}.parquet"

    def write(self, number: int, grasps: pa.Table, objects: pa.Table) -> None:
        """Writes a shard with a checksum of each page; the grasps come last: with both files it is
        complete.
        """
        for kind, table in (("objects", objects), ("grasps", grasps)):
            buffer = io.BytesIO()
            pq.write_table(table, buffer, compression="zstd", write_page_checksum=True)
            write_atomically(self.file(kind, number), buffer.getvalue())

    def finished(self, about: Mapping[str, Any]) -> dict[int, dict[str, Any]]:
        """Returns the descriptions of the finished shards by their numbers, with the SHA-256 of
        their files by name.

        Raises:
          CongraspError: the folder holds a shard of another dataset than `about` describes, a
            damaged one, one whose columns differ, or one that differs from its SHA-256 in the card.
        """
        recorded = _recorded_hashes(self.folder / CARD)
        finished: dict[int, dict[str, Any]] = {}
        for grasps in sorted((self.folder / "grasps").glob("*.parquet")):
            objects = self.folder / "objects" / grasps.name
            if not objects.exists():
                continue
            description = _read(grasps, grasps.stat().st_mtime_ns).description
            _check_description(grasps, description, about)
            sha256: dict[str, str] = {}
            for path in (grasps, objects):
                content = _read(path, path.stat().st_mtime_ns)
                kind = path.parent.name
                name = f"{kind}/{path.name}"
                _check_columns(path, content.schema, self.columns[kind])
                _check_hash(path, content.sha256, recorded.get(name, content.sha256))
                sha256[name] = content.sha256
            finished[int(description["shard"])] = {**description, "sha256": sha256}
        return finished


class _Content(NamedTuple):
    """Facts about the file of a shard."""

    description: dict[str, Any]
    schema: pa.Schema
    sha256: str


@functools.cache
def _read(path: pathlib.Path, changed: int) -> _Content:
    """Returns the facts about a shard's file, once for each time of change.

    Raises:
      CongraspError: the checksums of its pages do not match, or it is no shard.
    """
    try:
        data = path.read_bytes()
        file = pq.ParquetFile(pa.BufferReader(data), page_checksum_verification=True)
        schema = file.schema_arrow
        description = dict(json.loads(schema.metadata[b"congrasp"]))
        for _ in file.iter_batches():
            pass
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise CongraspError(
            f"{path} is damaged, or is not a shard of a dataset ({str(error)[:100]}).",
            "Delete it, and repeat the command to make it again.",
        ) from None
    return _Content(description, schema, hashlib.sha256(data).hexdigest())


def _recorded_hashes(card: pathlib.Path) -> dict[str, str]:
    """Returns the SHA-256 of each shard's file in a card; empty without a card.

    Raises:
      CongraspError: the card cannot be read.
    """
    try:
        return dict(json.loads(card.read_bytes())["sha256"])
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise CongraspError(
            f"{card} is damaged ({str(error)[:100]}).",
            "Restore it, or delete it to write the card again without this comparison.",
        ) from None


def _check_description(
    path: pathlib.Path, description: Mapping[str, Any], about: Mapping[str, Any]
) -> None:
    """Raises a CongraspError if a shard is of another dataset than `about` describes."""
    for name, value in about.items():
        if description.get(name) != value:
            raise CongraspError(
                f"{path} belongs to another dataset: its {name} is {description.get(name)}, not "
                f"{value}.",
                "Pass another --out, or the options of the first command (in card.json).",
            )


def _check_hash(path: pathlib.Path, sha256: str, recorded: str) -> None:
    """Raises a CongraspError if a file has changed since the card was written."""
    if sha256 != recorded:
        raise CongraspError(
            f"{path} differs from its SHA-256 in {CARD}: it was changed or damaged.",
            "Delete it, and repeat the command to make it again.",
        )


def _check_columns(path: pathlib.Path, schema: pa.Schema, columns: Sequence[Column]) -> None:
    """Raises a CongraspError for the first column that is missing, added or changed."""
    fault = _fault(schema, columns)
    if fault:
        raise CongraspError(
            f"{path} {fault}.", "Delete it, and repeat the command to make it again."
        )


def _fault(schema: pa.Schema, columns: Sequence[Column]) -> str:
    """Difference of a schema from the columns; empty if they agree."""
    for column in columns:
        if schema.names.count(column.name) != 1:
            return f"has no column {column.name}, or has it twice"
        expected = field(column)
        stored = schema.field(column.name)
        if stored.type != expected.type:
            return f"has {stored.type} in column {column.name}, not {expected.type}"
        metadata = stored.metadata or {}
        for key, value in expected.metadata.items():
            if metadata.get(key) != value:
                return f"has another {key.decode()} of column {column.name} in its metadata"
    added = set(schema.names) - {column.name for column in columns}
    if added:
        return f"has the unknown column {min(added)}"
    return ""
