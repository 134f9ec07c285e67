"""Capsules, boxes and meshes that rays are cast at, by MuJoCo: no OpenGL, EGL or display is needed."""

import dataclasses
import functools
from typing import Literal, NamedTuple

import mujoco
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from services.viz.smooth import SmoothNormals

Kind = Literal["box", "sphere", "capsule", "cylinder", "ellipsoid", "mesh"]

THREADS = 4
"""Casts that may run at the same time."""
_TYPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "mesh": mujoco.mjtGeom.mjGEOM_MESH,
}
_SOLID, _GLASS = 0, 1  # geom groups
GAMMA = 2.2
"""sRGB is about linear light to the power of one over this."""
_KEY = np.array([-0.45, -0.55, 1.0])  # towards the key light: right, away from the camera, up
_TOP, _BOTTOM = np.array([0.93, 0.945, 0.965]), np.array([0.80, 0.82, 0.85])  # background, sRGB


@dataclasses.dataclass(frozen=True)
class Shape:
    """One thing to draw.

    `size` follows MuJoCo (half extents; radius and half length along z; radii), zeros for a mesh; `position` (3,) and
    `quaternion` (4,) are in the world. `colour` is sRGB in [0, 1]. With `alpha` below one the shape is seen through
    and casts no shadow. `vertices` (V, 3) and `faces` (F, 3) belong to a mesh. Where `paint_points` (N, 3) and
    `paint_colours` (N, 3) are given, each point of the surface takes the colours of the nearest of them, in the
    shape's frame.
    """

    kind: Kind
    size: tuple[float, float, float]
    colour: tuple[float, float, float]
    position: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    quaternion: np.ndarray = dataclasses.field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    alpha: float = 1.0
    shine: float = 0.25
    vertices: np.ndarray | None = None
    faces: np.ndarray | None = None
    paint_points: np.ndarray | None = None
    paint_colours: np.ndarray | None = None


@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera at `position` that looks at `target`, both (3,) in the world; z is up."""

    position: np.ndarray
    target: np.ndarray
    field_of_view: float = 30.0
    """Degrees from the lower to the upper edge of the picture."""

    def axes(self) -> np.ndarray:
        """(3, 3) rows: right, up and forward."""
        forward = np.subtract(self.target, self.position)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(right, forward), forward])

    def key_light(self) -> np.ndarray:
        """(3,) unit direction towards the key light, which stays at the camera's left."""
        right = self.axes()[0]
        key = _KEY @ np.stack([right, np.cross([0.0, 0.0, 1.0], right), [0.0, 0.0, 1.0]])
        return key / np.linalg.norm(key)

    def rays(self, x: np.ndarray, y: np.ndarray, width: int, height: int) -> np.ndarray:
        """(n, 3) unit directions through places (n,) of a picture, in pixels from its upper left corner."""
        tangent = np.tan(np.radians(self.field_of_view) / 2)
        right, up, forward = self.axes()
        across = ((2 * x - width) / height * tangent)[:, None] * right
        rays = forward + across + ((1 - 2 * y / height) * tangent)[:, None] * up
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def between(
    start: np.ndarray, end: np.ndarray, radius: float, colour: tuple[float, float, float], *, alpha: float = 1.0
) -> Shape:
    """A capsule from `start` to `end` (3,), or a ball where they coincide."""
    along = np.subtract(end, start)
    length = float(np.linalg.norm(along))
    middle = np.add(start, end) / 2
    if length < 1e-9:
        return Shape("sphere", (radius, 0.0, 0.0), colour, middle, alpha=alpha)
    turn = Rotation.align_vectors([along / length], [[0.0, 0.0, 1.0]])[0].as_quat(scalar_first=True)
    return Shape("capsule", (radius, length / 2, 0.0), colour, middle, turn, alpha)


class Hits(NamedTuple):
    """What unit rays (n, 3) hit first: the shape's index (-1: none), the distance in m and the flat normal (n, 3)."""

    what: np.ndarray
    distance: np.ndarray
    normal: np.ndarray

    def at(self, which: np.ndarray) -> "Hits":
        """Those of some rays, by a mask or by indices."""
        return Hits(self.what[which], self.distance[which], self.normal[which])


