"""Shards of a dataset: files of grasps and of their objects, each written atomically."""

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
        """Writes a shard; the grasps come last, so that their file means that the shard is complete."""
        for kind, table in (("objects", objects), ("grasps", grasps)):
            buffer = io.BytesIO()
            pq.write_table(table, buffer, compression="zstd")
            write_atomically(self.file(kind, number), buffer.getvalue())

    def finished(self, about: Mapping[str, Any]) -> dict[int, dict[str, Any]]:
        """Returns the descriptions of the finished shards by their numbers.

        Raises:
          CongraspError: the folder holds a shard of another dataset than `about` describes, or a damaged one.
        """
        found = {}
        for path in sorted((self.folder / "grasps").glob("*.parquet")):
            said = _said(path)
            for name, value in about.items():
                if said.get(name) != value:
                    raise CongraspError(
                        f"{path} is of another dataset: its {name} is {said.get(name)}, not {value}.",
                        "Pass another --out, or the options of the first command (in card.json).",
                    )
            found[int(said["shard"])] = said
        return found


def _said(path: pathlib.Path) -> dict[str, Any]:
    """Returns the description in a shard's metadata."""
    try:
        said = json.loads(pq.read_schema(path).metadata[b"congrasp"])
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise CongraspError(
            f"{path} is no shard of a dataset ({str(error)[:100]}).", "Remove it, and repeat the command."
        ) from None
    return dict(said)
