"""A batch of environments in PhysX, stepped one after another in this process."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from congrasp.actors.physics.compiled_objects import CompiledObjects
from congrasp.actors.physics.engine import PhysicsState, ResetState, has_diverged, host_arrays
from congrasp.actors.physics.physx.collisions import collisions
from congrasp.actors.physics.physx.contacts import ContactReader
from congrasp.actors.physics.physx.environment import CompiledScene, Environment
from congrasp.actors.physics.physx.transmission import check_transmission
from congrasp.actors.physics.scene import addresses
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.physics_library import mujoco
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.types import CONTACTS_PER_LINK

_NO_OCCUPANCY = np.zeros(3, np.float32)
"""`PhysicsState.occupancy` of PhysX, which allocates contacts as needed."""


class _Buffers(NamedTuple):
    """Arrays into which the environments write in each control step; see `PhysicsState`."""

    qpos: np.ndarray
    """(B, nq)."""
    qvel: np.ndarray
    """(B, nv), the object's angular velocity in the world frame."""
    contact_force: np.ndarray
    """(B, L, CONTACTS_PER_LINK, 3)."""
    contact_position: np.ndarray
    """(B, L, CONTACTS_PER_LINK, 3)."""
    contact_found: np.ndarray
    """(B, L, CONTACTS_PER_LINK) bool."""


def _allocate_buffers(batch: int, model: mujoco.MjModel, links: int) -> _Buffers:
    """Returns zeros for a batch of environments of a hand with this number of links."""
    slots = (batch, links, CONTACTS_PER_LINK)
    return _Buffers(
        qpos=np.zeros((batch, model.nq), np.float32),
        qvel=np.zeros((batch, model.nv), np.float32),
        contact_force=np.zeros((*slots, 3), np.float32),
        contact_position=np.zeros((*slots, 3), np.float32),
        contact_found=np.zeros(slots, bool),
    )


class PhysxPhysics:
    """A batch of environments in PhysX.

    The state that the calls of `Physics` take and return is this object itself: calls mutate it and
    ignore the argument.

    The Python binding of PhysX, sapien, never releases the GIL, so that threads would gain nothing.
    `PhysxProcesses` runs one `PhysxPhysics` in each of several processes.
    """

    name = "physx"
    compiled = False  # JAX cannot trace the calls

    def __init__(self, hand: Hand, task: TaskConfig, objects: Sequence[GraspObject]):
        """Creates the engine; scenes of objects are compiled on first use.

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
        self._scenes = CompiledObjects(hand, task, objects, self._derive_scene)
        self.environments: list[Environment] = []
        self._readers: list[ContactReader] = []
        # The first object's scene is compiled now, for errors at the start of a program. Its
        # addresses are those of every scene.
        scene = self._scenes[0]
        check_transmission(scene.model)
        self._addresses = scene.addresses
        self._buffers = _allocate_buffers(0, scene.model, len(hand.links))

    def start(self, reset_state: ResetState) -> "PhysxPhysics":
        """Starts environments; see `Physics.start`."""
        reset_state = host_arrays(reset_state)
        batch = len(reset_state.object_index)
        self.environments = []
        self._readers = []
        for i in range(batch):
            environment = self._build_environment(reset_state, i)
            self.environments.append(environment)
            self._readers.append(ContactReader(environment))
        model = self.environments[0].scene.model
        self._buffers = _allocate_buffers(batch, model, len(self._hand.links))
        for i in range(batch):
            self._read_joints(i)
        return self

    def reset(self, state: Any, mask: Any, reset_state: ResetState) -> "PhysxPhysics":
        """Restarts the masked environments; see `Physics.reset`."""
        reset_state = host_arrays(reset_state)
        for i in np.flatnonzero(np.asarray(mask)):
            self._replace(int(i), self._build_environment(reset_state, int(i)))
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
        diverged = has_diverged(np, self._buffers.qpos, self._buffers.qvel)
        for i in np.flatnonzero(diverged):
            environment = self.environments[i]
            self._replace(int(i), Environment(environment.scene, environment.reset_state))
        return self, self._current_state(diverged)

    def replace_objects(self, state: Any, objects: Sequence[GraspObject]) -> "PhysxPhysics":
        """Replaces the objects; see `Physics.replace_objects`."""
        self._scenes.replace(objects)
        return self

    def read(self, state: Any) -> PhysicsState:
        """Returns the current state of the environments; see `Physics.read`."""
        return self._current_state(np.zeros(len(self.environments), bool))

    def close(self) -> None:
        """Frees the scenes."""
        self.environments = []
        self._readers = []

    def _derive_scene(self, model: mujoco.MjModel) -> CompiledScene:
        """Returns the compiled scene of an object with what environments derive from it."""
        links = tuple(model.body(link.name).id for link in self._hand.links)
        return CompiledScene(model, addresses(model, self._hand), collisions(model), links)

    def _build_environment(self, reset_state: ResetState, i: int) -> Environment:
        """Builds environment i at row i of the reset states."""
        # A copy: the environment keeps its row, and the caller may reuse the arrays
        row = ResetState(*(field[i].copy() for field in reset_state))
        return Environment(self._scenes[int(row.object_index)], row)

    def _replace(self, i: int, environment: Environment) -> None:
        """Replaces environment i by another at its start, without contacts."""
        self.environments[i] = environment
        self._readers[i] = ContactReader(environment)
        self._buffers.contact_found[i] = False
        self._buffers.contact_force[i] = 0.0
        self._buffers.contact_position[i] = 0.0
        self._read_joints(i)

    def _read_joints(self, i: int) -> None:
        """Reads positions and velocities of environment i into the buffers."""
        self.environments[i].read(self._buffers.qpos[i], self._buffers.qvel[i])

    def _step_environments(self, target: np.ndarray, pushes: np.ndarray | None) -> None:
        """Steps all environments, and reads their states and contacts into the buffers."""
        buffers = self._buffers
        for i, environment in enumerate(self.environments):
            push = None if pushes is None else pushes[i]
            environment.step(target[i], self._task.substeps, push)
            self._read_joints(i)
            self._readers[i].read(
                buffers.contact_force[i], buffers.contact_position[i], buffers.contact_found[i]
            )

    def _current_state(self, diverged: np.ndarray) -> PhysicsState:
        """Returns the physics state from the buffers; `diverged` (B,) is passed through."""
        joints = self._addresses
        buffers = self._buffers
        # JAX may still read the returned arrays while the next step writes into the buffers. So all
        # are copies; indexing by an array of addresses already makes one.
        return PhysicsState(
            q=buffers.qpos[:, joints.finger_qpos],
            u=buffers.qpos[:, joints.wrist_qpos],
            q_velocity=buffers.qvel[:, joints.finger_qvel],
            u_velocity=buffers.qvel[:, joints.wrist_qvel],
            object_position=buffers.qpos[:, joints.object_qpos[:3]],
            object_quaternion=buffers.qpos[:, joints.object_qpos[3:]],
            object_velocity=buffers.qvel[:, joints.object_qvel[:3]],
            object_angular_velocity=buffers.qvel[:, joints.object_qvel[3:]],
            contact_force=buffers.contact_force.copy(),
            contact_position=buffers.contact_position.copy(),
            contact_found=buffers.contact_found.copy(),
            diverged=diverged,
            occupancy=_NO_OCCUPANCY.copy(),
        )
