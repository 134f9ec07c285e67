"""Random but valid scenes, goals and surfaces for tests of the task."""

import dataclasses
import functools
import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common import rotations
from congrasp.common.hands import get_hand
from congrasp.common.hands.kinematics import grasp_frame, keypoints, link_transforms
from congrasp.common.task import traced_settings  # noqa: F401 - weights may be traced
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.constraints.affordance import AffordanceGoal
from congrasp.common.task.constraints.fingers import FingersGoal
from congrasp.common.task.constraints.force import ForceGoal
from congrasp.common.task.constraints.heading import HeadingGoal
from congrasp.common.task.constraints.pose import PoseGoal
from congrasp.common.task.constraints.trajectory import TrajectoryGoal
from congrasp.common.task.features import features
from congrasp.common.task.scene import Scene
from congrasp.common.task.types import CONTACTS_PER_LINK, Goal, SceneState, Surface

HAND = get_hand("human")
F = len(HAND.joints)
L = len(HAND.links)
N = 64
K = 15


def quaternions(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Uniform unit quaternions (..., 4), w first."""
    q = rng.normal(size=(*shape, 4))
    return (q / np.linalg.norm(q, axis=-1, keepdims=True)).astype(np.float32)


def units(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Uniform unit vectors (..., 3)."""
    v = rng.normal(size=(*shape, 3))
    return (v / np.linalg.norm(v, axis=-1, keepdims=True)).astype(np.float32)


def pointing(z: float) -> jax.Array:
    """(4,) orientation of a human wrist whose heading points up (1) or down (-1)."""
    frame = grasp_frame(HAND)
    hand_frame = rotations.frame_from_axes(jnp.array(frame.heading), jnp.array(frame.cross))
    target = rotations.frame_from_axes(jnp.array([0.0, 0.0, z]), jnp.array([1.0, 0.0, 0.0]))
    return rotations.multiply(target, rotations.conjugate(hand_frame))


def scene(seed: int, batch: int = 4) -> tuple[SceneState, Surface, Goal]:
    """A scene near a box-like cloud of points, with every constraint active."""
    rng = np.random.default_rng(seed)

    def normal(*shape: int, scale: float = 1.0) -> np.ndarray:
        return (scale * rng.normal(size=(batch, *shape))).astype(np.float32)

    object_position = normal(3, scale=0.1) + np.array([0, 0, 0.3], np.float32)
    state = SceneState(
        q=rng.uniform(HAND.lower, HAND.upper, (batch, F)).astype(np.float32),
        u=normal(6, scale=0.1),
        q_velocity=normal(F),
        u_velocity=normal(6),
        q_target=rng.uniform(HAND.lower, HAND.upper, (batch, F)).astype(np.float32),
        u_target=normal(6, scale=0.1),
        object_position=object_position,
        object_quaternion=quaternions(rng, batch),
        object_velocity=normal(3),
        object_angular_velocity=normal(3),
        contact_force=normal(L, CONTACTS_PER_LINK, 3, scale=5.0),
        contact_position=object_position[:, None, None]
        + normal(L, CONTACTS_PER_LINK, 3, scale=0.03),
        contact_found=rng.random((batch, L, CONTACTS_PER_LINK)) < 0.4,
        base_position=object_position + normal(3, scale=0.15),
        base_quaternion=quaternions(rng, batch),
        q_initial=np.tile(HAND.q_open, (batch, 1)),
        object_position_initial=object_position + normal(3, scale=0.02),
        object_quaternion_initial=quaternions(rng, batch),
        wrist_load=np.zeros((batch, 6), np.float32),
        time=np.full(batch, 20.0, np.float32),
        table=np.ones(batch, bool),
    )
    direction = units(rng, batch)
    cross = np.cross(direction, units(rng, batch))
    values = {
        "heading": HeadingGoal(
            position=normal(3, scale=0.03),
            direction=direction,
            cross=(cross / np.linalg.norm(cross, axis=-1, keepdims=True)).astype(np.float32),
        ),
        "affordance": AffordanceGoal(),
        "pose": PoseGoal(
            q=rng.uniform(HAND.lower, HAND.upper, (batch, F)).astype(np.float32),
            position=normal(3, scale=0.1),
            quaternion=quaternions(rng, batch),
        ),
        "trajectory": TrajectoryGoal(
            position=normal(K, 3, scale=0.15), quaternion=quaternions(rng, batch, K)
        ),
    }
    surface = Surface(normal(N, 3, scale=0.03), rng.random((batch, N)) < 0.5)
    values["fingers"] = FingersGoal(
        np.arange(len(HAND.fingers)) < rng.integers(2, len(HAND.fingers), (batch, 1))
    )
    values["force"] = ForceGoal(rng.uniform(1.0, 8.0, batch).astype(np.float32))
    return (
        state,
        surface,
        Goal(values, active(*_all_blocks(), batch=batch)),
    )


def lone_scene(task: TaskConfig, *blocks: str, **goals: dict[str, np.ndarray]) -> Scene:
    """The first environment of a scene, with other goal arrays of some constraints, and these
    blocks active.
    """
    state, surface, goal = (jax.tree.map(lambda array: array[:1], part) for part in scene(0))
    for name, arrays in goals.items():
        goal = goal.replace(name, **arrays)
    return scene_of(
        task, state, surface, dataclasses.replace(goal, active=active(*blocks, batch=1))
    )


def active(*blocks: str, batch: int = 4) -> dict[str, np.ndarray]:
    """Which blocks are active: these, everywhere."""
    return {block: np.full(batch, block in blocks) for block in _all_blocks()}


def _all_blocks():
    """Names of the blocks of all constraints."""
    return itertools.chain.from_iterable(constraint.blocks for constraint in CONSTRAINTS)


def near_targets(state: SceneState, goal: Goal, seed: int) -> Goal:
    """The goal with every wrist target within some centimetres and a third of a radian of where the
    wrist is.
    """
    rng = np.random.default_rng(seed)
    world = Rotation.from_quat(state.base_quaternion, scalar_first=True)
    body = Rotation.from_quat(state.object_quaternion, scalar_first=True).inv()
    wrist = body * world * Rotation.from_euler("XYZ", state.u[:, 3:])
    position = body.apply(world.apply(state.u[:, :3]) + state.base_position - state.object_position)

    def near(count: int) -> tuple[np.ndarray, np.ndarray]:
        turns = [
            wrist * Rotation.from_rotvec(rng.normal(scale=0.1, size=position.shape))
            for _ in range(count)
        ]
        points = position[:, None] + rng.normal(scale=0.03, size=(len(position), count, 3))
        quaternions = np.stack([turn.as_quat(scalar_first=True) for turn in turns], 1)
        return points.astype(np.float32), quaternions.astype(np.float32)

    pose, pose_turn = near(1)
    way, way_turn = near(K)
    goal = goal.replace("heading", position=pose[:, 0])
    goal = goal.replace("pose", position=pose[:, 0], quaternion=pose_turn[:, 0])
    return goal.replace("trajectory", position=way, quaternion=way_turn)


def moved(state: SceneState, position: np.ndarray, turn: Rotation) -> SceneState:
    """The whole scene carried by a rigid motion of the world: first turned about the origin, then
    shifted.
    """

    def point(x: np.ndarray) -> np.ndarray:
        return (turn.apply(x.reshape(-1, 3)).reshape(x.shape) + position).astype(np.float32)

    def vector(x: np.ndarray) -> np.ndarray:
        return turn.apply(x.reshape(-1, 3)).reshape(x.shape).astype(np.float32)

    def attitude(q: np.ndarray) -> np.ndarray:
        return (
            (turn * Rotation.from_quat(q, scalar_first=True))
            .as_quat(scalar_first=True)
            .astype(np.float32)
        )

    return state._replace(
        object_position=point(state.object_position),
        object_quaternion=attitude(state.object_quaternion),
        object_velocity=vector(state.object_velocity),
        object_angular_velocity=vector(state.object_angular_velocity),
        contact_force=vector(state.contact_force),
        contact_position=point(state.contact_position),
        base_position=point(state.base_position),
        base_quaternion=attitude(state.base_quaternion),
        object_position_initial=point(state.object_position_initial),
        object_quaternion_initial=attitude(state.object_quaternion_initial),
    )


def scene_of(task: TaskConfig, state: SceneState, surface: Surface, goal: Goal) -> Scene:
    """A scene with its features, which one program computes."""
    return Scene(HAND, task, state, _features(task)(state, surface, goal), goal, surface)


@functools.cache
def _features(task: TaskConfig) -> Callable[..., Any]:
    return jax.jit(functools.partial(features, HAND, task))


def evaluated(function: Callable[..., Any], scene: Scene, *rest: Any) -> Any:
    """A function of a scene, compiled as one program: hundreds of single operations would be
    compiled one by one.
    """
    return jax.device_get(
        _compiled(function, scene.hand, scene.task)(scene._replace(hand=None, task=None), *rest)
    )


@functools.cache
def _compiled(function: Callable[..., Any], *static: Any) -> Callable[..., Any]:
    return jax.jit(
        lambda scene, *rest: function(scene._replace(hand=static[0], task=static[1]), *rest)
    )


points_of = jax.jit(lambda q: keypoints(HAND, link_transforms(HAND, q)))
"""Keypoints (..., P, 3) of the human hand in the wrist frame, for finger angles (..., F)."""
