"""Kernels of our own beside MuJoCo Warp's: what fills the worlds, and what counts how full their buffers are."""

# mypy: ignore-errors
# (Kernels are a language of their own in Python's syntax, which Warp's compiler checks.)

import warp as wp


@wp.struct
class Objects:
    """Rows of a catalogue; see `actors.physics.catalogue.Catalogue.rows`."""

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
    """Fields of model and data that differ between worlds (B, ...), and where the object is in them."""

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
    geoms: wp.array[int]
    object_body: int
    object_dof: int
    base_body: int
    table: int
    anchor: int
    weld: int
    table_away: float


OBJECT_FIELDS = {name: field.type.dtype for name, field in Objects.vars.items()}
"""Fields of `Objects` and the types of their elements."""
MODEL_LEAVES = [name for name in Leaves.vars if name.startswith(("geom_", "body_", "dof_"))]
DATA_LEAVES = [name for name in Leaves.vars if name.startswith(("mocap_", "eq_"))]


@wp.kernel
def place(
    table: wp.array[bool],
    row: wp.array[int],
    mass_scale: wp.array[float],
    friction: wp.array[float],
    base_position: wp.array[wp.vec3],
    base_quaternion: wp.array[wp.quat],
    anchor_position: wp.array[wp.vec3],
    anchor_quaternion: wp.array[wp.quat],
    stationary: wp.array[bool],
    objects: Objects,
    leaves: Leaves,
    occupancy: wp.array[int],
) -> None:
    """Fills a world's leaves from its object's row; one thread for each world and slot."""
    world, slot = wp.tid()
    r = row[world]
    geom = leaves.geoms[slot]
    leaves.geom_size[world, geom] = objects.geom_size[r, slot]
    leaves.geom_pos[world, geom] = objects.geom_pos[r, slot]
    leaves.geom_quat[world, geom] = objects.geom_quat[r, slot]
    leaves.geom_rbound[world, geom] = objects.geom_rbound[r, slot]
    leaves.geom_aabb[world, geom, 0] = objects.geom_aabb[r, slot, 0]
    leaves.geom_aabb[world, geom, 1] = objects.geom_aabb[r, slot, 1]
    leaves.geom_dataid[world, geom] = objects.geom_dataid[r, slot]
    shared = leaves.geom_friction[world, geom]
    leaves.geom_friction[world, geom] = wp.vec3(friction[world], shared[1], shared[2])
    if slot > 0:
        return
    body = leaves.object_body
    leaves.body_mass[world, body] = mass_scale[world] * objects.body_mass[r]
    leaves.body_inertia[world, body] = mass_scale[world] * objects.body_inertia[r]
    leaves.body_iquat[world, body] = objects.body_iquat[r]
    leaves.body_subtreemass[world, 0] = objects.body_subtreemass[r, 0]
    leaves.body_subtreemass[world, body] = objects.body_subtreemass[r, 1]
    leaves.body_invweight0[world, body] = objects.body_invweight0[r]
    for i in range(6):
        leaves.dof_invweight0[world, leaves.object_dof + i] = objects.dof_invweight0[r, i]
    leaves.body_pos[world, leaves.base_body] = base_position[world]
    leaves.body_quat[world, leaves.base_body] = base_quaternion[world]
    leaves.mocap_pos[world, leaves.anchor] = anchor_position[world]
    leaves.mocap_quat[world, leaves.anchor] = anchor_quaternion[world]
    leaves.mocap_pos[world, leaves.table] = wp.vec3(0.0, 0.0, wp.where(table[world], 0.0, leaves.table_away))
    leaves.eq_active[world, leaves.weld] = stationary[world]
    if world == 0:
        occupancy[0] = 0
        occupancy[1] = 0


@wp.kernel
def count(ncollision: wp.array[int], nacon: wp.array[int], nefc: wp.array[int], occupancy: wp.array[int]) -> None:
    """Keeps the most contacts of all worlds together, and the most constraint rows of any; also what had no room."""
    world = wp.tid()
    wp.atomic_max(occupancy, 1, nefc[world])
    if world == 0:
        wp.atomic_max(occupancy, 0, wp.max(ncollision[0], nacon[0]))
