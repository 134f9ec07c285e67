"""Headings of one object in its resting poses: its part of a constraint bank."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.closure import CENTER_ONLY, Outline
from congrasp.common.objects.spec import SURFACE_POINTS, GraspObject
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling.bank import feasible_indices
from congrasp.common.task.sampling.heading_sampler import HeadingOptions, sample_headings
from congrasp.common.task.sampling.headings import INWARD, Headings, max_width
from congrasp.common.task.sampling.reach import above, within_reach

HEADINGS = 256
"""H, headings of an object and region."""
POSES = 20
"""M, reference poses of an object and region."""


class _Regions(NamedTuple):
    """Headings of an object for the two regions of a bank (axis V)."""

    whole: Headings
    """Headings for the whole surface."""
    graspable: Headings | None
    """Headings for the graspable region; None if it is out of reach."""

    def both(self) -> list[Headings]:
        """Headings of V = 2 regions. The whole surface replaces a graspable region out of reach."""
        return [self.whole, self.graspable or self.whole]


class _Reach(NamedTuple):
    """Headings that a hand can follow in each of R resting poses."""

    cleared: list[list[Headings]]
    """(V, R) headings moved clear of the table."""
    reachable: np.ndarray
    """(V, R, H) bool: the heading is feasible."""
    too_flat: bool
    """True if no heading for the whole surface has opposing surfaces over the table."""


def headings_of(
    task: TaskConfig,
    obj: GraspObject,
    seed: tuple[int, int],
    prescribed: Headings | None = None,
    scale: float = 1.0,
    hand_outline: Outline = CENTER_ONLY,
) -> dict[str, np.ndarray]:
    """Computes headings and resting poses of one object; resting poses without a reachable heading
    are dropped.

    An object that lies too flat in all of them, such as a wide board, is given weight 0: no episode
    draws it.

    Args:
      task: geometry of the approach.
      obj: the object.
      seed: seed of the headings.
      prescribed: `HEADINGS` headings that replace sampled ones.
      scale: scale of the object; the lengths of the rules scale with it, so that a larger hand gets
        the headings of the smaller object.
      hand_outline: outline that must clear the table.

    Returns:
      Fields of `ConstraintBank` without the axis N, and `chosen_position`, `chosen_direction` and
      `chosen_cross` (V, M, 3): headings of the reference poses.

    Raises:
      CongraspError: the object is too wide (`TooWideError`), or cannot be approached in any of its
        resting poses.
    """
    rng = np.random.default_rng(seed)
    opposed = task.headings != "center" and prescribed is None
    if prescribed is not None:
        regions = _Regions(prescribed, prescribed)
    else:
        regions = _sample_regions(obj, rng, scale, hand_outline, opposed=opposed)
    # Captured headings may be off by a centimetre, but a hand did hold their objects.
    avoid = None
    if regions.graspable is not None and prescribed is None:
        avoid = obj.non_graspable_points
    reach = _reach(task, obj, regions, hand_outline, avoid, opposed=opposed)
    usable = np.flatnonzero(reach.reachable[0].any(-1))
    if len(usable) == 0:
        raise CongraspError(
            f"The object '{obj.name}' cannot be approached in any of its resting poses.",
            "Scale it or remove it.",
        )
    reachable = reach.reachable[:, usable]
    positions = _positions(reach.cleared, usable)
    references = _reference_headings(rng, regions.both(), positions, reachable)
    points = rng.permutation(SURFACE_POINTS)[: task.surface_points]
    avoid_labels = obj.non_graspable_points[points]
    index = feasible_indices(reachable)
    has_affordance = reachable[1].any(-1) & avoid_labels.any() & (regions.graspable is not None)
    return {
        "points": obj.points[points].astype(np.float32),
        "normals": obj.normals[points].astype(np.float32),
        "rest": obj.rest_poses[usable].astype(np.float32),
        **_prefixed("heading_", _stacked(regions.both())),
        "heading_back": _distances_back(regions, positions, index),
        **_prefixed("chosen_", references),
        "avoid": avoid_labels,
        "heading_index": index.astype(np.int32),
        "weight": np.float32(not reach.too_flat),
        "has_affordance": has_affordance,
    }


def _prefixed(prefix: str, headings: Headings) -> dict[str, np.ndarray]:
    """Arrays of headings by name, float32."""
    arrays = headings._asdict()
    return {f"{prefix}{name}": array.astype(np.float32) for name, array in arrays.items()}


def _stacked(parts: Sequence[Headings]) -> Headings:
    """Stacks headings along a new leading axis."""
    return Headings(*[np.stack(arrays) for arrays in zip(*parts, strict=True)])


def _sample_regions(
    obj: GraspObject,
    rng: np.random.Generator,
    scale: float,
    hand_outline: Outline,
    *,
    opposed: bool,
) -> _Regions:
    """Samples the headings of both regions, see `headings_of`."""
    options = HeadingOptions(
        count=HEADINGS,
        inward=scale * INWARD,
        max_width=max_width(hand_outline, scale),
        opposed=opposed,
    )
    all_surface = sample_headings(obj, rng, use_affordance=False, options=options)
    graspable = sample_headings(obj, rng, use_affordance=True, options=options)
    assert all_surface is not None, "only the graspable region may be unreachable"
    return _Regions(all_surface, graspable)


def _reach(
    task: TaskConfig,
    obj: GraspObject,
    regions: _Regions,
    hand_outline: Outline,
    avoid: np.ndarray | None,
    *,
    opposed: bool,
) -> _Reach:
    """Moves headings clear of the table and selects the feasible ones.

    Args:
      task: kind of headings.
      obj: the object.
      regions: headings of both regions.
      hand_outline: outline that must clear the table.
      avoid: (P,) bool, avoid region of sampled headings; None for captured ones, or without a
        graspable region.
      opposed: see `within_reach`.
    """
    outline = CENTER_ONLY if task.headings == "center" else hand_outline
    whole, graspable = regions.both()
    rests = obj.rest_poses
    cleared, reachable = within_reach(whole, obj, rests, outline, opposed=opposed)
    too_flat = not reachable.any()
    if too_flat:
        cleared, reachable = within_reach(whole, obj, rests, outline, opposed=False)
    graspable_cleared, graspable_reachable = within_reach(
        graspable, obj, rests, outline, avoid, opposed=opposed
    )
    both = np.stack([reachable, graspable_reachable])
    if task.headings == "above" and reachable.any():
        both = _steep_where_possible(both, regions, rests)
    return _Reach([cleared, graspable_cleared], both, too_flat)


def _steep_where_possible(
    reachable: np.ndarray, regions: _Regions, rests: np.ndarray
) -> np.ndarray:
    """(V, R, H) bool: reachable headings from above in each resting pose (R, 7).

    In a resting pose without such headings, all reachable headings.
    """
    steep = []
    for headings in regions.both():
        steep.append([above(headings, rest) for rest in rests])
    from_above = reachable & np.array(steep)
    return np.where(from_above.any(-1, keepdims=True), from_above, reachable)


def _positions(cleared: Sequence[Sequence[Headings]], rests: np.ndarray) -> np.ndarray:
    """Positions (V, R, H, 3) of headings moved clear of the table, in these resting poses (R,)."""
    positions = []
    for region in cleared:
        positions.append([region[rest].position for rest in rests])
    return np.array(positions)


def _distances_back(regions: _Regions, positions: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Distances (V, R, H) in m by which the headings of `index` (V, R, H) moved to `positions`."""
    before = np.array([headings.position for headings in regions.both()])
    back = np.linalg.norm(positions - before[:, None], axis=-1)
    return np.take_along_axis(back, index, -1).astype(np.float32)


