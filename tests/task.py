"""The task of the suite: a module that needs another one says why.

Modules that share hand, task, policy and batch share compiled programs, in one process and through
the disk's cache.
"""

import contextlib
import dataclasses
import functools
import os
import tempfile
from collections.abc import Iterator, Sequence
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.actors.initial import InitialConditions
from congrasp.actors.physics.engine import Physics, ResetState
from congrasp.actors.physics.native import NativePhysics
from congrasp.actors.rollout import Probe, Programs, no_probe, programs_of
from congrasp.actors.worker import RolloutWorker
from congrasp.common.config import NetworkConfig, RunConfig
from congrasp.common.hands import get_hand
from congrasp.common.objects import procedural
from congrasp.common.objects.spec import GraspObject
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling import cache
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.sampling.build import build_bank
from congrasp.common.task.types import Array
from congrasp.services.train.command import untrained

HAND = get_hand("human")
TASK = TaskConfig()
OBJECTS = procedural.generate_many(4, 0, ("box", "cylinder", "mug", "hammer"))
BATCH = 8
CONFIG = RunConfig(task=TASK, network=NetworkConfig(hidden=(16,), encoder=4))
"""A run whose policy is tiny."""


@contextlib.contextmanager
def kept_banks() -> Iterator[None]:
    """Keeps banks on disk like those of large pools, for the other workers."""
    folder = os.path.join(tempfile.gettempdir(), "congrasp-tests-banks")
    with (
        mock.patch.dict(os.environ, XDG_CACHE_HOME=folder),
        mock.patch.object(cache, "MIN_OBJECTS", 1),
    ):
        yield


@functools.cache
def bank() -> ConstraintBank:
    """The constraint bank of `OBJECTS`."""
    with kept_banks():
        return build_bank(HAND, TASK, OBJECTS, 0)


def bank_of(index: int, points: int) -> ConstraintBank:
    """The constraint bank of one of `OBJECTS`, with its first surface points."""
    row = jax.tree.map(lambda rows: rows[index : index + 1], bank())
    return row._replace(
        **{name: getattr(row, name)[:, :points] for name in ("points", "avoid", "normals")}
    )


@functools.cache
def policy() -> PolicyBundle:
    """The untrained policy of `CONFIG`."""
    return untrained(CONFIG)


@functools.cache
def heading_policy() -> PolicyBundle:
    """An untrained policy whose only constraint is the heading: a server of it compiles in less
    than half the time.
    """
    task = dataclasses.replace(TASK, constraints=("heading",))
    return untrained(dataclasses.replace(CONFIG, task=task))


def warp_engine(objects: Sequence[GraspObject], **options: Any) -> Physics:
    """MJX-Warp with these objects, on a CPU."""
    import warp  # takes seconds in every worker

    from congrasp.actors.physics.warp import WarpPhysics

    warp.config.optimization_level = 0  # the optimiser takes longer than the kernels run here
    return WarpPhysics(HAND, TASK, objects, **options)


def start_of(**fields: Any) -> ResetState:
    """An environment that starts with what is given: else a free object of its own mass at the
    origin, and the open hand at the world's pose."""
    level = np.array([[1.0, 0.0, 0.0, 0.0]], np.float32)
    place = np.zeros((1, 3), np.float32)
    neutral = {
        **dict.fromkeys(("mass_scale", "friction", "gain_scale"), np.ones(1, np.float32)),
        **dict.fromkeys(("base_position", "object_position"), place),
        **dict.fromkeys(("base_quaternion", "object_quaternion"), level),
        **{"object_index": np.zeros(1, int), "stationary": np.zeros(1, bool)},
        **{"u_velocity": np.zeros((1, 6), np.float32), "q": HAND.q_open[None].astype(np.float32)},
    }
    return ResetState(**{**neutral, **fields})


def commanded(parameters: Array, observation: Array, key: Array) -> tuple[Array, Array]:
    """A policy for `worker`: acts by its parameters (A + 1,), a mean action and the size of its
    noise.
    """
    noise = jax.random.normal(key, (len(observation), len(parameters) - 1))
    return parameters[:-1] + parameters[-1] * noise, -0.5 * jnp.sum(noise**2, -1)


def command(fingers: float = 0.0, lift: float = 0.0, noise: float = 0.0) -> np.ndarray:
    """Parameters of `commanded`: the action of every finger joint, that of the wrist along z, and
    the noise.
    """
    mean = np.zeros(len(HAND.motors) + 7, np.float32)
    mean[: len(HAND.motors)] = fingers
    mean[len(HAND.motors) + 2] = lift
    mean[-1] = noise
    return mean


def worker(
    seed: int = 0, physics: Physics | None = None, *, renewed: bool = True, **options: Any
) -> RolloutWorker:
    """Environments of the suite's task in which `commanded` acts.

    Args:
      seed: seed of episodes and actions.
      physics: the engine.
      renewed: whether finished episodes restart; otherwise `RolloutWorker.begin` sets the episodes.
      options: other options of `RolloutWorker`, which cost other programs.
    """
    physics = physics or NativePhysics(HAND, TASK, OBJECTS, 2)
    settings = {"batch": BATCH, "half_precision": True, "traced": "all", **options}
    return RolloutWorker(
        HAND, TASK, physics, bank() if renewed else None, commanded, seed=seed, **settings
    )


def placed(tree: Any) -> Any:
    """The arrays on this process's device, as a worker places them: others would compile its
    programs again.
    """
    return jax.device_put(tree, jax.local_devices()[0])


def programs(probe: Probe = no_probe, task: TaskConfig = TASK) -> Programs:
    """The programs of `worker`, or of those of another task."""
    settings = {
        "batch": BATCH,
        "half_precision": True,
        "probe": probe,
        "traced": "all",
        "taught": False,
    }
    return programs_of(HAND, task, NativePhysics, commanded, **settings)


def episodes(
    count: int, episode_bank: ConstraintBank | None = None, task: TaskConfig = TASK
) -> InitialConditions:
    """Initial conditions of many episodes of the suite's task, by the program that draws those of
    `worker`.

    Args:
      count: number of episodes, rounded up to a multiple of `BATCH`.
      episode_bank: a bank with the shapes of that of the suite; by default, that.
      task: another task, which costs another program.
    """
    placed_bank, keys = placed(
        (episode_bank or bank(), jax.random.split(jax.random.key(3), -(-count // BATCH)))
    )
    drawn = [
        jax.device_get(programs(task=task).sample(placed_bank, key, np.array(False)))
        for key in keys
    ]
    return jax.tree.map(lambda *rows: np.concatenate(rows), *drawn)
