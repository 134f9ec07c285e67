"""Files of a dataset: shards of grasps and of their objects, each written atomically, and the card about them."""

import collections
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
from congrasp.services.dataset.columns import VERDICTS
from congrasp.services.evaluate.table import Table, percent

CARD, README = "card.json", "README.md"


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


def write_card(shards: Shards, about: Mapping[str, Any], facts: Mapping[str, Any]) -> dict[str, Any]:
    """Writes the card of the shards in a folder, and returns it.

    Args:
      shards: locations of the shards.
      about: description of the dataset in its shards (`services.dataset.make.Recipe.about`).
      facts: further entries of the card: command, licence, machine.

    Raises:
      CongraspError: see `Shards.finished`.
    """
    found = shards.finished(about)
    counts: dict[str, collections.Counter[str]] = {}
    for said in found.values():
        for asked, own in said["counts"].items():
            counts.setdefault(asked, collections.Counter()).update(own)
    card = {
        **about,
        **facts,
        "shards": {"finished": len(found), "of": shards.total},
        "left_out": sorted(name for said in found.values() for name in said["left_out"]),
        "counts": counts,
        "sha256": {name: value for said in found.values() for name, value in said["sha256"].items()},
        "columns": {kind: _columns(shards, kind, found) for kind in ("grasps", "objects")},
    }
    write_atomically(shards.folder / CARD, (json.dumps(card, indent=1) + "\n").encode())
    write_atomically(shards.folder / README, _readme(card).encode())
    return card


def _columns(shards: Shards, kind: str, found: Mapping[int, Any]) -> dict[str, dict[str, Any]]:
    """Type, shape and meaning of the columns of a kind of table; empty without a shard."""
    return {
        field.name: {
            "type": str(field.type.value_type if hasattr(field.type, "value_type") else field.type),
            "shape": json.loads(field.metadata[b"shape"]),
            "meaning": field.metadata[b"meaning"].decode(),
        }
        for number in list(found)[:1]
        for field in pq.read_schema(shards.file(kind, number))
    }


def _readme(card: Mapping[str, Any]) -> str:
    """The card as Markdown, with the header for Hugging Face's viewer."""
    counts = [(asked, own) for asked, own in card["counts"].items() if own["episodes"]]
    rows = [
        [
            asked,
            f"{own['episodes']:,}",
            f"{own['kept']:,}",
            *(percent(own[name] / own["episodes"]) for name in VERDICTS),
        ]
        for asked, own in counts
    ]
    table = Table("", ("constraints", "episodes", "kept", *VERDICTS), rows)
    kept = sum(own["kept"] for own in card["counts"].values())
    part = card["shards"]
    return f"""---
license: {card["licence"].lower()}
tags: [robotics, grasping, dexterous-hand]
configs:
- config_name: grasps
  data_files: grasps/*.parquet
- config_name: objects
  data_files: objects/*.parquet
---
# {kept:,} grasps of the {card["hand"]} hand

Episodes of a policy under sampled constraints, each simulated to its end: the hand approaches, grasps, the table is
removed for two seconds, the object is carried upwards and pushed. {_kept(card["keep"])} The rates are of all episodes.

{chr(10).join(table.markdown())}

{chr(10).join(f"* `{name}`: {meaning}" for name, meaning in VERDICTS.items())}

* Objects: {card["objects"]:,}, of which {len(card["left_out"]):,} were left out (see `card.json`); shards here: \
{part["finished"]} of {part["of"]}.
* Policy: SHA-256 `{card["policy_sha256"]}`.
* congrasp {card["version"]}, engine `{card["physics"]}`, seed {card["seed"]}.
* Command: `{card["command"]}`, on {card["machine"]}.
* Licence: {card["licence"]}; the objects' own licences stay theirs.

Columns, with shapes, units and frames, are in `card.json` and in the schema of the files. Everything was simulated.
"""


def _kept(keep: list[str]) -> str:
    """Sentence on the episodes in the files."""
    return f"The files hold those that are {' and '.join(keep)}." if keep else "The files hold all of them."
