"""Frames of a captured sequence in which fingers touch, grasp and carry an object.

Definitions of terms that the paper leaves open:

* contact: a finger's skin within `CONTACT_DISTANCE_M` of the surface, or below it;
* grasped: skins of thumb and another finger within `CLOSED_DISTANCE_M` of the surface, where its
  normals oppose each other;
* carried: the object has moved by `CARRIED_DISTANCE_M`, and the wrist relative to it by less than
  half as much.
"""

import numpy as np

from congrasp.services.assets.captures.sequence import FINGERS, Dropped, Sequence
from congrasp.services.assets.captures.surface import Surface

STABLE_FRAMES = 5
"""Consecutive frames in which thumb and another finger must touch for a stable contact."""
CONTACT_DISTANCE_M = 0.005
"""Greatest distance of touching skin from the surface."""
CLOSED_DISTANCE_M = 0.002
"""Greatest distance of grasping skin from the surface."""
MAX_OPPOSED_COSINE = -0.5
"""Greatest cosine of the surface's normals where fingers oppose each other."""
MAX_FRAMES_TO_CLOSE = 30
"""Greatest number of frames between the first stable contact and the grasping frame."""
CARRIED_DISTANCE_M = 0.03
"""Least displacement of a carried object."""
REST_TOLERANCE_M = 0.01
"""Greatest displacement of an object at rest."""
_SKIN_RADII_M = np.array([[0.010] * 3, *[[0.009, 0.0075, 0.0075]] * 3, [0.009, 0.0065, 0.0065]])
"""(5, 3) skin radius of each bone, as in GraspXL's MANO hand, m."""
_BONE_SHARES = (0.25, 0.5, 0.75, 1.0)
"""Shares of a bone at which its skin is sampled."""
_FAR_AWAY_M = 1e3
"""Coordinate of a hand in a missing frame, m."""


def first_contact(sequence: Sequence, surface: Surface, skin: np.ndarray) -> int:
    """Returns the grasping frame named by the data set, or the first frame of stable contact.

    Args:
      sequence: captured sequence.
      surface: surface of the object.
      skin: (T, 5, 4, 3) joints of the fingers, m, object frame.

    Raises:
      Dropped: there is no stable contact, or the frame is missing.
    """
    if sequence.grasp is not None:
        if not sequence.present[sequence.grasp]:
            reason = f"hand or object is missing in its grasping frame {sequence.grasp}"
            raise Dropped(sequence.name, "frames missing", reason)
        return sequence.grasp
    touching = sequence.touching
    if touching is None:
        touching = _find_touching(sequence, surface, skin)
    opposing = touching[:, 0] & touching[:, 1:].any(-1) & sequence.present
    stable = np.convolve(opposing, np.ones(STABLE_FRAMES), "valid") == STABLE_FRAMES
    if not stable.any():
        ever_touching = touching[sequence.present].any(0)
        names = [name for name, ever in zip(FINGERS, ever_touching, strict=True) if ever]
        raise Dropped(
            sequence.name,
            "no stable contact",
            f"thumb and another finger never touch the object for {STABLE_FRAMES} frames "
            f"(ever touching: {', '.join(names) or 'none'})",
        )
    return int(np.argmax(stable))


def opposed_frame(sequence: Sequence, surface: Surface, skin: np.ndarray, first: int) -> int:
    """Returns the first frame, from stable contact on, in which thumb and a finger have grasped.

    Frames count while the object is not carried, at most `MAX_FRAMES_TO_CLOSE` of them. If fingers
    never close in them, it is the frame in which an opposing pair comes nearest to the surface; the
    first one if none opposes.

    Args:
      sequence: captured sequence.
      surface: surface of the object.
      skin: (T, 5, 4, 3) joints of the fingers, m, object frame.
      first: frame of stable contact.
    """
    frames = np.flatnonzero(sequence.present[: first + MAX_FRAMES_TO_CLOSE + 1])
    moved = np.linalg.norm(sequence.object_position - sequence.object_position[first], axis=-1)
    frames = frames[(frames >= first) & (moved[frames] < CARRIED_DISTANCE_M)]
    points, radii = _skin_points(skin[frames])
    gaps = (surface.distance(points) - radii).reshape(*points.shape[:2], -1)
    nearest = gaps.argmin(-1)[..., None]
    finger_points = points.reshape(*gaps.shape, 3)
    nearest_points = np.take_along_axis(finger_points, nearest[..., None], 2)[:, :, 0]
    gap = np.take_along_axis(gaps, nearest, 2)[..., 0]
    normal = surface.normals(nearest_points)
    opposes = np.einsum("tj,tfj->tf", normal[:, 0], normal[:, 1:]) < MAX_OPPOSED_COSINE
    pair_gap = np.where(opposes, np.maximum(gap[:, :1], gap[:, 1:]), np.inf).min(-1)
    closed = pair_gap <= CLOSED_DISTANCE_M
    if closed.any():
        return int(frames[np.argmax(closed)])
    return int(frames[np.argmin(pair_gap)])


def before_carried(sequence: Sequence, position: np.ndarray, frame: int) -> int:
    """Returns the frame, or the last one with the object at rest if it is being carried.

    Slightly inaccurate skin touches late. By then the hand may be in the place of the table, and
    its path is not an approach.

    Args:
      sequence: captured sequence.
      position: (T, 3) positions of the wrist, object frame, m.
      frame: frame of stable contact.
    """
    present = np.flatnonzero(sequence.present[: frame + 1])
    offsets = sequence.object_position[present] - sequence.object_position[frame]
    moved = np.linalg.norm(offsets, axis=-1)
    last_at_rest = int(present[moved >= moved.max() - REST_TOLERANCE_M][-1])
    slid = np.linalg.norm(position[last_at_rest] - position[frame])
    if moved.max() > CARRIED_DISTANCE_M and slid < moved.max() / 2:
        return last_at_rest
    return frame


def skin_balls(joints: np.ndarray, margin: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns balls (n, 3), (n,) that fill fingers, enlarged by a margin.

    Args:
      joints: (5, 4, 3) m.
      margin: m.
    """
    points, radii = _skin_points(joints)
    return points.reshape(-1, 3), np.broadcast_to(radii + margin, points.shape[:-1]).ravel()


def _find_touching(sequence: Sequence, surface: Surface, skin: np.ndarray) -> np.ndarray:
    """(T, 5) bool: fingers whose skin is in contact; False in missing frames."""
    points, radii = _skin_points(skin)
    points = np.where(sequence.present[:, None, None, None, None], points, _FAR_AWAY_M)
    return (surface.distance(points) - radii <= CONTACT_DISTANCE_M).any((-1, -2))


def _skin_points(joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points along the bones between joints, and the skin's radii.

    Args:
      joints: (..., 5, 4, 3) m.

    Returns:
      (..., 5, 3, n, 3) points, and (5, 3, 1) radii, m.
    """
    share = np.array(_BONE_SHARES)[:, None]
    points = (1 - share) * joints[..., :-1, None, :] + share * joints[..., 1:, None, :]
    return points, _SKIN_RADII_M[..., None]
