"""Halves of an object without labelled parts, cut so that a hand can close on the graspable one."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from congrasp.common.hands.human import HUMAN
from congrasp.common.hands.outline import outline
from congrasp.common.objects.spec import GraspObject
from congrasp.common.objects.surface import halves
from congrasp.common.task.sampling.headings import max_width, sample_headings, within_reach
from congrasp.services.assets.objects.affordance import relabelled

_CUTS = (0.5, 0.65, 0.35, 0.8, 0.2)
"""Shares of the surface points on the near side of a cut, in the order in which they are tried."""
UNCOVERED = "none of its halves can be held without the other: it has no affordance"


def cut_to_hold(obj: GraspObject) -> GraspObject:
    """An object of two halves with the first partition that is covered in all resting poses, or in the most.

    Its current halves come first, then their exchange, then cuts across the longest axis that make the graspable half
    larger or smaller. If no half can be held in any resting pose, a note is added.
    """
    most = int(covered(obj, use_affordance=False).sum())
    best, score = obj, -1
    for candidate in _candidates(obj):
        found = int(covered(candidate).sum())
        if found > score:
            best, score = candidate, found
        if score >= most:
            break
    return best if score > 0 else dataclasses.replace(best, notes=(*best.notes, UNCOVERED))


def covered(obj: GraspObject, *, use_affordance: bool = True) -> np.ndarray:
    """(R,) bool, resting poses in which the human hand has a heading on the graspable region, or the whole surface."""
    hand = outline(HUMAN)
    found = sample_headings(
        obj, np.random.default_rng(0), use_affordance=use_affordance, max_width=max_width(hand, HUMAN.object_scale)
    )
    if found is None:
        return np.zeros(len(obj.rest_poses), bool)
    avoid = obj.non_graspable_points if use_affordance else None
    return np.asarray(within_reach(found, obj, obj.rest_poses, hand, avoid)[1].any(-1))


def _candidates(obj: GraspObject) -> Iterator[GraspObject]:
    """Yields the object with its current partition, then with others."""
    yield obj
    first = int(np.flatnonzero(obj.graspable)[0])
    for cut in _CUTS:
        labels = halves(obj.points, cut)
        for half in (first, 1 - first):
            if cut != 0.5 or half != first:
                yield relabelled(obj, labels, obj.part_names, [half == 0, half == 1])
