"""Observation: state and constraint features relative to the hand (paper, section Observation
Space).
"""

from collections.abc import Sequence

import jax.numpy as jnp

from congrasp.common import rotations
from congrasp.common.hands.spec import Hand
from congrasp.common.task.constraints import Constraint, blocks, known
from congrasp.common.task.constraints.specs import ObservationField
from congrasp.common.task.geometry import flat, squash
from congrasp.common.task.readings import Readings
from congrasp.common.task.scene import Scene
from congrasp.common.task.sensors import get_sensor
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array

_POSE_FIELDS = (
    "object_displacement",
    "object_rotation",
    "past object_position",
    "past object_rotation",
)
"""Fields that need the object's pose, which some sensors do not show (`Sensor.shows_pose`)."""


def layout(hand: Hand, task: TaskSettings) -> tuple[tuple[str, int], ...]:
    """Names and sizes of the observation's blocks, in order: the state, those of the constraints,
    and the mask.
    """
    sizes = []
    for block, block_fields in fields(hand, task).items():
        sizes.append((block, sum(field.size for field in block_fields)))
    return tuple(sizes)


def fields(hand: Hand, task: TaskSettings) -> dict[str, tuple[ObservationField, ...]]:
    """Fields of every block, in order, restricted to those that the task's policy observes."""
    sensor = get_sensor(task)
    state = _state_fields(hand, task)
    if not sensor.privileged:
        state += _past_fields(hand, task)
    described = {"state": _observed_fields(task, state)}
    for block, block_fields in sensor.fields(hand, task).items():
        described[block] = described.get(block, ()) + block_fields
    for constraint in known(task):
        names = constraint.blocks or (constraint.name,)
        for block, block_fields in zip(names, constraint.fields(hand, task), strict=True):
            described[block] = _observed_fields(task, block_fields)
    described["mask"] = (_mask_field(task),)
    return described


def observe(scene: Scene) -> Array:
    """Observation (B, D), laid out like `fields`; blocks of inactive constraints are zero."""
    hand = scene.hand
    task = scene.task
    sensor = get_sensor(task)
    parts = _observed_values(task, _state_values(scene), _state_fields(hand, task))
    if not sensor.privileged:
        parts += _observed_values(task, _past_values(scene), _past_fields(hand, task))
    for values in sensor.observe(scene).values():
        parts += values
    for constraint in known(task):
        parts += _constraint_values(scene, constraint)
    mask = [scene.gate(block) for block in blocks(task)]
    if mask:
        parts.append(jnp.stack(mask, -1))
    return jnp.concatenate(parts, -1)


def _is_observed(task: TaskSettings, field: ObservationField) -> bool:
    """True if a field is part of the task's observation."""
    sensor = get_sensor(task)
    if field.name in _POSE_FIELDS and not sensor.shows_pose:
        return False
    return sensor.privileged or not field.privileged


def _observed_fields(
    task: TaskSettings, described: Sequence[ObservationField]
) -> tuple[ObservationField, ...]:
    """Selects the fields that are part of the task's observation."""
    return tuple(field for field in described if _is_observed(task, field))


def _observed_values(
    task: TaskSettings, values: Sequence[Array], described: Sequence[ObservationField]
) -> list[Array]:
    """Selects the values (B, ...) of fields that are part of the task's observation."""
    pairs = zip(values, described, strict=True)
    return [value for value, field in pairs if _is_observed(task, field)]


def _state_fields(hand: Hand, task: TaskSettings) -> tuple[ObservationField, ...]:
    """Fields of the state of hand and object in the current control step."""
    joints = len(hand.joints)
    links = len(hand.links)
    keypoints = len(hand.keypoints)
    return (
        ObservationField("q", joints, "rad, finger joints in the order of 'joints'"),
        ObservationField(
            "u",
            6,
            "m and rad, wrist joints in the order of 'wrist_joints', relative to the wrist's "
            "initial pose",
        ),
        ObservationField(
            "q_target - q", joints, "rad, lead of the last finger targets over the joints"
        ),
        ObservationField(
            "u_target - u", 6, "m and rad, lead of the last wrist targets over the joints"
        ),
        ObservationField("q_velocity", joints, "rad/s", privileged=True),
        ObservationField("u_velocity", 6, "m/s and rad/s", privileged=True),
        ObservationField(
            "touching",
            links,
            "1 if a link, in the order of 'links', touches the object, else 0",
            privileged=True,
        ),
        ObservationField(
            "force",
            3 * links,
            "f / (|f| + force_scale) for the object's net force f on each link, N, wrist frame",
            privileged=True,
        ),
        ObservationField(
            "nearest",
            3 * keypoints,
            "m, from each keypoint to the nearest surface point, wrist frame",
        ),
        *_normal_fields(hand, task),
        ObservationField(
            "object_velocity", 3, "m/s of the centre of mass, wrist frame", privileged=True
        ),
        ObservationField("object_angular_velocity", 3, "rad/s, wrist frame", privileged=True),
        ObservationField("object_displacement", 3, "m since the start, wrist frame"),
        ObservationField(
            "object_rotation",
            3,
            "twice the vector part of the rotation since the start (w >= 0), wrist frame",
        ),
        # It saturates: the length of a hold is hidden from the policy, which must hold
        # indefinitely, not until a deadline.
        ObservationField(
            "time",
            1,
            "control steps over (approach_steps + hold_steps), at most 1; the remaining hold is "
            "hidden",
        ),
        ObservationField("table", 1, "1 while the table is present"),
    )


