"""Flow of `congrasp reproduce`: trains missing policies, evaluates every part, writes the
result.
"""

import dataclasses
import gc
import itertools
import pathlib
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax

from congrasp.actors.physics import PhysicsName, resolve_physics
from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_json
from congrasp.common.policy.bundle import content_hash
from congrasp.common.policy.pretrained import pretrained_file
from congrasp.common.runtime.engines import engine_title
from congrasp.common.task.methods import get_method
from congrasp.common.wire.codec import encode
from congrasp.services.assets.objects.named import objects_of
from congrasp.services.evaluate.experiment import Experiment, Track, Variation
from congrasp.services.evaluate.lineup import Entrant, facts, read_entrant
from congrasp.services.evaluate.pictures import failure_sheets
from congrasp.services.evaluate.plan import NOMINAL_FRICTION
from congrasp.services.evaluate.pools import MANY, exam_pool, procedural_pools
from congrasp.services.evaluate.report import count_causes, curves_of
from congrasp.services.evaluate.scores import Row, write_json
from congrasp.services.evaluate.tables import Captured, Found, captured, evaluate_tables
from congrasp.services.reproduce.comparison import Account, compare, page, write
from congrasp.services.reproduce.plan import (
    BASELINES,
    Part,
    RequiredPolicy,
    Result,
    parts,
    policies,
)
from congrasp.services.train import processes
from congrasp.services.viz.sheets import save_png

RUNS = "policies"
"""Folder of trainings within the output folder."""
OBJECTS, CONSTRAINTS = "objects", "constraints"
"""Folders of a captured data set, with the default names of `congrasp constraints import`."""
_LARGEST = 1 << 28
_CAPTURED_TABLES = {
    "cross": ("cross",),
    "captured": ("single", "composed"),
    "": ("single", "composed"),
}
_SOURCES = {"objects": "objects", "noise": ""}
_PICTURED = 2
_PARTS = ".parts"


@dataclasses.dataclass(frozen=True)
class Request:
    """Request for a reproduction."""

    out: pathlib.Path
    hands: tuple[str, ...]
    """Hands; the first is used in all tables except that of hands."""
    methods: tuple[str, ...]
    given: Mapping[RequiredPolicy, Entrant]
    """Policies that need no training."""
    captured: tuple[pathlib.Path, ...]
    quick: bool
    """Uses pretrained policies instead of training."""
    options: tuple[str, ...]
    """Further options of trainings."""
    patience: float
    """Limit of each training, s."""
    command: str
    """Command line of the request."""
    episodes: int
    """Episodes of a row."""
    pool: int
    """Procedural objects of rows."""
    many: int
    """Episodes and most objects of the table of many objects."""
    physics: PhysicsName
    """Engine; `auto` is resolved after the trainings."""
    seed: int

    @property
    def runs(self) -> pathlib.Path:
        """Folder of all trainings."""
        return self.out / RUNS


class _Policies(NamedTuple):
    """Policies available for evaluation."""

    entrants: dict[RequiredPolicy, Entrant]
    absent: dict[RequiredPolicy, str]
    """Reasons for missing policies."""


def to_train(request: Request) -> list[RequiredPolicy]:
    """Returns the policies that the request would have to train."""
    if request.quick:
        return []
    found = policies(request.hands, request.methods)
    return [
        policy
        for policy in found
        if get_method(policy.method).learns and _file(request, policy) is None
    ]


