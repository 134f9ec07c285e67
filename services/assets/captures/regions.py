"""Graspable regions of captured objects: the parts or the points that fingers touch."""

from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import safe_name
from congrasp.common.objects.spec import GraspObject
from congrasp.services.assets.captures.extract import Demonstration
from congrasp.services.assets.captures.sequence import Dropped, Sequence
from congrasp.services.assets.objects.affordance import (
    SmallRegionError,
    near_points,
    relabelled,
)
from congrasp.services.assets.objects.assembly import UNLABELLED

Affordance = Literal["auto", "parts", "contacts", "none"]
"""Graspable region of a captured object.

- parts: the labelled parts that fingers touch;
- contacts: the surface around the touched points;
- none: the whole surface;
- auto: as parts if the object has labelled parts, else the whole surface.
"""
CONTACT_RADIUS_M = 0.03
"""Surface points within this distance of a touched point are graspable (`contacts`)."""
_MIN_CONTACT_POINTS = 3
"""Contact points that make a part of an object graspable."""


class _Part(NamedTuple):
    """A labelled part of an object."""

    name: str
    points: np.ndarray
    """(n, 3) in the object frame, m."""


class _Partition(NamedTuple):
    """P parts of an object, each in the graspable region or not."""

    object_name: str
    """Name of the object with these parts."""
    part_names: list[str]
    graspable: list[bool]
    """(P,) True for parts of the graspable region."""
    labels: np.ndarray
    """(512,) int: part of each surface point of the object."""


def with_touched_region(
    sequence: Sequence, obj: GraspObject, demonstration: Demonstration, affordance: Affordance
) -> GraspObject:
    """Returns the object with the graspable and the avoid region of a grasp.

    It gets a name that differs from the object's, unless its whole surface is graspable.

    Args:
      sequence: the captured sequence.
      obj: its object.
      demonstration: the grasp.
      affordance: the graspable region.

    Raises:
      Dropped: the object has no labelled parts, or too small a region is touched.
    """
    parts = _labelled_parts(sequence, obj)
    if affordance == "none" or (affordance == "auto" and not parts):
        return obj
    if affordance == "contacts":
        partition = _partition_by_contacts(sequence, obj, demonstration)
    else:
        partition = _partition_by_parts(sequence, obj, demonstration, parts)
    try:
        return relabelled(
            obj,
            partition.labels,
            partition.part_names,
            partition.graspable,
            partition.object_name,
        )
    except SmallRegionError as error:
        reason = str(error).split(". ")[0]
        raise Dropped(sequence.name, "graspable region too small", reason) from None
    except CongraspError as error:
        raise Dropped(sequence.name, "unusable region", str(error)) from None


def _partition_by_contacts(
    sequence: Sequence, obj: GraspObject, demonstration: Demonstration
) -> _Partition:
    """Partition into the surface around touched points, and the rest."""
    is_near_contact = near_points(obj, demonstration.contact, CONTACT_RADIUS_M)
    return _Partition(
        object_name=safe_name(f"{obj.name}-{sequence.name}"),
        part_names=["grasp", "avoid"],
        graspable=[True, False],
        labels=np.where(is_near_contact, 0, 1),
    )


def _partition_by_parts(
    sequence: Sequence, obj: GraspObject, demonstration: Demonstration, parts: list[_Part]
) -> _Partition:
    """Partition into the labelled parts; those with enough contact points are graspable.

    Raises:
      Dropped: there is no part, or none is touched.
    """
    if not parts:
        raise Dropped(
            sequence.name,
            "no labelled parts",
            f"the parts of '{sequence.object_name}' are not labelled",
        )
    contact_parts = _nearest(parts, demonstration.contact)
    contact_counts = np.bincount(contact_parts, minlength=len(parts))
    graspable = [bool(count >= _MIN_CONTACT_POINTS) for count in contact_counts]
    if not any(graspable):
        most = contact_counts.max()
        reason = f"fingers touch no part in {_MIN_CONTACT_POINTS} points ({most} at most)"
        raise Dropped(sequence.name, "no part touched", reason)
    object_name = obj.name
    if not all(graspable):
        touched = []
        for part, is_graspable in zip(parts, graspable, strict=True):
            if is_graspable:
                touched.append(part.name)
        object_name = safe_name("-".join([obj.name, *touched]))
    return _Partition(
        object_name=object_name,
        part_names=[part.name for part in parts],
        graspable=graspable,
        labels=_nearest(parts, obj.points),
    )


def _labelled_parts(sequence: Sequence, obj: GraspObject) -> list[_Part]:
    """The parts labelled by the data set, or by the object's files."""
    if sequence.parts:
        return [_Part(part.name, part.points + obj.origin) for part in sequence.parts]
    if obj.part_names == UNLABELLED:
        return []
    return [_Part(name, obj.points[obj.labels == i]) for i, name in enumerate(obj.part_names)]


def _nearest(parts: list[_Part], points: np.ndarray) -> np.ndarray:
    """Indices (n,) of the part nearest to each point (n, 3)."""
    if len(points) == 0:
        return np.zeros(0, int)
    distances = [cKDTree(part.points).query(points)[0] for part in parts]
    return np.argmin(distances, axis=0)
