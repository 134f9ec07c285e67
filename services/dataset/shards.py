"""Shards of a dataset: files of grasps and of their objects, each written atomically."""

import functools
import hashlib
import io
import json
import pathlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically


class Shards(NamedTuple):
    """Files of the shards of one dataset."""

    folder: pathlib.Path
    total: int
    """Number of shards of the whole dataset, including missing ones."""

    def file(self, kind: str, number: int) -> pathlib.Path:
        """File of a shard of `grasps` or of `objects`."""
        return self.folder / kind / f"{number:05d}-of-{self.total:05d}.parquet"

    def write(self, number: int, grasps: pa.Table, objects: pa.Table) -> None:
        """Writes a shard with a checksum of each page; the grasps come last: with both files it is complete."""
        for kind, table in (("objects", objects), ("grasps", grasps)):
            buffer = io.BytesIO()
            pq.write_table(table, buffer, compression="zstd", write_page_checksum=True)
            write_atomically(self.file(kind, number), buffer.getvalue())

    def finished(self, about: Mapping[str, Any]) -> dict[int, dict[str, Any]]:
        """Returns the descriptions of the finished shards by their numbers, with the SHA-256 of their files by name.

        Raises:
          CongraspError: the folder holds a shard of another dataset than `about` describes, or a damaged one.
        """
        found = {}
        for path in sorted((self.folder / "grasps").glob("*.parquet")):
            other = self.folder / "objects" / path.name
            if not other.exists():
                continue
            said, sha256 = _read(path, path.stat().st_mtime_ns)
            for name, value in about.items():
                if said.get(name) != value:
                    raise CongraspError(
                        f"{path} is of another dataset: its {name} is {said.get(name)}, not {value}.",
                        "Pass another --out, or the options of the first command (in card.json).",
                    )
            hashes = {f"grasps/{path.name}": sha256, f"objects/{path.name}": _read(other, other.stat().st_mtime_ns)[1]}
            found[int(said["shard"])] = {**said, "sha256": hashes}
        return found


@functools.cache
def _read(path: pathlib.Path, changed: int) -> tuple[dict[str, Any], str]:
    """Returns the description in a shard's metadata and the SHA-256 of its file, once for each time of change.

    Raises:
      CongraspError: the checksums of its pages do not match, or it is no shard.
    """
    try:
        data = path.read_bytes()
        file = pq.ParquetFile(pa.BufferReader(data), page_checksum_verification=True)
        said = json.loads(file.schema_arrow.metadata[b"congrasp"])
        for _ in file.iter_batches():
            pass
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise CongraspError(
            f"{path} is damaged, or no shard of a dataset ({str(error)[:100]}).", "Remove it, and repeat the command."
        ) from None
    return dict(said), hashlib.sha256(data).hexdigest()
