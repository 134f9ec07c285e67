"""The observation: state and constraint features relative to the hand (paper, section Observation Space)."""

import jax.numpy as jnp

from common import rotations
from common.config import TaskConfig
from common.hands.spec import Hand
from common.task.constraints import blocks, known
from common.task.constraints.base import ObservationField, Scene
from common.task.geometry import flat, squash
from common.task.types import Array


def layout(hand: Hand, task: TaskConfig) -> tuple[tuple[str, int], ...]:
    """Names and sizes of the observation's blocks, in order: the state, those of the constraints, and the mask."""
    return tuple((block, sum(field.size for field in content)) for block, content in fields(hand, task).items())


def fields(hand: Hand, task: TaskConfig) -> dict[str, tuple[ObservationField, ...]]:
    """What every block holds, in order."""
    f, n, p = len(hand.joints), len(hand.links), len(hand.keypoints)
    state = (
        ("q", f, "rad, finger joints in the order of 'joints'"),
        ("u", 6, "m and rad, wrist joints in the order of 'wrist_joints', from the wrist's pose at the start"),
        ("q_target - q", f, "rad, by what the last action's finger targets are ahead"),
        ("u_target - u", 6, "m and rad, the same for the wrist"),
        ("q_velocity", f, "rad/s"),
        ("u_velocity", 6, "m/s and rad/s"),
        ("touching", n, "1 where a link, in the order of 'links', touches the object, else 0"),
        ("force", 3 * n, "f / (|f| + force_scale) of the object's net force f on each link, N, wrist frame"),
        ("nearest", 3 * p, "m, from each keypoint to the nearest surface point, wrist frame"),
        ("object_velocity", 3, "m/s of the centre of mass, wrist frame"),
        ("object_angular_velocity", 3, "rad/s, wrist frame"),
        ("object_displacement", 3, "m since the start, wrist frame"),
        ("object_rotation", 3, "twice the vector part of the rotation since the start (w >= 0), wrist frame"),
        ("time", 1, "control steps over (approach_steps + hold_steps), at most 1"),
        ("table", 1, "1 while the table is there"),
    )
    mask = "1 for each active constraint in the order of 'masks'; else its block is zero"
    return {
        "state": tuple(ObservationField(*field) for field in state),
        **{
            block: content
            for constraint in known(task)
            for block, content in zip(
                constraint.blocks or (constraint.name,), constraint.fields(hand, task), strict=True
            )
        },
        "mask": (ObservationField("mask", len(blocks(task)), mask),),
    }


def observe(scene: Scene) -> Array:
    """(B, D) observation, laid out as `fields` says; blocks of inactive constraints are zero."""
    task, state, features = scene.task, scene.state, scene.features
    to_wrist = rotations.conjugate(features.wrist_quaternion)
    turned = rotations.multiply(state.object_quaternion, rotations.conjugate(state.object_quaternion_initial))
    turned = turned * jnp.where(turned[..., :1] < 0, -1.0, 1.0)
    horizon = task.approach_steps + task.hold_steps
    parts = [
        state.q,
        state.u,
        state.q_target - state.q,
        state.u_target - state.u,
        state.q_velocity,
        state.u_velocity,
        features.touching.astype(jnp.float32),
        flat(squash(features.force)),
        flat(features.nearest),
        rotations.rotate(to_wrist, state.object_velocity),
        rotations.rotate(to_wrist, state.object_angular_velocity),
        rotations.rotate(to_wrist, state.object_position - state.object_position_initial),
        rotations.rotate(to_wrist, 2.0 * turned[..., 1:]),
        jnp.stack([jnp.minimum(state.time / horizon, 1.0), state.table.astype(jnp.float32)], -1),
    ]
    for constraint in known(task):
        observed = constraint.observe(scene)
        if not constraint.optional:
            parts += observed[0]
            continue
        for block, values in zip(constraint.blocks, observed, strict=True):
            parts.append(jnp.where(scene.goal.active[block][:, None], jnp.concatenate(values, -1), 0.0))
    mask = [scene.gate(block) for block in blocks(task)]
    return jnp.concatenate([*parts, *([jnp.stack(mask, -1)] if mask else [])], -1)
