"""Convex pieces of a mesh: CoACD under a time limit, V-HACD where it fails, the convex hull as the last resort.

The decomposers are native code that cannot be interrupted, so that they run in a child process
(`python -m services.assets.objects.decompose`) which is killed at the limit.
"""

import os
import pathlib
import signal
import subprocess
import sys
import tempfile
from typing import NamedTuple

import numpy as np

from common.objects.shapes import hull_of
from common.objects.spec import MAX_MESH_PIECES, MAX_MESH_VERTICES

_CONVEX = 0.95  # share of its hull that a mesh fills to count as convex
_FALLBACK_LIMIT = 30.0  # s
_ROOT = pathlib.Path(__file__).resolve().parents[3]


class Decomposition(NamedTuple):
    """Convex pieces of a mesh."""

    pieces: list[np.ndarray]
    """Vertices (V, 3) of each piece, in the mesh's frame."""
    method: str
    """"convex", "coacd", "vhacd" or "hull"."""
    notes: list[str]
    """What the user should know."""


def decompose(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    fill: float | None,
    time_limit: float,
    max_pieces: int = MAX_MESH_PIECES,
) -> Decomposition:
    """Convex pieces of a triangle mesh.

    Args:
      vertices: (V, 3), not all in a plane.
      faces: (F, 3).
      fill: the mesh's volume if it is known; a mesh that nearly fills its hull needs no decomposition.
      time_limit: seconds for CoACD; V-HACD gets half a minute after it.
      max_pieces: most pieces asked for.
    """
    hull = hull_of(vertices)
    if fill is not None and fill > _CONVEX * hull.volume:
        return Decomposition([hull.points[hull.vertices]], "convex", [])
    notes: list[str] = []
    for method, limit in (("coacd", time_limit), ("vhacd", _FALLBACK_LIMIT)):
        pieces, failure = _in_child(method, vertices, faces, max_pieces, limit)
        if pieces:
            return Decomposition(pieces, method, notes)
        notes.append(f"{method} {failure}")
    notes.append("the convex hull of the whole mesh stands in for it: hollows are filled")
    return Decomposition([hull.points[hull.vertices]], "hull", notes)


def merge(pieces: list[np.ndarray], max_pieces: int) -> list[np.ndarray]:
    """Joins convex pieces (V, 3) until `max_pieces` are left, each time the two whose hull adds least volume."""
    parts = dict(enumerate(pieces))
    volumes = {i: hull_of(part).volume for i, part in parts.items()}
    joint: dict[tuple[int, int], tuple[float, np.ndarray]] = {}

    def consider(i: int, j: int) -> None:
        """Notes what joining two parts adds in volume."""
        hull = hull_of(np.concatenate([parts[i], parts[j]]))
        joint[i, j] = (hull.volume - volumes[i] - volumes[j], hull.points[hull.vertices])

    if len(parts) > max_pieces:
        for i in parts:
            for j in range(i):
                consider(i, j)
    while len(parts) > max_pieces:
        (i, j), (growth, vertices) = min(joint.items(), key=lambda item: item[1][0])
        new = max(parts) + 1
        volumes[new] = growth + volumes[i] + volumes[j]
        del parts[i], parts[j]
        joint = {pair: value for pair, value in joint.items() if not {i, j} & set(pair)}
        parts[new] = vertices
        for other in parts:
            if other != new:
                consider(new, other)
    return list(parts.values())


def simplify(vertices: np.ndarray, max_vertices: int = MAX_MESH_VERTICES) -> tuple[np.ndarray, float]:
    """A convex piece with few vertices and the same volume.

    Starting from the extreme points along the axes, the point that sticks out furthest is added again and again; the
    result is then scaled about its centroid to the volume of the original.

    Returns:
      Vertices (at most `max_vertices`, 3), and the share of the volume that was missing before the scaling.

    Raises:
      scipy.spatial.QhullError: the points lie in a plane.
    """
    hull = hull_of(vertices)
    points = hull.points[hull.vertices]
    if len(points) <= max_vertices:
        return points, 0.0
    axes = np.linalg.svd(points - points.mean(0), full_matrices=False)[2]
    along = points @ axes.T
    chosen = list(dict.fromkeys([*along.argmax(0).tolist(), *along.argmin(0).tolist()]))
    while len(chosen) < max_vertices:
        equations = hull_of(points[chosen]).equations if len(chosen) > 3 else np.zeros((1, 4))
        outside = (points @ equations[:, :3].T + equations[:, 3]).max(-1)
        outside[chosen] = -np.inf
        chosen.append(int(outside.argmax()))
    kept = points[chosen]
    share = hull_of(kept).volume / hull.volume
    center = kept.mean(0)
    return center + (kept - center) * share ** (-1 / 3), float(1 - share)


def _in_child(
    method: str, vertices: np.ndarray, faces: np.ndarray, max_pieces: int, limit: float
) -> tuple[list[np.ndarray], str]:
    """The pieces, or none and why."""
    with tempfile.TemporaryDirectory(prefix="congrasp-") as folder:
        mesh, result = os.path.join(folder, "mesh.npz"), os.path.join(folder, "pieces.npz")
        np.savez(mesh, vertices=vertices, faces=faces)
        path = os.pathsep.join(filter(None, [str(_ROOT), os.environ.get("PYTHONPATH")]))
        command = [
            sys.executable,
            "-m",
            "services.assets.objects.decompose",
            method,
            mesh,
            result,
            str(max_pieces),
            str(limit),
        ]
        try:
            child = subprocess.run(
                command,
                timeout=limit,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                env={**os.environ, "PYTHONPATH": path},
                check=False,
            )
        except subprocess.TimeoutExpired:
            return [], f"took longer than {limit:g} s"
        if child.returncode != 0 or not os.path.exists(result):
            last = child.stderr.decode(errors="replace").strip().splitlines()[-1:] or [f"exit code {child.returncode}"]
            return [], f"failed ({last[0]})"
        with np.load(result) as arrays:
            pieces = list(arrays.values())
    solid = [piece for piece in pieces if len(piece) >= 4 and np.linalg.matrix_rank(piece - piece[0], tol=1e-6) == 3]
    return solid, "" if solid else "found no piece"


def _child(method: str, mesh: str, result: str, max_pieces: str, limit: str) -> None:
    """Decomposes one mesh file into another; ends by itself soon after the limit, should the parent be gone."""
    signal.alarm(int(float(limit)) + 5)
    with np.load(mesh) as arrays:
        vertices, faces = arrays["vertices"], arrays["faces"]
    if method == "coacd":
        import coacd

        found = coacd.run_coacd(
            coacd.Mesh(vertices, faces),
            threshold=0.05,
            max_convex_hull=int(max_pieces),
            mcts_iterations=60,
            resolution=1000,
            seed=0,
        )
    else:
        import vhacdx

        found = vhacdx.compute_vhacd(vertices, faces.astype(np.uint32), maxConvexHulls=int(max_pieces))
    np.savez(result, *(np.asarray(piece[0], np.float64) for piece in found))


if __name__ == "__main__":
    _child(*sys.argv[1:])
