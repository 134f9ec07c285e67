"""Surface of a human hand as an implicit function, and the links that its points follow.

Each finger is a chain of round cones about its links' capsules, the palm a smooth union of its
capsules with a wrist and the ball of the thumb. A finger blends with the palm, but not with another
finger, so that closed fingers stay apart. Everything is in the wrist frame with every joint at
zero, in metres.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.spatial.transform import Rotation

from congrasp.common.hands.spec import Hand, link_origin

_CELL_SIDE_M = 0.0039
"""Side of a cell of the grid from which the surface is extracted."""
_PALM_BLEND_M = 0.014
"""Width of the blend between parts of the palm."""
_FINGER_BLEND_M = 0.008
"""Width of the blend of a finger with the palm."""
_THUMB_BLEND_M = 0.020
"""Width of the blend of the thumb with the palm."""
_WRIST_LENGTH_M = 0.040
"""Distance by which the wrist extends behind the palm."""
_WRIST_SPREAD = 1.9
"""Width of the wrist relative to that of the palm's start, between the metacarpals' axes."""
_WRIST_END_BLEND_M = 0.012
"""Width of the rounding at the flat end of the wrist."""
_WEIGHT_DECAY_M = 0.0035
"""Difference of the distances to two links over which the ratio of their weights changes by a
factor e."""
_SPREAD_RAD_PER_M = 9.0
"""Rotation by which fingers are spread while their surface is made, for each metre between
knuckles."""
_FOLD_M = 0.004
"""A point whose distances to two fingers differ by less belongs to the palm."""
_MAX_INFLUENCES = 4
"""Most links that move a point."""
_MIN_WEIGHT = 0.01
"""Smallest weight of a link that moves a point."""
_SMOOTHINGS = 4
"""Iterations of smoothing of weights over neighbours."""
_PROJECTIONS = 3
"""Steps from the centre of a cell to the surface."""
_GRADIENT_STEP_M = 2e-4
"""Half step of a numerical gradient."""


class Skeleton(NamedTuple):
    """L links, C capsules and F joints in the wrist frame with every joint at zero, metres."""

    hand: str
    """Name of the hand."""
    names: tuple[str, ...]
    """L names; the first is the palm."""
    parents: np.ndarray
    """(L,) index of each link's parent, -1 for the palm."""
    origins: np.ndarray
    """(L, 3) origins of the links' frames, whose axes are parallel to the wrist's."""
    capsules: np.ndarray
    """(C, 2, 3)."""
    radii: np.ndarray
    """(C,)."""
    capsule_link: np.ndarray
    """(C,) index of the link of each capsule."""
    anchors: np.ndarray
    """(F, 3)."""
    axes: np.ndarray
    """(F, 3) unit."""
    joint_link: np.ndarray
    """(F,) index of the link that each joint moves."""

    def chains(self) -> list[list[int]]:
        """Links from the palm (excluded) to each last link with a capsule, a thumb first."""
        chains = []
        for tip in np.unique(self.capsule_link):
            is_last = not (self.parents == tip).any()
            if not tip or not is_last:
                continue
            chain = [int(tip)]
            while self.parents[chain[0]] > 0:
                chain.insert(0, int(self.parents[chain[0]]))
            chains.append([link for link in chain if (self.capsule_link == link).any()])
        return sorted(chains, key=lambda chain: not self.names[chain[-1]].startswith("thumb"))


def skeleton_of(hand: Hand) -> Skeleton:
    """Returns the skeleton of a hand."""
    names = tuple(link.name for link in hand.links)
    parents = [names.index(link.parent) if link.parent else -1 for link in hand.links]
    return Skeleton(
        hand=hand.name,
        names=names,
        parents=np.array(parents),
        origins=np.array([link_origin(link) for link in hand.links], float),
        capsules=hand.capsules.astype(float),
        radii=hand.capsule_radii.astype(float),
        capsule_link=hand.capsule_links,
        anchors=np.array([joint.anchor for joint in hand.joints], float),
        axes=np.array([joint.axis for joint in hand.joints], float),
        joint_link=hand.joint_links,
    )


class Cone(NamedTuple):
    """A round cone, which belongs to some links."""

    start: np.ndarray
    """(3,) m."""
    end: np.ndarray
    """(3,) m."""
    radii: tuple[float, float]
    """Radii at start and end, m."""
    links: tuple[int, ...]
    """Indices of the links."""


class _ThumbFlesh(NamedTuple):
    """A round cone between the thumb and the metacarpal nearest to it."""

    metacarpal_share: float
    """Start, as a share of the metacarpal's length."""
    thumb_share: float
    """End, as a share of the length of the thumb's first link."""
    start_radius: float
    """m."""
    end_radius: float
    """m."""


