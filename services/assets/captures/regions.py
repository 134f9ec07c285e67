"""Graspable regions of captured objects: the parts or the points that fingers touch."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import safe_name
from congrasp.common.objects.spec import GraspObject
from congrasp.services.assets.captures.extract import Demonstration
from congrasp.services.assets.captures.sequence import Dropped, Sequence
from congrasp.services.assets.objects.affordance import near_points, relabelled, two_parts
from congrasp.services.assets.objects.assembly import UNLABELLED

Affordance = Literal["auto", "parts", "contacts", "none"]
_TOUCHED_RADIUS = 0.03
"""Radius around touched points that counts as touched, m."""
_MIN_CONTACT_POINTS = 3
"""Contact points that make a part of an object graspable."""


class _Part(NamedTuple):
    """A labelled part of an object."""

    name: str
    points: np.ndarray
    """(n, 3) in the object frame, m."""


def with_touched_region(
    sequence: Sequence, obj: GraspObject, demonstration: Demonstration, affordance: Affordance
) -> GraspObject:
    """Returns the object with a grasp's partition into graspable and avoid region.

    It has a name of its own, unless the whole object is graspable.

    Args:
      sequence: the captured sequence.
      obj: its object.
      demonstration: the grasp.
      affordance: see `build.Options`.

    Raises:
      Dropped: the object has no labelled parts, or too small a region is touched.
    """
    parts = _parts(sequence, obj)
    if affordance == "none" or (affordance == "auto" and not parts):
        return obj
    if affordance == "contacts":
        touched = near_points(obj, demonstration.contact, _TOUCHED_RADIUS)
        name = safe_name(f"{obj.name}-{sequence.name}")
        return _with_region(sequence, lambda: two_parts(obj, touched, name))
    if not parts:
        raise Dropped(
            sequence.name,
            "no labelled parts",
            f"the parts of '{sequence.object_name}' are not labelled",
        )
    counts = np.bincount(_nearest(parts, demonstration.contact), minlength=len(parts))
    graspable = [bool(count >= _MIN_CONTACT_POINTS) for count in counts]
    if not any(graspable):
        reason = f"fingers touch no part in {_MIN_CONTACT_POINTS} points ({counts.max()} at most)"
        raise Dropped(sequence.name, "no part touched", reason)
    names = [part.name for part in parts]
    name = obj.name
    if not all(graspable):
        touched_names = [name for name, touched in zip(names, graspable, strict=True) if touched]
        name = safe_name("-".join([obj.name, *touched_names]))
    labels = _nearest(parts, obj.points)
    return _with_region(sequence, lambda: relabelled(obj, labels, names, graspable, name))


def _parts(sequence: Sequence, obj: GraspObject) -> list[_Part]:
    """The parts labelled by the data set, or by the object's files."""
    if sequence.parts:
        return [_Part(part.name, part.points + obj.origin) for part in sequence.parts]
    if obj.part_names == UNLABELLED:
        return []
    return [_Part(name, obj.points[obj.labels == i]) for i, name in enumerate(obj.part_names)]


def _with_region(sequence: Sequence, make: Callable[[], GraspObject]) -> GraspObject:
    """The object of `make`; drops the sequence if its graspable region is too small."""
    try:
        return make()
    except CongraspError as error:
        reason = str(error).split(". ")[0]
        raise Dropped(sequence.name, "graspable region too small", reason) from None


def _nearest(parts: list[_Part], points: np.ndarray) -> np.ndarray:
    """Indices (n,) of the part nearest to each point (n, 3)."""
    if len(points) == 0:
        return np.zeros(0, int)
    distances = [cKDTree(part.points).query(points)[0] for part in parts]
    return np.argmin(distances, axis=0)
