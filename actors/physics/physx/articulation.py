"""The hand as a PhysX articulation: a chain of links for each body, one link a joint."""

from typing import Any, NamedTuple

import numpy as np

from congrasp.actors.physics.physx.collisions import Collisions
from congrasp.actors.physics.physx.library import px, sapien
from congrasp.actors.physics.physx.shapes import geom_shape
from congrasp.actors.physics.physx.transmission import (
    Coupling,
    Servo,
    couplings_of,
    servos_of,
)
from congrasp.actors.physics.physx.units import INERTIA_SCALE, LENGTH_SCALE, scaled_pose
from congrasp.common.ranges import MAX_SPEED
from congrasp.common.runtime.physics_library import mujoco

_CONNECTOR_MASS = 1e-4
"""Mass of a link between two joints of one body, kg."""
_CONNECTOR_INERTIA = 1e-7
"""Its principal moments of inertia, kg.m^2."""
_COUPLING_STIFFNESS = 300.0
"""Stiffness of a coupling, N.m/rad of the follower."""


class HandStart(NamedTuple):
    """Start of an episode of one hand."""

    base_pose: Any
    """Pose of the base in the world frame."""
    qpos: np.ndarray
    """(nq,) of the compiled scene."""
    qvel: np.ndarray
    """(nv,) of the compiled scene."""
    gains: np.ndarray
    """(nu,) factors on both gains of the actuators."""


class _Drive(NamedTuple):
    """Servo of a joint, with what the other joints of its tendon contribute."""

    joint: Any
    servo: Servo
    unit: float
    """Positions of the joint in PhysX per m or rad."""
    damping_share: float
    """Share of the servo in the drive's damping; the rest is passive."""
    others: np.ndarray
    """Indices of the other joints of the tendon in the articulation; empty without a tendon."""
    coefficients: np.ndarray
    """Their coefficients."""