_THUMB_BALL = _ThumbFlesh(0.10, 0.75, start_radius=0.0120, end_radius=0.0105)
_THUMB_FOLD = _ThumbFlesh(0.45, 0.55, start_radius=0.0090, end_radius=0.0080)
"""The skin between thumb and index finger."""


class _Turn(NamedTuple):
    """A rotation of a finger about a point."""

    anchor: np.ndarray
    """(3,) m."""
    rotation: np.ndarray
    """(3, 3)."""


class Surface(NamedTuple):
    """V points of a closed surface with unit normals, F triangles that wind outwards, and weights
    of L links.
    """

    points: np.ndarray
    """(V, 3) m."""
    normals: np.ndarray
    """(V, 3) unit."""
    faces: np.ndarray
    """(F, 3)."""
    weights: np.ndarray
    """(V, L), at most four nonzero for each point; rows sum to one."""


def flesh(skeleton: Skeleton) -> Surface:
    """Returns the surface of a human hand whose links' capsules are phalanges and metacarpals."""
    palm = _palm(skeleton)
    fingers_together = _fingers(skeleton)
    turns = _spread_fingers(fingers_together)
    fingers = []
    for finger, turn in zip(fingers_together, turns, strict=True):
        fingers.append([_turn_cone(cone, turn) for cone in finger])
    low, high = _bounds([*palm, *itertools.chain.from_iterable(fingers)])
    axes = [np.arange(a, b + _CELL_SIDE_M, _CELL_SIDE_M) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    distances = _distance(grid.reshape(-1, 3), palm, fingers)
    cells, faces = surface_net(distances.reshape(grid.shape[:3]))
    points = low + _CELL_SIDE_M * cells
    for _ in range(_PROJECTIONS):
        distance = _distance(points, palm, fingers)
        points = points - distance[:, None] * _gradient(points, palm, fingers)
    normals = _gradient(points, palm, fingers)
    weights = _weights(len(skeleton.names), points, faces, palm, fingers)
    for finger, (anchor, rotation) in zip(fingers, turns, strict=True):  # undoes the spread
        share = weights[:, _links_of(finger)].sum(1)[:, None]
        points = points + share * ((points - anchor) @ rotation + anchor - points)
        normals = normals + share * (normals @ rotation - normals)
    return Surface(points, normals / np.linalg.norm(normals, axis=1, keepdims=True), faces, weights)


def _spread_fingers(fingers: Sequence[Sequence[Cone]]) -> list[_Turn]:
    """Returns turns that separate each finger from its neighbours by at least a cell of the grid.

    The thumb, the first finger, stays.
    """
    other_fingers = fingers[1:]
    roots = np.array([finger[0].start for finger in other_fingers])
    tips = np.array([finger[-1].end for finger in other_fingers])
    across = np.linalg.svd(roots - roots.mean(0))[2][0]
    up = np.cross(across, (tips - roots).mean(0))
    turns = [_Turn(fingers[0][0].start, np.eye(3))]
    for root, place in zip(roots, (roots - roots.mean(0)) @ across, strict=True):
        # `across` points to the right of `up x across`: a turn about `up` by a negative angle.
        angle = -_SPREAD_RAD_PER_M * place / np.linalg.norm(up)
        turns.append(_Turn(root, Rotation.from_rotvec(angle * up).as_matrix()))
    return turns


def _turn_cone(cone: Cone, turn: _Turn) -> Cone:
    """Returns the turned cone."""
    start = turn.anchor + turn.rotation @ (cone.start - turn.anchor)
    end = turn.anchor + turn.rotation @ (cone.end - turn.anchor)
    return cone._replace(start=start, end=end)


def _fingers(skeleton: Skeleton) -> list[list[Cone]]:
    """Cones of each finger, thumb first; their radii are interpolated between links."""
    fingers = []
    for chain in skeleton.chains():
        first = [int(np.flatnonzero(skeleton.capsule_link == link)[0]) for link in chain]
        radii = skeleton.radii[first]
        joints = [radii[0], *((radii[1:] + radii[:-1]) / 2), radii[-1]]
        finger = []
        for i, link in enumerate(chain):
            start, end = skeleton.capsules[first[i]]
            finger.append(Cone(start, end, (float(joints[i]), float(joints[i + 1])), (link,)))
        fingers.append(finger)
    return fingers


def _palm(skeleton: Skeleton) -> list[Cone]:
    """Cones of metacarpals, wrist and the ball of the thumb."""
    is_of_palm = skeleton.capsule_link == 0
    metacarpals = skeleton.capsules[is_of_palm]
    radii = skeleton.radii[is_of_palm]
    thumb_link = skeleton.chains()[0][0]
    thumb = _first_capsule(skeleton, thumb_link)
    centres, widest, back = wrist_circles(skeleton)
    palm = []
    for (start, end), radius, wide, last in zip(metacarpals, radii, centres, widest, strict=True):
        palm.append(Cone(start, end, (radius, radius), (0,)))
        wrist_start = wide - 0.2 * _WRIST_LENGTH_M * back
        wrist_end = wide + _WRIST_LENGTH_M * back
        palm.append(Cone(wrist_start, wrist_end, (1.1 * radius, last), (0,)))
    start, end = min(metacarpals, key=lambda ends: float(np.linalg.norm(ends.mean(0) - thumb[1])))
    for part in (_THUMB_BALL, _THUMB_FOLD):
        on_metacarpal = start + part.metacarpal_share * (end - start)
        on_thumb = thumb[0] + part.thumb_share * (thumb[1] - thumb[0])
        radii_of_part = (part.start_radius, part.end_radius)
        palm.append(Cone(on_metacarpal, on_thumb, radii_of_part, (0, thumb_link)))
    return palm


def wrist_circles(skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Circles, one for each metacarpal, whose hull is the outline of the wrist's start.

    Returns:
      (n, 3) centres and (n,) radii, m, and the unit direction (3,) from the fingers to the arm.
    """
    is_of_palm = skeleton.capsule_link == 0
    starts = skeleton.capsules[is_of_palm, 0]
    root = starts.mean(0)
    knuckles = [_first_capsule(skeleton, chain[0])[0] for chain in skeleton.chains()[1:]]
    centres = root + _WRIST_SPREAD * (starts - root)
    radii = 1.3 * skeleton.radii[is_of_palm]
    back = _unit(root - np.mean(knuckles, 0))
    return centres, radii, back


def _links_of(finger: Sequence[Cone]) -> list[int]:
    """Link of each cone of a finger."""
    return [cone.links[0] for cone in finger]


def _first_capsule(skeleton: Skeleton, link: int) -> np.ndarray:
    """Ends (2, 3) of a link's first capsule."""
    return skeleton.capsules[np.flatnonzero(skeleton.capsule_link == link)[0]]


def _bounds(cones: Sequence[Cone]) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a box around cones, with a margin for blending."""
    radii = np.array([max(cone.radii) for cone in cones])
    reach = radii[:, None, None] + 2 * _CELL_SIDE_M + 0.004
    ends = np.array([(cone.start, cone.end) for cone in cones])
    return (ends - reach).min((0, 1)), (ends + reach).max((0, 1))


def _distance_to_cone(points: np.ndarray, cone: Cone) -> np.ndarray:
    """Approximate signed distances (n,) of points (n, 3) to a cone, negative inside, m."""
    along = cone.end - cone.start
    share = np.clip((points - cone.start) @ along / (along @ along), 0, 1)
    first, last = cone.radii
    to_axis = np.linalg.norm(points - cone.start - share[:, None] * along, axis=-1)
    return to_axis - (first + share * (last - first))


def _distance_to_nearest(points: np.ndarray, cones: Sequence[Cone]) -> np.ndarray:
    """Approximate signed distances (n,) of points (n, 3) to the nearest of some cones."""
    return np.min([_distance_to_cone(points, cone) for cone in cones], 0)


def _smooth_minimum(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Smaller of two distances, rounded where they differ by less than a width (polynomial smooth
    minimum).
    """
    share = np.clip(0.5 + 0.5 * (b - a) / width, 0, 1)
    return b + share * (a - b) - width * share * (1 - share)


def _distance(
    points: np.ndarray, palm: Sequence[Cone], fingers: Sequence[Sequence[Cone]]
) -> np.ndarray:
    """Approximate signed distances (n,) of points (n, 3) to the hand."""
    body = _distance_to_cone(points, palm[0])
    for cone in palm[1:]:
        body = _smooth_minimum(body, _distance_to_cone(points, cone), _PALM_BLEND_M)
    # Palm[1] belongs to the wrist
    beyond = (points - palm[1].end) @ _unit(palm[1].end - palm[1].start)
    body = -_smooth_minimum(-body, -beyond, _WRIST_END_BLEND_M)  # the wrist ends flat
    nearest = body
    for i, finger in enumerate(fingers):
        to_finger = _distance_to_nearest(points, finger)
        width = _FINGER_BLEND_M if i else _THUMB_BLEND_M
        nearest = np.minimum(nearest, _smooth_minimum(body, to_finger, width))
    return nearest


def _unit(vector: np.ndarray) -> np.ndarray:
    """Returns the vector normalised to length one."""
    return vector / np.linalg.norm(vector)


def _gradient(
    points: np.ndarray, palm: Sequence[Cone], fingers: Sequence[Sequence[Cone]]
) -> np.ndarray:
    """Unit gradients (n, 3) of the distances."""
    steps = _GRADIENT_STEP_M * np.concatenate([np.eye(3), -np.eye(3)])
    moved = (points[:, None] + steps).reshape(-1, 3)
    values = _distance(moved, palm, fingers).reshape(-1, 6)
    rise = values[:, :3] - values[:, 3:]
    return rise / (np.linalg.norm(rise, axis=-1, keepdims=True) + 1e-12)


def surface_net(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the zero surface of values (X, Y, Z) on a grid, by naive surface nets (Gibson 1998).

    Args:
      values: negative inside; positive at the border of the grid.

    Returns:
      Points (V, 3) in units of cells, one in each cell that the surface crosses, at the mean of its
      crossings; and triangles (F, 3) with outward normals.
    """
    inside = values < 0
    cells = np.subtract(values.shape, 1)
    sums = np.zeros((*cells, 3))
    counts = np.zeros(cells, int)
    quads = []
    number = np.arange(counts.size).reshape(counts.shape)
    for axis in range(3):
        u = (axis + 1) % 3
        v = (axis + 2) % 3
        layers = np.moveaxis(values, axis, 0)
        changes_sign = (layers[:-1] < 0) != (layers[1:] < 0)
        crossed = np.argwhere(np.moveaxis(changes_sign, 0, axis))
        at = tuple(crossed.T)
        after = tuple((crossed + np.eye(3, dtype=int)[axis]).T)
        place = crossed + np.eye(3)[axis] * (values[at] / (values[at] - values[after]))[:, None]
        around = []
        for du, dv in ((0, 0), (-1, 0), (-1, -1), (0, -1)):
            cell = crossed + du * np.eye(3, dtype=int)[u] + dv * np.eye(3, dtype=int)[v]
            np.add.at(sums, tuple(cell.T), place)
            np.add.at(counts, tuple(cell.T), 1)
            around.append(number[tuple(cell.T)])
        quad = np.stack(around, -1)
        quads.append(np.where(inside[at][:, None], quad, quad[:, ::-1]))
    used = counts.ravel() > 0
    index = np.cumsum(used) - 1
    corners = index[np.concatenate(quads)]
    points = sums.reshape(-1, 3)[used] / counts.ravel()[used, None]
    return points, np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])


def _weights(
    links: int,
    points: np.ndarray,
    faces: np.ndarray,
    palm: Sequence[Cone],
    fingers: Sequence[Sequence[Cone]],
) -> np.ndarray:
    """Weights (V, L) by the distances to the links' cones, smoothed; among fingers only the nearest
    counts.
    """
    far = np.full((len(points), links), np.inf)
    palm = [*palm, fingers[0][0]]  # the thumb's metacarpal belongs to the palm
    fingers = [fingers[0][1:], *fingers[1:]]
    distances = np.stack([_distance_to_nearest(points, finger) for finger in fingers], 1)
    nearest = distances.argmin(1)
    first, second = np.sort(distances, 1).T[:2]
    for cone in palm:
        for link in cone.links:
            far[:, link] = np.minimum(far[:, link], _distance_to_cone(points, cone))
    for i, finger in enumerate(fingers):
        is_nearest = nearest == i
        for cone in finger:
            (link,) = cone.links
            distance = _distance_to_cone(points[is_nearest], cone)
            far[is_nearest, link] = np.minimum(far[is_nearest, link], distance)
    weights = np.exp((far.min(1, keepdims=True) - far) / _WEIGHT_DECAY_M)
    weights /= weights.sum(1, keepdims=True)
    weights[:, 1:] *= np.clip((second - first) / _FOLD_M, 0, 1)[:, None]
    weights[:, 0] = 1 - weights[:, 1:].sum(1)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    pairs = np.concatenate([edges, edges[:, ::-1]]).T
    around = sparse.csr_array(
        (np.ones(pairs.shape[1]), (pairs[0], pairs[1])), (len(points), len(points))
    )
    finger_links = [_links_of(finger) for finger in fingers]
    for _ in range(_SMOOTHINGS):
        weights = 0.5 * weights + 0.5 * (around @ weights) / around.sum(1)[:, None]
        for i, links_of_finger in enumerate(finger_links):
            weights[np.ix_(nearest != i, links_of_finger)] = 0.0
        weights[:, 0] = 1 - weights[:, 1:].sum(1)
    smallest_influence = np.sort(weights, 1)[:, -_MAX_INFLUENCES, None]
    weights[weights < np.maximum(smallest_influence, _MIN_WEIGHT)] = 0.0
    return weights / weights.sum(1, keepdims=True)