def _reference_headings(
    rng: np.random.Generator,
    regions: Sequence[Headings],
    positions: np.ndarray,
    reachable: np.ndarray,
) -> Headings:
    """Headings (V, M, 3) of the references, drawn among those that are feasible.

    Args:
      rng: generator of the draws.
      regions: H headings for each of V regions.
      positions: (V, R, H, 3) their positions in each resting pose, m.
      reachable: (V, R, H) bool, feasible headings.
    """
    drawn = []
    for headings, position, allowed in zip(regions, positions, reachable, strict=True):
        rest, heading = _drawn_evenly(rng, allowed)
        drawn.append(
            Headings(position[rest, heading], headings.direction[heading], headings.cross[heading])
        )
    return _stacked(drawn)


def _drawn_evenly(rng: np.random.Generator, allowed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draws resting poses (M,) and headings (M,) of references, evenly over resting poses with a
    heading (R, H).

    If there is none, all headings are equally likely.
    """
    weights = allowed if allowed.any() else np.ones(allowed.shape)
    rests = np.flatnonzero(weights.any(1))
    rests = np.resize(rng.permutation(rests), POSES)
    headings = []
    for row in weights[rests]:
        headings.append(rng.choice(len(row), p=row / row.sum()))
    return rests, np.array(headings)
