"""Episodes to attempt for a request: headings and resting poses that the table leaves room for."""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np
from scipy.spatial import cKDTree

from congrasp.actors.initial import RequestedEpisodes
from congrasp.common.errors import CongraspError
from congrasp.common.hands.closure import outline
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.shapes import DENSE, balanced, matrix, sample_union
from congrasp.common.objects.spec import GraspObject
from congrasp.common.request import GraspRequest
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import CONSTRAINTS, goal_of, optional
from congrasp.common.task.sampling.heading_sampler import HeadingOptions, sample_headings
from congrasp.common.task.sampling.headings import INWARD, Headings, max_width
from congrasp.common.task.sampling.reach import above, within_reach
from congrasp.common.task.sampling.table import clear_of_table
from congrasp.common.task.types import Surface

_clear_of_table = jax.jit(clear_of_table, static_argnums=0)
_ACROSS = 0.02
"""Metres per unit of normal difference: the two sides of a thin wall may belong to different
regions."""


def to_attempt(
    hand: Hand,
    task: TaskConfig,
    obj: GraspObject,
    request: GraspRequest,
    batch: int,
    rng: np.random.Generator,
) -> tuple[RequestedEpisodes, np.ndarray, int]:
    """Samples episodes that attempt a request for an object with labelled regions.

    Returns:
      The episodes, the resting pose of each (B,), and the number of distinct ones, which come
      first.

    Raises:
      CongraspError: no approach fits the request, or its reference path leads through the table.
    """
    episodes = equal_episodes(hand, task, obj, request, batch)
    path = prescribed_path(request)
    if path is None:
        position, direction, cross, rests = headings(hand, obj, request, batch, rng)
        goal = episodes.goal.replace(
            "heading",
            position=position.astype(np.float32),
            direction=direction.astype(np.float32),
            cross=cross.astype(np.float32),
        )
        episodes = episodes._replace(goal=goal)
        distinct = batch
    else:
        valid = valid_rests(hand, obj, *path, request.rest)
        rests = np.resize(valid, batch)
        distinct = min(batch, len(valid))
    return episodes._replace(rest=np.asarray(obj.rest_poses, np.float32)[rests]), rests, distinct


def equal_episodes(
    hand: Hand, task: TaskConfig, obj: GraspObject, request: GraspRequest, batch: int
) -> RequestedEpisodes:
    """Equal episodes of a request for a labelled object, in the requested resting pose."""
    rest = np.asarray(obj.rest_poses[request.rest or 0], np.float32)
    goal, surface, rest = jax.tree.map(
        lambda array: np.broadcast_to(array, (batch, *np.shape(array))),
        (goal_of(hand, task, request), surface_of(task, obj), rest),
    )
    is_requested = {c.name: np.full(batch, c.name in request.constraints) for c in optional(task)}
    return RequestedEpisodes(goal, is_requested, surface, rest)


def surface_of(task: TaskConfig, obj: GraspObject) -> Surface:
    """Labelled points of an object, as many as the policy observes, with their normals if it
    observes them.
    """
    points = task.surface_points
    normals = np.asarray(obj.normals[:points], np.float32) if task.surface_normals else None
    return Surface(
        np.asarray(obj.points[:points], np.float32), obj.non_graspable_points[:points], normals
    )


def with_avoid(obj: GraspObject, avoid: np.ndarray) -> GraspObject:
    """The object with another avoid region, (512,) bool."""
    return dataclasses.replace(
        obj,
        part_names=("graspable", "non-graspable"),
        graspable=np.array([True, False]),
        labels=avoid.astype(np.int32),
    )


