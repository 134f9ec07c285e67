"""Evaluation of one part of a reproduction, stored in a file from which a second start reads it."""

import dataclasses
import gc
import pathlib
import shutil
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax

from congrasp.actors.physics import PhysicsName
from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_json
from congrasp.common.policy.bundle import content_hash
from congrasp.common.wire.codec import encode
from congrasp.services.assets.objects.named import objects_of
from congrasp.services.evaluate.captured import CapturedObjects, captured_objects
from congrasp.services.evaluate.exams import MANY, exam_pool
from congrasp.services.evaluate.experiment import Experiment, Track, Variation
from congrasp.services.evaluate.lineup import Entrant, facts
from congrasp.services.evaluate.pages import count_causes
from congrasp.services.evaluate.paper.parts import Part
from congrasp.services.evaluate.pictures import failure_sheets
from congrasp.services.evaluate.plan import NOMINAL_FRICTION
from congrasp.services.evaluate.pools import PoolLoaders, procedural_pools
from congrasp.services.evaluate.scores import Row, write_json
from congrasp.services.evaluate.tables import Evaluation, evaluate_tables
from congrasp.services.viz.sheets import save_png

OBJECTS_FOLDER = "objects"
CONSTRAINTS_FOLDER = "constraints"
"""Folders of a captured data set, with the default names of `congrasp constraints import`."""
_MAX_FILE_BYTES = 1 << 28
_TABLES_OF_CAPTURED = {
    "cross": ("cross",),
    "captured": ("single", "composed"),
    "": ("single", "composed"),
}
"""Tables evaluated for a captured data set, by the paper's table of it."""
_SOURCES = {"objects": "objects", "noise": ""}
"""Sources of the paper's figures by our table; `hands` for all others."""
_PICTURES_OF_EACH_KIND = 2
"""Most failures, and most successes, drawn for a row."""
_PARTIAL_RESULTS = ".parts"
"""Suffix of the folder of an unfinished part's rows."""
_REQUIRED_FACTS = {"pictures", "seconds", "references", "left_out", "heading_rules"}


@dataclasses.dataclass(frozen=True)
class PartSettings:
    """Settings of all parts of a reproduction."""

    episodes: int
    """Episodes of a row."""
    pool: int
    """Procedural objects of rows."""
    many: int
    """Episodes and most objects of the table of many objects."""
    physics: PhysicsName
    """Engine; `auto` is resolved by `services.evaluate.paper.reproduction.reproduce`."""
    seed: int


class PartResult(NamedTuple):
    """Result of a part."""

    part: Part
    source: str
    """Source of its episodes (`services.evaluate.paper.figures`)."""
    rows: list[Row]
    about: Mapping[str, Any]
    """Further content of its JSON file: policy, settings, pictures, references, skipped rows,
    seconds.
    """
    evaluated_now: bool
    """False if the rows were read from the file of an earlier start."""

    def outcome(self) -> str:
        """One line about the part."""
        if not self.evaluated_now:
            return "evaluated before"
        rates = [
            f"{row.constraint} {100 * row.success:.1f} %" for row in self.rows if not row.group
        ]
        return f"{', '.join(rates)} ({self.about['seconds']:.0f} s)"


def evaluate_part(
    part: Part, entrant: Entrant, settings: PartSettings, out: pathlib.Path, track: Track
) -> PartResult:
    """Returns the rows of a part, from its file if that has the same policy and settings.

    Rows are stored like those of `congrasp evaluate --json`.

    Args:
      part: policy and table.
      entrant: the policy, or for a method without learning a policy of the same hand.
      settings: settings of the reproduction.
      out: folder of the reproduction.
      track: shows progress.

    Raises:
      CongraspError: the part cannot be evaluated.
    """
    file = out / "tables" / f"{part.name}.json"
    partial_results = file.with_suffix(_PARTIAL_RESULTS)
    identity = _identity(part, entrant, settings)
    stored = _read_part(file, part, identity)
    if stored is not None:
        return stored
    started = time.monotonic()
    experiment, data = _experiment(part, entrant, settings, track)
    evaluation = evaluate_tables(
        experiment,
        _tables(part, data),
        _pools(part, settings),
        partial_results,
        keep=part.has_pictures,
    )
    source = _SOURCES.get(part.table, "hands")
    if data is not None:
        source = data.paper
    heading_rules = ""
    if evaluation.heading_rules is not None:
        heading_rules = evaluation.heading_rules.sentence(entrant.hand)
    about: dict[str, Any] = {
        "policy": facts(entrant),
        "settings": identity,
        "source": source,
        "pictures": _draw_pictures(part, evaluation, out / "pictures" / part.name),
        "references": evaluation.references,
        "heading_rules": heading_rules,
        "left_out": [str(error) for error in evaluation.left_out],
        "seconds": round(time.monotonic() - started, 1),
    }
    write_json(evaluation.rows, file, about)
    shutil.rmtree(partial_results, ignore_errors=True)
    jax.clear_caches()  # no other part uses its compiled programs
    gc.collect()
    return PartResult(part, source, evaluation.rows, about, True)


