"""Extracts a reference pose and a wrist trajectory from a captured sequence (paper, section
Constraint Setup).

Definitions of terms that the paper leaves open:

* wrist-object distance: from the wrist's origin to the nearest point of the object's surface;
* contact: a finger's skin within `CONTACT` of the surface, or below it;
* grasped: skins of thumb and another finger within `CLOSED` of the surface, where its normals
  oppose each other;
* carried: the object has moved by `CARRIED`, and the wrist by less than half as much against it;
* continuous: the wrist moves at most `JUMP` between two frames, and at most `GAP` frames in a row
  are missing;
* too complex: the path is more than `DETOUR` times its straight line, or the wrist rotates by more
  than `TURN` in total.
"""

import dataclasses

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from congrasp.common.hands.files import HUMAN
from congrasp.common.objects.spec import GraspObject
from congrasp.common.rotations import continuous
from congrasp.services.assets.captures.human import Fit, fit
from congrasp.services.assets.captures.sequence import FINGERS, Dropped, Sequence

STABLE = 5
"""Number of consecutive frames in which thumb and another finger must touch."""
NEAREST = 0.08
"""Least distance from which a wrist must come, m."""
FARTHEST = 0.20
"""Greatest distance at which a trajectory begins, m."""
CONTACT = 0.005
CLOSED, OPPOSITE = 0.002, -0.5
"""Distance of skin from the surface in m, and cosine of its normals, where fingers oppose each
other.
"""
LATER = 30
"""Most frames between the first stable contact and the grasping frame."""
JUMP = 0.10
GAP = 3
DETOUR = 2.0
TURN = 2.5
DIP = 0.01
"""Decrease of the distance, going backwards, after which its maximum counts as passed, m."""
CARRIED, STILL = 0.03, 0.01
"""Displacement of a carried object, and tolerance within which it counts as at rest, m."""
BEYOND = 0.1
_RESTING = 1e-6  # m, largest step of a wrist at rest
_RADII = np.array([[0.010] * 3, *[[0.009, 0.0075, 0.0075]] * 3, [0.009, 0.0065, 0.0065]])
"""(5, 3) skin radius of each bone, as in GraspXL's MANO hand, m."""
_ALONG = (0.25, 0.5, 0.75, 1.0)
_SPACING, _SAMPLES = 0.0015, (4000, 40_000)


class Surface:
    """Dense sample of an object's surface for distance queries."""

    def __init__(self, obj: GraspObject):
        mesh = trimesh.Trimesh(obj.visual_vertices, obj.visual_faces, process=False)
        count = int(np.clip(mesh.area / _SPACING**2, *_SAMPLES))
        points, face = trimesh.sample.sample_surface(mesh, count, seed=0)
        self.points, self._normals = np.asarray(points), np.asarray(mesh.face_normals)[face]
        self._tree = cKDTree(self.points)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distances (...,) of points (..., 3) in the object frame, m; negative inside."""
        away, nearest = self._tree.query(points)
        inside = ((points - self.points[nearest]) * self._normals[nearest]).sum(-1) < 0
        return np.where(inside, -away, away)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Outward unit normals (..., 3) of the surface nearest to points (..., 3)."""
        return np.asarray(self._normals[self._tree.query(points)[1]])

    def within(self, points: np.ndarray, radii: np.ndarray) -> np.ndarray:
        """Samples (n, 3) of the surface within any of the balls (M, 3), (M,)."""
        return self.points[sorted(set().union(*self._tree.query_ball_point(points, radii)))]


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
    sequence: Sequence, obj: GraspObject, surface: Surface, waypoints: int, beyond: float = BEYOND
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
    far = surface.distance(np.where(sequence.present[:, None], position, 1e3))
    if not sequence.present.any():
        raise Dropped(sequence.name, "frames missing", "hand and object are in no frame together")
    if far[sequence.present].min() > 1.0:
        nearest = far[sequence.present].min()
        reason = (
            f"the wrist stays {nearest:.3g} m from the object: check that its positions are in "
            f"metres"
        )
        raise Dropped(sequence.name, "wrong units", reason)
    skin = position[:, None, None] + np.einsum("tij,tfkj->tfki", rotation, sequence.joints)
    first = _first_contact(sequence, surface, skin)
    touched = frame = first
    if sequence.grasp is None:
        touched = _opposed(sequence, surface, skin, first)
        frame = _before_carried(sequence, position, touched)
    start, path, turns = approach(
        sequence.name, position, rotation, far, sequence.present, frame, waypoints
    )
    found = _fit(sequence, frame)
    _check_limits(sequence.name, found.q, beyond)
    return Demonstration(
        name=sequence.name,
        frame=frame,
        later=touched - first,
        start=start,
        fit=found,
        q=np.clip(found.q, HUMAN.lower, HUMAN.upper),
        position=path,
        quaternion=turns,
        contact=surface.within(*_skin_balls(skin[touched], CONTACT)),
    )


