"""Observation: state and constraint features relative to the hand (paper, section Observation
Space).
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from congrasp.common import rotations
from congrasp.common.hands.spec import Hand
from congrasp.common.task.constraints import blocks, known
from congrasp.common.task.constraints.specs import ObservationField
from congrasp.common.task.geometry import flat, squash
from congrasp.common.task.scene import Scene
from congrasp.common.task.sensing import Readings
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array

_OF_POSE = (
    "object_displacement",
    "object_rotation",
    "past object_position",
    "past object_rotation",
)
"""Fields that a camera does not provide, because they need the object's pose."""


def layout(hand: Hand, task: TaskSettings) -> tuple[tuple[str, int], ...]:
    """Names and sizes of the observation's blocks, in order: the state, those of the constraints,
    and the mask.
    """
    return tuple(
        (block, sum(field.size for field in content))
        for block, content in fields(hand, task).items()
    )


def fields(hand: Hand, task: TaskSettings) -> dict[str, tuple[ObservationField, ...]]:
    """Fields of every block, in order, restricted to those that the task's policy observes."""
    mask = (
        "1 for each active constraint in the order of 'masks'; the block of an inactive one is zero"
    )
    past = _past_fields(hand, task) if task.observation != "full" else ()
    meaning = (
        "m, points of the camera's cloud, wrist frame, each with 1 if an active affordance avoids "
        "it, else 0"
    )
    cloud = (ObservationField("cloud", 4 * task.surface_points, meaning),)
    return {
        "state": tuple(
            field for field in (*_state_fields(hand, task), *past) if _is_seen(task, field)
        ),
        **({"cloud": cloud} if task.observation == "camera" else {}),
        **{
            block: tuple(field for field in content if _is_seen(task, field))
            for constraint in known(task)
            for block, content in zip(
                constraint.blocks or (constraint.name,), constraint.fields(hand, task), strict=True
            )
        },
        "mask": (ObservationField("mask", len(blocks(task)), mask),),
    }


def _is_seen(task: TaskSettings, field: ObservationField) -> bool:
    """True if a field is part of the task's observation."""
    if task.observation == "camera" and field.name in _OF_POSE:
        return False
    return task.observation == "full" or not field.privileged


def _state_fields(hand: Hand, task: TaskSettings) -> tuple[ObservationField, ...]:
    """Fields of the state of hand and object in the current control step."""
    f, n, p = len(hand.joints), len(hand.links), len(hand.keypoints)
    normals: tuple[tuple[Any, ...], ...] = (
        ("normal", 3 * p, "outward unit normal at each of these surface points, wrist frame"),
        (
            "height",
            p,
            "m, signed height of each keypoint above the tangent plane at its surface point",
        ),
    )
    state: tuple[tuple[Any, ...], ...] = (
        ("q", f, "rad, finger joints in the order of 'joints'"),
        (
            "u",
            6,
            "m and rad, wrist joints in the order of 'wrist_joints', relative to the wrist's "
            "initial pose",
        ),
        ("q_target - q", f, "rad, lead of the last finger targets over the joints"),
        ("u_target - u", 6, "m and rad, lead of the last wrist targets over the joints"),
        ("q_velocity", f, "rad/s", True),
        ("u_velocity", 6, "m/s and rad/s", True),
        ("touching", n, "1 if a link, in the order of 'links', touches the object, else 0", True),
        (
            "force",
            3 * n,
            "f / (|f| + force_scale) for the object's net force f on each link, N, wrist frame",
            True,
        ),
        ("nearest", 3 * p, "m, from each keypoint to the nearest surface point, wrist frame"),
        *(normals if task.surface_normals else ()),
        ("object_velocity", 3, "m/s of the centre of mass, wrist frame", True),
        ("object_angular_velocity", 3, "rad/s, wrist frame", True),
        ("object_displacement", 3, "m since the start, wrist frame"),
        (
            "object_rotation",
            3,
            "twice the vector part of the rotation since the start (w >= 0), wrist frame",
        ),
        # It saturates: the length of a hold is hidden from the policy, which must hold
        # indefinitely, not until a deadline.
        (
            "time",
            1,
            "control steps over (approach_steps + hold_steps), at most 1; the remaining hold is "
            "hidden",
        ),
        ("table", 1, "1 while the table is present"),
    )
    return tuple(ObservationField(*field) for field in state)


def _normals(scene: Scene) -> list[Array]:
    """Arrays (B, ...) of the fields of `TaskSettings.surface_normals`."""
    if not scene.task.surface_normals:
        return []
    assert scene.features.normal is not None and scene.features.height is not None, (
        "the surface has no normals"
    )
    return [flat(scene.features.normal), scene.features.height]


