"""New partitions of an object into graspable region and avoid region.

They are derived from a mesh of one part, painted vertices, a half-space, touched points, or cuts
into halves that a hand can hold. They relabel the object's surface points and pieces; nothing else
about the object changes.
"""

import dataclasses
import pathlib
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from congrasp.common.errors import CongraspError
from congrasp.common.hands.closure import outline
from congrasp.common.hands.files import HUMAN
from congrasp.common.objects.shapes import halves
from congrasp.common.objects.spec import GraspObject, Piece
from congrasp.common.task.sampling.heading_sampler import HeadingOptions, sample_headings
from congrasp.common.task.sampling.headings import max_width
from congrasp.common.task.sampling.reach import within_reach
from congrasp.services.assets.objects.mesh_files import (
    check_triangles,
    load_geometry,
    up_of,
    upright,
)

MIN_GRASPABLE_SHARE = 0.10
"""Share of the surface that the graspable region must have (paper, section Constraint Setup)."""
_MAX_PART_DISTANCE_M = 0.003
"""Distance from a part's mesh up to which a surface point belongs to the part, m."""
_PART_SAMPLES = 8000
"""Points on a part's mesh."""
_BOX_TOLERANCE = 0.1
"""Tolerance of the bounding box of a painted file, as a share of the object's length."""
_COLOUR_TOLERANCE = 60
"""Largest distance of two colours in RGB that count as one."""
_MAX_LISTED_COLOURS = 5
"""Colours that a message lists."""
_CUT_SHARES = (0.5, 0.65, 0.35, 0.8, 0.2)
"""Shares of the surface points on the near side of a cut, in the order in which they are tried."""
UNCOVERED = "none of its halves can be held without the other: it has no affordance"


class SmallRegionError(CongraspError):
    """The graspable region has less than `MIN_GRASPABLE_SHARE` of the surface."""


def relabelled(
    obj: GraspObject,
    labels: np.ndarray,
    names: Sequence[str],
    graspable: Sequence[bool],
    name: str = "",
) -> GraspObject:
    """Returns the object with other parts.

    Args:
      obj: the object.
      labels: (512,) part of each of its surface points.
      names: names of the parts.
      graspable: True for each part of the graspable region.
      name: name of the new object; unchanged if empty.

    Raises:
      SmallRegionError: the graspable region has less than a tenth of the surface.
    """
    labels = np.asarray(labels, np.int32)
    share = float(np.asarray(graspable, bool)[labels].mean())
    if share < MIN_GRASPABLE_SHARE:
        raise SmallRegionError(
            f"The graspable region of '{obj.name}' is {share:.0%} of its surface.",
            f"It must be at least {MIN_GRASPABLE_SHARE:.0%}: select a larger part, or swap the "
            f"regions with --invert.",
        )
    return dataclasses.replace(
        obj,
        name=name or obj.name,
        pieces=with_labels(obj.pieces, obj.points, labels),
        part_names=tuple(names),
        graspable=np.array(graspable, bool),
        labels=labels,
    )


def with_labels(
    pieces: Sequence[Piece], points: np.ndarray, labels: np.ndarray
) -> tuple[Piece, ...]:
    """Returns the pieces with the part that most of their vertices are nearest to.

    Args:
      pieces: convex pieces.
      points: (N, 3) surface points, in the same frame.
      labels: (N,) part of each point.
    """
    tree = cKDTree(points)
    labelled = []
    for piece in pieces:
        corners = np.zeros((1, 3)) if piece.vertices is None else piece.vertices
        votes = labels[tree.query(corners + piece.pos)[1]]
        labelled.append(dataclasses.replace(piece, part=int(np.bincount(votes).argmax())))
    return tuple(labelled)


def two_parts(obj: GraspObject, graspable: np.ndarray, name: str = "") -> GraspObject:
    """Returns the object with two parts, a graspable region and an avoid region.

    Args:
      obj: the object.
      graspable: (512,) bool, its surface points of the graspable region.
      name: name of the new object; unchanged if empty.
    """
    return relabelled(obj, np.where(graspable, 0, 1), ("grasp", "avoid"), (True, False), name)


