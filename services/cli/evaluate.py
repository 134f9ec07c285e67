"""`congrasp evaluate`: a policy by the paper's protocol."""

import dataclasses
import pathlib
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
import tyro

from actors.physics import PhysicsName
from common.config import Split
from common.errors import CongraspError

if TYPE_CHECKING:
    from rich.console import Console

    from common.objects.spec import GraspObject
    from common.task.bank import ConstraintBank
    from services.cli.console import Track

Table = Literal["single", "composed", "cross", "objects", "noise", "all"]
_POOL = 64
_PICTURED = 4
_MOST = 50_000


def evaluate(
    policy: pathlib.Path | None = None,
    table: tuple[Table, ...] = ("single",),
    objects: pathlib.Path | None = None,
    constraints: pathlib.Path | None = None,
    split: Split = "all",
    episodes: int = 1000,
    physics: PhysicsName = "auto",
    pool: int = 0,
    batch: int = 0,
    seed: int = 0,
    json: Annotated[pathlib.Path | None, tyro.conf.arg(name="json")] = None,
    pictures: pathlib.Path | None = None,
    hand: str = "human",
    method: str | None = None,
    by: Literal["object"] | None = None,
    friction: float = 1.0,
) -> int:
    """Evaluate a policy by the paper's protocol, beside the paper's figures.

    An episode has 50 control steps with the table and 2 s without it. Success is counted after the paper's 25 steps
    without the table, and again after the 2 s (held). Rates come with 95 % Wilson intervals; errors and forces are
    those of successful episodes in the paper's window of 25 steps. The policy acts by its mean. Every object has the
    same number of episodes in a row, which is the same whatever other rows are asked for. Reference poses and
    trajectories are grasps of a reference policy, which never had any; the last fifth of each object's 20 is evaluated.

    Args:
      policy: A policy file (policy.safetensors of a run); by default a pretrained one.
      table: single: one constraint a row; composed: two; cross: the rows of the paper's cross-dataset table; objects:
        the heading alone on many objects, by size, mass and family; noise: poses and trajectories with errors, as
        captured ones have; all: everything. Several may be named.
      objects: Objects to grasp: a folder as 'congrasp objects import' takes it, or one that it made. By default
        procedural objects of seeds that training never uses.
      constraints: Folder of constraint sets of these objects, from 'congrasp constraints generate' or 'import'; its
        references are used instead of the reference policy's. Objects without a set are left out.
      split: Of these sets all constraints, the 80 % for training, or those that are held out.
      episodes: Episodes in each row; of the table 'objects', episodes in all.
      physics: Engine; auto takes warp on an NVIDIA GPU and native (MuJoCo C) on a CPU.
      pool: Number of procedural objects; 0 takes 64, and for the table 'objects' one an episode, at most 50,000.
      batch: Worlds that run side by side; 0 chooses by the engine.
      seed: Seed of constraints and episodes.
      json: Also write the rows to this file.
      pictures: Also draw failures, with their causes, and successes of every constraint into this folder.
      hand: Whose pretrained policy.
      method: ours, pd (no learning: PD control along the guidance), graspxl, dgrasp, no-dynamic-center,
        no-feedforward, two-phase or single-stage. A policy of another is refused; by default the policy says.
      by: object: also print the rates of each object; --json always has them.
      friction: Sliding friction between hand and object. The published code of the paper's predecessor (GraspXL)
        simulates 3.
    """
    from actors.physics import resolve_physics
    from common.policy import bundle as bundles
    from common.policy.pretrained import policy_file
    from common.task.methods import evaluated_as
    from services.assets.objects.named import objects_of
    from services.cli.console import at_least, tracked
    from services.evaluate.protocol import objects_label
    from services.evaluate.scores import write_json

    at_least(1, episodes=episodes)
    at_least(0, pool=pool, batch=batch, seed=seed)
    _check_friction(friction)
    policy = policy_file(policy, hand)
    loaded = bundles.load(policy)
    if method is not None:
        loaded = dataclasses.replace(loaded, task=evaluated_as(loaded.task, method, policy.name))
    engine = resolve_physics(physics)
    settings: dict[str, Any] = {"physics": engine, "batch": batch, "seed": seed, "friction": friction}
    with tracked() as track:
        given, bank, paper = objects_of(objects, track=track) if objects else None, None, "hands"
        if constraints is not None:
            given, bank, paper = _captured(constraints, split, given, objects)
        found = _evaluate(loaded, given, bank, paper, table, episodes, pool, settings, track, keep=pictures is not None)
    source = objects_label(loaded, objects)
    _show(found, f"{_title(loaded, policy)}, on {source}, {engine}, friction {friction:g}", by == "object")
    if json is not None:
        write_json(found.rows, json, _about(policy, loaded, objects, source, constraints, split) | settings)
    if pictures is not None:
        _draw(found, loaded, episodes, pictures)
    return 0


