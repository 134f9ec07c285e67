"""Evaluation by the paper's protocol: the deterministic policy, one table row for each set of constraints."""

import dataclasses
import json
import math
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from actors.environment import EPISODE_FIELDS, EnvironmentState
from actors.episode import episode_message
from actors.physics import make_physics
from actors.rollout import Rollout, RolloutWorker, finished_episodes, goal_of_world
from actors.taskset import TaskSet, build_taskset
from common.config import PhysicsName, TaskConfig
from common.hands import get_hand
from common.objects.spec import GraspObject
from common.policy.bundle import PolicyBundle, mean_action
from common.task.types import Array, Surface
from common.wire.codec import Message

TABLES = {
    "single": ("heading", "pose", "trajectory", "affordance"),
    "composed": ("pose+trajectory", "trajectory+affordance"),
}
"""Rows of the paper's tables, by the constraints that are active."""
_ERRORS = {
    "heading": ("heading_rad", "heading_m"),
    "pose": ("pose_rad", "pose_m"),
    "trajectory": ("trajectory_rad", "trajectory_m"),
    "affordance": ("affordance_ratio",),
}
_NAMES = {
    "heading_rad": "heading_rad",
    "heading_m": "heading_m",
    "pose_rad": "pose_rad",
    "pose_m": "pose_m",
    "trajectory_rad": "traj_rad",
    "trajectory_m": "traj_m",
    "affordance_ratio": "affordance_ratio",
}


@dataclasses.dataclass(frozen=True)
class Row:
    """One row: rates with 95 % Wilson intervals, errors averaged over successful episodes."""

    constraint: str
    hand: str
    method: str
    episodes: int
    success: float
    success_low: float
    success_high: float
    held: float
    """Rate of success that also lasts to the end of the hold."""
    episode_return: float
    links_at_removal: float
    force_sum: float
    """Mean sum of the links' contact forces after the removal, N."""
    errors: dict[str, float | None]

    def to_json(self) -> dict[str, Any]:
        """The row as it is written to `--json`."""
        row = dataclasses.asdict(self)
        return {**row, **row.pop("errors"), "return": row.pop("episode_return")}


def wilson(successes: int, count: int) -> tuple[float, float]:
    """95 % Wilson score interval of a rate."""
    if count == 0:
        return 0.0, 1.0
    z, p = 1.959964, successes / count
    middle = p + z * z / (2 * count)
    spread = z * math.sqrt(p * (1 - p) / count + z * z / (4 * count * count))
    return (middle - spread) / (1 + z * z / count), (middle + spread) / (1 + z * z / count)


def with_constraints(task: TaskConfig, constraint: str) -> TaskConfig:
    """The task with exactly these constraints active, wherever an object allows them."""
    parts = constraint.split("+")
    return dataclasses.replace(
        task,
        p_affordance=float("affordance" in parts),
        p_pose=float("pose" in parts),
        p_trajectory=float("trajectory" in parts),
    )