def in_half_space(obj: GraspObject, normal: Sequence[float], offset: float) -> np.ndarray:
    """Returns (512,) bool: surface points x with normal . x >= offset (m), in the object frame.

    The normal is scaled to length 1.

    Raises:
      CongraspError: the normal is zero or not finite, or the offset is larger than the object.
    """
    length = float(np.linalg.norm(normal))
    if not np.isfinite(length) or length < 1e-9:
        raise CongraspError(
            f"The direction {tuple(normal)} is not a vector with a finite length above zero.",
            "Pass three finite numbers that are not all zero.",
        )
    farthest = float(np.linalg.norm(obj.points, axis=-1).max())
    if not abs(offset) <= farthest:
        raise CongraspError(
            f"The plane at {offset:g} m does not intersect '{obj.name}', whose farthest point is "
            f"{farthest:.3f} m from its centre of mass.",
            "Pass the plane's distance from the centre of mass in metres.",
        )
    return obj.points @ (np.asarray(normal, float) / length) >= offset


def from_part(obj: GraspObject, path: pathlib.Path) -> np.ndarray:
    """Returns distances (512,) of the surface points from a part, m.

    Args:
      obj: an imported object.
      path: the part, a closed mesh, a patch of the surface or points of it, in the frame and unit
        of the file that the object was imported from.

    Raises:
      CongraspError: the file cannot be read, or is empty.
    """
    geometry: Any = load_geometry(path, "Export the part as PLY.")
    up = "y" if obj.file_up == "y" else up_of(geometry)
    if isinstance(geometry, trimesh.Scene):
        geometry = geometry.to_geometry()
    points = np.asarray(getattr(geometry, "vertices", ()), float).reshape(-1, 3)
    if len(getattr(geometry, "faces", ())):
        check_triangles(path, geometry)
        if geometry.area > 0:
            samples = trimesh.sample.sample_surface(geometry, _PART_SAMPLES, seed=0)[0]
            points = np.concatenate([points, samples])
    points = upright(points[np.isfinite(points).all(-1)], up)
    if not len(points):
        raise CongraspError(f"{path} holds no points.", "Export the part as PLY.")
    in_object_frame = points * obj.file_scale + np.asarray(obj.origin)
    return np.asarray(cKDTree(in_object_frame).query(obj.points)[0])


def on_part_mesh(obj: GraspObject, path: pathlib.Path) -> np.ndarray:
    """Returns (512,) bool: surface points that lie on a part (`from_part`).

    Raises:
      CongraspError: the file cannot be read, or the part lies elsewhere.
    """
    distance = from_part(obj, path)
    if distance.min() > _MAX_PART_DISTANCE_M:
        raise CongraspError(
            f"{path} is {100 * distance.min():.1f} cm away from the surface of '{obj.name}'.",
            "Export the part in the frame and unit of the object's file.",
        )
    return distance <= _MAX_PART_DISTANCE_M


def find_painted(obj: GraspObject, path: pathlib.Path, colour: tuple[int, int, int]) -> np.ndarray:
    """Returns (512,) bool: surface points whose nearest vertex in a file has a colour.

    Args:
      obj: an imported object.
      path: its mesh with coloured vertices, in the frame and unit of the file that it was imported
        from.
      colour: red, green and blue, 0 to 255.

    Raises:
      CongraspError: the file has no coloured vertices, none of this colour, or shows another
        object.
    """
    mesh = load_geometry(path, "Export it as PLY with coloured vertices.")
    visual = getattr(mesh, "visual", None)
    colours = ()
    if getattr(visual, "kind", None) == "vertex":
        colours = getattr(visual, "vertex_colors", ())
    if not len(colours):
        raise CongraspError(
            f"{path} has no coloured vertices.",
            "Paint the vertices, and export the mesh as PLY with colours.",
        )
    vertices = upright(np.asarray(mesh.vertices, float), obj.file_up) * obj.file_scale + obj.origin
    finite = np.isfinite(vertices).all(-1)
    vertices = vertices[finite]
    rgb = np.asarray(colours)[finite, :3].astype(int)
    _check_box(obj, path, vertices)
    has_colour = np.linalg.norm(rgb - np.array(colour), axis=-1) <= _COLOUR_TOLERANCE
    if not has_colour.any():
        present = ", ".join(_hexadecimal(row) for row in _commonest(rgb))
        raise CongraspError(
            f"No vertex of {path} has the colour {_hexadecimal(colour)}.",
            f"Pass one of its colours with --colour: {present}.",
        )
    return has_colour[cKDTree(vertices).query(obj.points)[1]]


