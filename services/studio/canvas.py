"""The painted surface of an object: the avoid region, and a mesh fine enough to show it."""

import itertools
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from congrasp.common.errors import CongraspError
from congrasp.common.objects.painting import finer, painted
from congrasp.common.objects.spec import GraspObject

_versions = itertools.count(1)


class Paint(NamedTuple):
    """Painted regions."""

    avoid: np.ndarray
    """(512,) bool, surface points of the painted avoid region."""
    shown: np.ndarray
    """(V,) bool, painted vertices."""
    version: int
    """Changes with the paint, and is unique across canvases."""


class Canvas:
    """The paint on one object, at first empty.

    Attributes:
      vertices, faces: (V, 3), (E, 3) of the painted mesh.
      colours: (V, 3) uint8 sRGB of the object; None if it has none.
      paint: the painted regions.
    """

    def __init__(self, obj: GraspObject):
        """Refines the object's mesh."""
        self._obj = obj
        self.colours: np.ndarray | None = None
        if obj.colours:
            self.vertices, self.faces, self.colours = painted(obj.visual_vertices, obj.visual_faces, obj.colours)
        else:
            self.vertices, self.faces = finer(obj.visual_vertices, obj.visual_faces)
        self._set(np.zeros(len(obj.points), bool), np.zeros(len(self.vertices), bool))

    @property
    def avoid(self) -> np.ndarray:
        """(512,) bool, surface points of the painted avoid region."""
        return self.paint.avoid

    def brush(self, points: Any, radius: float, avoid: bool) -> None:
        """Paints everything within `radius` (m) of points (N, 3), or removes the paint there if `avoid` is False.

        Raises:
          CongraspError: the points are not at most 2000 finite ones, or the radius is not 1 mm to 20 cm.
        """
        strokes = np.asarray(points, float)
        if strokes.ndim != 2 or strokes.shape[1:] != (3,) or not np.isfinite(strokes).all() or len(strokes) > 2000:
            raise CongraspError("A brush stroke must be at most 2000 points of three numbers.")
        if not 0.001 <= radius <= 0.2:
            raise CongraspError(f"The brush has a radius of {radius} m.", "Choose 1 mm to 20 cm.")

        def brushed(places: np.ndarray, before: np.ndarray) -> np.ndarray:
            """Painted state of some places after a stroke."""
            squared = ((places[:, None] - strokes[None]) ** 2).sum(-1).min(-1, initial=np.inf)
            return np.where(squared <= radius**2, bool(avoid), before)

        self._set(brushed(self._obj.points, self.avoid), brushed(self.vertices, self.paint.shown))

    def fill(self, avoid: bool) -> None:
        """Paints everything, or removes all paint if `avoid` is False."""
        self._set(np.full_like(self.avoid, avoid), np.full_like(self.paint.shown, avoid))

    def take_parts(self) -> None:
        """Paints the object's non-graspable parts, and nothing else."""
        avoid = self._obj.non_graspable_points
        self._set(avoid, avoid[cKDTree(self._obj.points).query(self.vertices)[1]])

    def _set(self, avoid: np.ndarray, shown: np.ndarray) -> None:
        """Sets the paint, with a new version."""
        self.paint = Paint(avoid, shown, next(_versions))
