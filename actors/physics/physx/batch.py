"""A batch of environments in PhysX, stepped one after another in this process."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from congrasp.actors.physics.compiled_objects import CompiledObjects
from congrasp.actors.physics.engine import PhysicsState, ResetState, has_diverged, host_arrays
from congrasp.actors.physics.physx.collisions import collisions
from congrasp.actors.physics.physx.contacts import ContactReader
from congrasp.actors.physics.physx.environment import CompiledScene, Environment
from congrasp.actors.physics.physx.transmission import couplings_of, servos_of
from congrasp.actors.physics.scene import addresses
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.physics_library import mujoco
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.types import CONTACTS_PER_LINK


class PhysxPhysics:
    """A batch of environments in PhysX. Its state is this object; calls mutate it.

    sapien never releases the interpreter's lock, so that threads gain nothing: `PhysxProcesses` has
    a batch in each of several processes.
    """

    name = "physx"
    compiled = False

    def __init__(self, hand: Hand, task: TaskConfig, objects: Sequence[GraspObject]):
        """Creates the engine; objects are compiled on first use.

        Args:
          hand: the hand.
          task: timing and collision settings.
          objects: the pool indexed by `ResetState.object_index`.

        Raises:
          CongraspError: PhysX lacks something that the hand has: too many links, a joint with two
            motors, a coupling of distant joints, or a shape.
        """
        self._hand = hand
        self._task = task
        self._compiled = CompiledObjects(hand, task, objects, self._scene)
        self.environments: list[Environment] = []
        self._readers: list[ContactReader] = []
        scene = self._compiled[0]
        servos_of(scene.model)
        couplings_of(scene.model)
        self._where = scene.where

    def start(self, reset_state: ResetState) -> "PhysxPhysics":
        """Starts environments; see `Physics.start`."""
        reset_state = host_arrays(reset_state)
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
        reset_state = host_arrays(reset_state)
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
        self._step_environments(np.asarray(target), pushes)
        diverged = has_diverged(np, self._qpos, self._qvel)
        for i in np.flatnonzero(diverged):
            environment = self.environments[i]
            self._replace(int(i), Environment(environment.scene, environment.start))
        return self, self._current_state(diverged)

    def replace_objects(self, state: Any, objects: Sequence[GraspObject]) -> "PhysxPhysics":
        """Replaces the objects; see `Physics.replace_objects`."""
        self._compiled.replace(objects)
        return self

    def read(self, state: Any) -> PhysicsState:
        """Returns the current state of the environments; see `Physics.read`."""
        return self._current_state(np.zeros(len(self.environments), bool))

    def close(self) -> None:
        """Frees the scenes."""
        self.environments = []
        self._readers = []

    def _scene(self, model: mujoco.MjModel) -> CompiledScene:
        """Returns what environments share of the compiled scene of an object."""
        links = tuple(model.body(link.name).id for link in self._hand.links)
        return CompiledScene(model, addresses(model, self._hand), collisions(model), links)

    def _environment(self, reset_state: ResetState, i: int) -> Environment:
        """Builds environment i at row i of the reset states."""
        start = ResetState(*(leaf[i].copy() for leaf in reset_state))
        return Environment(self._compiled[int(start.object_index)], start)

    def _replace(self, i: int, environment: Environment) -> None:
        """Replaces environment i by another at its start, without contacts."""
        self.environments[i] = environment
        self._readers[i] = ContactReader(environment)
        self._touches[i] = False
        self._contact_force[i] = 0.0
        environment.read(self._qpos[i], self._qvel[i])

    def _step_environments(self, target: np.ndarray, pushes: np.ndarray | None) -> None:
        """Steps all environments, and reads their states and contacts into the batch's arrays."""
        for i, environment in enumerate(self.environments):
            push = None if pushes is None else pushes[i]
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
