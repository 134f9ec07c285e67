"""`congrasp evaluate`: a policy by the paper's protocol."""

import pathlib
from typing import Annotated, Any, Literal

import tyro

from common.config import PhysicsName


def evaluate(
    policy: pathlib.Path,
    objects: pathlib.Path | None = None,
    table: Literal["single", "composed"] = "single",
    episodes: int = 1000,
    physics: PhysicsName = "auto",
    pool: int = 64,
    batch: int = 64,
    hold: int = 25,
    seed: int = 0,
    json: Annotated[pathlib.Path | None, tyro.conf.arg(name="json")] = None,
) -> int:
    """Evaluate a policy: success after 50 steps and 25 without the table, and the errors of the active constraints.

    Rates come with 95 % Wilson intervals; errors are means over successful episodes, as in the paper.

    Args:
      policy: A policy file (policy.safetensors of a run).
      objects: Folder of objects (see 'congrasp objects'); by default procedural ones that training never uses.
      table: single: one constraint a row; composed: two.
      episodes: Episodes in each row.
      physics: Engine; auto takes warp on an NVIDIA GPU and native on a CPU.
      pool: Number of procedural objects.
      batch: Worlds that run side by side.
      hold: Control steps without the table; success counts the first 25, 'held' all of them.
      seed: Seed of constraints and episodes.
      json: Also write the rows to this file.
    """
    import functools
    import os

    from rich.console import Console
    from rich.progress import Progress

    from actors.physics import resolve_physics
    from common.config import ObjectsConfig
    from common.objects.pool import HELD_OUT_SEED, load_pool
    from common.policy import bundle as bundles
    from services.evaluate import TABLES, Evaluator, table_of, write_json

    loaded = bundles.load(policy)
    config = ObjectsConfig(folder=str(objects)) if objects else ObjectsConfig(count=pool, seed=HELD_OUT_SEED)
    evaluator = Evaluator(
        loaded,
        load_pool(config),
        physics=resolve_physics(physics),
        batch=batch,
        threads=os.cpu_count() or 1,
        seed=seed,
        hold_steps=hold,
    )
    rows = []
    with Progress(transient=True) as progress:
        for constraint in TABLES[table]:
            task = progress.add_task(constraint, total=episodes)
            rows.append(evaluator.row(constraint, episodes, functools.partial(_advance, progress, task)))
    Console().print(table_of(rows, f"{policy.name}, {table}, {len(evaluator.objects)} objects"))
    if json is not None:
        write_json(rows, json)
    return 0


def _advance(progress: Any, task: Any, done: int) -> None:
    progress.update(task, completed=done)


COMMAND = evaluate