def _state_values(scene: Scene) -> list[Array]:
    """Arrays (B, ...) of `_state_fields`."""
    task = scene.task
    state = scene.state
    features = scene.features
    to_wrist = rotations.conjugate(features.wrist_quaternion)
    displacement = state.object_position - state.object_position_initial
    rotation = _rotation(state.object_quaternion_initial, state.object_quaternion)
    horizon = task.approach_steps + task.hold_steps
    return [
        state.q,
        state.u,
        state.q_target - state.q,
        state.u_target - state.u,
        state.q_velocity,
        state.u_velocity,
        features.touching.astype(jnp.float32),
        flat(squash(features.force)),
        flat(features.nearest),
        *_normal_values(scene),
        rotations.rotate(to_wrist, state.object_velocity),
        rotations.rotate(to_wrist, state.object_angular_velocity),
        rotations.rotate(to_wrist, displacement),
        rotations.rotate(to_wrist, rotation),
        jnp.minimum(state.time / horizon, 1.0)[:, None],
        state.table.astype(jnp.float32)[:, None],
    ]


def _normal_fields(hand: Hand, task: TaskSettings) -> tuple[ObservationField, ...]:
    """Fields of `TaskSettings.surface_normals`."""
    if not task.surface_normals:
        return ()
    keypoints = len(hand.keypoints)
    return (
        ObservationField(
            "normal",
            3 * keypoints,
            "outward unit normal at each of these surface points, wrist frame",
        ),
        ObservationField(
            "height",
            keypoints,
            "m, signed height of each keypoint above the tangent plane at its surface point",
        ),
    )


def _normal_values(scene: Scene) -> list[Array]:
    """Arrays (B, ...) of `_normal_fields`."""
    if not scene.task.surface_normals:
        return []
    features = scene.features
    assert features.normal is not None, "the surface has no normals"
    assert features.height is not None, "the surface has no normals"
    return [flat(features.normal), features.height]


def _past_fields(hand: Hand, task: TaskSettings) -> tuple[ObservationField, ...]:
    """Fields of a robot's observation for earlier control steps."""
    joints = len(hand.joints)
    past = task.history - 1
    order = f"for each of the last {past} control steps, newest first"
    return (
        ObservationField("past q - q", past * joints, f"rad, {order}, minus the current angles"),
        ObservationField(
            "past u - u", past * 6, f"m and rad, {order}, minus the current wrist joints"
        ),
        ObservationField("past q_target - past q", past * joints, f"rad, {order}"),
        ObservationField("past u_target - past u", past * 6, f"m and rad, {order}"),
        ObservationField(
            "past object_position",
            past * 3,
            f"m, {order}, minus the current one, current wrist frame",
        ),
        ObservationField(
            "past object_rotation",
            past * 3,
            f"{order}: twice the vector part of the rotation since then (w >= 0)",
        ),
    )


def _past_values(scene: Scene) -> list[Array]:
    """Arrays (B, ...) of `_past_fields`."""
    assert scene.readings is not None, "a robot's observation needs readings"
    now = Readings(*[field[:, :1] for field in scene.readings])
    past = Readings(*[field[:, 1:] for field in scene.readings])
    to_wrist = rotations.conjugate(scene.features.wrist_quaternion)[:, None]
    rotation = _rotation(past.object_quaternion, now.object_quaternion)
    return [
        flat(past.q - now.q),
        flat(past.u - now.u),
        flat(past.q_target - past.q),
        flat(past.u_target - past.u),
        flat(rotations.rotate(to_wrist, past.object_position - now.object_position)),
        flat(rotations.rotate(to_wrist, rotation)),
    ]


def _constraint_values(scene: Scene, constraint: Constraint) -> list[Array]:
    """Arrays (B, ...) of the blocks of a constraint, zero where it is inactive."""
    task = scene.task
    blocks_of_constraint = zip(
        constraint.observe(scene), constraint.fields(scene.hand, task), strict=True
    )
    observed = [_observed_values(task, *block) for block in blocks_of_constraint]
    if not constraint.optional:
        (values,) = observed
        return values
    gated = []
    for block, values in zip(constraint.blocks, observed, strict=True):
        active = scene.goal.active[block][:, None]
        gated.append(jnp.where(active, jnp.concatenate(values, -1), 0.0))
    return gated


def _mask_field(task: TaskSettings) -> ObservationField:
    """Field of the flags of active constraints."""
    return ObservationField(
        "mask",
        len(blocks(task)),
        "1 for each active constraint in the order of 'masks'; the block of an inactive one is "
        "zero",
    )


def _rotation(start: Array, end: Array) -> Array:
    """Twice the vector part (..., 3) of the rotation from one quaternion to another, with positive
    w.
    """
    turned = rotations.multiply(end, rotations.conjugate(start))
    return 2.0 * turned[..., 1:] * jnp.where(turned[..., :1] < 0, -1.0, 1.0)
