"""Capsules of a link: fitted to its geometry, to its inertia, or around bare points."""

import numpy as np
import trimesh

from congrasp.common.hands.spec import Capsule, vector
from congrasp.services.assets.hands.links import Tree
from congrasp.services.assets.hands.urdf_inertias import LEAST_INERTIA, LEAST_MASS

_MAX_ROUND_RATIO = 1.6
"""Breadth relative to height from which a link gets several parallel capsules."""
_MAX_PARALLEL = 5
"""Parallel capsules of a link."""
_MIN_LENGTH = 1e-3
"""Side of a box, and half length of a capsule, m."""
_BOX_EXTENTS = (0.002, 0.15)
"""Range of the half extent of a plausible box of inertia, m."""
_MIN_BOX_MASS = 1e-4
"""Mass of a body whose inertia is used, kg."""
_MIN_THICKNESS = 1e-4
"""Thickness below which points have no box, m."""
_BARE_RADIUS = 0.005
"""Radius of a link without any geometry, m."""
_DIRECTIONS = np.concatenate([np.eye(3), -np.eye(3)])


def inertia_boxes(tree: Tree, link: int) -> list[np.ndarray]:
    """Returns corners (3,) of boxes with the mass and inertia of a link's bodies, m.

    Bodies whose inertia is proposed, or is not that of a link, have none.
    """
    model = tree.model
    data = tree.data
    corners: list[np.ndarray] = []
    for body in tree.groups[link]:
        mass = model.body_mass[body]
        x, y, z = model.body_inertia[body]
        is_proposed = mass == LEAST_MASS and x == y == z == LEAST_INERTIA
        if mass < _MIN_BOX_MASS or is_proposed:
            continue
        squares = 1.5 * np.array([y + z - x, x + z - y, x + y - z]) / mass
        half = np.sqrt(np.maximum(squares, 0.0))
        if _BOX_EXTENTS[0] <= half.max() <= _BOX_EXTENTS[1]:
            box = trimesh.creation.box(2 * np.maximum(half, _BOX_EXTENTS[0]))
            rotation = data.ximat[body].reshape(3, 3)
            corners += list(np.array(box.vertices) @ rotation.T + data.xipos[body])
    return corners


def bare(*centers: np.ndarray) -> list[np.ndarray]:
    """Returns points around centres, for a link without geometry in the file."""
    points: list[np.ndarray] = []
    for center in centers:
        points += list(center + _BARE_RADIUS * _DIRECTIONS)
    return points


def fit_capsules(points: np.ndarray) -> tuple[Capsule, ...]:
    """Fits capsules along the longest side of the box around points.

    Args:
      points: (N, 3) m.

    Returns:
      One capsule, or several in parallel if the box is flat.
    """
    if np.linalg.matrix_rank(points - points.mean(0), tol=_MIN_THICKNESS) < 3:
        points = _thickened(points)
    to_box, extents = trimesh.bounds.oriented_bounds(points)
    order = np.argsort(extents)[::-1]
    length, breadth, height = np.maximum(extents[order], _MIN_LENGTH)
    from_box = np.linalg.inv(to_box)
    center = from_box[:3, 3]
    along, sideways, _ = from_box[:3, order].T
    if breadth > _MAX_ROUND_RATIO * height:
        radius = height / 2
        count = min(_MAX_PARALLEL, int(np.ceil(breadth / height)))
    else:
        radius = (breadth + height) / 4
        count = 1
    offsets = np.zeros(1)
    if count > 1:
        offsets = np.linspace(-1, 1, count) * (breadth / 2 - radius)
    half_length = max(length / 2 - radius, _MIN_LENGTH)
    capsules = []
    for offset in offsets:
        middle = center + offset * sideways
        start = vector((middle - half_length * along).round(6))
        end = vector((middle + half_length * along).round(6))
        capsules.append(Capsule(start, end, round(float(radius), 6)))
    return tuple(capsules)


def far_end(capsules: tuple[Capsule, ...], origin: np.ndarray) -> np.ndarray:
    """Returns the mean (3,) of the capsules' ends far from a point (3,): the tip of a finger."""
    ends = []
    for capsule in capsules:
        to_start = float(np.linalg.norm(np.subtract(capsule.start, origin)))
        to_end = float(np.linalg.norm(np.subtract(capsule.end, origin)))
        ends.append(capsule.end if to_end > to_start else capsule.start)
    return np.mean(ends, axis=0)


def _thickened(points: np.ndarray) -> np.ndarray:
    """Points around points (N, 3) that lie in a plane."""
    distinct = np.unique(points.round(5), axis=0)
    return np.concatenate([distinct + offset for offset in _MIN_THICKNESS * _DIRECTIONS])
