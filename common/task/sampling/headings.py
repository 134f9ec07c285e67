"""Heading sets: directions and positions from which a hand may approach an object (paper, section
Constraint Setup).

The heading position is a few centimetres inward from a surface point of the graspable region (or of
the whole surface), along a direction in the cone around its inward normal. The cross-finger axis is
drawn from a few random rolls, preferring narrow ones. A candidate is rejected if

* the object's local width along the cross-finger axis exceeds the limit; it is measured on the
  surface points that the closing fingers sweep (3 cm to both sides of the hand's middle plane, down
  to 1 cm beyond the position);
* there are no opposing surfaces: among the points of that slab, within 1.5 cm of either end of the
  width, one whose normal is within 45 degrees of the axis (ours: at friction 1, two fingers that
  press along the axis slip off anything steeper, such as two edges of a board's corner);
* another part of the object is in front of the surface point (the point would not be hit first);
* with affordance, the approach comes within 1 cm of the avoid region, or the position lies nearer
  to it than to the graspable one, or it is as wide as that where the fingers close, so that they
  would meet it first (ours: the paper's regions were held by humans, so they can be held).
"""

from typing import Any, NamedTuple

import numpy as np

from congrasp.common.errors import TooWideError
from congrasp.common.hands.closure import CENTER, Outline, depth_below
from congrasp.common.objects.shapes import matrix
from congrasp.common.objects.spec import GraspObject

COUNT = 256
"""Headings of an object."""
INWARD = 0.02
"""Distance from the surface to the heading position along the heading direction, m."""
MAX_WIDTH = 0.12
"""Greatest width of the object along the cross-finger axis, m."""
BACK_OFF = 0.15
"""Distance from the heading position back to the start of the approach, m."""
_SKIN = 0.004  # m by which the widest pose exceeds the object on either side
# Half the breadth of the slab in which the local width is measured: a hand is about 6 cm broad
_BREADTH = 0.03
_BEYOND = 0.01  # the slab ends this far beyond the heading position, at the fingertips
_FINGER = 0.012  # thickness of a thin finger that closes from below
# Depth of an object's side along the cross-finger axis, in which fingertips need a surface
_SIDE = 0.015
_CONE = np.radians(30)  # half angle of the cone of directions around the inward normal, rad
# Least cosine of a normal with the cross-finger axis: edge of the cone of friction 1
_OPPOSED = np.cos(np.arctan(1.0))
_TUBE = 0.01  # radius around the approach that must be free in front of the surface point
# Distance of an approach from the avoid region; closing fingers of this thickness must not meet
# it
_MARGIN = 0.01
# Greatest distance back from the table: to a hand whose centre is 5 mm inside the surface
_BACK = 0.015
_FARTHEST_BACK = 0.03  # the same for objects without an alternative: to 1 cm over the surface
_RISE = 0.1  # largest upward component of a direction
_FACING = 0.5  # least cosine between a surface's inward normal and a prescribed direction
_ROLLS = 4
_BATCH = 320
_PREFERENCE = 0.015  # m of width by which a roll becomes e times less likely
_WIDTH_POINTS = 256
_FEW = (
    16  # different headings of a graspable region, below which others at half the depth are tried
)


class Headings(NamedTuple):
    """H headings in the object frame."""

    position: np.ndarray
    """(H, 3) p-bar, target of the hand centre, m."""
    direction: np.ndarray
    """(H, 3) v-bar, unit: direction of the hand's motion, into the surface."""
    cross: np.ndarray
    """(H, 3) unit, orthogonal to the direction: along the hand's cross-finger axis w."""