def _identity(part: Part, entrant: Entrant, settings: PartSettings) -> dict[str, Any]:
    """Returns all that a stored part must have in common with the requested one."""
    return {
        **dataclasses.asdict(settings),
        "friction": NOMINAL_FRICTION,
        "table": part.table,
        "data": str(part.data or ""),
        "content": content_hash(encode(entrant.policy.to_message())),
    }


def _tables(part: Part, data: CapturedObjects | None) -> tuple[str, ...]:
    """Returns the tables that are evaluated for a part."""
    if data is None:
        return (part.table,)
    return _TABLES_OF_CAPTURED[data.paper]


def _pools(part: Part, settings: PartSettings) -> PoolLoaders | None:
    """Returns the pools of the table of many objects; None for other tables."""
    if part.table != "objects":
        return None
    return procedural_pools(min(settings.many, MANY), settings.physics, "figures")


def _experiment(
    part: Part, entrant: Entrant, settings: PartSettings, track: Track
) -> tuple[Experiment, CapturedObjects | None]:
    """Returns the experiment of a part, and its captured data if it has some."""
    on_many_objects = part.table == "objects"
    objects = []
    if not on_many_objects and part.data is None:
        objects = exam_pool("figures", settings.pool)
    experiment = Experiment(
        entrant.policy,
        objects,
        episodes=settings.many if on_many_objects else settings.episodes,
        physics=settings.physics,
        seed=settings.seed,
        track=track,
    )
    if part.data is None:
        return experiment, None
    data = _read_captured(part.data, track)
    if data.hand != entrant.hand:
        raise CongraspError(
            f"The constraint sets in {part.data} are for the hand '{data.hand}', not "
            f"'{entrant.hand}'.",
            f"Import sets with 'congrasp constraints import … --hand {entrant.hand}'.",
        )
    experiment = dataclasses.replace(
        experiment, objects=data.objects, constraints=data.bank, paper=data.paper
    )
    return experiment, data


def _read_captured(folder: pathlib.Path, track: Track) -> CapturedObjects:
    """Returns all constraint sets of a captured data set, since no policy of a reproduction was
    trained with them.
    """
    for name in (OBJECTS_FOLDER, CONSTRAINTS_FOLDER):
        if not (folder / name).is_dir():
            raise CongraspError(
                f"{folder} has no folder '{name}'.",
                "Run 'congrasp constraints import' in it, or pass another folder.",
            )
    objects = objects_of(folder / OBJECTS_FOLDER, track=track)
    return captured_objects(folder / CONSTRAINTS_FOLDER, "all", objects)


def _read_part(file: pathlib.Path, part: Part, identity: Mapping[str, Any]) -> PartResult | None:
    """Reads a part's file; returns None if it is missing, damaged or has another identity."""
    try:
        about = read_json(file, _MAX_FILE_BYTES)
        rows = [Row.from_json(row) for row in about.pop("rows")]
        if about["settings"] != identity or not about.keys() >= _REQUIRED_FACTS:
            return None
        return PartResult(part, about["source"], rows, about, False)
    except (LookupError, TypeError, AttributeError, CongraspError):
        return None


def _draw_pictures(
    part: Part, evaluation: Evaluation, folder: pathlib.Path
) -> list[dict[str, str]]:
    """Draws failures and successes of every row; returns title, caption and file of each
    picture.
    """
    if not part.has_pictures:
        return []
    sheets = failure_sheets(
        evaluation.experiment,
        evaluation.of(Variation),
        _PICTURES_OF_EACH_KIND,
        _PICTURES_OF_EACH_KIND,
    )
    pictures = []
    for row, sheet, causes in sheets:
        file = folder / f"{row.replace(':', '-')}.png"
        save_png(file, sheet)
        pictures.append(
            {
                "title": f"{part.policy.hand}, {row.replace(':', ', ')}",
                "caption": count_causes(causes),
                "file": str(file),
            }
        )
    return pictures
