"""Bodies of a mesh: connected components of its triangles, and which of them are the object."""

from typing import NamedTuple

import numpy as np
import trimesh
from trimesh.geometry import faces_to_edges
from trimesh.graph import connected_component_labels

from congrasp.services.assets.objects.units import MAX_LENGTH_M

_MAX_FLATNESS = 0.08
"""Greatest thickness of a table, as a share of its width."""
_MIN_TABLE_RATIO = 2
"""Width of a table relative to that of the object on it."""
_MIN_OBJECT_LENGTH_M = 0.03
"""Shortest rest of a scan without its table; a shorter one is not an object."""
_MAX_BOX_GAP_SHARE = 0.02
"""Largest gap between the boxes of components of one body, as a share of the diagonal of the mesh's
box."""


class _Boxes(NamedTuple):
    """Boxes around the C components of a mesh, in its unit."""

    low: np.ndarray
    """(C, 3) smallest coordinates."""
    high: np.ndarray
    """(C, 3) largest coordinates."""

    def diagonals(self) -> np.ndarray:
        """(C,) lengths."""
        return np.linalg.norm(self.high - self.low, axis=-1)


def largest_body(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """Returns the largest of several bodies that lie apart from one another.

    Components that lie close together are one body.
    """
    labels = connected_component_labels(mesh.edges, len(mesh.vertices))
    if labels.max() == 0:
        return mesh
    margin = _MAX_BOX_GAP_SHARE / 2 * mesh.scale
    boxes = _boxes(np.asarray(mesh.vertices), labels)
    boxes = _Boxes(boxes.low - margin, boxes.high + margin)
    body = _join_touching(boxes)
    bodies_count = len(np.unique(body))
    if bodies_count == 1:
        return mesh
    largest = body[np.argmax(boxes.diagonals())]
    is_of_largest = (body == largest)[labels]
    selected = is_of_largest[np.asarray(mesh.faces)[:, 0]]
    share = float(mesh.area_faces[selected].sum() / mesh.area)
    notes.append(
        f"it holds {bodies_count} separate bodies; the largest was taken ({share:.0%} of the "
        f"surface): "
        "to use another one, save it as a file of its own"
    )
    used, faces = np.unique(np.asarray(mesh.faces)[selected], return_inverse=True)
    return trimesh.Trimesh(mesh.vertices[used], faces.reshape(-1, 3), process=False)


def without_table(mesh: trimesh.Trimesh, metres: float, notes: list[str]) -> trimesh.Trimesh:
    """Returns a scan longer than `MAX_LENGTH_M` without its table: its longest body, if that is
    flat and wide.

    The rest, without debris, must be at least 3 cm long and lie on one side of the table; otherwise
    the scan is returned unchanged.

    Args:
      mesh: the scan, in any unit.
      metres: metres per unit.
      notes: a table is appended.
    """
    if mesh.extents.max() * metres <= MAX_LENGTH_M:
        return mesh
    labels = connected_component_labels(mesh.edges, len(mesh.vertices))
    boxes = _boxes(mesh.vertices, labels)
    is_table = labels == boxes.diagonals().argmax()
    if is_table.all():
        return mesh
    rest = trimesh.Trimesh(mesh.vertices, mesh.faces[~is_table[mesh.faces[:, 0]]], process=False)
    rest.remove_unreferenced_vertices()
    rest_notes: list[str] = []
    rest = largest_body(rest, rest_notes)
    ratio = _table_ratio(mesh.vertices[is_table], rest.vertices)
    if ratio is None or rest.extents.max() * metres < _MIN_OBJECT_LENGTH_M:
        return mesh
    notes.append(f"a flat body {ratio:.1f} times as wide as the rest was left out: a table")
    notes += rest_notes
    return rest


def bodies(vertices: np.ndarray, faces: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Separates the bodies of a closed mesh; the hollows inside of a body belong to it.

    Args:
      vertices: (V, 3).
      faces: (F, 3).

    Returns:
      Vertices and faces of each body.
    """
    labels = connected_component_labels(faces_to_edges(faces), len(vertices))[faces[:, 0]]
    solids = []
    hollows = []
    for label in np.unique(labels):
        shell = faces[labels == label]
        if np.linalg.det(vertices[shell]).sum() > 0:
            solids.append(shell)
        else:
            hollows.append(shell)
    boxes = []
    for solid in solids:
        corners = vertices[solid]
        boxes.append(np.stack([corners.min((0, 1)), corners.max((0, 1))]))
    for hollow in hollows:
        around = _smallest_box_around(vertices[hollow].reshape(-1, 3), boxes)
        if around is not None:
            solids[around] = np.concatenate([solids[around], hollow])
    parts = []
    for solid in solids:
        used, places = np.unique(solid, return_inverse=True)
        parts.append((vertices[used], places.reshape(-1, 3)))
    return parts


def _boxes(vertices: np.ndarray, labels: np.ndarray) -> _Boxes:
    """Boxes around vertices (V, 3) of components (V,)."""
    order = np.argsort(labels, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(labels[order]) > 0])
    low = np.minimum.reduceat(vertices[order], starts)
    high = np.maximum.reduceat(vertices[order], starts)
    return _Boxes(low, high)


def _join_touching(boxes: _Boxes) -> np.ndarray:
    """(C,) body of each component; components whose boxes touch are one body.

    The largest component is joined with its neighbours first, then the next one.
    """
    low, high = boxes
    body = np.arange(len(low))
    for i in np.argsort(-boxes.diagonals()):
        touching = (low[i] <= high).all(-1) & (low <= high[i]).all(-1)
        body[np.isin(body, body[touching])] = body[i]
    return body


def _table_ratio(table: np.ndarray, rest: np.ndarray) -> float | None:
    """Width of a table relative to that of the rest; None if it cannot be a table.

    A table is flat, wider than the rest by far, and has all of the rest on one side.

    Args:
      table: (V, 3) vertices of the presumed table.
      rest: (W, 3) vertices of the rest.
    """
    axes = np.linalg.svd(table - table.mean(0), full_matrices=False)[2]
    along = table @ axes.T
    low = along.min(0)
    high = along.max(0)
    rest_along = rest @ axes.T
    rest_low = rest_along.min(0)
    rest_high = rest_along.max(0)
    size = high - low
    rest_width = float((rest_high - rest_low)[:2].max())
    if size[2] >= _MAX_FLATNESS * size[1] or rest_width >= size[1] / _MIN_TABLE_RATIO:
        return None
    is_within = (low <= rest_low)[:2].all() and (rest_high <= high)[:2].all()
    middle = (low + high)[2] / 2
    is_on_one_side = rest_low[2] > middle or rest_high[2] < middle
    if not (is_within and is_on_one_side):
        return None
    return size[1] / rest_width


def _smallest_box_around(points: np.ndarray, boxes: list[np.ndarray]) -> int | None:
    """Index of the smallest box (2, 3) that contains points (N, 3); None if there is none."""
    smallest = None
    smallest_volume = np.inf
    for i, (low, high) in enumerate(boxes):
        volume = float((high - low).prod())
        is_around = (low <= points).all() and (points <= high).all()
        if is_around and volume < smallest_volume:
            smallest = i
            smallest_volume = volume
    return smallest
