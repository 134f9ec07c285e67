"""Card of a dataset: counts, rates, checksums and columns, as JSON and as a README."""

import collections
import json
from collections.abc import Mapping
from typing import Any

import pyarrow.parquet as pq

from congrasp.common.io.files import write_atomically
from congrasp.services.dataset.columns import VERDICTS
from congrasp.services.dataset.shards import CARD, Shards
from congrasp.services.evaluate.text_table import Table, percent

README = "README.md"


def write_card(
    shards: Shards, about: Mapping[str, Any], facts: Mapping[str, Any]
) -> dict[str, Any]:
    """Writes the card of the finished shards in a folder, and returns it.

    Args:
      shards: locations and columns of the shards.
      about: description of the dataset in its shards (`services.dataset.make.Recipe.about`).
      facts: further entries of the card: command, licence, machine.

    Raises:
      CongraspError: see `Shards.finished`.
    """
    finished = shards.finished(about)
    left_out: list[str] = []
    sha256: dict[str, str] = {}
    counts: dict[str, collections.Counter[str]] = {}
    for description in finished.values():
        left_out += description["left_out"]
        sha256 |= description["sha256"]
        for constraints, outcomes in description["counts"].items():
            counts.setdefault(constraints, collections.Counter()).update(outcomes)
    card = {
        **about,
        **facts,
        "shards": {"finished": len(finished), "of": shards.total},
        "left_out": sorted(left_out),
        "counts": counts,
        "sha256": sha256,
        "columns": {kind: _columns(shards, kind, finished) for kind in ("grasps", "objects")},
    }
    write_atomically(shards.folder / CARD, (json.dumps(card, indent=1) + "\n").encode())
    write_atomically(shards.folder / README, _readme(card).encode())
    return card


def _columns(shards: Shards, kind: str, finished: Mapping[int, Any]) -> dict[str, dict[str, Any]]:
    """Type, shape and meaning of the columns of a kind of table; empty without a shard."""
    columns: dict[str, dict[str, Any]] = {}
    if not finished:
        return columns
    for field in pq.read_schema(shards.file(kind, min(finished))):
        value_type = getattr(field.type, "value_type", field.type)
        columns[field.name] = {
            "type": str(value_type),
            "shape": json.loads(field.metadata[b"shape"]),
            "meaning": field.metadata[b"meaning"].decode(),
        }
    return columns


def _readme(card: Mapping[str, Any]) -> str:
    """The card as Markdown, with the header for Hugging Face's viewer."""
    rows: list[list[str]] = []
    for constraints, counts in card["counts"].items():
        episodes = counts["episodes"]
        if not episodes:
            continue
        rates = [percent(counts[name] / episodes) for name in VERDICTS]
        rows.append([constraints, f"{episodes:,}", f"{counts['kept']:,}", *rates])
    table = Table("", ("constraints", "episodes", "kept", *VERDICTS), rows)
    total_kept = sum(counts["kept"] for counts in card["counts"].values())
    shards = card["shards"]
    return f"""---
license: {card["licence"].lower()}
tags: [robotics, grasping, dexterous-hand]
configs:
- config_name: grasps
  data_files: grasps/*.parquet
- config_name: objects
  data_files: objects/*.parquet
---
# {total_kept:,} grasps of the {card["hand"]} hand

Episodes of a policy under sampled constraints, each simulated to its end: the hand approaches, grasps, the table is
removed for two seconds, the object is carried upwards and pushed. {_kept(card["keep"])} The rates are of all episodes.

{chr(10).join(table.markdown())}

{chr(10).join(f"* `{name}`: {meaning}" for name, meaning in VERDICTS.items())}

* Objects: {card["objects"]:,}, of which {len(card["left_out"]):,} were left out (see `card.json`); shards here: \
{shards["finished"]} of {shards["of"]}.
* Policy: SHA-256 `{card["policy_sha256"]}`.
* congrasp {card["version"]}, engine `{card["physics"]}`, seed {card["seed"]}.
* Command: `{card["command"]}`, on {card["machine"]}.
* Licence: {card["licence"]}; the objects' own licences stay theirs.

Columns, with shapes, units and frames, are in `card.json` and in the schema of the files. Everything was simulated.
"""  # noqa: E501


def _kept(keep: list[str]) -> str:
    """Sentence on the episodes in the files."""
    if not keep:
        return "The files hold all of them."
    return f"The files hold those that are {' and '.join(keep)}."
