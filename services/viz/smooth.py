"""Smooth normals of a triangle mesh at points that a ray caster found on it, which reports flat ones."""

import numpy as np
import trimesh
from scipy.spatial import cKDTree

CREASE = np.cos(np.radians(35.0))
"""Faces whose normals differ by more than this angle (given as its cosine) meet in a sharp edge."""


class SmoothNormals:
    """Interpolated vertex normals of a mesh, sharp where two faces meet at more than the crease angle."""

    _NEAREST = 6

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        vertices, faces = np.asarray(vertices, float), np.asarray(faces)
        corners = vertices[faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(cross, axis=1)
        good = area > 1e-14
        faces, corners, cross, area = faces[good], corners[good], cross[good], area[good]
        self.normals = cross / area[:, None]
        self.corners = corners
        # Vertices at one place are one vertex, whatever the file says.
        _, place = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
        self.corner_normals = self._corner_normals(place.ravel()[faces], cross)
        self.scale = float(np.ptp(vertices, axis=0).max())
        offset = (self.normals * corners[:, 0]).sum(1)
        centre = corners.mean(1)
        self.tree = cKDTree(np.column_stack([self.normals * 10, offset / self.scale * 10, centre / self.scale]))
        self.reach = len(faces)

    def _corner_normals(self, faces: np.ndarray, cross: np.ndarray) -> np.ndarray:
        """(F, 3, 3) mean of the area-weighted normals around each corner that are within the crease angle."""
        order = np.argsort(faces.ravel(), kind="stable")
        owner = order // 3
        starts = np.flatnonzero(np.r_[True, np.diff(faces.ravel()[order]) > 0])
        sizes = np.diff(np.r_[starts, len(order)])
        result = np.zeros((len(order), 3))
        for size in np.unique(sizes):
            groups = starts[sizes == size][:, None] + np.arange(size)
            around = owner[groups]  # (groups, size) faces that share a vertex
            near = np.einsum("gik,gjk->gij", self.normals[around], self.normals[around]) > CREASE
            result[order[groups]] = np.einsum("gij,gjk->gik", near, cross[around])
        result /= np.linalg.norm(result, axis=-1, keepdims=True)
        return result.reshape(-1, 3, 3)

    def __call__(self, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """(n, 3) smooth normals at points (n, 3) of the surface with flat normals (n, 3), in the mesh's frame."""
        offset = (normal * point).sum(1)
        key = np.column_stack([normal * 10, offset / self.scale * 10, point / self.scale])
        near = self.tree.query(key, k=min(self._NEAREST, self.reach))[1].reshape(len(point), -1)
        triangles, points = self.corners[near.ravel()], np.repeat(point, near.shape[1], axis=0)
        weights = trimesh.triangles.points_to_barycentric(triangles, points).reshape(*near.shape, 3)
        best = np.argmax(weights.min(-1), 1)
        rows = np.arange(len(point))
        face = near[rows, best]
        weight = np.clip(weights[rows, best], 0, 1)
        smooth = (weight[:, :, None] * self.corner_normals[face]).sum(1)
        # Meshes that wind inwards are lit from the side that is seen.
        smooth *= np.where((smooth * normal).sum(1, keepdims=True) < 0, -1.0, 1.0)
        found = weights.min(-1).max(1) > -0.05
        smooth = np.where(found[:, None], smooth, normal)
        return smooth / np.linalg.norm(smooth, axis=1, keepdims=True)