def _check_friction(friction: float) -> None:
    """Raises a CongraspError for a friction that nothing has."""
    if not 0.05 <= friction <= 10.0:
        raise CongraspError(f"--friction is {friction:g}.", "It must lie between 0.05 and 10.")


def _title(loaded: Any, policy: pathlib.Path) -> str:
    """What was evaluated: a policy, or a method that has none."""
    from common.task.methods import get_method

    method, what = loaded.task.method, f"{policy.name}, version {loaded.version}"
    if method == "ours":
        return what
    return f"method {method}, {what}" if get_method(method).learns else f"method {method}"


class _Found(NamedTuple):
    """Results of an evaluation."""

    evaluator: Any
    """Of the rows by constraint; None if there are none."""
    names: list[str]
    """Rows by constraint that were evaluated."""
    left_out: list[CongraspError]
    """Why others were not."""
    noisy: list[Any]
    """Rows under noise."""
    rows: list[Any]
    """All rows."""
    references: str
    """Where reference poses and trajectories come from; empty if no row has any."""


def _evaluate(
    loaded: Any,
    given: "list[GraspObject] | None",
    bank: "ConstraintBank | None",
    paper: str,
    table: tuple[Table, ...],
    episodes: int,
    pool: int,
    settings: dict[str, Any],
    track: "Track",
    *,
    keep: bool,
) -> _Found:
    """The rows of the named tables; see `evaluate`."""
    from common.task.methods import takes
    from services.evaluate.noise import LEVELS
    from services.evaluate.plan import from_references
    from services.evaluate.scores import TABLES, known_rows

    wanted = {*TABLES, "noise", "objects"} if "all" in table else set(table)
    rows_of = known_rows((key for key in TABLES if key in wanted), loaded.task)
    method = loaded.task.method
    names = [name for name in rows_of if takes(method, name)]
    if not takes(method, "heading"):
        wanted -= {"objects"}
    if not names and not wanted & {"noise", "objects"}:
        raise CongraspError(f"The method '{method}' has no row in these tables.", "Name another --table.")
    rows: list[Any] = []
    noisy: list[Any] = []
    left_out: list[CongraspError] = []
    evaluator: Any = None
    if names or "noise" in wanted:
        evaluator = _evaluator(loaded, given, bank, paper, pool or _POOL, settings, track)
    source = ""
    if "noise" in wanted or any(from_references(name) for name in names):
        source = _references(evaluator, track)
    if names:
        names, left_out = evaluator.allowed(names)
        rows = evaluator.rows(names, episodes, track("Episodes", len(names) * episodes), keep=keep)
    if "noise" in wanted:
        noisy = evaluator.rows_under_noise(track("Episodes under noise", len(LEVELS) * episodes), episodes)
    many = []
    if "objects" in wanted:
        many = _object_rows(loaded, given, pool or min(episodes, _MOST), episodes, settings, track)
    return _Found(evaluator, names, left_out, noisy, [*rows, *noisy, *many], source)


def _references(evaluator: Any, track: "Track") -> str:
    """Makes the references, where none were given, and says where they come from."""
    from services.evaluate.references import reference_policy

    advance = track("Reference grasps", None)
    made = evaluator.references(lambda done, of: advance(done))
    if made is None:
        return "References are those of the constraint sets."
    _, who = reference_policy(evaluator.bundle)
    whole = made.grasps[:, 0]
    closed = [obj.name for obj, count in zip(evaluator.objects, whole, strict=True) if not count]
    text = f"References: grasps of {who}, {np.median(whole):.0f} an object (median), the last fifth held out."
    return text + (f" The hand closed around the object where it holds none: {', '.join(closed)}." if closed else "")


def _console() -> "Console":
    """Standard output, wide where it is no terminal."""
    import sys

    from rich.console import Console

    return Console(highlight=False, width=None if sys.stdout.isatty() else 160)