class Evaluator:
    """A policy on a pool of objects; worlds are built once and used for every row."""

    def __init__(
        self,
        bundle: PolicyBundle,
        objects: Sequence[GraspObject],
        *,
        physics: PhysicsName = "native",
        batch: int = 64,
        threads: int = 2,
        seed: int = 0,
        task: TaskConfig | None = None,
        hold_steps: int | None = None,
    ):
        """Builds the constraint sets.

        Args:
          bundle: the policy.
          objects: what it grasps.
          physics: engine.
          batch: worlds that run side by side.
          threads: threads of the `native` engine.
          seed: seed of constraints and episodes.
          task: where it is not to be the bundle's.
          hold_steps: control steps without the table (the paper's 25 always count as success; the rest as `held`).
        """
        base = task or bundle.task
        self.bundle, self.objects = bundle, objects
        self.task = dataclasses.replace(base, hold_steps_max=hold_steps or base.hold_steps)
        self._hold = hold_steps or base.hold_steps
        self._hand = get_hand(bundle.spec.hand)
        self._physics_name, self._threads, self._batch, self._seed = physics, threads, batch, seed
        self._taskset: TaskSet = build_taskset(self._hand, self.task, objects, seed)

    def row(self, constraint: str, episodes: int, progress: Callable[[int], None] = lambda n: None) -> Row:
        """Runs whole batches until `episodes` have ended, and summarises the first `episodes` of them."""
        collected = [found for found, _ in self._run(constraint, episodes, progress)]
        values = {name: np.concatenate([part[name] for part in collected])[:episodes] for name in collected[0]}
        return summarise(constraint, self.bundle.spec.hand, values)

    def rows(self, constraint: str, episodes: int, count: int) -> list[Row]:
        """`count` rows of `episodes` each from independent draws, to see how much chance there is in one."""
        collected = [found for found, _ in self._run(constraint, episodes * count, lambda n: None)]
        values = {name: np.concatenate([part[name] for part in collected]) for name in collected[0]}
        return [
            summarise(
                constraint,
                self.bundle.spec.hand,
                {name: column[i * episodes : (i + 1) * episodes] for name, column in values.items()},
            )
            for i in range(count)
        ]

    def episode(self, constraint: str, tries: int = 1) -> Message:
        """An episode of world 0 under a set of constraints: the first that succeeds, or the last of `tries`."""
        message: Message | None = None
        for _, (env, rollout) in self._run(constraint, tries * min(self._batch, tries), lambda n: None):
            message = self._message(env, rollout)
            if message.meta["success"]:
                break
        assert message is not None
        return message

    def _message(self, env: EnvironmentState, rollout: Rollout) -> Message:
        values = np.asarray(rollout.episodes)[0]
        metrics = {
            name.removeprefix("episode/"): float(value)
            for name, value in zip(EPISODE_FIELDS, values, strict=True)
            if name.startswith("episode/")
        }
        return episode_message(
            self._hand,
            self.task,
            rollout.trace,
            goal_of_world(env.goal),
            Surface(*(np.asarray(field)[0] for field in env.surface)),
            self.objects[int(np.asarray(env.world.object_index)[0])],
            {
                "version": self.bundle.version,
                "actor": "evaluation",
                "success": metrics["success"] > 0,
                "metrics": metrics,
            },
        )

    def _run(self, constraint: str, episodes: int, progress: Callable[[int], None]) -> Any:
        task = with_constraints(self.task, constraint)
        physics = make_physics(self._physics_name, self._hand, task, self.objects, threads=self._threads)
        layout = self.bundle.spec.layout

        def policy(acting: Any, observation: Array, key: Array) -> tuple[Array, Array]:
            return mean_action(layout, acting, observation), observation[..., 0] * 0.0

        try:
            worker = RolloutWorker(
                self._hand,
                dataclasses.replace(task, hold_steps_max=self._hold),
                physics,
                self._taskset,
                policy,
                batch=min(self._batch, episodes),
                seed=self._seed,
                half=False,
            )
            done = 0
            while done < episodes:
                env = worker.env
                rollout: Rollout = worker.collect(self.bundle.acting, task.approach_steps + self._hold)
                found = finished_episodes(rollout)
                done += len(found["episode/success"])
                progress(min(done, episodes))
                yield found, (env, rollout)
        finally:
            physics.close()


def summarise(constraint: str, hand: str, values: dict[str, np.ndarray]) -> Row:
    """A row from metrics (E,) of episodes, by the names of `actors.environment.EPISODE_FIELDS`."""
    success = values["episode/success"] > 0
    low, high = wilson(int(success.sum()), len(success))
    errors: dict[str, float | None] = dict.fromkeys(_NAMES.values())
    for part in constraint.split("+"):
        for name in _ERRORS[part]:
            errors[_NAMES[name]] = float(values[f"episode/{name}"][success].mean()) if success.any() else None
    return Row(
        constraint=constraint,
        hand=hand,
        method="ours",
        episodes=len(success),
        success=float(success.mean()),
        success_low=low,
        success_high=high,
        held=float((values["episode/held"] > 0).mean()),
        episode_return=float(values["episode/return"].mean()),
        links_at_removal=float(values["episode/links_at_removal"].mean()),
        force_sum=float(values["episode/force_sum"].mean()),
        errors=errors,
    )


def write_json(rows: Sequence[Row], path: pathlib.Path) -> None:
    """Writes `{"rows": [...]}`."""
    path.write_text(json.dumps({"rows": [row.to_json() for row in rows]}, indent=2))


def table_of(rows: Sequence[Row], title: str) -> Any:
    """Rows as a rich table."""
    from rich.table import Table

    table = Table(title=title)
    for column in ("constraint", "episodes", "success", "95 %", "held", "error", "force"):
        table.add_column(column, justify="left" if column in ("constraint", "error") else "right")
    for row in rows:
        parts = [f"{value:.3f} {_UNITS[name]}" for name, value in row.errors.items() if value is not None]
        table.add_row(
            row.constraint,
            str(row.episodes),
            f"{100 * row.success:.1f} %",
            f"{100 * row.success_low:.1f}-{100 * row.success_high:.1f}",
            f"{100 * row.held:.1f} %",
            ", ".join(parts),
            f"{row.force_sum:.1f} N",
        )
    return table


_UNITS = {name: name.rsplit("_", 1)[1] for name in _NAMES.values()}