def _past_fields(hand: Hand, task: TaskSettings) -> tuple[ObservationField, ...]:
    """Fields of a robot's observation for earlier control steps."""
    f, past = len(hand.joints), task.history - 1
    order = f"for each of the last {past} control steps, newest first"
    return (
        ObservationField("past q - q", past * f, f"rad, {order}, minus the current angles"),
        ObservationField(
            "past u - u", past * 6, f"m and rad, {order}, minus the current wrist joints"
        ),
        ObservationField("past q_target - past q", past * f, f"rad, {order}"),
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


def _past(scene: Scene) -> list[Array]:
    """Arrays (B, ...) of `_past_fields`."""
    assert scene.readings is not None, "a robot's observation needs readings"
    now = Readings(*(field[:, :1] for field in scene.readings))
    past = Readings(*(field[:, 1:] for field in scene.readings))
    to_wrist = rotations.conjugate(scene.features.wrist_quaternion)[:, None]
    return [
        flat(past.q - now.q),
        flat(past.u - now.u),
        flat(past.q_target - past.q),
        flat(past.u_target - past.u),
        flat(rotations.rotate(to_wrist, past.object_position - now.object_position)),
        flat(rotations.rotate(to_wrist, _turn(past.object_quaternion, now.object_quaternion))),
    ]


def _cloud(scene: Scene) -> Array:
    """Points of the cloud in the wrist frame, each followed by its label: (B, 4 N)."""
    assert scene.cloud is not None, "a camera observation needs a cloud"
    features, cloud = scene.features, scene.cloud
    points = rotations.inverse_transform(
        features.wrist_position, features.wrist_quaternion, cloud.points
    )
    labels = jnp.zeros(cloud.avoid.shape)
    for constraint in known(scene.task):
        if (own := constraint.cloud_labels(scene)) is not None:
            labels = jnp.maximum(labels, own)
    return flat(jnp.concatenate([points, labels[..., None]], -1))


def _turn(start: Array, end: Array) -> Array:
    """Twice the vector part (..., 3) of the rotation from one quaternion to another, with positive
    w.
    """
    turned = rotations.multiply(end, rotations.conjugate(start))
    return 2.0 * turned[..., 1:] * jnp.where(turned[..., :1] < 0, -1.0, 1.0)


def observe(scene: Scene) -> Array:
    """Observation (B, D), laid out like `fields`; blocks of inactive constraints are zero."""
    hand, task, state, features = scene.hand, scene.task, scene.state, scene.features
    to_wrist = rotations.conjugate(features.wrist_quaternion)
    horizon = task.approach_steps + task.hold_steps
    values = [
        state.q,
        state.u,
        state.q_target - state.q,
        state.u_target - state.u,
        state.q_velocity,
        state.u_velocity,
        features.touching.astype(jnp.float32),
        flat(squash(features.force)),
        flat(features.nearest),
        *_normals(scene),
        rotations.rotate(to_wrist, state.object_velocity),
        rotations.rotate(to_wrist, state.object_angular_velocity),
        rotations.rotate(to_wrist, state.object_position - state.object_position_initial),
        rotations.rotate(to_wrist, _turn(state.object_quaternion_initial, state.object_quaternion)),
        jnp.minimum(state.time / horizon, 1.0)[:, None],
        state.table.astype(jnp.float32)[:, None],
    ]
    parts = _seen(task, values, _state_fields(hand, task))
    if task.observation != "full":
        parts += _seen(task, _past(scene), _past_fields(hand, task))
    if task.observation == "camera":
        parts.append(_cloud(scene))
    for constraint in known(task):
        described = constraint.fields(hand, task)
        observed = [
            _seen(task, *block) for block in zip(constraint.observe(scene), described, strict=True)
        ]
        if not constraint.optional:
            parts += observed[0]
            continue
        for block, values in zip(constraint.blocks, observed, strict=True):
            parts.append(
                jnp.where(scene.goal.active[block][:, None], jnp.concatenate(values, -1), 0.0)
            )
    mask = [scene.gate(block) for block in blocks(task)]
    return jnp.concatenate([*parts, *([jnp.stack(mask, -1)] if mask else [])], -1)


def _seen(
    task: TaskSettings, values: Sequence[Array], content: Sequence[ObservationField]
) -> list[Array]:
    """Selects the values (B, ...) of fields that are part of the task's observation."""
    return [value for value, field in zip(values, content, strict=True) if _is_seen(task, field)]
