"""Shards of a dataset: files of grasps and of the objects they are of, each written whole or not at all."""

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
    """Places of the shards of one dataset."""

    folder: pathlib.Path
    total: int
    """N, of the whole dataset, whichever of them are here."""

    def file(self, kind: str, number: int) -> pathlib.Path:
        """Place of a shard of `grasps` or of `objects`."""
        return self.folder / kind / f"{number:05d}-of-{self.total:05d}.parquet"

    def write(self, number: int, grasps: pa.Table, objects: pa.Table) -> None:
        """Writes a shard; that of the grasps comes last, so that where it is everything is."""
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
                        "Name another --out, or give the options that it was begun with (card.json has the command).",
                    )
            found[int(said["shard"])] = said
        return found


def _said(path: pathlib.Path) -> dict[str, Any]:
    """Returns the description in a shard's metadata."""
    try:
        said = json.loads(pq.read_schema(path).metadata[b"congrasp"])
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise CongraspError(
            f"{path} is no shard of a dataset ({str(error)[:100]}).", "Remove it; it is made again."
        ) from None
    return dict(said)
