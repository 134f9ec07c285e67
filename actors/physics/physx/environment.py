"""One environment: a PhysX scene with hand, object and table."""

from typing import Any, NamedTuple

import numpy as np

from congrasp.actors.physics.engine import ResetState
from congrasp.actors.physics.physx.articulation import Articulation, HandStart, set_inertia
from congrasp.actors.physics.physx.collisions import Collisions, Frictions, frictions
from congrasp.actors.physics.physx.library import configure, px, sapien
from congrasp.actors.physics.physx.shapes import geom_shape, material, plane
from congrasp.actors.physics.physx.units import LENGTH_SCALE, scaled_pose
from congrasp.actors.physics.scene import TABLE_AWAY, Addresses
from congrasp.common.ranges import MAX_SPEED
from congrasp.common.runtime.physics_library import mujoco


class CompiledScene(NamedTuple):
    """MuJoCo's scene of one object, and what is derived from it."""

    model: mujoco.MjModel
    addresses: Addresses
    collisions: Collisions
    links: tuple[int, ...]
    """Bodies of the hand's links, in their order."""


class Environment:
    """One environment, from the start of an episode. It cannot be reset: another one replaces it,
    so that nothing of an episode, such as the contacts that PhysX caches, affects the next.
    """

    def __init__(self, scene: CompiledScene, reset_state: ResetState):
        """Builds the environment at the start of an episode.

        Args:
          scene: the scene of its object.
          reset_state: the start, without the dimension B.
        """
        self.scene = scene
        self.reset_state = reset_state
        model = scene.model
        configure(model.opt.gravity, LENGTH_SCALE)
        self.system = px.PhysxCpuSystem()
        self.system.timestep = model.opt.timestep
        # The scene keeps the entities; sapien's default would have a renderer.
        self._sapien_scene = sapien.Scene([self.system])
        self.friction = float(reset_state.friction)
        surfaces = frictions(model, self.friction)
        self.hand = Articulation(
            self._sapien_scene,
            model,
            scene.collisions,
            material(surfaces.link),
            _hand_start(model, scene.addresses, reset_state),
        )
        self._has_table = True
        self._add_object(surfaces)
        self._add_tables(surfaces)

    def place_table(self, present: bool) -> None:
        """Places the table or removes it."""
        if present == self._has_table:
            return
        for entity in self._tables:
            entity.set_pose(sapien.Pose() if present else scaled_pose(TABLE_AWAY))
        # PhysX does not notice that the ground of a resting body is gone
        self.object.wake_up()
        self._has_table = present

    def step(self, target: np.ndarray, substeps: int, push: np.ndarray | None) -> None:
        """Simulates one control step.

        Args:
          target: (nu,) targets of the actuators.
          substeps: physics steps.
          push: (3,) force on the object's centre of mass, world frame, N; None for none.
        """
        self.hand.set_targets(target)
        for _ in range(substeps):
            self.hand.update_tendons()
            if push is not None:
                self.object.add_force_torque(LENGTH_SCALE * push, np.zeros(3, np.float32))
            self.system.step()

    def read(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Writes the state into qpos (nq,) and qvel (nv,) of the compiled scene, but the object's
        angular velocity in the world frame.
        """
        addresses = self.scene.addresses
        self.hand.read(qpos, qvel)
        pose = self.object.entity_pose
        qpos[addresses.object_qpos[:3]] = pose.p / LENGTH_SCALE
        qpos[addresses.object_qpos[3:]] = pose.q
        qvel[addresses.object_qvel[:3]] = self.object.linear_velocity / LENGTH_SCALE
        qvel[addresses.object_qvel[3:]] = self.object.angular_velocity

    def _add_object(self, surfaces: Frictions) -> None:
        """Adds the object."""
        model = self.scene.model
        reset_state = self.reset_state
        index = self.scene.addresses.object_body
        body = px.PhysxRigidDynamicComponent()
        for geom in np.flatnonzero(model.geom_bodyid == index).tolist():
            shape = geom_shape(model, geom, material(surfaces.object))
            collisions = self.scene.collisions
            shape.set_collision_groups([collisions.own_bit[index], collisions.others[index], 0, 0])
            body.attach(shape)
        mass = reset_state.mass_scale * model.body_mass[index]
        principal = reset_state.mass_scale * model.body_inertia[index]
        set_inertia(
            body, mass, principal, scaled_pose(model.body_ipos[index], model.body_iquat[index])
        )
        # PhysX damps at a rate; MuJoCo's damping is a force or torque per speed
        damping = model.dof_damping[self.scene.addresses.object_qvel]
        body.linear_damping = float(damping[0] / mass)
        body.angular_damping = float(damping[3] / principal.mean())
        body.max_angular_velocity = MAX_SPEED
        body.kinematic = bool(reset_state.stationary)
        entity = sapien.Entity()
        entity.add_component(body)
        entity.set_pose(scaled_pose(reset_state.object_position, reset_state.object_quaternion))
        self._sapien_scene.add_entity(entity)
        self.object = body

    def _add_tables(self, surfaces: Frictions) -> None:
        """Adds two planes at z = 0, for the object and for the hand: they differ in friction."""
        collisions = self.scene.collisions
        objects_bit = collisions.own_bit[self.scene.addresses.object_body]
        self._tables = [
            self._add_plane(surfaces.table_to_object, collisions.table & objects_bit),
            self._add_plane(surfaces.table_to_link, collisions.table & ~objects_bit),
        ]

    def _add_plane(self, friction: float, partners: int) -> Any:
        """Adds a plane that collides with the bodies of a mask."""
        shape = plane(material(friction))
        shape.set_collision_groups([0, partners, 0, 0])
        body = px.PhysxRigidStaticComponent()
        body.attach(shape)
        entity = sapien.Entity()
        entity.add_component(body)
        self._sapien_scene.add_entity(entity)
        return entity


def _hand_start(model: mujoco.MjModel, addresses: Addresses, reset_state: ResetState) -> HandStart:
    """Returns the start of the hand; the wrist joints are at zero."""
    qpos = np.zeros(model.nq, np.float32)
    qpos[addresses.finger_qpos] = reset_state.q
    qvel = np.zeros(model.nv, np.float32)
    qvel[addresses.wrist_qvel] = reset_state.u_velocity
    gains = np.ones(model.nu)
    gains[addresses.motors] = reset_state.gain_scale
    return HandStart(
        scaled_pose(reset_state.base_position, reset_state.base_quaternion), qpos, qvel, gains
    )