def _hexadecimal(colour: Iterable[int]) -> str:
    """Formats red, green and blue, 0 to 255, as #rrggbb."""
    return "#{:02x}{:02x}{:02x}".format(*colour)


def _check_box(obj: GraspObject, path: pathlib.Path, vertices: np.ndarray) -> None:
    """Raises a CongraspError if vertices (n, 3), m, object frame, have another box than the object.

    Args:
      obj: the object.
      path: file of the vertices.
      vertices: those of finite numbers.
    """
    if not len(vertices):
        raise CongraspError(f"{path} has no vertex with finite coordinates.", "Export it again.")
    box = np.stack([vertices.min(0), vertices.max(0)])
    object_box = np.stack([obj.visual_vertices.min(0), obj.visual_vertices.max(0)])
    deviation = float(np.abs(object_box - box).max())
    if deviation > _BOX_TOLERANCE * np.ptp(object_box, axis=0).max():
        raise CongraspError(
            f"{path} is not a mesh of '{obj.name}': their bounding boxes differ by "
            f"{100 * deviation:.3g} cm.",
            "Export it in the frame and unit of the object's file.",
        )


def near_points(obj: GraspObject, points: np.ndarray, radius: float) -> np.ndarray:
    """Returns (512,) bool: surface points near any of some points.

    Args:
      obj: the object.
      points: (n, 3) in the object frame, m.
      radius: m.
    """
    if len(points) == 0:
        return np.zeros(len(obj.points), bool)
    return cKDTree(points).query(obj.points)[0] <= radius


def cut_to_hold(obj: GraspObject) -> GraspObject:
    """Returns the object with the first partition that is covered in the most resting poses.

    Its current halves are tried first, then their exchange, then cuts across the longest axis that
    make the graspable half larger or smaller. If no half can be held in any resting pose, a note is
    added.
    """
    coverable = int(find_covered_rests(obj, use_affordance=False).sum())
    best = obj
    best_covered = -1
    for candidate in _cuts(obj):
        candidate_covered = int(find_covered_rests(candidate).sum())
        if candidate_covered > best_covered:
            best = candidate
            best_covered = candidate_covered
        if best_covered >= coverable:
            break
    if best_covered > 0:
        return best
    return dataclasses.replace(best, notes=(*best.notes, UNCOVERED))


def find_covered_rests(obj: GraspObject, *, use_affordance: bool = True) -> np.ndarray:
    """Returns (R,) bool: resting poses in which the human hand has a heading.

    Args:
      obj: the object.
      use_affordance: True for headings on the graspable region, False for the whole surface.
    """
    hand = outline(HUMAN)
    headings = sample_headings(
        obj,
        np.random.default_rng(0),
        use_affordance=use_affordance,
        options=HeadingOptions(max_width=max_width(hand, HUMAN.object_scale)),
    )
    if headings is None:
        return np.zeros(len(obj.rest_poses), bool)
    avoid = obj.non_graspable_points if use_affordance else None
    is_reachable = within_reach(headings, obj, obj.rest_poses, hand, avoid)[1]
    return np.asarray(is_reachable.any(-1))


def _cuts(obj: GraspObject) -> Iterator[GraspObject]:
    """Yields the object with its current partition, then with others."""
    yield obj
    first = int(np.flatnonzero(obj.graspable)[0])
    for cut in _CUT_SHARES:
        labels = halves(obj.points, cut)
        for half in (first, 1 - first):
            is_current = cut == 0.5 and half == first
            if not is_current:
                yield relabelled(obj, labels, obj.part_names, [half == 0, half == 1])


def _commonest(rgb: np.ndarray) -> np.ndarray:
    """The most frequent colours (n, 3) among rows (N, 3)."""
    colours, counts = np.unique(rgb, axis=0, return_counts=True)
    return colours[np.argsort(-counts)[:_MAX_LISTED_COLOURS]]