def sample_headings(  # noqa: PLR0913
    obj: GraspObject,
    rng: np.random.Generator,
    *,
    use_affordance: bool,
    lenient: bool = False,
    count: int = COUNT,
    inward: float = INWARD,
    max_width: float = MAX_WIDTH,
    attempts: int = 6,
    along: np.ndarray | None = None,
    at: np.ndarray | None = None,
    opposed: bool = True,
) -> Headings | None:
    """Samples an object's heading set by the module's rules.

    Behind a small handle there is no room for fingertips: if fewer than 16 headings of a graspable
    region remain after `attempts` batches, others with half the `inward` are tried. Fewer than
    `count` are repeated. If none remains on the whole surface, the result consists of the narrowest
    of the candidates that violate the fewest rules; they satisfy the first one.

    Args:
      obj: the object.
      rng: random generator.
      use_affordance: restricts the headings to the graspable region.
      lenient: if fingers that close on the graspable region always meet the other one, as on a
        small handle, accepts candidates whose approach clears the avoid region.
      count: number of headings H.
      inward: metres from the surface point to the heading position.
      max_width: largest local width, m.
      attempts: batches of candidates.
      along: (3,) unit, prescribed direction of all headings; surface points that face it are used.
        None draws directions.
      at: (3,) prescribed position of all headings, m. None draws positions.
      opposed: requires opposing surfaces to press on; False applies only the paper's rules.

    Returns:
      H headings, float32; None if the graspable region cannot be approached.

    Raises:
      TooWideError: the object is wider than `max_width` wherever it can be approached.
    """
    avoid = obj.non_graspable_points & use_affordance
    surface = _Surface(obj.points.astype(np.float32), obj.normals.astype(np.float32), avoid)
    sampler = _Sampler(
        obj, surface, _sources(obj, avoid, along), along, at, max_width, opposed, rng
    )
    pool, drawn, faults = sampler.sample(inward, count, attempts)
    if avoid.any() and _different(pool) < _FEW:
        pool = max(pool, sampler.sample(inward / 2, count, attempts)[0], key=_different)
    if not len(pool.position):
        last = _last_resort(surface, drawn.position, drawn.direction, faults, rng, lenient=lenient)
        if last is None:
            return None
        width = local_width(last, surface.points)
        if not avoid.any() and width.min() > max_width:
            raise TooWideError(obj.name, width.min(), max_width)
        pool = Headings(*(part[width <= max(max_width, width.min())] for part in last))
    chosen = np.resize(np.arange(len(pool.position)), count)
    return Headings(*(part[chosen].astype(np.float32) for part in pool))


def _different(headings: Headings) -> int:
    """Number of different headings, up to `_FEW`."""
    return min(len(np.unique(headings.position, axis=0)), _FEW)


def _sources(obj: GraspObject, avoid: np.ndarray, along: np.ndarray | None) -> np.ndarray:
    """Indices of the surface points for headings: outside the avoid region, and facing the
    prescribed direction.
    """
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


class _Sampler(NamedTuple):
    """Draws candidates for an object in batches; the fields are arguments of `sample_headings`, but
    for two.
    """

    obj: GraspObject
    surface: _Surface
    """The object's surface."""
    sources: np.ndarray
    """Indices of the surface points that candidates approach."""
    along: np.ndarray | None
    at: np.ndarray | None
    max_width: float
    opposed: bool
    rng: np.random.Generator

    def sample(
        self, depth: float, count: int, attempts: int
    ) -> tuple[Headings, Headings, np.ndarray]:
        """Draws at most `attempts` batches at a depth in m, until `count` headings satisfy the
        rules.

        Returns:
          These headings, and the candidates (N, 3) of the last batch, without axes, with the number
          (N,) of rules that each violates, ascending.
        """
        found: list[Headings] = []
        for _ in range(attempts):
            drawn = self._draw(depth)
            faults = _faults(
                self.surface.points,
                self.surface.avoid,
                drawn.position,
                drawn.direction,
                depth,
                BACK_OFF,
            )
            order = faults.argsort(kind="stable")
            drawn, faults = Headings(*(part[order] for part in drawn)), faults[order]
            clean = int((faults == 0).sum())
            position, direction = drawn.position[:clean], drawn.direction[:clean]
            cross, width = _roll(self.surface, position, direction, self.rng, opposed=self.opposed)
            good = np.flatnonzero(width <= self.max_width)
            found.append(Headings(position[good], direction[good], cross[good]))
            if sum(len(part.position) for part in found) >= count:
                break
        return (
            Headings(*(np.concatenate(parts) for parts in zip(*found, strict=True))),
            drawn,
            faults,
        )

    def _draw(self, depth: float) -> Headings:
        """Positions and directions (N, 3) of a batch; the axes are still missing."""
        source = self.rng.choice(self.sources, _BATCH)
        direction = _in_cone(-self.obj.normals[source], _CONE, self.rng)
        if self.along is not None:
            direction = np.broadcast_to(np.float32(self.along), direction.shape)
        position = self.surface.points[source] + np.float32(depth) * direction
        if self.at is not None:
            position = np.broadcast_to(np.float32(self.at), position.shape)
        return Headings(position, direction, direction)


