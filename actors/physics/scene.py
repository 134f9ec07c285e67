"""MuJoCo model of one scene: hand, object, table, the anchor of a stationary object, contact
sensors.
"""

import dataclasses
import functools

import numpy as np

from congrasp.common.hands.mjcf import HAND_CONTYPE, WRIST_JOINTS, add_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.mjcf import CONTACT, ContactSettings, add_object
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.physics_library import mujoco
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.types import CONTACTS_PER_LINK

OBJECT_CONTYPE = 2
"""Collision bit of the object, which the table collides with."""
TABLE_AWAY = (0.0, 0.0, -1000.0)
"""Position of a removed table: a kilometre down, out of reach."""
GAINS = ("actuator_gainprm", "actuator_biasprm")
"""Fields of a model that hold only a position servo's gains and zeros."""
MASS_POWERS = {
    "body_mass": 1,
    "body_inertia": 1,
    "body_subtreemass": 1,
    "body_invweight0": -1,
    "dof_invweight0": -1,
}
"""Fields of a model that scale with a power of a body's mass, in the rows of the body or of its
free joint.
"""
SENSOR_WIDTH = 13
"""Numbers of one contact: found, force (3, contact frame), position (3), normal (3), tangent
(3).
"""
_CONTACT_FIELDS = (
    mujoco.mjtConDataField.mjCONDATA_FOUND,
    mujoco.mjtConDataField.mjCONDATA_FORCE,
    mujoco.mjtConDataField.mjCONDATA_POS,
    mujoco.mjtConDataField.mjCONDATA_NORMAL,
    mujoco.mjtConDataField.mjCONDATA_TANGENT,
)
_STRONGEST = 2  # reduce="maxforce"


@dataclasses.dataclass(frozen=True, eq=False)
class Addresses:
    """Addresses in a compiled scene that the task reads and writes; scenes with equal ones share
    compiled programs.
    """

    wrist_qpos: np.ndarray
    finger_qpos: np.ndarray
    object_qpos: np.ndarray
    wrist_qvel: np.ndarray
    finger_qvel: np.ndarray
    object_qvel: np.ndarray
    base_body: int
    object_body: int
    table_mocap: int
    anchor_mocap: int
    weld: int
    motors: np.ndarray
    """Actuators of the fingers; servo torque: gainprm[0] * target + biasprm[1] * angle + biasprm[2]
    * speed.
    """

    @functools.cached_property
    def _key(self) -> tuple[tuple[int, ...], ...]:
        """All addresses, in order."""
        key = []
        for field in dataclasses.fields(self):
            key.append(tuple(np.ravel(getattr(self, field.name)).tolist()))
        return tuple(key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Addresses) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


def scene_spec(hand: Hand, task: TaskConfig) -> mujoco.MjSpec:
    """Returns hand, table, anchor and options, without an object."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = task.control_dt / task.substeps
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # Held objects creep out of every grasp within seconds with pyramidal friction cones. With
    # elliptic ones they do too unless friction is much stiffer than normal forces and the solver
    # converges: with an impratio of 100 eight iterations are too few (docs/notes/training.md).
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = task.impratio
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    spec.option.iterations = 24
    spec.option.ls_iterations = 40
    # A hundredth of a millimetre: in single precision the default of a micrometre is hardly ever
    # reached.
    spec.option.ccd_tolerance = 1e-5
    spec.option.ccd_iterations = 16
    add_hand(
        spec,
        hand,
        self_collision=task.hand_self_collision,
        contact_time=task.contact_time,
        torsional_friction=task.torsional_friction,
    )
    _add_table(spec, task)
    spec.worldbody.add_body(name="anchor", mocap=True)
    return spec


def _add_table(spec: mujoco.MjSpec, task: TaskConfig) -> None:
    """Adds the table, which objects and, depending on the task, hands collide with."""
    collides_with = OBJECT_CONTYPE
    if task.hand_table_collision:
        collides_with |= HAND_CONTYPE
    table = spec.worldbody.add_body(name="table", mocap=True)
    table.add_geom(
        name="table",
        # MJX-JAX supports collisions of a cylinder with a plane, but not with a box
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(0.6, 0.6, 0.05),
        contype=0,
        conaffinity=collides_with,
        condim=CONTACT.condim,
        friction=CONTACT.friction,
        solref=CONTACT.solref,
    )


def object_contact(task: TaskConfig) -> ContactSettings:
    """Contact settings for the task's objects."""
    return dataclasses.replace(CONTACT, free_damping=task.object_damping)


def finish_spec(spec: mujoco.MjSpec, hand: Hand) -> None:
    """Adds the weld of the stationary phase and the contact sensors to a spec that contains the
    object.
    """
    spec.add_equality(
        name="hold",
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1="anchor",
        name2="object",
        active=False,
        data=[0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1, 0],  # anchor, relative pose, torque scale
        solref=(0.005, 1.0),
    )
    fields = sum(1 << int(field) for field in _CONTACT_FIELDS)
    for link in hand.links:
        spec.add_sensor(
            name=f"contact_{link.name}",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            objname=link.name,
            reftype=mujoco.mjtObj.mjOBJ_BODY,
            refname="object",
            intprm=[fields, _STRONGEST, CONTACTS_PER_LINK],
        )


def compile_scene(hand: Hand, task: TaskConfig, obj: GraspObject) -> mujoco.MjModel:
    """Compiles the scene with one object, for `native`."""
    spec = scene_spec(hand, task)
    add_object(
        spec, obj, contype=OBJECT_CONTYPE, conaffinity=HAND_CONTYPE, contact=object_contact(task)
    )
    finish_spec(spec, hand)
    return spec.compile()


def addresses(model: mujoco.MjModel, hand: Hand) -> Addresses:
    """Returns the addresses, in the order of u, q and the object's free joint."""

    def joint(name: str) -> tuple[int, int]:
        index = model.joint(name).id
        return model.jnt_qposadr[index], model.jnt_dofadr[index]

    wrist = np.array([joint(name) for name in WRIST_JOINTS])
    fingers = np.array([joint(j.name) for j in hand.joints])
    body = model.body("object")
    qpos = model.jnt_qposadr[body.jntadr[0]]
    qvel = model.jnt_dofadr[body.jntadr[0]]
    return Addresses(
        wrist_qpos=wrist[:, 0],
        finger_qpos=fingers[:, 0],
        object_qpos=np.arange(qpos, qpos + 7),
        wrist_qvel=wrist[:, 1],
        finger_qvel=fingers[:, 1],
        object_qvel=np.arange(qvel, qvel + 6),
        base_body=model.body("hand_base").id,
        object_body=body.id,
        table_mocap=int(model.body("table").mocapid[0]),
        anchor_mocap=int(model.body("anchor").mocapid[0]),
        weld=model.equality("hold").id,
        motors=np.array([model.actuator(motor.name).id for motor in hand.motors]),
    )
