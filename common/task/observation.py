"""Observation: state and constraint features relative to the hand (paper, section Observation
Space).

The vector consists of blocks: `state`, further blocks of the sensor, those of the constraints and
`mask`. A block consists of fields. Differences have these signs: targets minus joints; earlier
joints and positions minus current ones; rotations from the earlier orientation to the current one.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp

from congrasp.common import rotations
from congrasp.common.hands.spec import Hand
from congrasp.common.task.constraints import Constraint, known
from congrasp.common.task.constraints import blocks as gated_blocks
from congrasp.common.task.constraints.specs import ObservationField
from congrasp.common.task.geometry import flat, squash
from congrasp.common.task.readings import Readings
from congrasp.common.task.scene import Scene
from congrasp.common.task.sensors import get_sensor
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array


class _Quantity(NamedTuple):
    """A field of the block `state`, and its computation."""

    field: ObservationField
    values: Callable[[Scene], Array]
    """Computes the values (B, ...)."""
    needs_pose: bool = False
    """True if it needs the object's pose, which some sensors do not show (`Sensor.shows_pose`)."""


def layout(hand: Hand, task: TaskSettings) -> tuple[tuple[str, int], ...]:
    """Names and sizes of the observation's blocks, in order."""
    sizes = []
    for block, fields_of_block in fields(hand, task).items():
        sizes.append((block, sum(field.size for field in fields_of_block)))
    return tuple(sizes)


def fields(hand: Hand, task: TaskSettings) -> dict[str, tuple[ObservationField, ...]]:
    """Fields of every block, in order, restricted to those that the task's policy observes."""
    state = _observed_quantities(hand, task)
    by_block = {"state": tuple(quantity.field for quantity in state)}
    for block, sensor_fields in get_sensor(task).fields(hand, task).items():
        by_block[block] = by_block.get(block, ()) + sensor_fields
    for constraint in known(task):
        names = constraint.blocks or (constraint.name,)
        for block, all_fields in zip(names, constraint.fields(hand, task), strict=True):
            by_block[block] = tuple(field for field in all_fields if _is_observed(task, field))
    by_block["mask"] = (_mask_field(task),)
    return by_block


def observe(scene: Scene) -> Array:
    """Observation (B, D), laid out like `fields`; blocks of inactive constraints are zero."""
    task = scene.task
    sensor = get_sensor(task)
    state = _observed_quantities(scene.hand, task)
    by_block = {"state": [quantity.values(scene) for quantity in state]}
    sensor_values = sensor.observe(scene)
    for block in sensor.fields(scene.hand, task):  # in the order of `fields`
        by_block.setdefault(block, []).extend(sensor_values[block])
    values = list[Array]()
    for values_of_block in by_block.values():
        values += values_of_block
    for constraint in known(task):
        values += _constraint_values(scene, constraint)
    mask = [scene.gate(block) for block in gated_blocks(task)]
    if mask:
        values.append(jnp.stack(mask, -1))
    return jnp.concatenate(values, -1)


def _observed_quantities(hand: Hand, task: TaskSettings) -> list[_Quantity]:
    """Quantities of the block `state` that the task's policy observes."""
    sensor = get_sensor(task)
    quantities = _current_quantities(hand, task)
    if not sensor.privileged:
        quantities += _past_quantities(hand, task)
    observed = []
    for quantity in quantities:
        is_shown = sensor.shows_pose or not quantity.needs_pose
        if is_shown and _is_observed(task, quantity.field):
            observed.append(quantity)
    return observed


def _is_observed(task: TaskSettings, field: ObservationField) -> bool:
    """True if a field is not privileged, or the task's policy observes privileged ones as well."""
    return get_sensor(task).privileged or not field.privileged


