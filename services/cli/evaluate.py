"""`congrasp evaluate`: a policy by the paper's protocol."""

import pathlib
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from actors.physics import PhysicsName
from common.errors import CongraspError

if TYPE_CHECKING:
    from common.objects.spec import GraspObject
    from common.task.bank import ConstraintBank
    from services.cli.console import Track

Split = Literal["all", "training", "held-out"]
Table = Literal["single", "composed", "objects", "noise", "all"]
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
    friction: float = 1.0,
) -> int:
    """Evaluate a policy by the paper's protocol, beside the paper's figures.

    An episode has 50 control steps with the table and 2 s without it. Success is counted after the paper's 25 steps
    without the table, and again after the 2 s (held). Rates come with 95 % Wilson intervals; errors and forces are
    those of successful episodes in the paper's window of 25 steps. The policy acts by its mean. Reference poses and
    trajectories are made from its own grasps under headings, as the paper makes them for its hands.

    Args:
      policy: A policy file (policy.safetensors of a run); by default one that comes with the package.
      table: single: one constraint a row; composed: two; objects: the heading alone on many objects, by size, mass and
        family; noise: poses and trajectories with errors, as captured ones have; all: everything. Several may be
        named.
      objects: Objects to grasp: a folder as 'congrasp objects import' takes it, or one that it made. By default
        procedural objects of seeds that training never uses.
      constraints: Folder of constraint sets of these objects, from 'congrasp constraints generate' or 'import'; its
        references are used instead of the policy's own grasps. Objects without a set are left out.
      split: Of these sets all constraints, the 80 % for training, or those that are held out.
      episodes: Episodes in each row; of the table 'objects', episodes in all.
      physics: Engine; auto takes warp on an NVIDIA GPU and native on a CPU.
      pool: Number of procedural objects; 0 takes 64, and for the table 'objects' one an episode, at most 50,000.
      batch: Worlds that run side by side; 0 chooses by the engine.
      seed: Seed of constraints and episodes.
      json: Also write the rows to this file.
      pictures: Also draw failures, with their causes, and successes of every constraint into this folder.
      hand: Whose policy of those that come with the package.
      friction: Sliding friction between hand and object. The published code of the paper's predecessor (GraspXL)
        simulates 3.
    """
    import sys

    from rich.console import Console

    from actors.physics import resolve_physics
    from common.objects.pool import HELD_OUT_SEED
    from common.policy import bundle as bundles
    from common.policy.pretrained import policy_file
    from services.assets.objects.named import objects_of
    from services.cli.console import tracked
    from services.evaluate.noise import LEVELS
    from services.evaluate.scores import TABLES, tables_of, write_json
    from services.evaluate.worlds import objects_in_words

    for name, value, least in (("episodes", episodes, 1), ("pool", pool, 0), ("batch", batch, 0), ("seed", seed, 0)):
        if value < least:
            raise CongraspError(f"--{name} is {value}.", f"It must be at least {least}.")
    if not 0.05 <= friction <= 10.0:
        raise CongraspError(f"--friction is {friction:g}.", "It must lie between 0.05 and 10.")
    policy = policy_file(policy, hand)
    loaded = bundles.load(policy)
    engine = resolve_physics(physics)
    rows = []
    with tracked() as track:
        given = objects_of(objects, track=track) if objects else None
        settings: dict[str, Any] = {"physics": engine, "batch": batch, "seed": seed, "friction": friction}
        bank = None
        if constraints is not None:
            given, bank = _captured(constraints, split, given, objects)
        names = [name for key in TABLES if key in table or "all" in table for name in TABLES[key]]
        names = [name for name in names if set(name.split("+")) <= set(loaded.task.constraints)]
        evaluator: Any = None
        noisy: list[Any] = []
        left_out: list[CongraspError] = []
        if names:
            evaluator = _evaluator(loaded, given, bank, pool or _POOL, settings, track)
            names, left_out = evaluator.allowed(names)
            advance = track("Episodes", len(names) * episodes)
            rows += evaluator.rows(names, episodes, advance, keep=pictures is not None)
        if "noise" in table or "all" in table:
            evaluator = evaluator or _evaluator(loaded, given, bank, pool or _POOL, settings, track)
            noisy = evaluator.rows_under_noise(track("Episodes under noise", len(LEVELS) * episodes), episodes)
            rows += noisy
        if "objects" in table or "all" in table:
            rows += _object_rows(loaded, given, pool or min(episodes, _MOST), episodes, settings, track)
    source = objects_in_words(loaded, objects)
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 160)
    title = f"{policy.name}, version {loaded.version}, on {source}, {engine}, friction {friction:g}"
    for shown in tables_of(rows, title):
        console.print(shown)
    for error in left_out:
        console.print(f"Left out: {error}", markup=False, soft_wrap=True)
    if json is not None:
        about = {
            "policy": {"file": policy.name, "version": loaded.version, "transitions": loaded.transitions},
            "objects": source,
            "first_object_seed": None if objects else HELD_OUT_SEED,
            "headings": loaded.task.headings,
            "constraints": str(constraints) if constraints else None,
            "split": split if constraints else None,
            **settings,
        }
        write_json(rows, json, about)
    if pictures is not None and noisy:
        from services.evaluate.noise_sheet import draw_noise

        title = f"{loaded.spec.hand_name} hand, version {loaded.version}: {episodes} episodes a level"
        draw_noise(evaluator, noisy, pictures, title)
        console.print(f"Curves and examples of noisy references are drawn in {pictures}.", soft_wrap=True)
    if pictures is not None and names:
        from services.evaluate.failures import failure_sheets
        from services.viz.sheets import save_png

        for name, sheet, _ in failure_sheets(evaluator, loaded, names, _PICTURED, _PICTURED):
            save_png(pictures / f"{name}.png", sheet)
            console.print(f"Episodes of '{name}' are drawn in {pictures}.", soft_wrap=True)
    return 0


