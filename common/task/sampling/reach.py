"""Reach of headings over the table: headings that a hand can follow while the object rests on the
table.
"""

from typing import NamedTuple

import numpy as np

from congrasp.common.hands.closure import CENTER_ONLY, Outline, depth_below
from congrasp.common.objects.shapes import matrix
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.sampling.headings import (
    AVOID_MARGIN,
    Headings,
    closes_on,
    local_width,
    opposed_at,
)

_MAX_BACK = 0.015
"""Greatest distance back from the table, m: to a hand whose centre is 5 mm inside the surface."""
_MAX_BACK_WITHOUT_ALTERNATIVE = 0.03
"""The same for objects without an alternative, m: to 1 cm over the surface."""
_MAX_RISE = 0.1
"""Largest upward component of a direction."""
_FINGER_THICKNESS = 0.012
"""Thickness of a thin finger that closes from below, m."""


class _Way(NamedTuple):
    """A way to clear the table."""

    outline: Outline
    """Outline of the hand that must be over the table."""
    max_back: float
    """Greatest distance by which a heading may move back, m."""


def clear_table(
    headings: Headings,
    rest_pose: np.ndarray,
    outline: Outline = CENTER_ONLY,
    width: np.ndarray | float = 0.0,
    max_back: float = _MAX_BACK_WITHOUT_ALTERNATIVE,
) -> Headings:
    """Moves positions at which the hand would be in the table back along their direction.

    Two centimetres into a flat object may be inside the table; moving back keeps such an object
    graspable from above. A heading that cannot be cleared is returned unchanged, and `feasible` is
    False for it.

    Args:
      headings: headings in the object frame.
      rest_pose: (7,) the object's pose, with the table's top at z = 0.
      outline: outline of the hand.
      width: (H,) widths in m, see `feasible`.
      max_back: greatest distance back, m.
    """
    room, direction_z = _room(headings, rest_pose, outline, width)
    needed = np.maximum(-room, 0.0) / np.maximum(-direction_z, 1e-6)
    back = np.where(needed <= max_back, needed, 0.0)
    # A micrometre more, so that rounding leaves no hand that just touches.
    back = np.where(back > 0, back + 1e-6, 0.0)
    position = headings.position - back[:, None] * headings.direction
    return headings._replace(position=position.astype(np.float32))


def feasible(
    headings: Headings,
    rest_pose: np.ndarray,
    outline: Outline = CENTER_ONLY,
    width: np.ndarray | float = 0.0,
) -> np.ndarray:
    """(H,) bool: headings that can be followed while the object rests on the table in a resting
    pose.

    The approach must come from above or level (its direction rises by at most 0.1 per metre), and
    the hand must be above the table at the heading position in one of the poses that are open wide
    enough for the object (`actors.initial_hand` lifts the start of an approach over the table). All
    headings of a thin object may be infeasible: see `clear_table`.

    Args:
      headings: headings in the object frame.
      rest_pose: (7,) the object's pose, with the table's top at z = 0.
      outline: outline of the hand.
      width: (H,) widths of the object along the cross-finger axes (`local_width`), m.
    """
    room, direction_z = _room(headings, rest_pose, outline, width)
    return (direction_z <= _MAX_RISE) & (room >= 0)


def within_reach(
    headings: Headings,
    obj: GraspObject,
    rest_poses: np.ndarray,
    outline: Outline,
    avoid: np.ndarray | None = None,
    *,
    opposed: bool = True,
) -> tuple[list[Headings], np.ndarray]:
    """Headings moved clear of the table in each of R resting poses (R, 7), and (R, H) bool where
    they are feasible.

    They move back by at most 1.5 cm, because a shallower grip slips: with one policy, half of the
    grasps moved back by 2 to 3 cm were lost, against one in 25 of the others. If no heading of a
    flat object can be cleared that way, the limit is 3 cm. If the table leaves no room for the
    whole hand, as around a card, its centre and the closed fingers must be over the table. An
    object that allows not even that lies too flat.

    Headings of a graspable region must still close on it after the move (`closes_on`), and clearing
    only the hand's centre is never enough: a region must be graspable without the rest of the
    object.

    Args:
      headings: H headings in the object frame.
      obj: the object.
      rest_poses: (R, 7) poses of the object, with the table's top at z = 0.
      outline: outline of the hand.
      avoid: (P,) bool, avoid region, for headings of the graspable region; None for other headings.
      opposed: requires opposing surfaces at the position to which the table moved the heading, and
        closed fingers over the table; False applies the paper's rules alone.
    """
    width = local_width(headings, obj.points)
    ways = [_Way(outline, _MAX_BACK), _Way(outline, _MAX_BACK_WITHOUT_ALTERNATIVE)]
    if avoid is None:
        ways.append(_Way(CENTER_ONLY, _MAX_BACK_WITHOUT_ALTERNATIVE))
    for way in ways:
        cleared = []
        reachable = []
        for rest in rest_poses:
            moved = clear_table(headings, rest, way.outline, width, way.max_back)
            allowed = feasible(moved, rest, way.outline, width)
            if avoid is not None:
                allowed &= closes_on(moved, obj.points, avoid)
            if opposed:
                allowed &= _is_opposed(moved, obj, avoid) & _closed_over_table(moved, rest, width)
            cleared.append(moved)
            reachable.append(allowed)
        if np.any(reachable):
            break
    return cleared, np.array(reachable)


def _is_opposed(headings: Headings, obj: GraspObject, avoid: np.ndarray | None) -> np.ndarray:
    """(H,) bool, see `opposed_at`; `avoid` None for no avoid region."""
    if avoid is None:
        avoid = np.zeros(len(obj.points), bool)
    return opposed_at(headings, obj, avoid)


def _closed_over_table(headings: Headings, rest_pose: np.ndarray, width: np.ndarray) -> np.ndarray:
    """(H,) bool, true where fingers that hold the local width (H,) along the cross-finger axis are
    over the table.
    """
    up = matrix(rest_pose[3:])[2]
    height = headings.position @ up + rest_pose[2]
    below_center = np.abs(headings.cross @ up) * (width / 2 + _FINGER_THICKNESS)
    return height > below_center


def above(headings: Headings, rest_pose: np.ndarray, cone: float = np.radians(30)) -> np.ndarray:
    """(H,) bool: directions within `cone` (rad) of straight down, for an object in a resting pose
    (7,).
    """
    return headings.direction @ matrix(rest_pose[3:])[2] <= -np.cos(cone)


def _room(
    headings: Headings, rest_pose: np.ndarray, outline: Outline, width: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """Heights (H,) of the hand above the table at the positions, and z components of the
    directions.
    """
    up = matrix(rest_pose[3:])[2]
    height = headings.position @ up + rest_pose[2]
    direction_z = headings.direction @ up
    cross_z = headings.cross @ up
    side_z = np.cross(headings.direction, headings.cross) @ up
    below = depth_below(outline, np.stack([direction_z, cross_z, side_z], -1))
    needed = np.broadcast_to(width, height.shape) + 2 * AVOID_MARGIN
    wide = outline.gaps[:, None] >= needed
    wide[0] = True  # no pose is wider
    return height - np.where(wide, below, np.inf).min(0), direction_z
