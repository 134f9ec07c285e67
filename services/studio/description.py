"""Description of a request for the page, as JSON."""

import functools
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.actors.initial import initial_hand
from congrasp.common import rotations
from congrasp.common.hands import kinematics
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.resting import rest_tilts
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import get_constraint, goal_of, optional
from congrasp.common.task.constraints.markers import Ghost
from congrasp.common.task.types import Goal, Surface
from congrasp.services.grasp.grasper import surface_of
from congrasp.services.studio.state import Studio


def describe(studio: Studio) -> dict[str, Any]:
    """Everything that a page shows of a request; in the object frame, except resting pose and start (world frame)."""
    resolution = studio.resolution
    goal = resolution.goal
    obj, hand = studio.obj, studio.hand
    return {
        "hand": hand.name,
        "object": {
            "name": obj.name,
            "size_cm": [round(100 * float(side), 1) for side in np.ptp(obj.visual_vertices, axis=0)],
            "mass_g": round(1000 * obj.mass),
            "faces": len(studio.canvas.faces),
            "tilts_deg": np.degrees(rest_tilts(obj)).round().tolist(),
        },
        "rest": {"index": studio.rest, **_pose(obj.rest_poses[studio.rest])},
        "asked": sorted(studio.asked),
        "known": [constraint.name for constraint in optional(studio.task)],
        "others": [_toggles(hand, name, fields) for name, fields in studio.others.items()],
        "arrow": {name: part.tolist() for name, part in studio.arrow._asdict().items()},
        "roll_deg": round(float(np.degrees(studio.arrow.roll(studio.up))), 1),
        "active": {
            "masks": {block: bool(on) for block, on in goal.active.items()},
            "position": goal["heading"].position.tolist(),
            "direction": goal["heading"].direction.tolist(),
            "overruled": bool(resolution.redirected)
            or any("heading" in get_constraint(name).overrides for name in studio.asked),
        },
        "explanation": studio.explanation,
        "trouble": studio.trouble,
        "start": _frames(_start(hand, studio.task, *_batch_of_one(studio, goal))),
        "markers": list(_markers(studio)),
        "painted": studio.canvas.paint.version,
        "avoid_share": round(float(studio.canvas.avoid.mean()), 3),
    }


def _toggles(hand: Hand, name: str, fields: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Title and flags of a constraint that has no drawing tool."""
    constraint = get_constraint(name)
    labels = constraint.labels(hand)
    shown = {field: dict(zip(labels[field], fields[field].tolist(), strict=True)) for field in labels}
    return {"name": name, "title": constraint.title, "flags": shown}


def _markers(studio: Studio) -> Iterator[dict[str, Any]]:
    """Kind and fields of the markers of the requested optional constraints, object frame; a ghost as link frames."""
    goal = goal_of(studio.hand, studio.task, studio._request())
    for constraint in optional(studio.task):
        if constraint.name in studio.asked:
            for marker in constraint.markers(goal[constraint.name], constraint.blocks):
                if isinstance(marker, Ghost):
                    fields = _frames(_links(studio.hand, marker.q, marker.position, marker.quaternion))
                else:
                    fields = {name: np.asarray(value).tolist() for name, value in marker._asdict().items()}
                yield {"kind": type(marker).__name__.lower(), **fields}


def _frames(links: tuple[jax.Array, jax.Array]) -> dict[str, Any]:
    """Link frames (L, 3), (L, 4) as JSON."""
    return {"position": np.asarray(links[0]).tolist(), "quaternion": np.asarray(links[1]).tolist()}


def _batch_of_one(studio: Studio, goal: Goal) -> tuple[Goal, Surface, np.ndarray]:
    """The goal, the object's surface and its resting pose (7,), with a batch axis."""
    rest = np.asarray(studio.obj.rest_poses[studio.rest], np.float32)
    return jax.tree.map(lambda array: np.asarray(array)[None], (goal, surface_of(studio.task, studio.obj), rest))


@functools.partial(jax.jit, static_argnums=(0, 1))
def _start(hand: Hand, task: TaskConfig, goal: Goal, surface: Surface, rest: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Link frames (L, 3), (L, 4) at the start of a grasp, world frame."""
    q, position, quaternion = initial_hand(hand, task, goal, surface, rest)
    return _links(hand, q[0], position[0], quaternion[0])


@functools.partial(jax.jit, static_argnums=0)
def _links(hand: Hand, q: jax.Array, position: jax.Array, quaternion: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Link frames (L, 3), (L, 4) of finger angles (F,) and a wrist pose (3,), (4,), in the frame of that pose."""
    local = kinematics.link_poses(hand, q)
    turn = jnp.broadcast_to(quaternion, local[1].shape)
    return rotations.compose_pose(jnp.broadcast_to(position, local[0].shape), turn, *local)


def _pose(row: np.ndarray) -> dict[str, list[float]]:
    """A pose (7,) as JSON."""
    return {"position": row[:3].tolist(), "quaternion": row[3:].tolist()}
