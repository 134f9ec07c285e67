"""Heading sets: from where and how a hand may come to an object (paper, section Constraint Setup)."""

from typing import Any, NamedTuple

import numpy as np

from congrasp.common.errors import TooWideError
from congrasp.common.hands.outline import CENTER, Outline, depth_below
from congrasp.common.objects.shapes import matrix
from congrasp.common.objects.spec import GraspObject

COUNT = 256
"""Headings of an object."""
INWARD = 0.02
"""Metres from the surface to the heading position, along the heading direction."""
MAX_WIDTH = 0.12
"""Metres; the object may not be wider along the cross-finger axis."""
BACK_OFF = 0.15
"""Metres from the heading position back to the start of the approach."""
_SKIN = 0.004  # m that the widest pose is wider than the object on either side
_BREADTH = 0.03  # half the breadth of the slab in which the local width is measured: a hand is some 6 cm broad
_BEYOND = 0.01  # the slab ends this far beyond the heading position, where the fingertips close
_SIDE = 0.015  # depth of an object's side along the cross-finger axis, in which fingertips find a surface
_OPPOSED = np.cos(np.arctan(1.0))  # least cosine of a normal with that axis: the edge of the cone of friction 1
_TUBE = 0.01  # radius around the approach in which nothing may stand before the surface point
_MARGIN = 0.01  # an approach keeps this far from the avoid region, of which closing fingers, so thick, meet nothing
_BACK = 0.015  # longest way back from the table: to a hand whose centre is 5 mm inside the surface
_FARTHEST_BACK = 0.03  # the same for objects that leave no other choice: to 1 cm over the surface
_FACING = 0.5  # least cosine between a surface's inward normal and a direction that is given
_ROLLS = 4
_BATCH = 320
_PREFERENCE = 0.015  # m of width for which a roll becomes e times less likely
_WIDTH_POINTS = 256


class Headings(NamedTuple):
    """H headings in the object frame."""

    position: np.ndarray
    """(H, 3) p-bar, where the hand centre should be, m."""
    direction: np.ndarray
    """(H, 3) v-bar, unit: the way the hand moves, into the surface."""
    cross: np.ndarray
    """(H, 3) unit, orthogonal to the direction: along the hand's cross-finger axis w."""


def sample_headings(
    obj: GraspObject,
    rng: np.random.Generator,
    *,
    use_affordance: bool,
    lenient: bool = False,
    count: int = COUNT,
    cone: float = np.radians(30),
    inward: float = INWARD,
    max_width: float = MAX_WIDTH,
    back_off: float = BACK_OFF,
    attempts: int = 6,
    along: np.ndarray | None = None,
    at: np.ndarray | None = None,
    opposed: bool = True,
) -> Headings | None:
    """Samples an object's heading set by the paper's rules.

    A surface point of the graspable region (or of the whole surface) and a direction in the cone around its inward
    normal give the heading position, `inward` along the direction. The cross-finger axis is the best of a few random
    rolls, narrow ones being preferred. A candidate is rejected if

    * the object's local width along the cross-finger axis exceeds `max_width`; it is measured on the surface points
      that the closing fingers sweep (3 cm to both sides of the hand's middle plane, down to 1 cm beyond the position);
    * there are no surfaces to press on from both sides: among the points of that slab, within 1.5 cm of either end
      of the width, one whose normal is within 45 degrees of the axis (ours: at friction 1 two fingers that press
      along the axis slip off anything steeper, such as two edges of a board's corner);
    * another part of the object stands before the surface point (the point would not be the first one hit);
    * with affordance, the approach comes within 1 cm of the avoid region, or the position lies nearer to it than to
      the graspable one, or it is as wide as that where the fingers close, so that they would meet it first (ours: the
      paper's regions are those that people held, and can be held).

    If fewer than `count` remain after `attempts` batches, those found are repeated. If none remains on the whole
    surface, the candidates that break the fewest of the rules but the first are taken, among them the narrowest; the
    first one holds.

    Args:
      obj: the object.
      rng: random generator.
      use_affordance: restricts the headings to the graspable region.
      lenient: where no candidate is left because fingers that close on the graspable region meet the other, such as
        on a small handle, takes those whose approach keeps away from the avoid region.
      count: number of headings H.
      cone: half angle of the cone around the inward normal, rad.
      inward: metres from the surface point to the heading position.
      max_width: largest local width, m.
      back_off: length of the approach that is checked, m.
      attempts: batches of candidates.
      along: (3,) unit, the direction of all of them, if it is not to be drawn; surface points that face it are taken.
      at: (3,) the position of all of them, m, if it is not to be drawn.
      opposed: requires surfaces to press on from both sides; false applies the paper's rules alone.

    Returns:
      H headings, float32; None if the graspable region cannot be approached.

    Raises:
      TooWideError: the object is wider than `max_width` wherever it can be approached.
    """
    avoid = obj.non_graspable_points & use_affordance
    sources = _sources(obj, avoid, along)
    surface = _Surface(obj.points.astype(np.float32), obj.normals.astype(np.float32), avoid)
    points = surface.points
    found: list[Headings] = []
    total = 0
    for _ in range(attempts):
        source = rng.choice(sources, _BATCH)
        direction = _in_cone(-obj.normals[source], cone, rng)
        if along is not None:
            direction = np.broadcast_to(np.float32(along), direction.shape)
        position = points[source] + np.float32(inward) * direction
        if at is not None:
            position = np.broadcast_to(np.float32(at), position.shape)
        faults = _faults(points, avoid, position, direction, inward, back_off)
        position, direction, faults = (part[faults.argsort(kind="stable")] for part in (position, direction, faults))
        clean = int((faults == 0).sum())
        cross, width = _roll(surface, position[:clean], direction[:clean], rng, opposed=opposed)
        good = np.flatnonzero(width <= max_width)
        found.append(Headings(position[good], direction[good], cross[good]))
        total += len(good)
        if total >= count:
            break
    if total == 0:
        last = _last_resort(surface, position, direction, faults, rng, lenient=lenient)
        if last is None:
            return None
        width = local_width(last, points)
        if not avoid.any() and width.min() > max_width:
            raise TooWideError(obj.name, width.min(), max_width)
        last = Headings(*(part[width <= max(max_width, width.min())] for part in last))
        found.append(last)
    pool = Headings(*(np.concatenate(parts) for parts in zip(*found, strict=True)))
    chosen = np.resize(np.arange(len(pool.position)), count)
    return Headings(*(part[chosen].astype(np.float32) for part in pool))


