"""Extracts a reference pose and a wrist trajectory from a captured sequence (paper, section
Constraint Setup).

The wrist-object distance is that of the wrist's origin from the nearest point of the object's
surface; `contact` and `approach` define the other terms.
"""

import dataclasses

import numpy as np

from congrasp.common.hands.files import HUMAN
from congrasp.common.objects.spec import GraspObject
from congrasp.services.assets.captures.approach import approach
from congrasp.services.assets.captures.contact import (
    CONTACT_DISTANCE_M,
    before_carried,
    first_contact,
    opposed_frame,
    skin_balls,
)
from congrasp.services.assets.captures.human import Fit, fit
from congrasp.services.assets.captures.sequence import Dropped, Sequence
from congrasp.services.assets.captures.surface import Surface

LIMIT_TOLERANCE_RAD = 0.1
"""Tolerance of a captured joint beyond its limits."""
_MAX_DISTANCE_M = 1.0
"""Wrist-object distance above which positions are taken not to be in metres."""
_FAR_AWAY_M = 1e3
"""Coordinate of a wrist in a missing frame, m."""


@dataclasses.dataclass(frozen=True)
class Demonstration:
    """Result of a sequence, in the object frame."""

    name: str
    frame: int
    """The grasping frame."""
    later: int
    """Frames between the first stable contact and the closed fingers."""
    start: int
    """The frame of the farthest distance."""
    fit: Fit
    """Finger angles of the `human` hand and residual, before clamping to the limits."""
    q: np.ndarray
    """(20,) finger angles within the limits."""
    position: np.ndarray
    """(K, 3) wrist waypoints from the far end; the last is the reference pose's."""
    quaternion: np.ndarray
    """(K, 4)."""
    contact: np.ndarray
    """(n, 3) points of the object's surface touched by fingers from stable contact on."""


def extract(
    sequence: Sequence,
    obj: GraspObject,
    surface: Surface,
    waypoints: int,
    beyond: float = LIMIT_TOLERANCE_RAD,
) -> Demonstration:
    """Extracts the reference pose and the trajectory of a sequence.

    Args:
      sequence: captured sequence.
      obj: its object; `origin` is the mesh file's origin.
      surface: surface of the object.
      waypoints: number K of waypoints.
      beyond: tolerance of a captured joint beyond its limits, rad; it is then clamped.

    Raises:
      Dropped: a rule excludes the sequence.
    """
    position, rotation = in_object_frame(sequence, obj)
    distance = _wrist_distance(sequence, surface, position)
    fingers = np.einsum("tij,tfkj->tfki", rotation, sequence.joints)
    skin = position[:, None, None] + fingers
    first = first_contact(sequence, surface, skin)
    touched = first
    frame = first
    if sequence.grasp is None:
        touched = opposed_frame(sequence, surface, skin, first)
        frame = before_carried(sequence, position, touched)
    path = approach(sequence.name, position, rotation, distance, sequence.present, frame, waypoints)
    finger_fit = _fit(sequence, frame)
    _check_limits(sequence.name, finger_fit.q, beyond)
    return Demonstration(
        name=sequence.name,
        frame=frame,
        later=touched - first,
        start=path.start,
        fit=finger_fit,
        q=np.clip(finger_fit.q, HUMAN.lower, HUMAN.upper),
        position=path.position,
        quaternion=path.quaternion,
        contact=surface.within(*skin_balls(skin[touched], CONTACT_DISTANCE_M)),
    )


def in_object_frame(sequence: Sequence, obj: GraspObject) -> tuple[np.ndarray, np.ndarray]:
    """Returns wrist positions (T, 3) and rotations (T, 3, 3) in the object frame."""
    to_object = np.swapaxes(sequence.object_rotation, -1, -2)
    offset = sequence.wrist_position - sequence.object_position
    position = np.einsum("tij,tj->ti", to_object, offset) + obj.origin
    return position, to_object @ sequence.wrist_rotation


def _wrist_distance(sequence: Sequence, surface: Surface, position: np.ndarray) -> np.ndarray:
    """(T,) distance of the wrist from the object's surface, m.

    Args:
      sequence: captured sequence.
      surface: surface of the object.
      position: (T, 3) positions of the wrist, object frame, m.

    Raises:
      Dropped: hand and object are never present together, or their positions are not in metres.
    """
    present = sequence.present
    distance = surface.distance(np.where(present[:, None], position, _FAR_AWAY_M))
    if not present.any():
        raise Dropped(sequence.name, "frames missing", "no frame has both the hand and the object")
    nearest = distance[present].min()
    if nearest > _MAX_DISTANCE_M:
        reason = (
            f"the wrist stays {nearest:.3g} m from the object: check that its positions are in "
            f"metres"
        )
        raise Dropped(sequence.name, "wrong units", reason)
    return distance


def _fit(sequence: Sequence, frame: int) -> Fit:
    """Finger angles of a frame: those of the capture, or fitted to its joints."""
    if sequence.q is not None:
        return Fit(np.asarray(sequence.q[frame], float), 0.0, 0.0)
    return fit(sequence.joints[frame])


def _check_limits(name: str, q: np.ndarray, beyond: float) -> None:
    """Drops a sequence whose joints exceed their limits by more than `beyond` rad."""
    excess = np.maximum(HUMAN.lower - q, q - HUMAN.upper)
    worst = int(excess.argmax())
    if excess[worst] > beyond:
        raise Dropped(
            name,
            "joint limits",
            f"{HUMAN.joints[worst].name} is {excess[worst]:.2f} rad beyond its limits",
        )
