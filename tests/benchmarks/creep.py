"""Creep of held objects under two settings of friction and solver, for the same episodes of the same policy."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.actors.physics.native import NativePhysics, Scene
from congrasp.actors.rollout import Trace, finished_episodes
from congrasp.actors.worker import RolloutWorker
from congrasp.common.config import ObjectsConfig
from congrasp.common.hands import get_hand
from congrasp.common.objects.pool import HELD_OUT_SEED, load_pool, scale_objects
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.bundle import acting
from congrasp.common.policy.pretrained import named_policy
from congrasp.common.runtime.parallel import cores
from congrasp.common.task.sampling.build import build_bank
from congrasp.services.evaluate.plan import batches, plan_row, protocol, two_seconds


class Solver(NamedTuple):
    """Numbers that decide whether contacts creep."""

    impratio: float
    iterations: int
    ls_iterations: int


SOLVERS = (Solver(10.0, 8, 20), Solver(100.0, 24, 40))
"""Settings until November 2026, and those of the scene since."""


class SolvedPhysics(NativePhysics):
    """MuJoCo C with other numbers of the solver than the scene's."""

    solver = SOLVERS[0]

    def _scene(self, index: int) -> Scene:
        """See `NativePhysics._scene`."""
        scene = super()._scene(index)
        scene.model.opt.impratio = self.solver.impratio
        scene.model.opt.iterations, scene.model.opt.ls_iterations = self.solver.iterations, self.solver.ls_iterations
        return scene


class Held(NamedTuple):
    """Outcome of B episodes."""

    held: np.ndarray
    """(B,) bool: at the end of the hold."""
    moved: np.ndarray
    """(B,) mm by which the object's centre of mass moved in the wrist frame."""
    turned: np.ndarray
    """(B,) degrees by which it rotated in the wrist frame."""
    late: np.ndarray
    """(B,) mm in the last second alone."""
    limited: float
    """Share of physics steps whose solver reached its limit."""


def creep(
    policies: tuple[str, ...] = ("human", "sharpa", "allegro"), objects: int = 24, episodes: int = 24, threads: int = 0
) -> int:
    """Creep of held objects in mm and degrees, under the old and the new settings of friction and solver.

    It is that of two seconds of hold, from a quarter of a second after the table's removal on, in the episodes that are
    held under both settings.

    Args:
      policies: Policy files, or names of pretrained policies.
      objects: Number of procedural objects that no policy was trained with.
      episodes: Least number of episodes of a policy, under the heading alone.
      threads: Threads of the physics; 0 takes all cores.

    Examples:
      python -m tests.benchmarks creep
      python -m tests.benchmarks creep --policies human --objects 8 --episodes 8
    """
    columns = ("policy", "impratio, iterations, line search", "held", "creep, mm", "90 %", "degrees", "90 %")
    columns += ("mm in the last second", "90 %", "at limit")
    print(f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
    for name in policies:
        found = [_run(name, solver, objects, episodes, threads or cores()) for solver in SOLVERS]
        both = found[0].held & found[1].held
        for solver, one in zip(SOLVERS, found, strict=True):
            amounts = [f"{np.quantile(x[both], q):.2f}" for x in (one.moved, one.turned, one.late) for q in (0.5, 0.9)]
            numbers = f"{solver.impratio:g}, {solver.iterations}, {solver.ls_iterations}"
            cells = [name, numbers, f"{one.held.sum()} of {len(both)}", *amounts, f"{100 * one.limited:.2f} %"]
            print(f"| {' | '.join(cells)} |", flush=True)
    return 0


def _run(name: str, solver: Solver, count: int, episodes: int, threads: int) -> Held:
    """Simulates the episodes of a policy."""
    bundle = bundles.load(named_policy(name))
    window = bundle.task.hold_steps
    hold = window + two_seconds(bundle.task)
    task, hand = protocol(bundle.task, hold), get_hand(bundle.spec.hand)
    objects = scale_objects(hand, task, load_pool(ObjectsConfig(families=("all",), count=count, seed=HELD_OUT_SEED)))
    bank = build_bank(hand, task, objects, 0)
    plan = plan_row(task, bank, objects, "heading", episodes)
    SolvedPhysics.solver = solver
    physics = SolvedPhysics(hand, task, objects, threads)
    worker = RolloutWorker(
        hand,
        task,
        physics,
        None,
        acting(bundle.spec.layout, mean=True),
        batch=plan.total,
        seed=0,
        half_precision=False,
        traced="all",
    )
    ((conditions, _),) = batches(hand, task, bank, plan, 0, plan.total)
    worker.begin(conditions._replace(hold=np.full(plan.total, hold, np.int32)))
    rollout = worker.collect(bundle.inference_parameters, task.approach_steps + hold)
    physics.close()
    held = finished_episodes(rollout, task)["episode/held"] > 0
    moved, turned = _creep(rollout.trace, task.approach_steps + window - 1)
    late, _ = _creep(rollout.trace, task.approach_steps + hold - 1 - round(1.0 / task.control_dt))
    return Held(held, moved, turned, late, float(np.asarray(rollout.occupancy)[:, 2].mean()))


def _creep(trace: Trace, start: int) -> tuple[np.ndarray, np.ndarray]:
    """Motion of objects in the wrist frame from a step of a trace (T, B, ...) to the last: (B,) mm, (B,) degrees."""

    def pose(step: int) -> tuple[np.ndarray, Rotation]:
        wrist, body = (
            Rotation.from_quat(np.asarray(x[step]), scalar_first=True)
            for x in (trace.wrist_quaternion, trace.object_quaternion)
        )
        offset = np.asarray(trace.object_position[step]) - np.asarray(trace.wrist_position[step])
        return wrist.inv().apply(offset), wrist.inv() * body

    (first, turn), (last, end) = pose(start), pose(-1)
    return 1e3 * np.linalg.norm(last - first, axis=-1), np.degrees((turn.inv() * end).magnitude())
