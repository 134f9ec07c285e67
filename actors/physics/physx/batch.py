"""A batch of environments in PhysX on threads."""

import concurrent.futures
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from congrasp.actors.physics.engine import PhysicsState, ResetState, has_diverged
from congrasp.actors.physics.physx.collisions import collisions
from congrasp.actors.physics.physx.contacts import ContactReader
from congrasp.actors.physics.physx.environment import CompiledScene, Environment
from congrasp.actors.physics.physx.transmission import couplings_of, servos_of
from congrasp.actors.physics.scene import addresses, compile_scene
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.types import CONTACTS_PER_LINK


class PhysxPhysics:
    """A batch of environments in PhysX. Its state is this object; calls mutate it."""

    name = "physx"
    compiled = False

    def __init__(self, hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], threads: int):
        """Creates the engine; objects are compiled on first use.

        Args:
          hand: the hand.
          task: timing and collision settings.
          objects: the pool indexed by `ResetState.object_index`.
          threads: threads that step environments in parallel.

        Raises:
          CongraspError: PhysX lacks something that the hand has: too many links, a joint with two
            motors, a coupling of distant joints, or a shape.
        """
        self._hand = hand
        self._task = task
        self._objects = objects
        self.threads = max(1, threads)
        self._pool = concurrent.futures.ThreadPoolExecutor(
            self.threads, thread_name_prefix="physics"
        )
        self._compiled: dict[int, CompiledScene] = {}
        self.environments: list[Environment] = []
        self._readers: list[ContactReader] = []
        scene = self._scene(0)
        servos_of(scene.model)
        couplings_of(scene.model)
        self._where = scene.where

    def start(self, reset_state: ResetState) -> "PhysxPhysics":
        """Starts environments; see `Physics.start`."""
        reset_state = _rows(reset_state)
        batch = len(reset_state.object_index)
        self.environments = []
        self._readers = []
        for i in range(batch):
            environment = self._environment(reset_state, i)
            self.environments.append(environment)
            self._readers.append(ContactReader(environment))
        model = self.environments[0].scene.model
        self._qpos = np.zeros((batch, model.nq), np.float32)
        self._qvel = np.zeros((batch, model.nv), np.float32)
        slots = (batch, len(self._hand.links), CONTACTS_PER_LINK)
        self._contact_force = np.zeros((*slots, 3), np.float32)
        self._contact_position = np.zeros((*slots, 3), np.float32)
        self._touches = np.zeros(slots, bool)
        for i in range(batch):
            self.environments[i].read(self._qpos[i], self._qvel[i])
        return self

    def reset(self, state: Any, mask: Any, reset_state: ResetState) -> "PhysxPhysics":
        """Restarts the masked environments; see `Physics.reset`."""
        reset_state = _rows(reset_state)
        for i in np.flatnonzero(np.asarray(mask)):
            self._replace(int(i), self._environment(reset_state, int(i)))
        return self

    def step(
        self, state: Any, target: Any, table: Any, force: Any | None = None
    ) -> tuple["PhysxPhysics", PhysicsState]:
        """Simulates one control step; see `Physics.step`. Resets and flags diverged
        environments.
        """
        for environment, present in zip(self.environments, np.asarray(table), strict=True):
            environment.place_table(bool(present))
        pushes = None if force is None else np.asarray(force, np.float32)
        # Threads take environments from one shared iterator, since contacts make some slower than
        # others. sapien releases the interpreter's lock during a physics step.
        remaining = iter(range(len(self.environments)))
        steps = []
        for _ in range(self.threads):
            steps.append(
                self._pool.submit(self._step_environments, remaining, np.asarray(target), pushes)
            )
        for step in steps:
            step.result()
        diverged = has_diverged(np, self._qpos, self._qvel)
        for i in np.flatnonzero(diverged):
            environment = self.environments[i]
            self._replace(int(i), Environment(environment.scene, environment.start))
        return self, self._current_state(diverged)

    def replace_objects(self, state: Any, objects: Sequence[GraspObject]) -> "PhysxPhysics":
        """Replaces the objects; see `Physics.replace_objects`."""
        self._objects = objects
        self._compiled.clear()
        return self

    def read(self, state: Any) -> PhysicsState:
        """Returns the current state of the environments; see `Physics.read`."""
        return self._current_state(np.zeros(len(self.environments), bool))

    def close(self) -> None:
        """Stops the threads, and frees the scenes."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        self.environments = []
        self._readers = []

    def _scene(self, index: int) -> CompiledScene:
        """Returns the compiled scene of an object, compiling it on first use."""
        if index not in self._compiled:
            model = compile_scene(self._hand, self._task, self._objects[index])
            links = tuple(model.body(link.name).id for link in self._hand.links)
            where = addresses(model, self._hand)
            self._compiled[index] = CompiledScene(model, where, collisions(model), links)
        return self._compiled[index]

    def _environment(self, reset_state: ResetState, i: int) -> Environment:
        """Builds environment i at row i of the reset states."""
        start = ResetState(*(leaf[i].copy() for leaf in reset_state))
        return Environment(self._scene(int(start.object_index)), start)

    def _replace(self, i: int, environment: Environment) -> None:
        """Replaces environment i by another at its start, without contacts."""
        self.environments[i] = environment
        self._readers[i] = ContactReader(environment)
        self._touches[i] = False
        self._contact_force[i] = 0.0
        environment.read(self._qpos[i], self._qvel[i])

    def _step_environments(
        self, remaining: Iterator[int], target: np.ndarray, pushes: np.ndarray | None
    ) -> None:
        """Steps environments from a shared iterator until it is exhausted; runs in each thread."""
        for i in remaining:
            push = None if pushes is None else pushes[i]
            environment = self.environments[i]
            environment.step(target[i], self._task.substeps, push)
            environment.read(self._qpos[i], self._qvel[i])
            self._readers[i].read(
                self._contact_force[i], self._contact_position[i], self._touches[i]
            )

    def _current_state(self, diverged: np.ndarray) -> PhysicsState:
        """Returns the physics state from the batch's arrays; `diverged` (B,) is passed through."""
        where = self._where
        # Copies: the next step writes into the buffers while JAX may still read. Indexing copies.
        return PhysicsState(
            q=self._qpos[:, where.finger_qpos],
            u=self._qpos[:, where.wrist_qpos],
            q_velocity=self._qvel[:, where.finger_qvel],
            u_velocity=self._qvel[:, where.wrist_qvel],
            object_position=self._qpos[:, where.object_qpos[:3]],
            object_quaternion=self._qpos[:, where.object_qpos[3:]],
            object_velocity=self._qvel[:, where.object_qvel[:3]],
            object_angular_velocity=self._qvel[:, where.object_qvel[3:]],
            contact_force=self._contact_force.copy(),
            contact_position=self._contact_position.copy(),
            contact_found=self._touches.copy(),
            diverged=diverged,
            occupancy=np.zeros(3, np.float32),
        )


def _rows(reset_state: ResetState) -> ResetState:
    """Reset states as NumPy arrays."""
    return ResetState(*(np.asarray(leaf) for leaf in reset_state))
