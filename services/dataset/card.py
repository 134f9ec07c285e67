"""The card of a dataset: its origin, counts and rates, as `card.json` and as the text of its README."""

import collections
import json
from collections.abc import Mapping
from typing import Any

import pyarrow.parquet as pq

from congrasp.common.io.files import write_atomically
from congrasp.services.dataset.columns import VERDICTS
from congrasp.services.dataset.shards import Shards

CARD, README = "card.json", "README.md"


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
    rows = [
        f"| {asked} | {own['episodes']:,} | {own['kept']:,} | "
        + " | ".join(f"{100 * own[name] / own['episodes']:.1f} %" for name in VERDICTS)
        + " |"
        for asked, own in card["counts"].items()
        if own["episodes"]
    ]
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

| constraints | episodes | kept | {" | ".join(VERDICTS)} |
| --- | --- | --- | {" | ".join("---" for _ in VERDICTS)} |
{chr(10).join(rows)}

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
