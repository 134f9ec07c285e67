"""Lanes: fulfilment of each constraint step by step, green where the hand satisfies it."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands import known_hand
from congrasp.common.objects.painting import painted
from congrasp.common.objects.spec import Colours
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.constraints.base import ErrorSpec
from congrasp.common.task.constraints.markers import Ghost, Paint
from congrasp.common.task.reward import GRASP
from congrasp.common.wire.codec import Message
from congrasp.services.assets.hands.kinematics import mujoco_link_poses
from congrasp.services.record.goals import active_blocks, active_constraints, markers
from congrasp.services.viz.render import grasp_steps

TOUCH = 0.05
"""Least force of a link in contact, N."""
_UNITS = {"rad": (180 / np.pi, "°"), "m": (100.0, " cm"), "": (100.0, " %")}
MEANINGS = {term.name: term.meaning for term in GRASP} | {
    weight.name: weight.meaning for constraint in CONSTRAINTS for weight in constraint.weights
}
"""Descriptions of the reward terms by name."""


class Lane(NamedTuple):
    """One constraint over T steps."""

    met: np.ndarray
    """(T,) bool."""
    counts: np.ndarray
    """(T,) bool: the constraint applies to this step (a heading to the grasp, a path to the approach)."""
    legend: str
    """Measured quantity, and its tolerance."""
    errors: Mapping[str, np.ndarray]
    """(T,) errors by their units, `share` without unit; the number of links by `links`."""


def lanes(episode: Message) -> dict[str, Lane]:
    """The lanes of an episode by name: contact, then the active constraints whose errors are recorded."""
    arrays = {name: np.asarray(value) for name, value in episode.arrays.items()}
    table = np.arange(len(arrays["table"])) < grasp_steps(episode)[1]
    links = (np.linalg.norm(arrays["contact_force"], axis=-1) > TOUCH).sum(-1)
    found = {"contact": Lane(links >= 2, ~table, "two links or more touch the object", {"links": links.astype(float)})}
    active, blocks = active_constraints(arrays), active_blocks(arrays)
    for constraint in CONSTRAINTS:
        errors = [spec for spec in constraint.errors if not spec.block or blocks.get(spec.block)]
        if constraint.name in active and all(f"error/{spec.name}" in arrays for spec in errors):
            found[constraint.name] = _lane(errors, arrays, table)
    return found


def _lane(errors: Sequence[ErrorSpec], arrays: Mapping[str, np.ndarray], table: np.ndarray) -> Lane:
    """The lane of one constraint from its recorded errors (T,)."""
    values = {spec: arrays[f"error/{spec.name}"] for spec in errors}
    met = np.all([value <= spec.tolerance for spec, value in values.items()], 0)
    counts = table if errors[0].window == "approach" else ~table
    parts = []
    for spec in errors:
        factor, unit = _UNITS[spec.unit]
        parts.append(f"{spec.meaning}: {factor * spec.tolerance:.0f}{unit} at most")
    return Lane(met, counts, "; ".join(parts), {spec.unit or "share": value for spec, value in values.items()})


def _turn(quaternion: Any) -> Rotation:
    """Rotations of quaternions (..., 4), w x y z."""
    return Rotation.from_quat(quaternion, scalar_first=True)


def for_page(episode: Message) -> Message:
    """The episode for the page's player: poses, forces, rewards, object, markers and lanes."""
    found = lanes(episode)
    keep: tuple[str, ...] = (
        "link_position",
        "link_quaternion",
        "object_position",
        "object_quaternion",
        "contact_force",
        "table",
    )
    keep += ("visual_vertices", "visual_faces", "surface_points", "surface_avoid")
    arrays: dict[str, Any] = {name: episode.arrays[name] for name in keep}
    if "colour_values" in episode.arrays:
        own = Colours(episode.arrays["colour_points"], episode.arrays["colour_values"])
        mesh = painted(arrays["visual_vertices"], arrays["visual_faces"], own)
        arrays |= dict(zip(("visual_vertices", "visual_faces", "visual_colours"), mesh, strict=True))
    arrays |= {name: value for name, value in episode.arrays.items() if name.startswith("reward/")}
    for name, lane in found.items():
        arrays |= {f"lane/{name}/met": lane.met, f"lane/{name}/counts": lane.counts}
        arrays |= {f"lane/{name}/{unit}": np.asarray(value, np.float32) for unit, value in lane.errors.items()}
    arrays |= _drawn(episode)
    terms = {name.removeprefix("reward/") for name in arrays if name.startswith("reward/")}
    legends = {name: lane.legend for name, lane in found.items()}
    return Message(
        arrays, {**episode.meta, "lanes": legends, "terms": {name: MEANINGS.get(name, "") for name in terms}}
    )


def _drawn(episode: Message) -> dict[str, np.ndarray]:
    """Markers, object frame, as arrays `KIND/CONSTRAINT/FIELD`; a ghost as link frames (L, 3), (L, 4)."""
    found: dict[str, Any] = {}
    for name, marker in markers(episode.arrays):
        kind = type(marker).__name__.lower()
        if isinstance(marker, Ghost):
            if marker.q is None:
                continue
            wrist = _turn(marker.quaternion)
            position, quaternion = mujoco_link_poses(known_hand(episode.meta["hand"]), np.asarray(marker.q, float))
            position = wrist.apply(position) + marker.position
            quaternion = (wrist * _turn(quaternion)).as_quat(scalar_first=True)
            fields = {"position": position, "quaternion": quaternion}
        elif isinstance(marker, Paint):
            fields = {"avoid": np.asarray(episode.arrays["surface_avoid"])}
        else:
            fields = marker._asdict()
        found |= {f"{kind}/{name}/{field}": np.asarray(value, np.float32) for field, value in fields.items()}
    return found
