"""Which constraints are active: the paper's priority rules (figure "Priority among constraints") in one function.

Trajectory overrides the heading and the wrist part of the pose. Pose overrides heading and affordance. Affordance
redirects a heading that comes nearer to O- than to O+. Trajectory and affordance coexist, and must agree. Whatever
overrides the heading also replaces it, so that the heading stays active and consistent.
"""

from typing import NamedTuple

import jax.numpy as jnp

from common import rotations
from common.hands import kinematics
from common.hands.spec import Hand
from common.task.types import MASKS, Array, Goal, Surface

_AFFORDANCE, _FINGER, _WRIST, _TRAJECTORY = range(len(MASKS))
REACH = 0.15
"""Metres of approach before the heading position that are searched for O-."""


class Request(NamedTuple):
    """What was asked for, before the rules. Fields of absent constraints may hold anything finite."""

    goal: Goal
    """Constraint values; its mask is ignored."""
    affordance: Array
    """(B,) bool."""
    pose: Array
    """(B,) bool."""
    trajectory: Array
    """(B,) bool."""


class Resolution(NamedTuple):
    """What is active, and what the rules did."""

    goal: Goal
    """Active constraints with their mask; overridden headings are replaced."""
    redirected: Array
    """(B,) bool: the affordance turned the heading towards O+."""
    aligned: Array
    """(B,) bool: false where an active trajectory ends nearer to O- than to O+ of an active affordance."""


def _least(points: Array, which: Array, target: Array) -> Array:
    """(B,) least distance from target (B, 3) to the points (B, N, 3) that `which` (B, N) selects; inf if none."""
    return jnp.min(jnp.where(which, jnp.linalg.norm(points - target[:, None], axis=-1), jnp.inf), -1)


def _least_to_segment(points: Array, which: Array, start: Array, end: Array) -> Array:
    """(B,) least distance from the selected points to the segment start-end (B, 3)."""
    along = end - start
    length = jnp.sum(along**2, -1)[:, None]
    t = jnp.clip(jnp.einsum("bni,bi->bn", points - start[:, None], along) / length, 0.0, 1.0)
    closest = start[:, None] + t[..., None] * along[:, None]
    return jnp.min(jnp.where(which, jnp.linalg.norm(points - closest, axis=-1), jnp.inf), -1)


def resolve(hand: Hand, surface: Surface, request: Request) -> Resolution:
    """Applies the priority rules to a batch of requests; pure, and used by actors, server and viewer alike."""
    asked = request.goal
    trajectory = request.trajectory
    pose_finger = request.pose
    pose_wrist = request.pose & ~trajectory
    affordance = request.affordance & ~request.pose
    mask = jnp.stack([affordance, pose_finger, pose_wrist, trajectory], -1).astype(jnp.float32)

    last_position, last_quaternion = asked.trajectory_position[:, -1], asked.trajectory_quaternion[:, -1]
    pose_position = jnp.where(trajectory[:, None], last_position, asked.pose_position)
    pose_quaternion = jnp.where(trajectory[:, None], last_quaternion, asked.pose_quaternion)

    # The affordance's redirection, only where nothing stronger decides on the wrist.
    approach_start = asked.heading_position - REACH * asked.heading_direction
    nearer_minus = _least_to_segment(
        surface.points, surface.minus, approach_start, asked.heading_position
    ) < _least_to_segment(surface.points, ~surface.minus, approach_start, asked.heading_position)
    redirected = affordance & ~trajectory & nearer_minus
    weights = (~surface.minus)[..., None].astype(jnp.float32)
    plus_center = jnp.sum(surface.points * weights, 1) / jnp.maximum(jnp.sum(weights, 1), 1.0)
    towards = plus_center - approach_start
    towards = towards / jnp.linalg.norm(towards, axis=-1, keepdims=True)
    heading_position = jnp.where(redirected[:, None], plus_center, asked.heading_position)
    heading_direction = jnp.where(redirected[:, None], towards, asked.heading_direction)
    heading_cross = asked.heading_cross

    # A stronger wrist constraint replaces the heading by its own.
    frame = kinematics.grasp_frame(hand)
    q_reference = jnp.where(pose_finger[:, None], asked.pose_q, jnp.array(hand.q_open))
    center = kinematics.hand_center(hand, kinematics.keypoints(hand, kinematics.link_transforms(hand, q_reference)))
    overridden = (pose_finger | trajectory)[:, None]
    own = [jnp.broadcast_to(jnp.array(axis), center.shape) for axis in (frame.heading, frame.cross)]
    heading_position = jnp.where(
        overridden, pose_position + rotations.rotate(pose_quaternion, center), heading_position
    )
    heading_direction = jnp.where(overridden, rotations.rotate(pose_quaternion, own[0]), heading_direction)
    heading_cross = jnp.where(overridden, rotations.rotate(pose_quaternion, own[1]), heading_cross)
    heading_cross = heading_cross - jnp.sum(heading_cross * heading_direction, -1, keepdims=True) * heading_direction
    heading_cross = heading_cross / jnp.linalg.norm(heading_cross, axis=-1, keepdims=True)

    aligned = ~(trajectory & affordance) | (
        _least(surface.points, ~surface.minus, last_position) < _least(surface.points, surface.minus, last_position)
    )
    goal = asked._replace(
        heading_position=heading_position,
        heading_direction=heading_direction,
        heading_cross=heading_cross,
        pose_position=pose_position,
        pose_quaternion=pose_quaternion,
        mask=mask,
    )
    return Resolution(goal, redirected, aligned)


def explain(*, affordance: bool, pose: bool, trajectory: bool, redirected: bool = False) -> list[str]:
    """What the rules do with a request, in words, strongest constraint first."""
    words = []
    if trajectory:
        words.append("The wrist trajectory guides the wrist; the heading follows from its last waypoint.")
    if pose and trajectory:
        words.append("Of the reference pose only the fingers count: the trajectory decides on the wrist.")
    elif pose:
        words.append("The reference pose guides wrist and fingers; the heading follows from it.")
    if affordance and pose:
        words.append("The affordance is overridden by the reference pose, which names its own contacts.")
    elif affordance:
        words.append("The affordance keeps the fingers off O-.")
    if redirected:
        words.append("The heading came nearer to O- than to O+ and was turned towards O+.")
    if not (pose or trajectory):
        words.append("The heading guides the wrist.")
    return words
