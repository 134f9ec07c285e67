"""Samples the heading set of an object by the rules of `common.task.sampling.headings`."""

import dataclasses
from typing import NamedTuple

import numpy as np

from congrasp.common.errors import TooWideError
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.sampling.headings import (
    AVOID_MARGIN,
    BACK_OFF,
    INWARD,
    MAX_WIDTH,
    SLAB_HALF_BREADTH,
    WIDTH_POINTS,
    Headings,
    Slab,
    extent,
    local_width,
    meets_graspable_first,
    pressable,
)

_COUNT = 256
"""Headings of an object."""
_CONE = np.radians(30)
"""Half angle of the cone of directions around the inward normal, rad."""
_TUBE_RADIUS = 0.01
"""Radius around the approach that must be free in front of the surface point, m."""
_LEAST_FACING_COSINE = 0.5
"""Least cosine between a surface's inward normal and a prescribed direction."""
_ROLLS = 4
"""Rolls of a candidate, evenly spaced."""
_BATCH = 320
"""Candidates of a batch."""
_LAST_RESORT = 20
"""Most candidates that remain if all violate a rule."""
_PREFERENCE = 0.015
"""Width by which a roll becomes e times less likely, m."""
_FEW = 16
"""Different headings of a graspable region below which others at half the depth are tried."""


@dataclasses.dataclass(frozen=True)
class HeadingOptions:
    """Options of `sample_headings`."""

    count: int = _COUNT
    """Number of headings H."""
    inward: float = INWARD
    """Distance from the surface point to the heading position, m."""
    max_width: float = MAX_WIDTH
    """Largest local width, m."""
    attempts: int = 6
    """Batches of candidates."""
    along: np.ndarray | None = None
    """(3,) unit, prescribed direction of all headings; surface points that face it are used. None
    draws directions.
    """
    at: np.ndarray | None = None
    """(3,) prescribed position of all headings, m. None draws positions."""
    opposed: bool = True
    """Requires opposing surfaces to press on; False applies only the paper's rules."""
    lenient: bool = False
    """Accepts candidates whose approach clears the avoid region, if fingers that close on the
    graspable region always meet the other one, as on a small handle.
    """


_DEFAULTS = HeadingOptions()


def sample_headings(
    obj: GraspObject,
    rng: np.random.Generator,
    *,
    use_affordance: bool,
    options: HeadingOptions = _DEFAULTS,
) -> Headings | None:
    """Samples an object's heading set by the rules of `common.task.sampling.headings`.

    Behind a small handle there is no room for fingertips: if fewer than 16 headings of a graspable
    region remain after `attempts` batches, others with half the `inward` are tried. Fewer than
    `count` are repeated. If none remains on the whole surface, the result consists of the narrowest
    of the candidates that violate the fewest rules; they satisfy the first one.

    Args:
      obj: the object.
      rng: random generator.
      use_affordance: restricts the headings to the graspable region.
      options: lengths of the rules, prescribed axes and number of headings.

    Returns:
      H headings, float32; None if the graspable region cannot be approached.

    Raises:
      TooWideError: the object is wider than `max_width` wherever it can be approached.
    """
    avoid = obj.non_graspable_points & use_affordance
    surface = _Surface(obj.points.astype(np.float32), obj.normals.astype(np.float32), avoid)
    sampler = _Sampler(obj, surface, _sources(obj, avoid, options.along), options, rng)
    pool, last_batch = sampler.sample(options.inward)
    if avoid.any() and _different(pool) < _FEW:
        shallow, _ = sampler.sample(options.inward / 2)
        pool = max(pool, shallow, key=_different)
    if not len(pool.position):
        last_resort = _last_resort(surface, last_batch, rng, lenient=options.lenient)
        if last_resort is None:
            return None
        pool = _narrowest(last_resort, obj.name, surface, options.max_width)
    chosen = np.resize(np.arange(len(pool.position)), options.count)
    return Headings(*[part[chosen].astype(np.float32) for part in pool])


def _narrowest(headings: Headings, name: str, surface: "_Surface", max_width: float) -> Headings:
    """Returns the headings whose local width is allowed, or the narrowest ones.

    Raises:
      TooWideError: the object is wider than `max_width` at all headings for its whole surface.
    """
    width = local_width(headings, surface.points)
    if not surface.avoid.any() and width.min() > max_width:
        raise TooWideError(name, width.min(), max_width)
    narrow = width <= max(max_width, width.min())
    return Headings(*[part[narrow] for part in headings])


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
        sources = sources[facing >= min(_LEAST_FACING_COSINE, facing.max())]
    return sources


class _Surface(NamedTuple):
    """P surface points, of which the first cover the surface."""

    points: np.ndarray
    """(P, 3) m."""
    normals: np.ndarray
    """(P, 3) unit, outward."""
    avoid: np.ndarray
    """(P,) bool, the avoid region."""

    def selected(self, index: np.ndarray | slice) -> "_Surface":
        """Selected points."""
        return _Surface(self.points[index], self.normals[index], self.avoid[index])