def headings(
    hand: Hand, obj: GraspObject, request: GraspRequest, batch: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Samples headings for which the table leaves room: positions, directions, cross-finger axes
    (B, 3) and resting poses (B,).

    Likely resting poses are sampled more often.

    Raises:
      CongraspError: no approach fits the request.
    """
    if request.avoid is not None:
        obj = _balance_points(obj)
    candidates = _sampled_headings(hand, obj, request, rng)
    options = _with_room(hand, obj, request, candidates)
    if not options:
        raise CongraspError(*_no_room(obj, request))
    likeliest = min(option.rest for option in options)
    if likeliest > 0 and _is_free(request):
        raise _too_flat(hand, obj, likeliest)
    weights = np.array([option.weight for option in options])
    shares = weights / np.sum(weights)
    drawn = rng.choice(len(options), batch, replace=len(options) < batch, p=shares)
    chosen = [options[i] for i in drawn]
    return (
        np.array([option.position for option in chosen]),
        np.array([option.direction for option in chosen]),
        np.array([option.cross for option in chosen]),
        np.array([option.rest for option in chosen]),
    )


class _Option(NamedTuple):
    """A heading, and a resting pose in which the table leaves room for the hand."""

    rest: int
    position: np.ndarray
    """(3,) m, object frame, clear of the table."""
    direction: np.ndarray
    """(3,) unit vector."""
    cross: np.ndarray
    """(3,) cross-finger axis."""
    weight: float
    """Relative probability."""


def _sampled_headings(
    hand: Hand, obj: GraspObject, request: GraspRequest, rng: np.random.Generator
) -> Headings:
    """Headings of a request for an object, independent of its resting pose.

    Raises:
      CongraspError: no approach reaches the graspable part.
    """
    strict = HeadingOptions(
        inward=hand.object_scale * INWARD,
        max_width=max_width(outline(hand), hand.object_scale),
        along=request.given("heading", "direction"),
        at=request.given("heading", "position"),
    )
    for options in (strict, dataclasses.replace(strict, lenient=True)):
        candidates = sample_headings(
            obj, options=options, rng=rng, use_affordance=request.avoid is not None
        )
        if candidates:
            return candidates
    raise CongraspError(
        f"No approach reaches the graspable region of '{obj.name}' without touching its avoid "
        "region.",
        remedy_for(request, "make the graspable part larger"),
    )


def _with_room(
    hand: Hand, obj: GraspObject, request: GraspRequest, candidates: Headings
) -> list[_Option]:
    """Headings in each resting pose in which the table leaves room for them; likely poses have
    higher weights.
    """
    options = []
    reachable = within_reach(candidates, obj, obj.rest_poses, outline(hand))
    for rest, (cleared, room) in enumerate(zip(*reachable, strict=True)):
        if request.rest not in (None, rest):
            continue
        if request.above:
            room &= above(cleared, obj.rest_poses[rest])
        weight = 1.0 / ((rest + 1) * max(room.sum(), 1))
        for i in np.flatnonzero(room):
            option = _Option(
                rest=rest,
                position=cleared.position[i],
                direction=candidates.direction[i],
                cross=candidates.cross[i],
                weight=weight,
            )
            options.append(option)
    return options


def _is_free(request: GraspRequest) -> bool:
    """True if a request restricts neither resting pose, heading nor part."""
    return (
        request.rest is None
        and not request.above
        and request.given("heading", "direction") is None
        and request.given("heading", "position") is None
        and request.avoid is None
    )


def _too_flat(hand: Hand, obj: GraspObject, rest: int) -> CongraspError:
    """Error for an object whose likeliest resting pose leaves the hand no room.

    Args:
      hand: the hand.
      obj: the object.
      rest: index of a resting pose that leaves room.
    """
    height = np.ptp(matrix(obj.rest_poses[0][3:])[2] @ obj.points.T)
    return CongraspError(
        f"'{obj.name}' lies too flat for the {hand.name} hand: it is {1000 * height:.0f} mm high "
        f"in its likeliest resting pose, which leaves the fingers no room above the table.",
        f"Set --rest {rest + 1} to grasp it in another resting pose.",
    )


def _balance_points(obj: GraspObject) -> GraspObject:
    """The object with half of its surface points on the graspable region."""
    points, normals, _ = sample_union(obj.pieces, np.random.default_rng(0), DENSE)
    tree = cKDTree(np.hstack([obj.points, _ACROSS * obj.normals]))
    labels = obj.labels[tree.query(np.hstack([points, _ACROSS * normals]))[1]]
    graspable = obj.graspable[labels]
    if graspable.all() or not graspable.any():
        return obj
    chosen = balanced(graspable)
    return dataclasses.replace(
        obj, points=points[chosen], normals=normals[chosen], labels=labels[chosen]
    )


def remedy_for(request: GraspRequest, otherwise: str) -> str:
    """Returns the remedy for a request that no approach fits.

    Args:
      request: the request.
      otherwise: remedy besides leaving out the options that restrict the approach.
    """
    options = {
        "--rest": request.rest is not None,
        "--heading": request.above or request.given("heading", "direction") is not None,
        "--at": request.given("heading", "position") is not None,
    }
    set_options = [name for name, is_set in options.items() if is_set]
    if not set_options:
        return f"{otherwise.capitalize()}."
    return f"Leave out {' or '.join(set_options)}, or {otherwise}."


def _no_room(obj: GraspObject, request: GraspRequest) -> tuple[str, str]:
    """Error and remedy if the table does not leave room for any approach."""
    if request.rest is not None:
        return (
            f"'{obj.name}' cannot be approached under these constraints in resting pose "
            f"{request.rest + 1}.",
            remedy_for(request, "set another --heading"),
        )
    if request.given("heading", "direction") is None:
        return (
            f"'{obj.name}' cannot be approached in any of its resting poses.",
            remedy_for(request, "scale it"),
        )
    down = -matrix(obj.rest_poses[0][3:])[2]
    return (
        "In every resting pose, the hand would have to approach through the table.",
        f"Set another --heading. In the likeliest resting pose, straight down is --heading "
        f'"{" ".join(f"{x:.2f}" for x in np.round(down, 2) + 0.0)}".',
    )


def prescribed_path(request: GraspRequest) -> tuple[np.ndarray, np.ndarray] | None:
    """Wrist positions (n, 3) and last orientation (4,) that the strongest constraint prescribes;
    None if no constraint prescribes them.
    """
    for constraint in reversed(CONSTRAINTS):
        if constraint.name in request.constraints:
            path = constraint.wrist_path(request.goal(constraint.name))
            if path is not None:
                return path
    return None


def valid_rests(
    hand: Hand, obj: GraspObject, path: np.ndarray, turn: np.ndarray, rest: int | None
) -> np.ndarray:
    """Resting poses in which a wrist path (n, 3) stays over the table and its last orientation (4,)
    is not from below.

    Raises:
      CongraspError: there is no such resting pose, or the requested one, `rest`, is not among them.
    """
    valid = np.flatnonzero(_clear_of_table(hand, turn[None], path[None], obj.rest_poses[None])[0])
    if not len(valid):
        raise CongraspError(
            f"With this reference pose or path, the hand would be in the table in every resting "
            f"pose of '{obj.name}'.",
            "Use a reference whose wrist stays 2 cm above the table, and whose hand approaches "
            "from above or horizontally.",
        )
    if rest is not None and rest not in valid:
        raise CongraspError(
            f"With this reference pose or path, the hand would be in the table in resting pose "
            f"{rest + 1}.",
            "Leave out --rest.",
        )
    return valid if rest is None else np.array([rest])