def reproduce(
    request: Request, track: Track, note: Callable[[str], None] = lambda text: None
) -> Account:
    """Trains, evaluates and writes; a failure does not stop the rest.

    Args:
      request: the request.
      track: shows progress.
      note: called with messages for the user.

    Raises:
      CongraspError: nothing could be evaluated, or the result cannot be written.
    """
    page()  # fails before anything else if a package is missing
    failed = train_all(request, to_train(request), track)
    for text in failed.values():
        note(text)
    found, failures = _policies(request, failed), list(failed.values())
    # Not earlier: trainings have the whole device memory until this process initialises its engine.
    request = dataclasses.replace(request, physics=resolve_physics(request.physics))
    whole = parts(
        policies(request.hands, request.methods), request.captured, noise=not request.quick
    )
    wanted = [part for part in whole if part.policy in found.entrants]
    results: list[Result] = []
    advance = track("Parts", len(wanted))
    for done, part in enumerate(wanted, 1):
        try:
            results.append(evaluate_part(part, found.entrants[part.policy], request, track))
            note(f"{part.name}: {_outcome(results[-1])}")
        except CongraspError as error:
            failures.append(f"{part.name}: {error}")
            note(failures[-1])
        advance(done)
    if not results:
        raise CongraspError(
            "Nothing could be evaluated.",
            failures[0] if failures else "Pass --hands with a hand that has a policy.",
        )
    account = _account(request, found, results, failures)
    write(account, request.out)
    return account


def train_all(
    request: Request, wanted: Sequence[RequiredPolicy], track: Track
) -> dict[RequiredPolicy, str]:
    """Trains policies in turn, each in a separate run, resuming from its last checkpoint if there
    is one.

    Returns:
      Reasons for failed trainings; the others succeeded.
    """
    failures: dict[RequiredPolicy, str] = {}
    for policy in wanted:
        run_dir = request.runs / policy.name
        track(f"Training {policy.name} (log: {run_dir}.log)", None)
        try:
            processes.train_in_background(
                run_dir, policy.training, request.options, patience=request.patience
            )
        except CongraspError as error:
            failures[policy] = str(error)
    return failures


def evaluate_part(part: Part, entrant: Entrant, request: Request, track: Track) -> Result:
    """Returns the rows of a part, from its file if that has the same policy and settings.

    Rows are stored like those of `congrasp evaluate --json`.

    Raises:
      CongraspError: the part cannot be evaluated.
    """
    file = request.out / "tables" / f"{part.name}.json"
    settings = {
        name: getattr(request, name) for name in ("episodes", "pool", "many", "physics", "seed")
    }
    settings |= {"friction": NOMINAL_FRICTION, "table": part.table, "data": str(part.data or "")}
    settings["content"] = content_hash(encode(entrant.policy.to_message()))
    if (kept := _read(file, part, settings)) is not None:
        return kept
    began = time.monotonic()
    experiment, data = _experiment(part, entrant, request, track)
    tables = _CAPTURED_TABLES[data.paper] if data else (part.table,)
    pools = (
        procedural_pools(min(request.many, MANY), request.physics, "figures")
        if part.table == "objects"
        else None
    )
    found = evaluate_tables(experiment, tables, pools, file.with_suffix(_PARTS), keep=part.pictured)
    about: dict[str, Any] = {
        "policy": facts(entrant),
        "settings": settings,
        "source": data.paper if data else _SOURCES.get(part.table, "hands"),
        "pictures": _draw(part, found, request.out / "pictures" / part.name),
        "references": found.references,
        "heading_rules": found.heading_rules.sentence(entrant.hand) if found.heading_rules else "",
        "left_out": [str(error) for error in found.left_out],
        "seconds": round(time.monotonic() - began, 1),
    }
    write_json(found.rows, file, about)
    shutil.rmtree(file.with_suffix(_PARTS), ignore_errors=True)
    jax.clear_caches()  # no other part uses its compiled programs
    gc.collect()
    return Result(part, about["source"], found.rows, about, True)


def _experiment(
    part: Part, entrant: Entrant, request: Request, track: Track
) -> tuple[Experiment, Captured | None]:
    """Returns the experiment of a part, and its captured data if it has some."""
    many = part.table == "objects"
    own = Experiment(
        entrant.policy,
        [] if many or part.data else exam_pool("figures", request.pool),
        episodes=request.many if many else request.episodes,
        physics=request.physics,
        seed=request.seed,
        track=track,
    )
    if not part.data:
        return own, None
    data = _captured(part.data, track)
    if data.hand != entrant.hand:
        raise CongraspError(
            f"The constraint sets in {part.data} are for the hand '{data.hand}', not "
            f"'{entrant.hand}'."
        )
    return dataclasses.replace(
        own, objects=data.objects, constraints=data.bank, paper=data.paper
    ), data