def _captured(
    folder: pathlib.Path, split: Split, given: "list[GraspObject] | None", objects: pathlib.Path | None
) -> "tuple[list[GraspObject], ConstraintBank]":
    """The objects that have a constraint set in a folder, and the task set of their sets."""
    from services.grasp.constraint_sets import bank_of, load_for

    if given is None:
        raise CongraspError("--constraints needs the sets' objects.", "Name their folder with --objects.")
    chosen, sets = load_for(folder, given)
    if not sets:
        raise CongraspError(f"{folder} holds no constraint set of an object in {objects}.", "Name matching folders.")
    return chosen, bank_of(sets, split)


def _evaluator(
    bundle: Any,
    given: "list[GraspObject] | None",
    bank: "ConstraintBank | None",
    pool: int,
    settings: dict[str, Any],
    track: "Track",
) -> Any:
    import os

    from common.config import ObjectsConfig
    from common.objects.pool import HELD_OUT_SEED, load_pool
    from services.evaluate.evaluator import Evaluator
    from services.evaluate.worlds import two_seconds

    track("Making constraints", None)
    return Evaluator(
        bundle,
        given or load_pool(ObjectsConfig(count=pool, seed=HELD_OUT_SEED)),
        threads=os.cpu_count() or 1,
        hold_steps=two_seconds(bundle.task),
        bank=bank,
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
    import os

    from common.objects.pool import HELD_OUT_SEED
    from services.evaluate.unseen import POOL, evaluate_objects, procedural_pools

    pools = iter([given]) if given else procedural_pools(pool, HELD_OUT_SEED)
    number = 1 if given else -(-pool // POOL)
    each = -(-episodes // number)
    advance = track("Episodes on many objects", number * each)
    return evaluate_objects(bundle, pools, each, threads=os.cpu_count() or 1, progress=advance, **settings)


COMMAND = evaluate
