"""Surface of an object, sampled for distance queries."""

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from congrasp.common.objects.spec import GraspObject

_SAMPLE_SPACING_M = 0.0015
"""Distance of neighbouring samples, m."""
_MIN_SAMPLES = 4000
_MAX_SAMPLES = 40_000


class Surface:
    """Dense sample of an object's surface for distance queries."""

    def __init__(self, obj: GraspObject):
        mesh = trimesh.Trimesh(obj.visual_vertices, obj.visual_faces, process=False)
        count = int(np.clip(mesh.area / _SAMPLE_SPACING_M**2, _MIN_SAMPLES, _MAX_SAMPLES))
        points, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
        self.points = np.asarray(points)
        self._normals = np.asarray(mesh.face_normals)[faces]
        self._tree = cKDTree(self.points)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Returns distances (...,) of points (..., 3) in the object frame, m; negative inside."""
        distance, nearest = self._tree.query(points)
        offset = points - self.points[nearest]
        inside = (offset * self._normals[nearest]).sum(-1) < 0
        return np.where(inside, -distance, distance)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Returns outward unit normals (..., 3) of the surface nearest to points (..., 3)."""
        return np.asarray(self._normals[self._tree.query(points)[1]])

    def within(self, points: np.ndarray, radii: np.ndarray) -> np.ndarray:
        """Returns samples (n, 3) of the surface within any of the balls (M, 3), (M,)."""
        near: set[int] = set()
        for indices in self._tree.query_ball_point(points, radii):
            near.update(indices)
        return self.points[sorted(near)]