def _captured(folder: pathlib.Path, track: Track) -> Captured:
    """Returns all constraint sets of a captured data set, since no policy of a reproduction was
    trained with them.
    """
    for name in (OBJECTS, CONSTRAINTS):
        if not (folder / name).is_dir():
            raise CongraspError(
                f"{folder} has no folder '{name}'.",
                "Run 'congrasp constraints import' in it, or pass another folder.",
            )
    return captured(folder / CONSTRAINTS, "all", objects_of(folder / OBJECTS, track=track))


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


def _draw(part: Part, found: Found, folder: pathlib.Path) -> list[dict[str, str]]:
    """Draws failures and successes of every row; returns title, caption and file of each
    picture.
    """
    pictures = list[dict[str, str]]()
    results = found.of(Variation) if part.pictured else []
    for name, sheet, causes in failure_sheets(found.experiment, results, _PICTURED, _PICTURED):
        file = folder / f"{name.replace(':', '-')}.png"
        save_png(file, sheet)
        title = f"{part.policy.hand}, {name.replace(':', ', ')}"
        pictures.append({"title": title, "caption": count_causes(causes), "file": str(file)})
    return pictures


def _outcome(result: Result) -> str:
    """One line about a part."""
    if not result.fresh:
        return "evaluated before"
    rates = ", ".join(
        f"{row.constraint} {100 * row.success:.1f} %" for row in result.rows if not row.group
    )
    return f"{rates} ({result.about['seconds']:.0f} s)"


def _file(request: Request, policy: RequiredPolicy) -> pathlib.Path | None:
    """Returns a policy's file, if it exists."""
    if policy in request.given:
        return request.given[policy].file
    if request.quick and policy.method == "ours":
        return pretrained_file(policy.hand)
    return processes.trained(request.runs / policy.name)


def _policies(request: Request, failed: Mapping[RequiredPolicy, str]) -> _Policies:
    """Reads the available policies; methods without learning use the full system's hand and
    geometry.
    """
    found = _Policies({}, {})
    for policy in policies(request.hands, request.methods):
        learns = get_method(policy.method).learns
        file = _file(request, policy if learns else RequiredPolicy(policy.hand, "ours"))
        if policy in request.given:
            found.entrants[policy] = request.given[policy]
        elif file is not None:
            found.entrants[policy] = read_entrant(file, policy.method)
        elif policy in failed:
            found.absent[policy] = failed[policy]
        else:
            found.absent[policy] = (
                "not trained with --quick" if request.quick else "it was not trained"
            )
    for method in set(BASELINES) - set(request.methods):
        found.absent[RequiredPolicy(request.hands[0], method)] = "not requested"
    return found


def _account(
    request: Request, found: _Policies, results: Sequence[Result], failures: Sequence[str]
) -> Account:
    """Collects the content of the page."""
    trainings = {
        policy: processes.training_seconds(request.runs / policy.name) or 0.0
        for policy in found.entrants
    }
    seconds = {
        "training": sum(trainings.values()),
        "evaluation": sum(result.about["seconds"] for result in results),
    }
    where = []
    for policy, one in found.entrants.items():
        took = f", trained in {trainings[policy] / 60:.0f} min" if trainings[policy] else ""
        version = (
            f"{one.file.name}, version {one.policy.version}, {one.policy.transitions:,} "
            f"environment steps"
        )
        where.append((policy, version + took if get_method(policy.method).learns else "needs none"))
    where += [(policy, f"none: {reason}") for policy, reason in found.absent.items()]
    curves = [
        dataclasses.replace(curve, title=f"Training of {policy.name}: {curve.title}")
        for policy in found.entrants
        if trainings[policy]
        for curve in itertools.islice(curves_of(request.runs / policy.name), 1)
    ]
    conditions = (
        f"{request.episodes} episodes a row on {request.pool} held-out procedural objects, "
        f"{request.many} on many "
        f"objects, {engine_title(request.physics)}, friction {NOMINAL_FRICTION:g}, seed "
        f"{request.seed}."
    )
    cells = compare(results, found.absent, request.hands)
    return Account(
        list(results), cells, where, list(failures), conditions, request.command, curves, seconds
    )
