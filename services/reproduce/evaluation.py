"""Evaluates the parts of a reproduction, each once; rows are stored like those of `congrasp evaluate --json`."""

import dataclasses
import pathlib
import shutil
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_json
from congrasp.common.policy.bundle import content_hash
from congrasp.common.runtime.engines import PhysicsName
from congrasp.common.wire.codec import encode
from congrasp.services.assets.objects.named import objects_of
from congrasp.services.evaluate.failures import failure_sheets
from congrasp.services.evaluate.lineup import Entrant, facts
from congrasp.services.evaluate.report import count_causes
from congrasp.services.evaluate.scores import Row, write_json
from congrasp.services.evaluate.tables import Captured, Found, Setup, Track, captured, evaluate_tables
from congrasp.services.reproduce.plan import Part
from congrasp.services.viz.sheets import save_png

_LARGEST = 1 << 28
OBJECTS, CONSTRAINTS = "objects", "constraints"
"""Folders of a captured data set, with the default names of `congrasp constraints import`."""
_CAPTURED_TABLES = {"cross": ("cross",), "captured": ("single", "composed"), "": ("single", "composed")}
_SOURCES = {"objects": "objects", "noise": ""}
_PICTURED = 2
_POOLS = ".pools"


@dataclasses.dataclass(frozen=True)
class Numbers:
    """Sizes and settings of an evaluation."""

    episodes: int
    """Episodes of a row."""
    pool: int
    """Procedural objects of rows."""
    many: int
    """Episodes and most objects of the table of many objects."""
    physics: PhysicsName
    """Engine; `auto` until it is resolved."""
    seed: int
    friction: float


class Result(NamedTuple):
    """Result of a part."""

    part: Part
    source: str
    """Source of its episodes (`services.evaluate.paper`)."""
    rows: list[Row]
    about: Mapping[str, Any]
    """Further content of its JSON file: policy, settings, pictures, references, skipped rows, seconds."""
    fresh: bool
    """True if it was evaluated in this session."""


def evaluate_part(part: Part, entrant: Entrant, numbers: Numbers, out: pathlib.Path, track: Track) -> Result:
    """Returns the rows of a part, from its file if that has the same policy and settings.

    Args:
      part: part to evaluate.
      entrant: policy of the part.
      numbers: sizes and settings.
      out: folder of `tables/` and `pictures/`.
      track: shows progress.

    Raises:
      CongraspError: the part cannot be evaluated.
    """
    file = out / "tables" / f"{part.name}.json"
    settings = dataclasses.asdict(numbers) | {
        "table": part.table,
        "data": str(part.data or ""),
        "content": content_hash(encode(entrant.policy.to_message())),
    }
    if (kept := _read(file, part, settings)) is not None:
        return kept
    began = time.monotonic()
    data = _captured(part, track) if part.data else None
    if data and data.hand != entrant.hand:
        raise CongraspError(f"The constraint sets in {part.data} are for the hand '{data.hand}', not '{entrant.hand}'.")
    found = _evaluate(part, entrant, numbers, data, file, track)
    pictures = _draw(part, entrant, found, out / "pictures" / part.name)
    about: dict[str, Any] = {
        "policy": facts(entrant),
        "settings": settings,
        "source": data.paper if data else _SOURCES.get(part.table, "hands"),
        "pictures": pictures,
        "references": found.references,
        "heading_rules": found.heading_rules.sentence(entrant.hand) if found.heading_rules else "",
        "left_out": [str(error) for error in found.left_out],
        "seconds": round(time.monotonic() - began, 1),
    }
    write_json(found.rows, file, about)
    shutil.rmtree(file.with_suffix(_POOLS), ignore_errors=True)
    return Result(part, about["source"], found.rows, about, True)


def _read(file: pathlib.Path, part: Part, settings: Mapping[str, Any]) -> Result | None:
    """Reads a part's file; returns None if it is missing, damaged or has other settings."""
    try:
        about = read_json(file, _LARGEST)
        rows = [Row.from_json(row) for row in about.pop("rows")]
        kept = {"pictures", "seconds", "references", "left_out", "heading_rules"}
        same = about["settings"] == settings and about.keys() >= kept
        return Result(part, about["source"], rows, about, False) if same else None
    except (LookupError, TypeError, AttributeError, CongraspError):
        return None


def _captured(part: Part, track: Track) -> Captured:
    """Returns all constraint sets of a captured data set, since no policy of a reproduction was trained with them."""
    assert part.data is not None
    for name in (OBJECTS, CONSTRAINTS):
        if not (part.data / name).is_dir():
            raise CongraspError(
                f"{part.data} has no folder '{name}'.",
                "Run 'congrasp constraints import' in it, or pass another folder.",
            )
    return captured(part.data / CONSTRAINTS, "all", objects_of(part.data / OBJECTS, track=track))


def _evaluate(
    part: Part, entrant: Entrant, numbers: Numbers, data: Captured | None, file: pathlib.Path, track: Track
) -> Found:
    """Evaluates the part's rows."""
    many = part.table == "objects"
    setup = Setup(
        numbers.many if many else numbers.episodes,
        physics=numbers.physics,
        pool=0 if many else numbers.pool,
        seed=numbers.seed,
        friction=numbers.friction,
        keep=file.with_suffix(_POOLS) if many else None,
    )
    tables: tuple[str, ...] = (part.table,)
    if data:
        setup = dataclasses.replace(setup, given=data.objects, bank=data.bank, paper=data.paper)
        tables = _CAPTURED_TABLES[data.paper]
    return evaluate_tables(entrant.policy, tables, setup, track, keep=_is_pictured(part))


def _is_pictured(part: Part) -> bool:
    """True if episodes are drawn: those of the full system, under constraints without noise."""
    return part.policy.method == "ours" and part.table not in ("objects", "noise")


def _draw(part: Part, entrant: Entrant, found: Found, folder: pathlib.Path) -> list[dict[str, str]]:
    """Draws failures and successes of every row; returns title, caption and file of each picture."""
    if found.evaluator is None or not _is_pictured(part):
        return []
    pictures = list[dict[str, str]]()
    sheets = failure_sheets(found.evaluator, entrant.policy, found.names, _PICTURED, _PICTURED)
    for name, sheet, causes in sheets:
        file = folder / f"{name.replace(':', '-')}.png"
        save_png(file, sheet)
        title = f"{part.policy.hand}, {name.replace(':', ', ')}"
        pictures.append({"title": title, "caption": count_causes(causes), "file": str(file)})
    return pictures