def approach(
    name: str,
    position: np.ndarray,
    rotation: np.ndarray,
    far: np.ndarray,
    present: np.ndarray,
    frame: int,
    waypoints: int,
) -> tuple[int, np.ndarray, np.ndarray]:
    """Extracts the wrist trajectory that leads to a grasp.

    Args:
      name: name of the motion.
      position: (T, 3) positions of the wrist, object frame, m.
      rotation: (T, 3, 3) rotations of the wrist.
      far: (T,) wrist-object distance, m.
      present: (T,) bool, True for known frames.
      frame: the grasping frame.
      waypoints: number K of waypoints.

    Returns:
      The frame of the farthest distance, and waypoints (K, 3), (K, 4) from there to the grasp.

    Raises:
      Dropped: the wrist starts too near or does not move, or its path is too complex.
    """
    start = _farthest(position, far, present, frame)
    if far[start] < NEAREST:
        reason = (
            f"the wrist comes from only {100 * far[start]:.1f} cm ({100 * NEAREST:.0f} cm are "
            f"needed)"
        )
        raise Dropped(name, "starts too near", reason)
    frames = np.flatnonzero(present[start : frame + 1]) + start
    path, turns = _truncated(position[frames], rotation[frames], far[frames])
    if np.linalg.norm(np.diff(path, axis=0), axis=-1).max(initial=0.0) <= _RESTING:
        raise Dropped(name, "no approach", "the wrist does not move before the grasp")
    _check_complexity(name, path, turns)
    return start, *_resampled(path, turns, waypoints)


def in_object_frame(sequence: Sequence, obj: GraspObject) -> tuple[np.ndarray, np.ndarray]:
    """Wrist positions (T, 3) and rotations (T, 3, 3) in the object frame."""
    back = np.swapaxes(sequence.object_rotation, -1, -2)
    offset = sequence.wrist_position - sequence.object_position
    return np.einsum("tij,tj->ti", back, offset) + obj.origin, back @ sequence.wrist_rotation


def _first_contact(sequence: Sequence, surface: Surface, skin: np.ndarray) -> int:
    """Grasping frame named by the data set, or the first frame of stable contact."""
    if sequence.grasp is not None:
        if not sequence.present[sequence.grasp]:
            reason = f"hand or object is missing in its grasping frame {sequence.grasp}"
            raise Dropped(sequence.name, "frames missing", reason)
        return sequence.grasp
    touching = sequence.touching
    if touching is None:
        points, radii = _bones(skin)
        points = np.where(sequence.present[:, None, None, None, None], points, 1e3)
        touching = (surface.distance(points) - radii <= CONTACT).any((-1, -2))
    both = touching[:, 0] & touching[:, 1:].any(-1) & sequence.present
    stable = np.convolve(both, np.ones(STABLE), "valid") == STABLE
    if not stable.any():
        ever = [
            name
            for name, touched in zip(FINGERS, touching[sequence.present].any(0), strict=True)
            if touched
        ]
        raise Dropped(
            sequence.name,
            "no stable contact",
            f"thumb and another finger never touch the object for {STABLE} frames (ever touching: "
            f"{', '.join(ever) or 'none'})",
        )
    return int(np.argmax(stable))


def _opposed(sequence: Sequence, surface: Surface, skin: np.ndarray, first: int) -> int:
    """First frame, from that of stable contact on, in which thumb and another finger have grasped.

    Frames count while the object is not carried, at most `LATER` of them. If fingers never close in
    them, it is the frame in which an opposing pair comes nearest to the surface; the first one if
    none opposes.

    Args:
      sequence: captured sequence.
      surface: surface of the object.
      skin: (T, 5, 4, 3) joints of the fingers, m, object frame.
      first: frame of stable contact.
    """
    frames = np.flatnonzero(sequence.present[: first + LATER + 1])
    moved = np.linalg.norm(sequence.object_position - sequence.object_position[first], axis=-1)
    frames = frames[(frames >= first) & (moved[frames] < CARRIED)]
    points, radii = _bones(skin[frames])
    gaps = (surface.distance(points) - radii).reshape(*points.shape[:2], -1)
    nearest = gaps.argmin(-1)[..., None]
    points = np.take_along_axis(points.reshape(*gaps.shape, 3), nearest[..., None], 2)[:, :, 0]
    gap, normal = np.take_along_axis(gaps, nearest, 2)[..., 0], surface.normals(points)
    opposing = np.einsum("tj,tfj->tf", normal[:, 0], normal[:, 1:]) < OPPOSITE
    apart = np.where(opposing, np.maximum(gap[:, :1], gap[:, 1:]), np.inf).min(-1)
    return int(frames[np.argmax(apart <= CLOSED) if (apart <= CLOSED).any() else np.argmin(apart)])


