"""Appearance of a control step of a recorded episode: hand, object, table, contacts and constraints."""

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands import known_hand
from congrasp.common.hands.skin import skin_of
from congrasp.common.hands.spec import Hand
from congrasp.common.task.constraints.markers import Arrow, Ghost, Paint, Polyline
from congrasp.common.wire.codec import Message
from congrasp.services.record.goals import markers
from congrasp.services.record.palette import AVOID, GRASPABLE, HEADING, WAYPOINT
from congrasp.services.viz.scene import Shape
from congrasp.services.viz.shapes import arrow, beads, object_shape, posed_hand, skin_shape, table_shape

TOUCHING = (0.13, 0.74, 0.63)
TOUCH = 1e-3
"""Least force of a link in contact, N."""
_FULL_CONTACT = 2.0  # force at which the contact colour of a link is strongest, N
_ARROW_SEARCH, _ARROW_GAP = 0.012, 0.004  # radius around the arrow's line to search for the surface, gap before it, m


def episode_shapes(episode: Message, step: int, *, overlays: bool = True) -> list[Shape]:
    """Hand, object and table of one control step; with `overlays` also the active constraints and contacts."""
    bodies = _bodies(episode, step, overlays=overlays)
    return bodies + (_constraints(known_hand(episode.meta["hand"]), episode, step) if overlays else [])


def _bodies(episode: Message, step: int, *, overlays: bool) -> list[Shape]:
    """Hand, object and table of one control step of an episode."""
    arrays = episode.arrays
    hand = known_hand(episode.meta["hand"])
    force = np.linalg.norm(arrays["contact_force"][step], axis=-1)
    share = np.where(force > TOUCH, 0.3 + 0.3 * np.minimum(force / _FULL_CONTACT, 1.0), 0.0) * overlays
    links = arrays["link_position"][step], arrays["link_quaternion"][step]
    shapes = [skin_shape(skin_of(hand), *links, TOUCHING, share), _object(episode, step, painted=overlays)]
    if arrays["table"][step]:
        shapes.append(table_shape(arrays["object_position"][0]))
    return shapes


def _object(episode: Message, step: int, *, painted: bool = True) -> Shape:
    """The object at a step in its original colours, or painted with its two regions if they are a constraint."""
    arrays = episode.arrays
    avoid = np.asarray(arrays["surface_avoid"], bool)
    paint = None
    if painted and avoid.any() and any(isinstance(marker, Paint) for _, marker in markers(arrays)):
        paint = arrays["surface_points"], np.where(avoid[:, None], AVOID, GRASPABLE)
    elif "colour_values" in arrays:
        paint = arrays["colour_points"], arrays["colour_values"] / 255
    mesh = arrays["visual_vertices"], arrays["visual_faces"]
    return object_shape(mesh, arrays["object_position"][step], arrays["object_quaternion"][step], paint)


def _constraints(hand: Hand, episode: Message, step: int) -> list[Shape]:
    """Markers of the active constraints, which are given in the object's frame; the object is painted already."""
    arrays = episode.arrays
    origin = np.asarray(arrays["object_position"][step], float)
    turn = Rotation.from_quat(arrays["object_quaternion"][step], scalar_first=True)
    shapes: list[Shape] = []
    for _, marker in markers(arrays):
        if isinstance(marker, Arrow):
            direction = turn.apply(marker.direction)
            tip = turn.apply(_outside(marker, arrays["surface_points"])) + origin
            shapes += arrow(tip - 0.08 * direction, tip, 0.0028, HEADING)
        elif isinstance(marker, Polyline):
            shapes.append(beads(turn.apply(marker.points) + origin, 0.0035, WAYPOINT))
        elif isinstance(marker, Ghost) and marker.q is not None:
            wrist = turn * Rotation.from_quat(marker.quaternion, scalar_first=True)
            position = turn.apply(marker.position) + origin
            shapes.append(posed_hand(hand, marker.q, position, wrist, HEADING, np.ones(len(hand.links)), alpha=0.25))
    return shapes


def _outside(marker: Arrow, surface: np.ndarray) -> np.ndarray:
    """(3,) m, end of an arrow to a point inside the object: before its line enters the surface (P, 3)."""
    off = surface - marker.tip
    along = off @ marker.direction
    across = np.linalg.norm(off - along[:, None] * marker.direction, axis=-1)
    depth = max(0.0, -float(along[across < _ARROW_SEARCH].min(initial=0.0))) + _ARROW_GAP
    return np.asarray(marker.tip - depth * marker.direction)