class _Candidates(NamedTuple):
    """N candidates without axes, sorted by the number of rules that each violates."""

    position: np.ndarray
    """(N, 3) m."""
    direction: np.ndarray
    """(N, 3) unit."""
    faults: np.ndarray
    """(N,) number of violated rules on occlusion and on the avoid region, ascending."""

    def clean(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions and directions of the candidates that violate no rule."""
        count = int((self.faults == 0).sum())
        return self.position[:count], self.direction[:count]


class _Sampler(NamedTuple):
    """Draws candidates for an object in batches."""

    obj: GraspObject
    surface: _Surface
    """The object's surface."""
    sources: np.ndarray
    """Indices of the surface points that candidates approach."""
    options: HeadingOptions
    rng: np.random.Generator

    def sample(self, depth: float) -> tuple[Headings, _Candidates]:
        """Draws at most `attempts` batches at a depth in m, until `count` headings satisfy the
        rules.

        Returns:
          These headings, and the candidates of the last batch.
        """
        batches: list[Headings] = []
        for _ in range(self.options.attempts):
            candidates = self._candidates(depth)
            position, direction = candidates.clean()
            cross, width = _roll(
                self.surface, position, direction, self.rng, opposed=self.options.opposed
            )
            narrow = np.flatnonzero(width <= self.options.max_width)
            batches.append(Headings(position[narrow], direction[narrow], cross[narrow]))
            if sum(len(batch.position) for batch in batches) >= self.options.count:
                break
        headings = Headings(*[np.concatenate(parts) for parts in zip(*batches, strict=True)])
        return headings, candidates

    def _candidates(self, depth: float) -> _Candidates:
        """Draws a batch at a depth in m, and sorts it by violated rules."""
        source = self.rng.choice(self.sources, _BATCH)
        direction = _in_cone(-self.obj.normals[source], _CONE, self.rng)
        if self.options.along is not None:
            direction = np.broadcast_to(np.float32(self.options.along), direction.shape)
        position = self.surface.points[source] + np.float32(depth) * direction
        if self.options.at is not None:
            position = np.broadcast_to(np.float32(self.options.at), position.shape)
        faults = _faults(self.surface, position, direction, depth)
        order = faults.argsort(kind="stable")
        return _Candidates(position[order], direction[order], faults[order])


def _last_resort(
    surface: _Surface, candidates: _Candidates, rng: np.random.Generator, *, lenient: bool
) -> Headings | None:
    """Headings among candidates that all violate a rule, see `sample_headings`."""
    if surface.avoid.any():
        position, direction = candidates.clean()
        if not lenient or not len(position):
            return None
        graspable = surface.selected(~surface.avoid)
        cross, _ = _roll(graspable, position, direction, rng, opposed=False)
        return Headings(position, direction, cross)
    position = candidates.position
    direction = candidates.direction
    cross, width = _roll(surface, position, direction, rng, opposed=False)
    # Faults are integers and a width in metres is below one: their sum sorts by faults first.
    best = (candidates.faults + width).argsort(kind="stable")[:_LAST_RESORT]
    return Headings(position[best], direction[best], cross[best])


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
    points, normals, avoid = surface.selected(slice(WIDTH_POINTS))
    axes = _rolls(direction, rng)
    slab = _slab_of_rolls(points, position, direction, axes)
    low, high = extent(slab.along, slab.swept())
    width = high - low
    if avoid.any():
        width[~meets_graspable_first(slab, avoid)] = np.inf
    if opposed:
        touchable = slab.swept() & ~avoid
        width[~pressable(slab.along, touchable, axes @ normals.T)] = np.inf
    # Gumbel's trick samples a roll with probability exp(-width / preference).
    roll = (rng.gumbel(size=width.shape) - width / _PREFERENCE).argmax(-1)
    rows = np.arange(len(width))
    sign = rng.choice(np.array([-1.0, 1.0], np.float32), len(width))
    return sign[:, None] * axes[rows, roll], width[rows, roll]


def _rolls(direction: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Cross-finger axes (N, R, 3) of evenly spaced rolls, the first of which is random."""
    side, other = _frame(direction)
    first = rng.uniform(0, np.pi, len(direction))[:, None]
    turn = first + np.pi / _ROLLS * np.arange(_ROLLS)
    return _spin(side[:, None], other[:, None], turn).astype(np.float32)


def _slab_of_rolls(
    points: np.ndarray, position: np.ndarray, direction: np.ndarray, axes: np.ndarray
) -> Slab:
    """Surface points (P, 3) along the axes of N headings with R rolls (N, R, 3): (N, R, P)."""
    along = (axes.reshape(-1, 3) @ points.T).reshape(*axes.shape[:-1], len(points))
    along -= (axes * position[:, None]).sum(-1, keepdims=True)
    depth = direction @ points.T - (direction * position).sum(-1, keepdims=True)
    # The slab's other axis is the roll a right angle further on: for rolls spread over a half turn,
    # the one half of them later (the sign does not matter).
    in_breadth = np.abs(np.roll(along, -_ROLLS // 2, 1)) < SLAB_HALF_BREADTH
    return Slab(along, in_breadth, depth[:, None])


def _faults(
    surface: _Surface, position: np.ndarray, direction: np.ndarray, inward: float
) -> np.ndarray:
    """Number (N,) of rules on occlusion and on the avoid region violated by each approach."""
    points = surface.points
    avoid = surface.avoid
    depth = direction @ points.T - (direction * position).sum(-1, keepdims=True)
    squared = (points**2).sum(-1) + (position**2).sum(-1, keepdims=True) - 2 * (position @ points.T)
    from_line = squared - depth**2
    before = (depth < -inward - 1.5 * _TUBE_RADIUS) & (depth > -BACK_OFF - inward)
    faults = ((from_line < _TUBE_RADIUS**2) & before).any(-1).astype(int)
    if avoid.any():
        past = depth - depth.clip(-BACK_OFF, 0.0)
        near = (from_line + past**2)[:, avoid].min(-1) < AVOID_MARGIN**2
        to_graspable = squared[:, ~avoid].min(-1, initial=np.inf)
        ends_near = squared[:, avoid].min(-1) < to_graspable
        faults += near | ends_near
    return faults
