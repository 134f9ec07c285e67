"""Files of a dataset: shards of grasps and of their objects, each written atomically, and the card
about them.

Columns have units and frames. Arrays are lists of one length in row-major order; their shape, unit
and frame are in the schema. Values of constraints that were not requested are NaN. Poses are
position (m) and quaternion (w, x, y, z).
"""

import collections
import functools
import hashlib
import io
import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from congrasp.actors.stress import ASSESSED, SURVIVAL
from congrasp.common import rotations
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.io.files import write_atomically
from congrasp.common.objects import store
from congrasp.common.objects.spec import SURFACE_POINTS, GraspObject
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import known
from congrasp.common.task.metrics import FORCES
from congrasp.services.evaluate.episodes import Batch
from congrasp.services.evaluate.plan import ALIGNED
from congrasp.services.evaluate.table import Table, percent

VERDICTS = {
    "success": (
        "bool, the object is up a quarter of a second after the table's removal (the paper's)"
    ),
    "held": "bool, and two seconds after it",
    "clean": "bool, held, and no penetration is deeper than 2 mm (3 mm of hand and object)",
    "lifted": "bool, held, then carried 15 cm upwards",
    "pushed_weight": "bool, lifted, then pushed six times with half of the object's weight",
    "pushed": "bool, and six times with 1 N",
}
"""Outcomes of an episode, with their meanings."""
_SURVIVED = dict(zip(SURVIVAL, ("lifted", "pushed_weight", "pushed"), strict=True))
_MEASURES = (*(name for name in ASSESSED if name not in (*SURVIVAL, "clean")), *FORCES)
_MEASURES += ("links_at_removal", "moved_at_removal")
_WIDE = {
    np.dtype(np.float32): pa.float32(),
    np.dtype(bool): pa.bool_(),
    np.dtype(np.int32): pa.int32(),
}


class Column(NamedTuple):
    """One column of a table."""

    name: str
    meaning: str
    shape: tuple[int, ...] = ()
    """Shape of a row's array."""
    kind: type = np.float32
    """`np.float32`, `bool`, `np.int32` or `str`."""


def grasp_columns(hand: Hand, task: TaskConfig) -> list[Column]:
    """Columns of a grasp: episode, constraints, hand and object at the start and after the hold,
    outcome.
    """
    joints = (len(hand.joints),)
    goals = [
        Column(
            f"goal_{c.name}_{name}", array.meaning, np.shape(getattr(c.neutral(hand, task), name))
        )
        for c in known(task)
        for name, array in c.arrays.items()
    ]
    errors = [
        Column(spec.name, f"{spec.unit or 'ratio'}, mean error in the {spec.window}")
        for constraint in known(task)
        for spec in constraint.errors
    ]
    return [
        Column("object", "name, as in the table of objects", kind=str),
        Column("constraints", "requested ones, with + between them", kind=str),
        Column(
            "episode",
            "number among the episodes of this object and these constraints",
            kind=np.int32,
        ),
        Column("mass", "kg"),
        *goals,
        Column("start_q", "rad, finger joints at the start", joints),
        Column("start_wrist", "pose in the object frame at the start", (7,)),
        Column("start_object", "pose on the table, whose top is at z = 0", (7,)),
        Column("q", "rad, finger joints after the hold", joints),
        Column("q_target", "rad, targets of the finger servos after the hold", joints),
        Column("wrist", "pose in the object frame after the hold", (7,)),
        Column("object_pose", "pose in the world after the hold", (7,)),
        *(Column(name, meaning, kind=bool) for name, meaning in VERDICTS.items()),
        *errors,
        *(Column(name, "see docs/reference/metrics.md") for name in _MEASURES),
    ]


def object_columns() -> list[Column]:
    """Columns of an object, in the size in which the hand grasps it."""
    surface = (SURFACE_POINTS, 3)
    return [
        Column("object", "name", kind=str),
        Column("family", "of the generator, or empty", kind=str),
        Column("sha256", "first 16 digits, of the object's content", kind=str),
        Column("mass", "kg"),
        Column("points", "m, object frame: surface points", surface),
        Column("normals", "unit, object frame", surface),
        Column("graspable", "surface points that an affordance allows", (SURFACE_POINTS,), bool),
        Column("file_scale", "metres per unit of the imported file"),
        Column("file_origin", "m, object frame: origin of that file", (3,)),
        Column("shape_reliable", "the simulated shape is that of the file", kind=bool),
    ]


