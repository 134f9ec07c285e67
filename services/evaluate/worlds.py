"""Worlds of an evaluation: their task, their worker, and what is measured at every step."""

import contextlib
import dataclasses
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any

from actors import protocols
from actors.physics import make_physics
from actors.rollout import RolloutWorker
from common.config import TaskConfig
from common.engines import PhysicsName
from common.hands import get_hand
from common.objects.distance import distance_field
from common.objects.mjcf import CONTACT
from common.objects.pool import object_scale
from common.objects.spec import GraspObject
from common.policy.bundle import PolicyBundle, mean_action
from common.task import plausibility
from common.task.bank import ConstraintBank
from common.task.constraints import optional
from common.task.types import Array

HOLD_SECONDS = 2.0
"""How long a grasp should last without the table, beyond the paper's quarter of a second."""
NOMINAL_FRICTION = CONTACT.friction[0]
"""Sliding friction between hand and object, of evaluations that name no other."""


def two_seconds(task: TaskConfig) -> int:
    """Control steps in `HOLD_SECONDS`."""
    return round(HOLD_SECONDS / task.control_dt)


def protocol(task: TaskConfig, hold: int, friction: float = NOMINAL_FRICTION) -> TaskConfig:
    """The task with `hold` control steps without the table, and objects of their own mass and of one sliding friction.

    So rates compare between policies, whatever ranges they were trained with.
    """
    return dataclasses.replace(
        task,
        hold_steps=min(task.hold_steps, hold),
        hold_steps_max=hold,
        end_when_fallen=False,
        mass_range=(1.0, 1.0),
        friction_range=(friction, friction),
    )


def sampling_config(task: TaskConfig, constraints: Sequence[str]) -> TaskConfig:
    """The task that samples episodes of these rows: a constraint that only some of them have with probability 1/2."""
    rows = [constraint.split("+") for constraint in constraints]

    def probability(part: str) -> float:
        """Of one constraint."""
        share = sum(part in parts for parts in rows) / len(rows)
        return share if share in (0.0, 1.0) else 0.5

    shares: dict[str, Any] = {f"p_{constraint.name}": probability(constraint.name) for constraint in optional(task)}
    return dataclasses.replace(task, **shares)


def objects_label(bundle: PolicyBundle, folder: pathlib.Path | None) -> str:
    """Name of the objects' source, with the factor on their lengths for the policy's hand."""
    scale = object_scale(get_hand(bundle.spec.hand), bundle.task)
    source = str(folder) if folder else "held-out procedural objects"
    return source if scale == 1.0 else f"{source}, lengths x {scale:g} for the {bundle.spec.hand_name} hand"


@contextlib.contextmanager
def evaluation_worker(
    bundle: PolicyBundle,
    task: TaskConfig,
    objects: Sequence[GraspObject],
    bank: ConstraintBank,
    *,
    physics: PhysicsName,
    threads: int,
    batch: int,
    seed: int,
    traced: slice,
) -> Iterator[RolloutWorker]:
    """A worker whose worlds act by the policy's mean, and whose probe is `common.task.plausibility.sample`.

    `measure` gives it the objects that it measures against.

    Args:
      bundle: the policy.
      task: the task.
      objects: what is grasped.
      bank: constraints on them.
      physics: engine; not `auto`.
      threads: threads of the `native` engine.
      batch: B, number of worlds.
      seed: seed of the episodes.
      traced: worlds of which a trace is kept.
    """
    layout, hand = bundle.spec.layout, get_hand(bundle.spec.hand)

    def policy(parameters: Any, observation: Array, key: Array) -> tuple[Array, Array]:
        """Mean action (B, A), and a log probability (B,) that nobody reads."""
        return mean_action(layout, parameters, observation), observation[..., 0] * 0.0

    engine = make_physics(physics, hand, task, objects, threads=threads)
    try:
        worker = RolloutWorker(
            hand,
            task,
            engine,
            bank,
            policy,
            batch=batch,
            seed=seed,
            half_precision=False,
            probe=plausibility.sample,
            traced=traced,
        )
        measure(worker, task, objects)
        yield worker
    finally:
        engine.close()


def measure(worker: RolloutWorker, task: TaskConfig, objects: Sequence[GraspObject]) -> None:
    """Measures against these objects from now on; episodes that go on after their hold are under `protocols.stress`."""
    hold = task.hold_steps_max
    protocol = protocols.stress(task, objects, hold) if hold == two_seconds(task) else None
    worker.adjust(protocol=protocol, probe_data=distance_field(objects))