def _last_resort(
    surface: _Surface,
    position: np.ndarray,
    direction: np.ndarray,
    faults: np.ndarray,
    rng: np.random.Generator,
    *,
    lenient: bool,
) -> Headings | None:
    """Headings among candidates (N, 3) that all violate a rule, see `sample_headings`; `faults`
    (N,) ascend.
    """
    if surface.avoid.any():
        clean = int((faults == 0).sum())
        if not (lenient and clean):
            return None
        cross, _ = _roll(
            surface.some(~surface.avoid), position[:clean], direction[:clean], rng, opposed=False
        )
        return Headings(position[:clean], direction[:clean], cross)
    cross, width = _roll(surface, position, direction, rng, opposed=False)
    # Faults are integers and a width in metres is below one: their sum sorts by faults first.
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

    Two centimetres into a flat object may be inside the table; moving back keeps such an object
    graspable from above. A heading that cannot be cleared is returned unchanged, and `feasible` is
    False for it.

    Args:
      headings: headings in the object frame.
      rest_pose: (7,) the object's pose, with the table's top at z = 0.
      outline: outline of the hand.
      width: (H,) widths in m, see `feasible`.
      farthest: greatest distance back, m.
    """
    room, direction_z = _room(headings, rest_pose, outline, width)
    needed = np.maximum(-room, 0.0) / np.maximum(-direction_z, 1e-6)
    back = np.where(needed <= farthest, needed, 0.0)
    # A micrometre more, so that rounding leaves no hand that just touches.
    back = np.where(back > 0, back + 1e-6, 0.0)
    return headings._replace(
        position=(headings.position - back[:, None] * headings.direction).astype(np.float32)
    )


def feasible(
    headings: Headings,
    rest_pose: np.ndarray,
    outline: Outline = CENTER,
    width: np.ndarray | float = 0.0,
) -> np.ndarray:
    """(H,) bool: headings that can be followed while the object rests on the table in a resting
    pose.

    The approach must come from above or level (its direction rises by at most 0.1 per metre), and
    the hand must be above the table at the heading position in one of the poses that are open wide
    enough for the object (`actors.initial` lifts the start of an approach over the table). All
    headings of a thin object may be infeasible: see `clear_table`.

    Args:
      headings: headings in the object frame.
      rest_pose: (7,) the object's pose, with the table's top at z = 0.
      outline: outline of the hand.
      width: (H,) widths of the object along the cross-finger axes (`local_width`), m.
    """
    room, direction_z = _room(headings, rest_pose, outline, width)
    return (direction_z <= _RISE) & (room >= 0)


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
    bare = np.zeros(len(obj.points), bool) if avoid is None else avoid
    ways = [(outline, _BACK), (outline, _FARTHEST_BACK), (CENTER, _FARTHEST_BACK)]
    for own, farthest in ways if avoid is None else ways[:2]:
        cleared = [clear_table(headings, rest, own, width, farthest) for rest in rest_poses]
        pairs = list(zip(cleared, rest_poses, strict=True))
        reachable = np.array([feasible(moved, rest, own, width) for moved, rest in pairs])
        if avoid is not None:
            reachable &= np.array([closes_on(moved, obj.points, avoid) for moved in cleared])
        if opposed:
            reachable &= np.array([opposed_at(moved, obj, bare) for moved in cleared])
            reachable &= np.array([_closed_over_table(moved, rest, width) for moved, rest in pairs])
        if reachable.any():
            break
    return cleared, reachable


def _closed_over_table(headings: Headings, rest_pose: np.ndarray, width: np.ndarray) -> np.ndarray:
    """(H,) bool, true where fingers that hold the local width (H,) along the cross-finger axis are
    over the table.
    """
    up = matrix(rest_pose[3:])[2]
    return headings.position @ up + rest_pose[2] > np.abs(headings.cross @ up) * (
        width / 2 + _FINGER
    )


def opposed_at(headings: Headings, obj: GraspObject, avoid: np.ndarray) -> np.ndarray:
    """(H,) bool, true where surfaces outside of the avoid region (P,) can be pressed on from both
    sides.
    """
    points, normals, avoid = (
        obj.points[:_WIDTH_POINTS],
        obj.normals[:_WIDTH_POINTS],
        avoid[:_WIDTH_POINTS],
    )
    along, aside, depth = _offsets(headings, points)
    return _pressable(
        along, (np.abs(aside) < _BREADTH) & (depth < _BEYOND) & ~avoid, headings.cross @ normals.T
    )


def closes_on(headings: Headings, points: np.ndarray, avoid: np.ndarray) -> np.ndarray:
    """(H,) bool, True where fingers that close at the position meet the graspable region, on both
    sides and first.

    The position is nearer to that region than to the avoid region, which along the cross-finger
    axis ends at least 5 mm farther inside (see the module's rules).

    Args:
      headings: headings in the object frame.
      points: (P, 3) surface points, of which the first 256 are used, m.
      avoid: (P,) bool, the avoid region.
    """
    points, avoid = points[:_WIDTH_POINTS], avoid[:_WIDTH_POINTS]
    along, aside, depth = _offsets(headings, points)
    (low, high), first = _region_first(along, np.abs(aside) < _BREADTH, depth, avoid)
    squared = along**2 + aside**2 + depth**2
    nearer = squared[:, ~avoid].min(-1, initial=np.inf) < squared[:, avoid].min(-1, initial=np.inf)
    return (high > low) & first & nearer


def local_width(headings: Headings, points: np.ndarray) -> np.ndarray:
    """Widths (..., H) in m of objects along the cross-finger axes where fingers close.

    The width is measured in the slab of the module's rules; it is 0 if the slab contains no surface
    point.

    Args:
      headings: headings with fields (..., H, 3), NumPy or JAX arrays.
      points: (..., P, 3) surface points, of which the first 256 are used, m.
    """
    xp = headings.position.__array_namespace__()
    along, aside, depth = _offsets(headings, points[..., :_WIDTH_POINTS, :])
    inside = (xp.abs(aside) < _BREADTH) & (depth < _BEYOND)
    low, high = xp.where(inside, along, xp.inf).min(-1), xp.where(inside, along, -xp.inf).max(-1)
    return xp.maximum(high - low, 0.0)


def _offsets(headings: Headings, points: Any) -> tuple[Any, Any, Any]:
    """Surface points (..., P, 3) along the axes w, v x w and v of headings (..., H, 3): (..., H, P)
    m each.
    """
    aside = headings.position.__array_namespace__().cross(headings.direction, headings.cross)
    along, aside, depth = (
        axis @ points.mT - (axis * headings.position).sum(-1)[..., None]
        for axis in (headings.cross, aside, headings.direction)
    )
    return along, aside, depth


def max_width(outline: Outline, scale: float) -> float:
    """Greatest width of an object for a hand, m: the paper's 12 cm times its scale, or the hand's
    opening.
    """
    return min(scale * MAX_WIDTH, float(outline.openings[0]) - 2 * _SKIN)


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
    """Two unit vectors (N, 3) that are orthogonal to each axis (N, 3) and to each other."""
    side = np.cross(axes, np.eye(3, dtype=axes.dtype)[np.abs(axes).argmin(-1)])
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    return side, np.cross(axes, side)


def _spin(side: np.ndarray, other: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Unit vectors at an angle (rad) from the first towards the second of two orthogonal ones."""
    return np.cos(turn)[..., None] * side + np.sin(turn)[..., None] * other


def _roll(
    surface: _Surface,
    position: np.ndarray,
    direction: np.ndarray,
    rng: np.random.Generator,
    *,
    opposed: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Cross-finger axes (N, 3), each drawn from a few evenly spaced rolls, and the object's widths
    (N,) along them.

    The width is infinite where the fingers would meet the avoid region first, or find nothing to
    press on.

    Args:
      surface: of the object.
      position: (N, 3) heading positions.
      direction: (N, 3) heading directions.
      rng: generator of the rolls.
      opposed: requires opposing surfaces to press on.
    """
    side, other = _frame(direction)
    turn = rng.uniform(0, np.pi, len(direction))[:, None] + np.pi / _ROLLS * np.arange(_ROLLS)
    axes = _spin(side[:, None], other[:, None], turn).astype(np.float32)
    points, normals, avoid = surface.some(slice(_WIDTH_POINTS))
    along = (axes.reshape(-1, 3) @ points.T).reshape(*turn.shape, len(points))
    along -= (axes * position[:, None]).sum(-1, keepdims=True)
    depth = (direction @ points.T - (direction * position).sum(-1, keepdims=True))[:, None]
    # The slab's other axis is the roll a right angle further on: for rolls spread over a half turn,
    # the one half of them later (the sign does not matter).
    slab = np.abs(np.roll(along, -_ROLLS // 2, 1)) < _BREADTH
    low, high = _extent(along, slab & (depth < _BEYOND))
    width = high - low
    if avoid.any():
        width[~_region_first(along, slab, depth, avoid)[1]] = np.inf
    if opposed:
        width[~_pressable(along, slab & (depth < _BEYOND) & ~avoid, axes @ normals.T)] = np.inf
    # Gumbel's trick samples a roll with probability exp(-width / preference).
    pick = (rng.gumbel(size=width.shape) - width / _PREFERENCE).argmax(-1)
    rows = np.arange(len(width))
    sign = rng.choice(np.array([-1.0, 1.0], np.float32), len(width))
    return sign[:, None] * axes[rows, pick], width[rows, pick]


def _pressable(along: np.ndarray, between: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """(...,) bool, true where both sides of what lies between closing fingers have a surface to
    press on.

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
    """Extent (...,) of the graspable region between closing fingers, and (...,) bool, True where
    they meet it first.

    Args:
      along: (..., P) coordinates of surface points along the cross-finger axis, m.
      slab: (..., P) bool, True within the hand's breadth.
      depth: (..., P) distance beyond the heading position, m.
      avoid: (P,) bool, the avoid region.
    """
    low, high = _extent(along, slab & (depth < _BEYOND) & ~avoid)
    low_avoid, high_avoid = _extent(along, slab & (depth < _BEYOND + _MARGIN) & avoid)
    return (low, high), ~((low_avoid < low + _MARGIN / 2) | (high_avoid > high - _MARGIN / 2))


def _extent(along: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Minimum and maximum (...,) of coordinates (..., P) selected by `which` (..., P)."""
    return np.where(which, along, np.inf).min(-1), np.where(which, along, -np.inf).max(-1)


def _faults(
    points: np.ndarray,
    avoid: np.ndarray,
    position: np.ndarray,
    direction: np.ndarray,
    inward: float,
    back_off: float,
) -> np.ndarray:
    """Number (N,) of rules on occlusion and on the avoid region violated by each approach."""
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