class Articulation:
    """The hand of one environment.

    A servo of one joint is a drive of PhysX. A servo of a tendon is a drive on each of its joints,
    whose target and speed are set before every physics step from the other joints of the tendon, so
    that the torques are those of the tendon at that moment. The passive damping of a joint adds to
    its drive's damping and thus counts within the torque limit, unlike in MuJoCo.
    """

    def __init__(
        self,
        scene: Any,
        model: mujoco.MjModel,
        collisions: Collisions,
        surface: Any,
        start: HandStart,
    ):
        """Builds the articulation in a scene.

        Args:
          scene: scene of the environment.
          model: the compiled scene.
          collisions: pairs of bodies that collide.
          surface: material of the links.
          start: start of the episode.
        """
        self._model = model
        self._collisions = collisions
        self._surface = surface
        self._entities: list[Any] = []
        self._joints: dict[int, Any] = {}
        is_slide = model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE
        self._units = np.where(is_slide, LENGTH_SCALE, 1.0)
        """(njnt,) positions of joints in PhysX per m or rad."""
        self._gain_units = np.where(is_slide, 1.0, INERTIA_SCALE)
        """(njnt,) gains and armatures of joints in PhysX per SI unit."""
        base = model.body("hand_base").id
        self.bodies = {base: self._base()}
        """Links by the index of their body: the one that carries its shapes and mass."""
        for body in range(base + 1, model.nbody):
            if model.body_rootid[body] == base:
                self.bodies[body] = self._add_body(body)
        for entity in self._entities:
            scene.add_entity(entity)
        self.articulation = self.bodies[base].articulation
        active = list(self.articulation.active_joints)
        self._addresses = {j: active.index(joint) for j, joint in self._joints.items()}
        self._order = np.array(sorted(self._joints, key=self._addresses.__getitem__))
        for coupling in couplings_of(model):
            self._couple(coupling)
        self._add_servos(start.gains)
        self.articulation.root_pose = start.base_pose
        units = self._units[self._order]
        self.articulation.qpos = units * start.qpos[model.jnt_qposadr[self._order]]
        self.articulation.qvel = units * start.qvel[model.jnt_dofadr[self._order]]

    def set_targets(self, target: np.ndarray) -> None:
        """Sets the targets (nu,) of the actuators."""
        for drive in self._drives:
            angle = target[drive.servo.actuator] / drive.servo.coefficient
            drive.joint.set_drive_target(drive.unit * angle)
        self._target = target

    def update_tendons(self) -> None:
        """Sets the drives of joints with a tendon from the current angles and speeds; call it
        before every physics step.
        """
        if not self._tendon_drives:
            return
        q = self.articulation.qpos
        qvel = self.articulation.qvel
        for drive in self._tendon_drives:
            servo = drive.servo
            length_of_others = drive.coefficients @ q[drive.others]
            speed_of_others = drive.coefficients @ qvel[drive.others]
            angle = (self._target[servo.actuator] - length_of_others) / servo.coefficient
            speed = -speed_of_others / servo.coefficient
            drive.joint.set_drive_target(angle)
            drive.joint.set_drive_velocity_target(drive.damping_share * speed)

    def read(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Writes the joints' positions and velocities into qpos (nq,) and qvel (nv,)."""
        units = self._units[self._order]
        qpos[self._model.jnt_qposadr[self._order]] = self.articulation.qpos / units
        qvel[self._model.jnt_dofadr[self._order]] = self.articulation.qvel / units

    def _base(self) -> Any:
        """Returns the fixed root."""
        root = self._add_link(None)
        root.joint.type = "fixed"
        set_inertia(root, 1.0, np.full(3, 1e-3), sapien.Pose())
        return root

    def _add_link(self, parent: Any) -> Any:
        """Adds a link without shapes."""
        link = px.PhysxArticulationLinkComponent(parent)
        entity = sapien.Entity()
        entity.add_component(link)
        self._entities.append(entity)
        link.linear_damping = 0.0
        link.angular_damping = 0.0
        link.max_angular_velocity = MAX_SPEED
        link.max_linear_velocity = LENGTH_SCALE * MAX_SPEED
        link.disable_gravity = True
        return link

    def _add_body(self, body: int) -> Any:
        """Adds the links of a body; returns the last link, which has the body's shapes and mass."""
        model = self._model
        link = self.bodies[model.body_parentid[body]]
        pose_in_parent = scaled_pose(model.body_pos[body], model.body_quat[body])
        first = model.body_jntadr[body]
        joints = range(first, first + model.body_jntnum[body])
        for joint in joints:
            link = self._add_link(link)
            self._set_joint(link, joint, pose_in_parent)
            set_inertia(link, _CONNECTOR_MASS, np.full(3, _CONNECTOR_INERTIA), sapien.Pose())
            pose_in_parent = sapien.Pose()
        if not joints:
            link = self._add_link(link)
            link.joint.type = "fixed"
            link.joint.set_pose_in_parent(pose_in_parent)
        self._add_shapes(link, body)
        link.disable_gravity = model.body_gravcomp[body] == 1.0
        return link

    def _set_joint(self, link: Any, joint: int, pose_in_parent: Any) -> None:
        """Sets the joint between a link and its parent to a joint of the model.

        Args:
          link: the child link.
          joint: index of the joint.
          pose_in_parent: pose of the child's frame in the parent's at zero.
        """
        model = self._model
        is_slide = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        link.joint.type = "prismatic" if is_slide else "revolute_unwrapped"
        frame = scaled_pose(model.jnt_pos[joint], _from_x_to(model.jnt_axis[joint]))
        link.joint.set_pose_in_parent(pose_in_parent * frame)
        link.joint.set_pose_in_child(frame)
        limits = np.array([[-np.inf, np.inf]], np.float32)
        if model.jnt_limited[joint]:
            limits[0] = self._units[joint] * model.jnt_range[joint]
        link.joint.set_limits(limits)
        dof = model.jnt_dofadr[joint]
        armature = self._gain_units[joint] * model.dof_armature[[dof]]
        link.joint.set_armature(armature.astype(np.float32))
        link.joint.friction = 0.0
        link.joint.max_velocity = self._units[joint] * MAX_SPEED
        self._joints[joint] = link.joint

    def _add_shapes(self, link: Any, body: int) -> None:
        """Adds a body's shapes to its link, and sets its mass."""
        model = self._model
        for geom in np.flatnonzero(model.geom_bodyid == body).tolist():
            shape = geom_shape(model, geom, self._surface)
            own_bit = self._collisions.own_bit[body]
            shape.set_collision_groups([own_bit, self._collisions.others[body], 0, 0])
            link.attach(shape)
        centre = scaled_pose(model.body_ipos[body], model.body_iquat[body])
        set_inertia(link, model.body_mass[body], model.body_inertia[body], centre)

    def _add_servos(self, gains: np.ndarray) -> None:
        """Sets the drives of all joints; `gains` (nu,) are factors on the actuators' gains."""
        model = self._model
        servos = servos_of(model)
        self._drives: list[_Drive] = []
        for j, joint in self._joints.items():
            damping = float(model.dof_damping[model.jnt_dofadr[j]])
            servo = servos.get(j)
            gain_unit = self._gain_units[j]
            if servo is None:
                joint.set_drive_property(0.0, gain_unit * damping)
                continue
            scale = servo.coefficient**2 * float(gains[servo.actuator])
            stiffness = scale * servo.kp
            # PhysX applies the spring at the end of the step, MuJoCo at its beginning: without this
            # difference the servo would be damped more.
            kv = scale * servo.kv - model.opt.timestep * stiffness
            limit = abs(servo.coefficient) * servo.limit
            joint.set_drive_property(
                gain_unit * stiffness,
                gain_unit * max(kv + damping, 0.0),
                gain_unit * self._units[j] * limit,
            )
            others = []
            for other, pulled in servos.items():
                if other != j and pulled.actuator == servo.actuator:
                    others.append(other)
            drive = _Drive(
                joint,
                servo,
                unit=self._units[j],
                damping_share=max(kv, 0.0) / max(kv + damping, 1e-12),
                others=np.array([self._addresses[other] for other in others], int),
                coefficients=np.array([servos[other].coefficient for other in others]),
            )
            self._drives.append(drive)
        self._tendon_drives = [drive for drive in self._drives if len(drive.others)]

    def _couple(self, coupling: Coupling) -> None:
        """Makes a joint follow its neighbour by a stiff tendon of PhysX.

        The tendon lists the link that carries its first joint, then the links that its joints move.
        """
        leader = self._joints[coupling.leader].child_link
        follower = self._joints[coupling.follower].child_link
        coefficients = {leader: -coupling.ratio, follower: 1.0}
        moved = [leader, follower]
        if leader.parent is follower:
            moved = [follower, leader]
        chain = [moved[0].parent, *moved]
        weights = [0.0, *(coefficients[link] for link in moved)]
        self.articulation.create_fixed_tendon(
            chain,
            weights,
            weights,
            rest_length=coupling.offset,
            stiffness=INERTIA_SCALE * _COUPLING_STIFFNESS,
        )


def set_inertia(body: Any, mass: float, principal: np.ndarray, centre: Any) -> None:
    """Sets a body's mass (kg), principal moments of inertia (3,) in kg.m^2, and the pose of their
    axes in the body. Attaching a shape changes all of them: call it afterwards.
    """
    body.set_mass(float(mass))
    body.set_inertia((INERTIA_SCALE * np.asarray(principal)).astype(np.float32))
    body.set_cmass_local_pose(centre)


def _from_x_to(axis: np.ndarray) -> np.ndarray:
    """Quaternion (4,) of a rotation from x, PhysX's joint axis, to an axis (3,)."""
    x, y, z = axis / np.linalg.norm(axis)
    if x < -1 + 1e-6:
        return np.array([0.0, 0.0, 0.0, 1.0])
    quaternion = np.array([1 + x, 0.0, -z, y])
    return quaternion / np.linalg.norm(quaternion)