def grasp_rows(task: TaskConfig, asked: np.ndarray, batch: Batch) -> dict[str, np.ndarray]:
    """Columns (B, ...) of a batch of episodes under the constraints `asked` (B,), without those
    that a plan knows.
    """
    start, state, features = batch.conditions.reset_state, *batch.final
    values, names = (
        batch.sample.values,
        [one.removesuffix(ALIGNED).split("+") for one in asked.tolist()],
    )
    rows: dict[str, Any] = {
        "mass": values["mass_kg"],
        "start_q": start.q,
        "start_wrist": _in_object(
            start.object_position,
            start.object_quaternion,
            start.base_position,
            start.base_quaternion,
        ),
        "start_object": _pose(start.object_position, start.object_quaternion),
        "q": state.q,
        "q_target": state.q_target,
        "wrist": _in_object(
            state.object_position,
            state.object_quaternion,
            features.wrist_position,
            features.wrist_quaternion,
        ),
        "object_pose": _pose(state.object_position, state.object_quaternion),
        **{name: values[name] > 0 for name in ("success", "held", "clean")},
        **{short: values[name] > 0 for name, short in _SURVIVED.items()},
        **{name: values.get(name, np.full(len(start.q), np.nan)) for name in _MEASURES},
    }
    for constraint in known(task):
        requested = np.array(
            [1.0 if constraint.name in own else np.nan for own in names], np.float32
        )
        rows |= {
            f"goal_{constraint.name}_{name}": (requested * np.asarray(array, np.float32).T).T
            for name, array in batch.conditions.goal[constraint.name]._asdict().items()
        }
        rows |= {spec.name: requested * values[spec.name] for spec in constraint.errors}
    return {name: np.asarray(column) for name, column in rows.items()}


def object_rows(objects: Sequence[GraspObject]) -> dict[str, np.ndarray]:
    """Columns (N, ...) of objects."""
    rows = {
        "object": [obj.name for obj in objects],
        "family": [obj.family for obj in objects],
        "sha256": [store.digest(obj) for obj in objects],
        "mass": [obj.mass for obj in objects],
        "points": [obj.points for obj in objects],
        "normals": [obj.normals for obj in objects],
        "graspable": [~obj.non_graspable_points for obj in objects],
        "file_scale": [obj.file_scale for obj in objects],
        "file_origin": [obj.origin for obj in objects],
        "shape_reliable": [obj.shape_reliable for obj in objects],
    }
    return {name: np.asarray(column) for name, column in rows.items()}


def table(
    columns: Sequence[Column], rows: Mapping[str, np.ndarray], about: Mapping[str, Any]
) -> pa.Table:
    """A Parquet table of these columns; `about` is in its metadata, as JSON under the key
    `congrasp`.
    """
    fields, arrays = [], []
    for column in columns:
        facts = {"meaning": column.meaning, "shape": json.dumps(column.shape)}
        array = _array(column, rows[column.name])
        fields.append(pa.field(column.name, array.type, nullable=False, metadata=facts))
        arrays.append(array)
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields, {"congrasp": json.dumps(about)}))


def _array(column: Column, values: np.ndarray) -> pa.Array:
    """A column (B, ...) as an Arrow array."""
    if column.kind is str:
        return pa.array(values.tolist(), pa.string())
    flat: np.ndarray = np.asarray(values, column.kind).ravel()
    array = pa.array(flat, _WIDE[flat.dtype])
    return (
        pa.FixedSizeListArray.from_arrays(array, int(np.prod(column.shape)))
        if column.shape
        else array
    )


def _pose(position: Any, quaternion: Any) -> np.ndarray:
    """(B, 7) of positions (B, 3) and quaternions (B, 4)."""
    return np.concatenate([position, quaternion], -1, dtype=np.float32)


def _in_object(
    position: Any, quaternion: Any, wrist_position: Any, wrist_quaternion: Any
) -> np.ndarray:
    """(B, 7) wrist poses in the object frames, from poses of objects and wrists in the world
    frame.
    """
    return _pose(*rotations.relative_pose(position, quaternion, wrist_position, wrist_quaternion))


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
          CongraspError: the folder holds a shard of another dataset than `about` describes, or a
            damaged one.
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
                        f"{path} is of another dataset: its {name} is {said.get(name)}, not "
                        f"{value}.",
                        "Pass another --out, or the options of the first command (in card.json).",
                    )
            hashes = {
                f"grasps/{path.name}": sha256,
                f"objects/{path.name}": _read(other, other.stat().st_mtime_ns)[1],
            }
            found[int(said["shard"])] = {**said, "sha256": hashes}
        return found


@functools.cache
def _read(path: pathlib.Path, changed: int) -> tuple[dict[str, Any], str]:
    """Returns the description in a shard's metadata and the SHA-256 of its file, once for each time
    of change.

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
            f"{path} is damaged, or no shard of a dataset ({str(error)[:100]}).",
            "Remove it, and repeat the command.",
        ) from None
    return dict(said), hashlib.sha256(data).hexdigest()


def write_card(
    shards: Shards, about: Mapping[str, Any], facts: Mapping[str, Any]
) -> dict[str, Any]:
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
        "sha256": {
            name: value for said in found.values() for name, value in said["sha256"].items()
        },
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
"""  # noqa: E501


def _kept(keep: list[str]) -> str:
    """Sentence on the episodes in the files."""
    return (
        f"The files hold those that are {' and '.join(keep)}."
        if keep
        else "The files hold all of them."
    )