def _sources(obj: GraspObject, avoid: np.ndarray, along: np.ndarray | None) -> np.ndarray:
    """Indices of the surface points that headings come to: outside of the avoid region, and facing what is given."""
    sources = np.flatnonzero(~avoid)
    if len(sources) == 0:
        sources = np.arange(len(avoid))
    if along is not None:
        facing = -obj.normals[sources] @ along
        sources = sources[facing >= min(_FACING, facing.max())]
    return sources


class _Surface(NamedTuple):
    """P surface points, of which the first cover the surface."""

    points: np.ndarray
    """(P, 3) m."""
    normals: np.ndarray
    """(P, 3) unit, outward."""
    avoid: np.ndarray
    """(P,) bool, the avoid region."""

    def some(self, which: np.ndarray | slice) -> "_Surface":
        """Selected points."""
        return _Surface(*(part[which] for part in self))


def _last_resort(
    surface: _Surface,
    position: np.ndarray,
    direction: np.ndarray,
    faults: np.ndarray,
    rng: np.random.Generator,
    *,
    lenient: bool,
) -> Headings | None:
    """Headings among candidates (N, 3) of which none keeps all rules, see `sample_headings`; `faults` (N,) ascend."""
    if surface.avoid.any():
        clean = int((faults == 0).sum())
        if not (lenient and clean):
            return None
        cross, _ = _roll(surface.some(~surface.avoid), position[:clean], direction[:clean], rng, opposed=False)
        return Headings(position[:clean], direction[:clean], cross)
    cross, width = _roll(surface, position, direction, rng, opposed=False)
    # Faults count whole numbers and a width in metres less than one: together they sort in the right order.
    best = (faults + width).argsort(kind="stable")[: _BATCH // 16]
    return Headings(position[best], direction[best], cross[best])


def clear_table(
    headings: Headings,
    rest_pose: np.ndarray,
    outline: Outline = CENTER,
    width: np.ndarray | float = 0.0,
    farthest: float = _FARTHEST_BACK,
) -> Headings:
    """Moves positions at which the hand would be in the table back along their direction.

    Two centimetres into a flat object may be inside the table; this keeps such an object graspable from above. A
    heading that cannot be cleared is left as it is, and `feasible` is false for it.

    Args:
      headings: in the object frame.
      rest_pose: (7,) the object's pose, with the table's top at z = 0.
      outline: of the hand.
      width: (H,) m, see `feasible`.
      farthest: longest way back, m.
    """
    room, direction_z = _room(headings, rest_pose, outline, width)
    needed = np.maximum(-room, 0.0) / np.maximum(-direction_z, 1e-6)
    back = np.where(needed <= farthest, needed, 0.0)
    # A micrometre more, so that rounding does not leave a hand that just touches.
    back = np.where(back > 0, back + 1e-6, 0.0)
    return headings._replace(position=(headings.position - back[:, None] * headings.direction).astype(np.float32))


def feasible(
    headings: Headings,
    rest_pose: np.ndarray,
    outline: Outline = CENTER,
    width: np.ndarray | float = 0.0,
    *,
    steepest_up: float = 0.1,
) -> np.ndarray:
    """(H,) bool, which headings can be followed while the object lies on the table in a resting pose.

    The approach must come from above or level (its direction rises by at most `steepest_up` per metre), and the hand
    must be over the table at the heading position in one of the poses that are open wide enough for the object
    (`actors.initial` lifts the start of an approach over the table). It may be false for all headings of a thin
    object: see `clear_table`.

    Args:
      headings: in the object frame.
      rest_pose: (7,) the object's pose, with the table's top at z = 0.
      outline: of the hand.
      width: (H,) m, the object's along the cross-finger axes (`local_width`).
      steepest_up: largest upward component of a direction.
    """
    room, direction_z = _room(headings, rest_pose, outline, width)
    return (direction_z <= steepest_up) & (room >= 0)


def within_reach(
    headings: Headings,
    obj: GraspObject,
    rest_poses: np.ndarray,
    outline: Outline,
    avoid: np.ndarray | None = None,
    *,
    opposed: bool = True,
) -> tuple[list[Headings], np.ndarray]:
    """The headings clear of the table in each of R resting poses (R, 7), and (R, H) bool whether they can be followed.

    They are moved back by 1.5 cm at most, since what is held by less slips: of grasps moved back by 2 to 3 cm half were
    lost, with one policy, and of the others one in 25. Flat objects, none of whose headings can be cleared by that, get
    3 cm; and where the table leaves the hand no room at all, as beside a card, its centre and the places that the
    fingers close on must be over the table, or else its centre alone.

    Headings of a graspable region must still close on it where they end (`closes_on`), and the hand's centre alone
    never counts: what cannot be held without the rest of the object is no region.

    Args:
      headings: H of them, in the object frame.
      obj: the object.
      rest_poses: (R, 7), with the table's top at z = 0.
      outline: of the hand.
      avoid: (P,) bool, the avoid region of headings that are made for the graspable one; None for other headings.
      opposed: requires surfaces to press on from both sides at the position to which the table moved it, but of the
        last resort.
    """
    width = local_width(headings, obj.points)
    bare = np.zeros(len(obj.points), bool) if avoid is None else avoid
    ways = [(outline, _BACK, opposed, False), (outline, _FARTHEST_BACK, opposed, False)]
    if avoid is None:
        ways += [(CENTER, _FARTHEST_BACK, opposed, True), (CENTER, _FARTHEST_BACK, False, False)]
    for own, farthest, pressed, touching in ways:
        cleared = [clear_table(headings, rest, own, width, farthest) for rest in rest_poses]
        pairs = list(zip(cleared, rest_poses, strict=True))
        reachable = np.array([feasible(moved, rest, own, width) for moved, rest in pairs])
        if avoid is not None:
            reachable &= np.array([closes_on(moved, obj.points, avoid) for moved in cleared])
        if pressed:
            reachable &= np.array([opposed_at(moved, obj, bare) for moved in cleared])
        if touching:
            reachable &= np.array([_contacts_over_table(moved, rest, width) for moved, rest in pairs])
        if reachable.any():
            break
    return cleared, reachable


def _contacts_over_table(headings: Headings, rest_pose: np.ndarray, width: np.ndarray) -> np.ndarray:
    """(H,) bool, true where both ends of the local width (H,) along the cross-finger axis are over the table."""
    up = matrix(rest_pose[3:])[2]
    return headings.position @ up + rest_pose[2] - np.abs(headings.cross @ up) * width / 2 > 0


def opposed_at(headings: Headings, obj: GraspObject, avoid: np.ndarray) -> np.ndarray:
    """(H,) bool, true where surfaces outside of the avoid region (P,) can be pressed on from both sides."""
    points, normals, avoid = obj.points[:_WIDTH_POINTS], obj.normals[:_WIDTH_POINTS], avoid[:_WIDTH_POINTS]
    along, aside, depth = _offsets(headings, points)
    return _pressable(along, (np.abs(aside) < _BREADTH) & (depth < _BEYOND) & ~avoid, headings.cross @ normals.T)


def closes_on(headings: Headings, points: np.ndarray, avoid: np.ndarray) -> np.ndarray:
    """(H,) bool, true where fingers that close at the position meet the graspable region, on both sides and first.

    The position is nearer to that region than to the other, and along the cross-finger axis the other ends at least
    5 mm further inside (`sample_headings`).

    Args:
      headings: in the object frame.
      points: (P, 3) surface points, of which the first 256 are taken, m.
      avoid: (P,) bool, the avoid region.
    """
    points, avoid = points[:_WIDTH_POINTS], avoid[:_WIDTH_POINTS]
    along, aside, depth = _offsets(headings, points)
    (low, high), first = _region_first(along, np.abs(aside) < _BREADTH, depth, avoid)
    squared = along**2 + aside**2 + depth**2
    nearer = squared[:, ~avoid].min(-1, initial=np.inf) < squared[:, avoid].min(-1, initial=np.inf)
    return (high > low) & first & nearer


def local_width(headings: Headings, points: np.ndarray) -> np.ndarray:
    """(..., H) m, how wide objects are along the cross-finger axes where fingers close.

    That is in the slab of `sample_headings`; where no surface point lies in it, 0.

    Args:
      headings: fields (..., H, 3), NumPy's or JAX's.
      points: (..., P, 3) surface points, of which the first 256 are taken, m.
    """
    xp = headings.position.__array_namespace__()
    along, aside, depth = _offsets(headings, points[..., :_WIDTH_POINTS, :])
    inside = (xp.abs(aside) < _BREADTH) & (depth < _BEYOND)
    low, high = xp.where(inside, along, xp.inf).min(-1), xp.where(inside, along, -xp.inf).max(-1)
    return xp.maximum(high - low, 0.0)


def _offsets(headings: Headings, points: Any) -> tuple[Any, Any, Any]:
    """Surface points (..., P, 3) along the axes w, v x w and v of headings (..., H, 3): (..., H, P) m each."""
    aside = headings.position.__array_namespace__().cross(headings.direction, headings.cross)
    along, aside, depth = (
        axis @ points.mT - (axis * headings.position).sum(-1)[..., None]
        for axis in (headings.cross, aside, headings.direction)
    )
    return along, aside, depth


def max_width(outline: Outline, scale: float) -> float:
    """Metres, the widest that an object may be for a hand: the paper's 12 cm times its scale, or what it opens to."""
    return min(scale * MAX_WIDTH, float(outline.openings[0]) - 2 * _SKIN)


def above(headings: Headings, rest_pose: np.ndarray, cone: float = np.radians(30)) -> np.ndarray:
    """(H,) bool, which directions are within `cone` (rad) of straight down for an object in a resting pose (7,)."""
    return headings.direction @ matrix(rest_pose[3:])[2] <= -np.cos(cone)


def _room(
    headings: Headings, rest_pose: np.ndarray, outline: Outline, width: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """Heights (H,) of the hand over the table at the positions, and z of the directions."""
    up = matrix(rest_pose[3:])[2]
    height = headings.position @ up + rest_pose[2]
    direction_z, cross_z = headings.direction @ up, headings.cross @ up
    local = np.stack([direction_z, cross_z, np.cross(headings.direction, headings.cross) @ up], -1)
    below = depth_below(outline, local)
    wide = outline.openings[:, None] >= np.broadcast_to(width, height.shape) + 2 * _MARGIN
    wide[0] = True  # no pose is wider
    return height - np.where(wide, below, np.inf).min(0), direction_z


def _in_cone(axes: np.ndarray, cone: float, rng: np.random.Generator) -> np.ndarray:
    """Unit vectors (N, 3), uniform in the cone (rad) around each axis (N, 3)."""
    cosine = rng.uniform(np.cos(cone), 1.0, len(axes))
    side, other = _frame(axes)
    around = _spin(side, other, rng.uniform(0, 2 * np.pi, len(axes)))
    return (cosine[:, None] * axes + np.sqrt(1 - cosine**2)[:, None] * around).astype(np.float32)


def _frame(axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (N, 3) that are orthogonal to each axis (N, 3) and to one another."""
    side = np.cross(axes, np.eye(3, dtype=axes.dtype)[np.abs(axes).argmin(-1)])
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    return side, np.cross(axes, side)


def _spin(side: np.ndarray, other: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Unit vectors at an angle (rad) from the first towards the second of two orthogonal ones."""
    return np.cos(turn)[..., None] * side + np.sin(turn)[..., None] * other


def _roll(
    surface: _Surface, position: np.ndarray, direction: np.ndarray, rng: np.random.Generator, *, opposed: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Cross-finger axes (N, 3), one of a few evenly spaced rolls each, and the object's local widths (N,) along them.

    The width is infinite where the fingers would meet the avoid region first, or find nothing to press on.

    Args:
      surface: of the object.
      position: (N, 3) heading positions.
      direction: (N, 3).
      rng: draws the rolls.
      opposed: requires surfaces to press on from both sides.
    """
    side, other = _frame(direction)
    turn = rng.uniform(0, np.pi, len(direction))[:, None] + np.pi / _ROLLS * np.arange(_ROLLS)
    axes = _spin(side[:, None], other[:, None], turn).astype(np.float32)
    points, normals, avoid = surface.some(slice(_WIDTH_POINTS))
    along = (axes.reshape(-1, 3) @ points.T).reshape(*turn.shape, len(points))
    along -= (axes * position[:, None]).sum(-1, keepdims=True)
    depth = (direction @ points.T - (direction * position).sum(-1, keepdims=True))[:, None]
    # The slab's other axis is the roll a right angle further on: with the rolls spread over a half turn, the one
    # half of them later (the sign does not matter).
    slab = np.abs(np.roll(along, -_ROLLS // 2, 1)) < _BREADTH
    low, high = _extent(along, slab & (depth < _BEYOND))
    width = high - low
    if avoid.any():
        width[~_region_first(along, slab, depth, avoid)[1]] = np.inf
    if opposed:
        width[~_pressable(along, slab & (depth < _BEYOND) & ~avoid, axes @ normals.T)] = np.inf
    # Gumbel's trick draws a roll with probability exp(-width / preference).
    pick = (rng.gumbel(size=width.shape) - width / _PREFERENCE).argmax(-1)
    rows = np.arange(len(width))
    sign = rng.choice(np.array([-1.0, 1.0], np.float32), len(width))
    return sign[:, None] * axes[rows, pick], width[rows, pick]


def _pressable(along: np.ndarray, between: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """(...,) bool, true where both sides of what lies between closing fingers have a surface to press on.

    Args:
      along: (..., P) m, surface points along the cross-finger axis.
      between: (..., P) bool, points that the fingers sweep and may touch.
      facing: (..., P) cosines of the outward normals with the axis.
    """
    low, high = (extreme[..., None] for extreme in _extent(along, between))
    below = between & (along < low + _SIDE) & (facing < -_OPPOSED)
    above = between & (along > high - _SIDE) & (facing > _OPPOSED)
    return below.any(-1) & above.any(-1)


def _region_first(
    along: np.ndarray, slab: np.ndarray, depth: np.ndarray, avoid: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Extent (...,) of the graspable region between closing fingers, and (...,) bool whether they meet it first.

    Args:
      along: (..., P) m, surface points along the cross-finger axis.
      slab: (..., P) bool, within the hand's breadth.
      depth: (..., P) m, beyond the heading position.
      avoid: (P,) bool, the avoid region.
    """
    low, high = _extent(along, slab & (depth < _BEYOND) & ~avoid)
    low_avoid, high_avoid = _extent(along, slab & (depth < _BEYOND + _MARGIN) & avoid)
    return (low, high), ~((low_avoid < low + _MARGIN / 2) | (high_avoid > high - _MARGIN / 2))


def _extent(along: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest (...,) of coordinates (..., P) where `which` (..., P) is true."""
    return np.where(which, along, np.inf).min(-1), np.where(which, along, -np.inf).max(-1)


def _faults(
    points: np.ndarray, avoid: np.ndarray, position: np.ndarray, direction: np.ndarray, inward: float, back_off: float
) -> np.ndarray:
    """(N,) how many of the rules on occlusion and on the avoid region each approach breaks."""
    depth = direction @ points.T - (direction * position).sum(-1, keepdims=True)
    squared = (points**2).sum(-1) + (position**2).sum(-1, keepdims=True) - 2 * (position @ points.T)
    aside = squared - depth**2
    before = (depth < -inward - 1.5 * _TUBE) & (depth > -back_off - inward)
    faults = ((aside < _TUBE**2) & before).any(-1).astype(int)
    if avoid.any():
        past = depth - depth.clip(-back_off, 0.0)
        near = (aside + past**2)[:, avoid].min(-1) < _MARGIN**2
        ends_near = squared[:, avoid].min(-1) < squared[:, ~avoid].min(-1, initial=np.inf)
        faults += near | ends_near
    return faults
