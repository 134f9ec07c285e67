"""Additional kernels for MuJoCo Warp: they set the object and the controls of each environment, and
measure the occupancy of the engine's buffers.

B is the number of environments, N that of object rows and S that of slots for an object's pieces.
"""

# mypy: ignore-errors
# (Kernels are a language with Python's syntax, checked by Warp's compiler.)

import warp as wp
from mujoco.mjx.third_party.mujoco_warp._src.types import vec10f

CONTACTS = wp.constant(0)
"""Entry of the occupancy with the largest number of contacts of all environments together, which
share one buffer."""
CONSTRAINT_ROWS = wp.constant(1)
"""Entry with the largest number of constraint rows of one environment."""
LIMITED_STEPS = wp.constant(2)
"""Entry with the number of physics steps, each of one environment, whose solver reached its limit
of iterations."""


@wp.struct
class ObjectFields:
    """Fields of N objects (N, ...); see `actors.physics.object_rows.ObjectRows.rows`."""

    geom_size: wp.array2d[wp.vec3]
    geom_pos: wp.array2d[wp.vec3]
    geom_quat: wp.array2d[wp.quat]
    geom_rbound: wp.array2d[float]
    geom_aabb: wp.array3d[wp.vec3]
    geom_dataid: wp.array2d[int]
    body_mass: wp.array[float]
    body_inertia: wp.array[wp.vec3]
    body_iquat: wp.array[wp.quat]
    body_subtreemass: wp.array2d[float]
    body_invweight0: wp.array[wp.vec2]
    dof_invweight0: wp.array2d[float]


@wp.struct
class EnvironmentFields:
    """Fields of MuJoCo's model and data that differ between environments (B, ...), and the indices
    of what is set in them.
    """

    geom_size: wp.array2d[wp.vec3]
    geom_pos: wp.array2d[wp.vec3]
    geom_quat: wp.array2d[wp.quat]
    geom_rbound: wp.array2d[float]
    geom_aabb: wp.array3d[wp.vec3]
    geom_dataid: wp.array2d[int]
    geom_friction: wp.array2d[wp.vec3]
    body_mass: wp.array2d[float]
    body_inertia: wp.array2d[wp.vec3]
    body_iquat: wp.array2d[wp.quat]
    body_subtreemass: wp.array2d[float]
    body_invweight0: wp.array2d[wp.vec2]
    body_pos: wp.array2d[wp.vec3]
    body_quat: wp.array2d[wp.quat]
    dof_invweight0: wp.array2d[float]
    mocap_pos: wp.array2d[wp.vec3]
    mocap_quat: wp.array2d[wp.quat]
    eq_active: wp.array2d[bool]
    xfrc_applied: wp.array2d[wp.spatial_vector]
    actuator_gainprm: wp.array2d[vec10f]
    actuator_biasprm: wp.array2d[vec10f]
    # (S,) geom of each slot of the object.
    slot_geoms: wp.array[int]
    # (M,) actuators of the fingers' servos.
    motors: wp.array[int]
    # (M,) their nominal gains kp, -kp, -kv.
    nominal_gains: wp.array[wp.vec3]
    # Body of the object, and the first of its six degrees of freedom.
    object_body: int
    object_dof: int
    # Body to which the wrist's joints are attached.
    base_body: int
    # Mocap bodies of the table, and of the anchor to which an object may be fixed.
    table_mocap: int
    anchor_mocap: int
    # Equality constraint between object and anchor.
    anchor_weld: int
    # Height z of the table in the world frame while it is absent, m.
    absent_table_height: float


OBJECT_FIELDS = {name: field.type.dtype for name, field in ObjectFields.vars.items()}
"""Fields of `ObjectFields` and their element types."""
MODEL_FIELDS = (
    "geom_size",
    "geom_pos",
    "geom_quat",
    "geom_rbound",
    "geom_aabb",
    "geom_dataid",
    "geom_friction",
    "body_mass",
    "body_inertia",
    "body_iquat",
    "body_subtreemass",
    "body_invweight0",
    "body_pos",
    "body_quat",
    "dof_invweight0",
    "actuator_gainprm",
    "actuator_biasprm",
)
"""Entries of `EnvironmentFields` that are fields of MuJoCo's model."""
DATA_FIELDS = ("mocap_pos", "mocap_quat", "eq_active", "xfrc_applied")
"""Entries of `EnvironmentFields` that are fields of MuJoCo's data."""


@wp.func
def set_gains(environments: EnvironmentFields, env: int, gain_scale: float) -> None:
    """Sets the gains of an environment's finger servos to scaled nominal ones."""
    for i in range(environments.motors.shape[0]):
        motor = environments.motors[i]
        # A position servo of MuJoCo: gainprm[0] = kp, biasprm[1] = -kp, biasprm[2] = -kv
        scaled = gain_scale * environments.nominal_gains[i]
        gain = environments.actuator_gainprm[env, motor]
        bias = environments.actuator_biasprm[env, motor]
        gain[0] = scaled[0]
        bias[1] = scaled[1]
        bias[2] = scaled[2]
        environments.actuator_gainprm[env, motor] = gain
        environments.actuator_biasprm[env, motor] = bias