def _show(found: _Found, title: str, by_object: bool) -> None:
    """Prints the tables, where references come from, and why rows were left out."""
    from services.evaluate.scores import object_table, tables_of

    console = _console()
    for shown in tables_of(found.rows, title) + ([object_table(found.rows)] if by_object else []):
        console.print(shown)
    if found.references:
        console.print(found.references, markup=False, soft_wrap=True)
    for error in found.left_out:
        console.print(f"Left out: {error}", markup=False, soft_wrap=True)


def _about(
    policy: pathlib.Path,
    loaded: Any,
    objects: pathlib.Path | None,
    source: str,
    constraints: pathlib.Path | None,
    split: Split,
) -> dict[str, Any]:
    """What the JSON file says beside rows and settings."""
    from common.objects.pool import HELD_OUT_SEED

    return {
        "policy": {"file": policy.name, "version": loaded.version, "transitions": loaded.transitions},
        "objects": source,
        "first_object_seed": None if objects else HELD_OUT_SEED,
        "headings": loaded.task.headings,
        "constraints": str(constraints) if constraints else None,
        "split": split if constraints else None,
    }


def _draw(found: _Found, loaded: Any, episodes: int, pictures: pathlib.Path) -> None:
    """Draws curves and examples of noisy references, and episodes of the other rows."""
    from services.evaluate.failures import failure_sheets
    from services.evaluate.noise_sheet import draw_noise
    from services.viz.sheets import save_png

    console = _console()
    if found.noisy:
        title = f"{loaded.spec.hand_name} hand, version {loaded.version}: {episodes} episodes a level"
        draw_noise(found.evaluator, found.noisy, pictures, title)
        console.print(f"Curves and examples of noisy references are drawn in {pictures}.", soft_wrap=True)
    for name, sheet, _ in failure_sheets(found.evaluator, loaded, found.names, _PICTURED, _PICTURED):
        save_png(pictures / f"{name}.png", sheet)
        console.print(f"Episodes of '{name}' are drawn in {pictures}.", soft_wrap=True)


def _captured(
    folder: pathlib.Path, split: Split, given: "list[GraspObject] | None", objects: pathlib.Path | None
) -> "tuple[list[GraspObject], ConstraintBank, str]":
    """The objects that have a constraint set in a folder, the bank of their sets, and the paper's table of their data
    set."""
    from common.task.constraint_sets import bank_of, load_for
    from services.evaluate.paper import CAPTURED_SETS

    if given is None:
        raise CongraspError("--constraints needs the sets' objects.", "Name their folder with --objects.")
    chosen, sets = load_for(folder, given)
    if not sets:
        raise CongraspError(f"{folder} holds no constraint set of an object in {objects}.", "Name matching folders.")
    sources = {made.meta.get("source", "") for made in sets}
    table = CAPTURED_SETS.get(sources.pop(), "") if len(sources) == 1 else ""
    return chosen, bank_of(sets, split), table


def _evaluator(
    bundle: Any,
    given: "list[GraspObject] | None",
    bank: "ConstraintBank | None",
    paper: str,
    pool: int,
    settings: dict[str, Any],
    track: "Track",
) -> Any:
    """An evaluator of given objects, or of held-out procedural ones."""
    from common.config import ObjectsConfig
    from common.objects.pool import HELD_OUT_SEED, load_pool
    from common.parallel import cores
    from services.evaluate.evaluator import Evaluator
    from services.evaluate.protocol import two_seconds

    track("Making constraints", None)
    return Evaluator(
        bundle,
        given or load_pool(ObjectsConfig(count=pool, seed=HELD_OUT_SEED)),
        threads=cores(),
        hold_steps=two_seconds(bundle.task),
        bank=bank,
        paper=paper,
        **settings,
    )


def _object_rows(
    bundle: Any,
    given: "list[GraspObject] | None",
    pool: int,
    episodes: int,
    settings: dict[str, Any],
    track: "Track",
) -> list[Any]:
    """Rows of the heading on many objects."""
    from common.objects.pool import HELD_OUT_SEED
    from common.parallel import cores
    from services.evaluate.unseen import POOL, evaluate_objects, procedural_pools

    pools = iter([given]) if given else procedural_pools(pool, HELD_OUT_SEED)
    number = 1 if given else -(-pool // POOL)
    each = -(-episodes // number)
    advance = track("Episodes on many objects", number * each)
    return evaluate_objects(bundle, pools, each, threads=cores(), progress=advance, **settings)


COMMAND = evaluate