def _current_quantities(hand: Hand, task: TaskSettings) -> list[_Quantity]:
    """State of hand and object in the current control step."""
    joints = len(hand.joints)
    links = len(hand.links)
    keypoints = len(hand.keypoints)
    return [
        _Quantity(
            ObservationField("q", joints, "rad, finger joints in the order of 'joints'"),
            lambda scene: scene.state.q,
        ),
        _Quantity(
            ObservationField(
                "u",
                6,
                "m and rad, wrist joints in the order of 'wrist_joints', relative to the wrist's "
                "initial pose",
            ),
            lambda scene: scene.state.u,
        ),
        _Quantity(
            ObservationField(
                "q_target - q", joints, "rad, lead of the last finger targets over the joints"
            ),
            lambda scene: scene.state.q_target - scene.state.q,
        ),
        _Quantity(
            ObservationField(
                "u_target - u", 6, "m and rad, lead of the last wrist targets over the joints"
            ),
            lambda scene: scene.state.u_target - scene.state.u,
        ),
        _Quantity(
            ObservationField("q_velocity", joints, "rad/s", privileged=True),
            lambda scene: scene.state.q_velocity,
        ),
        _Quantity(
            ObservationField("u_velocity", 6, "m/s and rad/s", privileged=True),
            lambda scene: scene.state.u_velocity,
        ),
        _Quantity(
            ObservationField(
                "touching",
                links,
                "1 if a link, in the order of 'links', touches the object, else 0",
                privileged=True,
            ),
            lambda scene: scene.features.touching.astype(jnp.float32),
        ),
        _Quantity(
            # `force_scale` is an entry of an exported policy's description, too.
            ObservationField(
                "force",
                3 * links,
                "f / (|f| + force_scale) for the object's net force f on each link, N, wrist frame",
                privileged=True,
            ),
            lambda scene: flat(squash(scene.features.force)),
        ),
        _Quantity(
            ObservationField(
                "nearest",
                3 * keypoints,
                "m, from each keypoint to the nearest surface point, wrist frame",
            ),
            lambda scene: flat(scene.features.nearest),
        ),
        *_normal_quantities(hand, task),
        _Quantity(
            ObservationField(
                "object_velocity", 3, "m/s of the centre of mass, wrist frame", privileged=True
            ),
            lambda scene: rotations.rotate(_to_wrist(scene), scene.state.object_velocity),
        ),
        _Quantity(
            ObservationField("object_angular_velocity", 3, "rad/s, wrist frame", privileged=True),
            lambda scene: rotations.rotate(_to_wrist(scene), scene.state.object_angular_velocity),
        ),
        _Quantity(
            ObservationField("object_displacement", 3, "m since the start, wrist frame"),
            _displacement,
            needs_pose=True,
        ),
        _Quantity(
            ObservationField(
                "object_rotation",
                3,
                "twice the vector part of the rotation since the start (w >= 0), wrist frame",
            ),
            _rotation_since_start,
            needs_pose=True,
        ),
        _Quantity(
            # At most 1: after the planned end of the hold, the policy cannot know how long it must
            # still hold, and thus has to hold indefinitely.
            ObservationField(
                "time",
                1,
                "control steps over (approach_steps + hold_steps), at most 1; the remaining hold "
                "is hidden",
            ),
            _time,
        ),
        _Quantity(
            ObservationField("table", 1, "1 while the table is present"),
            lambda scene: scene.state.table.astype(jnp.float32)[:, None],
        ),
    ]


def _normal_quantities(hand: Hand, task: TaskSettings) -> list[_Quantity]:
    """Quantities that `TaskSettings.surface_normals` adds."""
    if not task.surface_normals:
        return []
    keypoints = len(hand.keypoints)
    return [
        _Quantity(
            ObservationField(
                "normal",
                3 * keypoints,
                "outward unit normal at each of these surface points, wrist frame",
            ),
            _normals,
        ),
        _Quantity(
            ObservationField(
                "height",
                keypoints,
                "m, signed height of each keypoint above the tangent plane at its surface point",
            ),
            _heights,
        ),
    ]


def _past_quantities(hand: Hand, task: TaskSettings) -> list[_Quantity]:
    """State of earlier control steps, which a robot's policy observes."""
    joints = len(hand.joints)
    past = task.history - 1
    order = f"for each of the last {past} control steps, newest first"
    return [
        _Quantity(
            ObservationField(
                "past q - q", past * joints, f"rad, {order}, minus the current angles"
            ),
            lambda scene: flat(_past(scene).q - _now(scene).q),
        ),
        _Quantity(
            ObservationField(
                "past u - u", past * 6, f"m and rad, {order}, minus the current wrist joints"
            ),
            lambda scene: flat(_past(scene).u - _now(scene).u),
        ),
        _Quantity(
            ObservationField("past q_target - past q", past * joints, f"rad, {order}"),
            lambda scene: flat(_past(scene).q_target - _past(scene).q),
        ),
        _Quantity(
            ObservationField("past u_target - past u", past * 6, f"m and rad, {order}"),
            lambda scene: flat(_past(scene).u_target - _past(scene).u),
        ),
        _Quantity(
            ObservationField(
                "past object_position",
                past * 3,
                f"m, {order}, minus the current one, current wrist frame",
            ),
            _past_positions,
            needs_pose=True,
        ),
        _Quantity(
            ObservationField(
                "past object_rotation",
                past * 3,
                f"{order}: twice the vector part of the rotation since then (w >= 0), current "
                f"wrist frame",
            ),
            _past_rotations,
            needs_pose=True,
        ),
    ]