def _before_carried(sequence: Sequence, position: np.ndarray, frame: int) -> int:
    """Returns the frame or, if the object is being carried, the last one before in which it was at
    rest.

    Slightly inaccurate skin touches late. By then the hand may be in the place of the table, and
    its path is not an approach.

    Args:
      sequence: captured sequence.
      position: (T, 3) positions of the wrist, object frame, m.
      frame: frame of stable contact.
    """
    known = np.flatnonzero(sequence.present[: frame + 1])
    moved = np.linalg.norm(
        sequence.object_position[known] - sequence.object_position[frame], axis=-1
    )
    picked = int(known[moved >= moved.max() - STILL][-1])
    slid = np.linalg.norm(position[picked] - position[frame])
    return picked if moved.max() > CARRIED and slid < moved.max() / 2 else frame


def _bones(joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (..., 5, 3, n, 3) along the bones between joints (..., 5, 4, 3), and the skin's radii
    (5, 3, 1).
    """
    share = np.array(_ALONG)[:, None]
    points = (1 - share) * joints[..., :-1, None, :] + share * joints[..., 1:, None, :]
    return points, _RADII[..., None]


def _skin_balls(joints: np.ndarray, margin: float) -> tuple[np.ndarray, np.ndarray]:
    """Balls (n, 3), (n,) that fill fingers with joints (5, 4, 3), enlarged by a margin."""
    points, radii = _bones(joints)
    return points.reshape(-1, 3), np.broadcast_to(radii + margin, points.shape[:-1]).ravel()


def _farthest(position: np.ndarray, far: np.ndarray, present: np.ndarray, frame: int) -> int:
    """Frame of the local maximum of the distance, backwards from the grasping frame along
    continuous motion.
    """
    best = last = frame
    for t in range(frame - 1, -1, -1):
        if not present[t]:
            continue
        step = np.linalg.norm(position[last] - position[t])
        if last - t > GAP + 1 or step > JUMP * (last - t) or far[t] < far[best] - DIP:
            break
        last = t
        if far[t] > far[best]:
            best = t
    return best


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


def _truncated(path: np.ndarray, turns: np.ndarray, far: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """Path from its last entry within `FARTHEST` on; the entry point is interpolated between two
    frames.
    """
    rotation = Rotation.from_matrix(turns)
    beyond = np.flatnonzero(far > FARTHEST)
    if len(beyond) == 0 or beyond[-1] == len(far) - 1:
        return path, rotation
    i = int(beyond[-1])
    share = (far[i] - FARTHEST) / (far[i] - far[i + 1])
    first = Slerp([0.0, 1.0], rotation[[i, i + 1]])(share)
    start = (1 - share) * path[i] + share * path[i + 1]
    return np.concatenate([start[None], path[i + 1 :]]), Rotation.concatenate(
        [first, rotation[i + 1 :]]
    )


def _check_complexity(name: str, path: np.ndarray, turns: Rotation) -> None:
    """Drops a sequence whose path (n, 3) has too much detour or rotation."""
    length = np.linalg.norm(np.diff(path, axis=0), axis=-1).sum()
    straight = np.linalg.norm(path[-1] - path[0])
    if length > DETOUR * straight:
        raise Dropped(
            name,
            "too complex",
            f"the wrist's path is {length / max(straight, 1e-9):.1f} times its straight line",
        )
    turn = float((turns[1:] * turns[:-1].inv()).magnitude().sum())
    if turn > TURN:
        raise Dropped(name, "too complex", f"the wrist rotates by {turn:.1f} rad on its way")


def _resampled(path: np.ndarray, turns: Rotation, waypoints: int) -> tuple[np.ndarray, np.ndarray]:
    """K waypoints at equal distances along the path, with quaternions of continuous sign."""
    length = np.concatenate([[0.0], np.linalg.norm(np.diff(path, axis=0), axis=-1).cumsum()])
    # While the wrist rests the path length does not grow: the last of such frames is used.
    keep = np.append(np.diff(length) > _RESTING, True)
    length, path, turns = length[keep], path[keep], turns[keep]
    wanted = np.linspace(length[0], length[-1], waypoints)
    position = np.stack([np.interp(wanted, length, axis) for axis in path.T], -1)
    return position, continuous(Slerp(length, turns)(wanted).as_quat(scalar_first=True))
