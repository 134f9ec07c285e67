"""Scene of a control step of an episode: hand, object, table, and markers of its constraints."""

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.episode.episode import Episode
from congrasp.common.hands.skin import skin_of
from congrasp.common.hands.spec import Hand
from congrasp.common.task.constraints.markers import Arrow, Ghost, Marker, Paint, Polyline
from congrasp.services.appearance.palette import HEADING, WAYPOINT
from congrasp.services.appearance.surface_colours import region_colours
from congrasp.services.viz.hand_shapes import Look, posed_hand, skin_shape
from congrasp.services.viz.shapes import Shape, arrow, beads, object_shape, table_shape

TOUCHING = (0.13, 0.74, 0.63)
"""Colour of links in contact."""
TOUCH = 1e-3
"""Least force of a link in contact, N."""
_FULL_CONTACT_N = 2.0
"""Force at which the contact colour of a link is strongest."""
_LIGHTEST_TOUCH = 0.3
_STRONGEST_TOUCH = 0.6
"""Shares of the contact colour at the least and at the strongest force."""
_LOWERED_M = 0.12
"""Depth of a removed table below its place, so that pictures keep a ground."""
_LOWERING_S = 0.4
"""Time in which a removed table sinks."""
_ARROW_LENGTH_M = 0.08
_ARROW_RADIUS_M = 0.0028
_BEAD_RADIUS_M = 0.0035
_GHOST_ALPHA = 0.25
_ARROW_SEARCH_M = 0.012
"""Radius around an arrow's line in which its surface is searched."""
_ARROW_GAP_M = 0.004
"""Distance of an arrow's tip from the surface."""


def episode_shapes(episode: Episode, step: int, *, overlays: bool = True) -> list[Shape]:
    """Shapes of a control step.

    Args:
      episode: the episode.
      step: its control step, from 0.
      overlays: also returns the markers of the active constraints, paints the object's regions, and
        tints links in contact.

    Returns:
      The hand, the object, the table, and then the markers.
    """
    hand = episode.known_hand()
    shapes = [
        _hand(hand, episode, step, tinted=overlays),
        object_at(episode, step, painted=overlays),
        _table(episode, step),
    ]
    if overlays:
        shapes += _markers(hand, episode, step)
    return shapes


def _hand(hand: Hand, episode: Episode, step: int, *, tinted: bool) -> Shape:
    """The hand at a step; if `tinted`, links in contact have a colour by their force."""
    look = Look()
    if tinted:
        force = np.linalg.norm(episode.link_force[step], axis=-1)
        strength = np.minimum(force / _FULL_CONTACT_N, 1.0)
        share = _LIGHTEST_TOUCH + (_STRONGEST_TOUCH - _LIGHTEST_TOUCH) * strength
        look = Look(TOUCHING, np.where(force > TOUCH, share, 0.0))
    position = episode.link_position[step]
    quaternion = episode.link_quaternion[step]
    return skin_shape(skin_of(hand), position, quaternion, look)


def object_at(episode: Episode, step: int, *, painted: bool = True) -> Shape:
    """The object at a step in its original colours.

    If `painted`, and if the graspable region is a constraint, it has the colours of its regions.
    """
    paint = episode.colours
    if painted and _has_regions(episode):
        paint = region_colours(episode.surface_points, episode.surface_avoid)
    mesh = (episode.object_vertices, episode.object_faces)
    position = episode.object_position[step]
    return object_shape(mesh, position, episode.object_quaternion[step], paint)


def _has_regions(episode: Episode) -> bool:
    """True if an active constraint divides the object's surface, with a region to avoid."""
    if not episode.surface_avoid.any():
        return False
    return any(isinstance(marker, Paint) for _, marker in episode.markers())


def _table(episode: Episode, step: int) -> Shape:
    """The table; a removed one sinks by a fixed depth."""
    below = episode.object_position[0]
    if episode.table[step]:
        return table_shape(below)
    removal = int(np.argmin(episode.table))
    seconds = (step - removal + 1) * episode.control_dt
    share = min(seconds / _LOWERING_S, 1.0)
    return table_shape(below, -_LOWERED_M * share)


def _markers(hand: Hand, episode: Episode, step: int) -> list[Shape]:
    """Markers of the active constraints, which are given in the object's frame.

    The graspable region has none: the object itself is painted.
    """
    origin = np.asarray(episode.object_position[step], float)
    turn = Rotation.from_quat(episode.object_quaternion[step], scalar_first=True)
    shapes: list[Shape] = []
    for _, marker in episode.markers():
        shapes += _marker_shapes(hand, marker, origin, turn, episode.surface_points)
    return shapes


def _marker_shapes(
    hand: Hand, marker: Marker, origin: np.ndarray, turn: Rotation, surface: np.ndarray
) -> list[Shape]:
    """Shapes of one marker; the object has the pose `origin` (3,), `turn` and a surface (P, 3)."""
    if isinstance(marker, Arrow):
        direction = turn.apply(marker.direction)
        tip = turn.apply(_outside(marker, surface)) + origin
        return arrow(tip - _ARROW_LENGTH_M * direction, tip, _ARROW_RADIUS_M, HEADING)
    if isinstance(marker, Polyline):
        return [beads(turn.apply(marker.points) + origin, _BEAD_RADIUS_M, WAYPOINT)]
    if isinstance(marker, Ghost) and marker.q is not None:
        wrist = turn * Rotation.from_quat(marker.quaternion, scalar_first=True)
        position = turn.apply(marker.position) + origin
        look = Look(HEADING, np.ones(len(hand.links)), _GHOST_ALPHA)
        return [posed_hand(hand, marker.q, position, wrist, look)]
    return []


def _outside(marker: Arrow, surface: np.ndarray) -> np.ndarray:
    """(3,) m, tip of an arrow before its line enters the surface (P, 3), near a point inside it."""
    offset = surface - marker.tip
    along = offset @ marker.direction
    across = np.linalg.norm(offset - along[:, None] * marker.direction, axis=-1)
    entry = float(along[across < _ARROW_SEARCH_M].min(initial=0.0))
    depth = max(0.0, -entry) + _ARROW_GAP_M
    return np.asarray(marker.tip - depth * marker.direction)