def _to_wrist(scene: Scene) -> Array:
    """Rotations (B, 4) from the frame of the scene's state to the wrist frame."""
    return rotations.conjugate(scene.features.wrist_quaternion)


def _displacement(scene: Scene) -> Array:
    """Displacement (B, 3) of the object since the start, m, wrist frame."""
    displacement = scene.state.object_position - scene.state.object_position_initial
    return rotations.rotate(_to_wrist(scene), displacement)


def _rotation_since_start(scene: Scene) -> Array:
    """Rotation (B, 3) of the object since the start, see `_rotation`, wrist frame."""
    state = scene.state
    rotation = _rotation(state.object_quaternion_initial, state.object_quaternion)
    return rotations.rotate(_to_wrist(scene), rotation)


def _time(scene: Scene) -> Array:
    """Share (B, 1) of the control steps of approach and hold that have passed, at most 1."""
    horizon = scene.task.approach_steps + scene.task.hold_steps
    return jnp.minimum(scene.state.time / horizon, 1.0)[:, None]


def _normals(scene: Scene) -> Array:
    """Normals (B, 3 P) at the nearest surface points of P keypoints, wrist frame."""
    assert scene.features.normal is not None, "the surface has no normals"
    return flat(scene.features.normal)


def _heights(scene: Scene) -> Array:
    """Heights (B, P) in m of P keypoints above the tangent planes."""
    assert scene.features.height is not None, "heights need the surface's normals"
    return scene.features.height


def _readings(scene: Scene) -> Readings:
    """Readings (B, history, ...) of the last control steps, newest first."""
    assert scene.readings is not None, "a robot's observation needs readings"
    return scene.readings


def _now(scene: Scene) -> Readings:
    """Readings (B, 1, ...) of the current control step."""
    return Readings(*[field[:, :1] for field in _readings(scene)])


def _past(scene: Scene) -> Readings:
    """Readings (B, history - 1, ...) of the earlier control steps, newest first."""
    return Readings(*[field[:, 1:] for field in _readings(scene)])


def _past_positions(scene: Scene) -> Array:
    """Earlier positions (B, (history - 1) 3) of the object minus the current one, m, current wrist
    frame.
    """
    displacement = _past(scene).object_position - _now(scene).object_position
    return flat(rotations.rotate(_to_wrist(scene)[:, None], displacement))


def _past_rotations(scene: Scene) -> Array:
    """Rotations (B, (history - 1) 3) of the object since earlier control steps, see `_rotation`,
    current wrist frame.
    """
    rotation = _rotation(_past(scene).object_quaternion, _now(scene).object_quaternion)
    return flat(rotations.rotate(_to_wrist(scene)[:, None], rotation))


def _constraint_values(scene: Scene, constraint: Constraint) -> list[Array]:
    """Values (B, ...) of the fields of a constraint, zero where it is inactive."""
    observed = []
    for values_of_block, fields_of_block in zip(
        constraint.observe(scene), constraint.fields(scene.hand, scene.task), strict=True
    ):
        observed.append(_observed_values(scene.task, values_of_block, fields_of_block))
    if not constraint.optional:
        (values,) = observed
        return values
    gated = []
    for block, values in zip(constraint.blocks, observed, strict=True):
        if not values:  # all fields of the block are privileged
            continue
        active = scene.goal.active[block][:, None]
        gated.append(jnp.where(active, jnp.concatenate(values, -1), 0.0))
    return gated


def _observed_values(
    task: TaskSettings, values: Sequence[Array], fields_of_block: Sequence[ObservationField]
) -> list[Array]:
    """Selects the values (B, ...) of fields that are part of the task's observation."""
    pairs = zip(values, fields_of_block, strict=True)
    return [value for value, field in pairs if _is_observed(task, field)]


def _mask_field(task: TaskSettings) -> ObservationField:
    """Field of the flags of active constraints."""
    return ObservationField(
        "mask",
        len(gated_blocks(task)),
        "1 for each active constraint in the order of 'masks'; the block of an inactive one is "
        "zero",
    )


def _rotation(start: Array, end: Array) -> Array:
    """Twice the vector part (..., 3) of the rotation from one quaternion to another, with positive
    w.
    """
    turned = rotations.multiply(end, rotations.conjugate(start))
    return 2.0 * turned[..., 1:] * jnp.where(turned[..., :1] < 0, -1.0, 1.0)