class Scene:
    """Shapes compiled into a MuJoCo model whose geoms have the shapes' indices."""

    def __init__(self, shapes: list[Shape]):
        self.shapes = shapes
        spec = mujoco.MjSpec()
        for index, shape in enumerate(shapes):
            geom = {
                "type": _TYPES[shape.kind],
                "pos": shape.position,
                "quat": shape.quaternion,
                "group": _SOLID if shape.alpha >= 1 else _GLASS,
                "contype": 0,
                "conaffinity": 0,
            }
            if shape.kind == "mesh":
                spec.add_mesh(
                    name=str(index),
                    uservert=np.asarray(shape.vertices, np.float32).ravel(),
                    userface=np.asarray(shape.faces, np.int32).ravel(),
                    inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
                )
                geom["meshname"] = str(index)
            else:
                geom["size"] = shape.size
            spec.worldbody.add_geom(**geom)
        self.model = spec.compile()
        # Ray casts keep scratch memory in their data: one for each thread.
        self._data = [mujoco.MjData(self.model) for _ in range(THREADS)]
        for data in self._data:
            mujoco.mj_kinematics(self.model, data)
        self._paint = {i: cKDTree(s.paint_points) for i, s in enumerate(shapes) if s.paint_points is not None}

    @functools.cached_property
    def _smooth(self) -> dict[int, SmoothNormals]:
        """Smooth normals of the meshes by their indices."""
        meshes = {i: shape for i, shape in enumerate(self.shapes) if shape.kind == "mesh"}
        return {i: SmoothNormals(np.asarray(s.vertices), np.asarray(s.faces)) for i, s in meshes.items()}

    def cast(self, origin: np.ndarray, rays: np.ndarray, *, glass: bool = False, thread: int = 0) -> Hits:
        """Casts unit rays (n, 3) from `origin` (3,) at the solid shapes, or at those that are seen through."""
        count = len(rays)
        index, distance, normal = np.full(count, -1, np.int32), np.full(count, -1.0), np.zeros(3 * count)
        groups = np.zeros(6, np.uint8)
        groups[_GLASS if glass else _SOLID] = 1
        if count:
            mujoco.mj_multiRay(
                self.model, self._data[thread], np.asarray(origin, float), np.ravel(rays), groups, True, -1,
                index, distance, normal, count, mujoco.mjMAXVAL,
            )  # fmt: skip
        return Hits(index, distance, normal.reshape(-1, 3))

    def surface(self, hits: Hits, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Colours (n, 3) sRGB and smooth normals (n, 3) at the points (n, 3) that were hit."""
        colour = np.array([shape.colour for shape in self.shapes], float)[hits.what]
        normal = hits.normal.copy()
        for i in {*self._smooth, *self._paint}:
            here = hits.what == i
            if not here.any():
                continue
            shape = self.shapes[i]
            turn = Rotation.from_quat(shape.quaternion, scalar_first=True)
            local = turn.inv().apply(point[here] - shape.position)
            if i in self._smooth:
                normal[here] = turn.apply(self._smooth[i](local, turn.inv().apply(normal[here])))
            if i in self._paint:
                colour[here] = painted(self._paint[i], np.asarray(shape.paint_colours), local)
        return colour, normal


def background(share: np.ndarray) -> np.ndarray:
    """(..., 3) sRGB at heights (..., 1) from zero, below, to one."""
    return share * _TOP + (1 - share) * _BOTTOM


def painted(tree: cKDTree, colours: np.ndarray, point: np.ndarray) -> np.ndarray:
    """(n, 3) colours of the nearest paint points, with a soft border."""
    distance, near = tree.query(point, k=min(4, len(colours)))
    distance, near = distance.reshape(len(point), -1), near.reshape(len(point), -1)
    weight = 1 / (distance**2 + 1e-8) ** 2
    return (weight[..., None] * colours[near]).sum(1) / weight.sum(1, keepdims=True)