@wp.kernel
def set_environments(  # noqa: PLR0913
    table_is_present: wp.array[bool],
    force: wp.array[wp.vec3],
    object_row: wp.array[int],
    mass_scale: wp.array[float],
    friction: wp.array[float],
    gain_scale: wp.array[float],
    base_position: wp.array[wp.vec3],
    base_quaternion: wp.array[wp.quat],
    anchor_position: wp.array[wp.vec3],
    anchor_quaternion: wp.array[wp.quat],
    is_stationary: wp.array[bool],
    objects: ObjectFields,
    environments: EnvironmentFields,
    occupancy: wp.array[int],
) -> None:
    """Sets what a control step needs in the fields of an environment, and the occupancy to zero;
    one thread for each environment and slot.

    `WarpBuffers.control_step` passes the first eleven arrays in the order of `warp._control_step`.

    Args:
      table_is_present: (B,).
      force: (B, 3) disturbing force at the object's centre of mass, N, world frame.
      object_row: (B,) row of the environment's object in `objects`.
      mass_scale: (B,) factor on the object's mass and inertia.
      friction: (B,) sliding friction of the object.
      gain_scale: (B,) factor on the finger servos' gains.
      base_position: (B, 3) position of the wrist's base, m, world frame.
      base_quaternion: (B, 4) its orientation.
      anchor_position: (B, 3) position of the anchor, m, world frame.
      anchor_quaternion: (B, 4) its orientation.
      is_stationary: (B,) True if the object is fixed to the anchor.
      objects: rows of the objects.
      environments: fields that are set.
      occupancy: (3,) counters; see `CONTACTS`, `CONSTRAINT_ROWS` and `LIMITED_STEPS`.
    """
    env, slot = wp.tid()
    row = object_row[env]
    geom = environments.slot_geoms[slot]
    environments.geom_size[env, geom] = objects.geom_size[row, slot]
    environments.geom_pos[env, geom] = objects.geom_pos[row, slot]
    environments.geom_quat[env, geom] = objects.geom_quat[row, slot]
    environments.geom_rbound[env, geom] = objects.geom_rbound[row, slot]
    environments.geom_aabb[env, geom, 0] = objects.geom_aabb[row, slot, 0]
    environments.geom_aabb[env, geom, 1] = objects.geom_aabb[row, slot, 1]
    environments.geom_dataid[env, geom] = objects.geom_dataid[row, slot]
    previous = environments.geom_friction[env, geom]  # torsional and rolling friction stay
    environments.geom_friction[env, geom] = wp.vec3(friction[env], previous[1], previous[2])
    if slot > 0:
        return
    body = environments.object_body
    scale = mass_scale[env]
    environments.body_mass[env, body] = scale * objects.body_mass[row]
    environments.body_inertia[env, body] = scale * objects.body_inertia[row]
    environments.body_iquat[env, body] = objects.body_iquat[row]
    # Not scaled for the world: only its centre of mass depends on it, which nothing uses, since no
    # moving body has the world as its root.
    environments.body_subtreemass[env, 0] = objects.body_subtreemass[row, 0]
    environments.body_subtreemass[env, body] = scale * objects.body_subtreemass[row, 1]
    environments.body_invweight0[env, body] = objects.body_invweight0[row] / scale
    for i in range(6):
        dof = environments.object_dof + i
        environments.dof_invweight0[env, dof] = objects.dof_invweight0[row, i] / scale
    set_gains(environments, env, gain_scale[env])
    environments.body_pos[env, environments.base_body] = base_position[env]
    environments.body_quat[env, environments.base_body] = base_quaternion[env]
    environments.mocap_pos[env, environments.anchor_mocap] = anchor_position[env]
    environments.mocap_quat[env, environments.anchor_mocap] = anchor_quaternion[env]
    environments.mocap_pos[env, environments.table_mocap] = wp.vec3(
        0.0, 0.0, wp.where(table_is_present[env], 0.0, environments.absent_table_height)
    )
    environments.eq_active[env, environments.anchor_weld] = is_stationary[env]
    environments.xfrc_applied[env, body] = wp.spatial_vector(force[env], wp.vec3(0.0, 0.0, 0.0))
    if env == 0:
        occupancy[CONTACTS] = 0
        occupancy[CONSTRAINT_ROWS] = 0
        occupancy[LIMITED_STEPS] = 0


@wp.kernel
def record_occupancy(
    ncollision: wp.array[int],
    nacon: wp.array[int],
    nefc: wp.array[int],
    solver_niter: wp.array[int],
    max_iterations: int,
    occupancy: wp.array[int],
) -> None:
    """Updates the occupancy after a physics step; one thread for each environment.

    Contacts and constraint rows that found no room in their buffers, and were dropped, count.

    Args:
      ncollision: (1,) pairs of geoms of all environments that the broadphase found.
      nacon: (1,) contacts of all environments.
      nefc: (B,) constraint rows.
      solver_niter: (B,) iterations of the solver.
      max_iterations: limit of the iterations.
      occupancy: (3,) counters since the last `set_environments`.
    """
    env = wp.tid()
    wp.atomic_max(occupancy, CONSTRAINT_ROWS, nefc[env])
    if solver_niter[env] >= max_iterations:
        wp.atomic_add(occupancy, LIMITED_STEPS, 1)
    if env == 0:
        wp.atomic_max(occupancy, CONTACTS, wp.max(ncollision[0], nacon[0]))
