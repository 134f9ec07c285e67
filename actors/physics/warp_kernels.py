"""Additional kernels for MuJoCo Warp: they fill the environments and measure the occupancy of their
buffers.
"""

# mypy: ignore-errors
# (Kernels are a language with Python's syntax, checked by Warp's compiler.)

import warp as wp
from mujoco.mjx.third_party.mujoco_warp._src.types import vec10f


@wp.struct
class Objects:
    """Rows of objects; see `actors.physics.object_rows.ObjectRows.rows`."""

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
class Leaves:
    """Fields of model and data that differ between environments (B, ...), and addresses of the
    object in them.
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
    geoms: wp.array[int]
    motors: wp.array[int]
    gains: wp.array[wp.vec3]
    object_body: int
    object_dof: int
    base_body: int
    table: int
    anchor: int
    weld: int
    table_away: float


OBJECT_FIELDS = {name: field.type.dtype for name, field in Objects.vars.items()}
"""Fields of `Objects` and their element types."""
MODEL_LEAVES = [
    name for name in Leaves.vars if name.startswith(("geom_", "body_", "dof_", "actuator_"))
]
DATA_LEAVES = [name for name in Leaves.vars if name.startswith(("mocap_", "eq_", "xfrc_"))]


@wp.func
def scale_gains(leaves: Leaves, env: int, scale: float) -> None:
    """Scales the gains of an environment's servos."""
    for i in range(leaves.motors.shape[0]):
        motor = leaves.motors[i]
        gains = scale * leaves.gains[i]
        gain = leaves.actuator_gainprm[env, motor]
        bias = leaves.actuator_biasprm[env, motor]
        gain[0] = gains[0]
        bias[1] = gains[1]
        bias[2] = gains[2]
        leaves.actuator_gainprm[env, motor] = gain
        leaves.actuator_biasprm[env, motor] = bias


@wp.kernel
def place(  # noqa: PLR0913
    table: wp.array[bool],
    force: wp.array[wp.vec3],
    row: wp.array[int],
    mass_scale: wp.array[float],
    friction: wp.array[float],
    gain_scale: wp.array[float],
    base_position: wp.array[wp.vec3],
    base_quaternion: wp.array[wp.quat],
    anchor_position: wp.array[wp.vec3],
    anchor_quaternion: wp.array[wp.quat],
    stationary: wp.array[bool],
    objects: Objects,
    leaves: Leaves,
    occupancy: wp.array[int],
) -> None:
    """Fills an environment's leaves from its object's row; one thread for each environment and
    slot.
    """
    env, slot = wp.tid()
    r = row[env]
    geom = leaves.geoms[slot]
    leaves.geom_size[env, geom] = objects.geom_size[r, slot]
    leaves.geom_pos[env, geom] = objects.geom_pos[r, slot]
    leaves.geom_quat[env, geom] = objects.geom_quat[r, slot]
    leaves.geom_rbound[env, geom] = objects.geom_rbound[r, slot]
    leaves.geom_aabb[env, geom, 0] = objects.geom_aabb[r, slot, 0]
    leaves.geom_aabb[env, geom, 1] = objects.geom_aabb[r, slot, 1]
    leaves.geom_dataid[env, geom] = objects.geom_dataid[r, slot]
    shared = leaves.geom_friction[env, geom]
    leaves.geom_friction[env, geom] = wp.vec3(friction[env], shared[1], shared[2])
    if slot > 0:
        return
    body = leaves.object_body
    scale = mass_scale[env]
    leaves.body_mass[env, body] = scale * objects.body_mass[r]
    leaves.body_inertia[env, body] = scale * objects.body_inertia[r]
    leaves.body_iquat[env, body] = objects.body_iquat[r]
    leaves.body_subtreemass[env, 0] = objects.body_subtreemass[r, 0]
    leaves.body_subtreemass[env, body] = scale * objects.body_subtreemass[r, 1]
    leaves.body_invweight0[env, body] = objects.body_invweight0[r] / scale
    for i in range(6):
        leaves.dof_invweight0[env, leaves.object_dof + i] = objects.dof_invweight0[r, i] / scale
    scale_gains(leaves, env, gain_scale[env])
    leaves.body_pos[env, leaves.base_body] = base_position[env]
    leaves.body_quat[env, leaves.base_body] = base_quaternion[env]
    leaves.mocap_pos[env, leaves.anchor] = anchor_position[env]
    leaves.mocap_quat[env, leaves.anchor] = anchor_quaternion[env]
    leaves.mocap_pos[env, leaves.table] = wp.vec3(
        0.0, 0.0, wp.where(table[env], 0.0, leaves.table_away)
    )
    leaves.eq_active[env, leaves.weld] = stationary[env]
    leaves.xfrc_applied[env, body] = wp.spatial_vector(force[env], wp.vec3(0.0, 0.0, 0.0))
    if env == 0:
        occupancy[0] = 0
        occupancy[1] = 0
        occupancy[2] = 0


@wp.kernel
def count(
    ncollision: wp.array[int],
    nacon: wp.array[int],
    nefc: wp.array[int],
    solver_niter: wp.array[int],
    iterations: int,
    occupancy: wp.array[int],
) -> None:
    """Records the most contacts of all environments and the most constraint rows of any, including
    dropped ones.

    Also counts environments whose solver reached its limit of iterations.
    """
    env = wp.tid()
    wp.atomic_max(occupancy, 1, nefc[env])
    if solver_niter[env] >= iterations:
        wp.atomic_add(occupancy, 2, 1)
    if env == 0:
        wp.atomic_max(occupancy, 0, wp.max(ncollision[0], nacon[0]))
