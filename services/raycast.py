"""Pictures of capsules, boxes and meshes by casting rays with MuJoCo: no OpenGL, EGL or display is needed.

Every pixel takes one ray, and `SAMPLES` x `SAMPLES` where it lies on an edge. Light comes from one soft key light and
a dome; shadows are found by casting rays from each lamp to the shaded points.
"""

import dataclasses
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Literal

import mujoco
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from services.smooth import SmoothNormals

Kind = Literal["box", "sphere", "capsule", "cylinder", "ellipsoid", "mesh"]

SAMPLES = 2
"""Rays along each side of a pixel that lies on an edge."""
_TYPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "mesh": mujoco.mjtGeom.mjGEOM_MESH,
}
_SOLID, _GLASS = 0, 1  # geom groups
_FAR = 4.0  # distance of the lamps from what they light, m
_KEY = np.array([-0.45, -0.55, 1.0])  # direction towards the key light, in the camera's turned frame
_KEY_STRENGTH, _DOME_STRENGTH, _BOUNCE = 0.72, 0.46, 0.05
_KEY_LAMPS, _DOME_LAMPS = 16, 32
_SETS, _EDGE_SETS = (
    16,
    4,
)  # sets into which the lamps are split; pixels, or samples of edge pixels, take turns with them
_THREADS = 4
_SKIN = 4e-4  # how far shadow rays may end before the surface, m
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

    def rays(self, x: np.ndarray, y: np.ndarray, width: int, height: int) -> np.ndarray:
        """(n, 3) unit directions through places (n,) of a picture, in pixels from its upper left corner."""
        tangent = np.tan(np.radians(self.field_of_view) / 2)
        right, up, forward = self.axes()
        across = ((2 * x - width) / height * tangent)[:, None] * right
        rays = forward + across + ((1 - 2 * y / height) * tangent)[:, None] * up
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def between(start: np.ndarray, end: np.ndarray, radius: float, colour: tuple, **options: object) -> Shape:
    """A capsule from `start` to `end` (3,), as a `Shape`."""
    along = np.subtract(end, start)
    length = float(np.linalg.norm(along))
    turn = Rotation.align_vectors([along / length], [[0.0, 0.0, 1.0]])[0] if length > 0 else Rotation.identity()
    return Shape(
        "capsule",
        (radius, length / 2, 0.0),
        colour,
        np.add(start, end) / 2,
        turn.as_quat(scalar_first=True),
        **options,  # type: ignore[arg-type]
    )


def render_scene(shapes: list[Shape], camera: Camera, size: tuple[int, int] = (640, 480)) -> np.ndarray:
    """Draws the shapes.

    Args:
      shapes: what to draw; the world's z axis points up.
      camera: from where.
      size: width and height in pixels.

    Returns:
      (height, width, 3) uint8 sRGB.
    """
    return _Scene(shapes).render(camera, *size)


def visible(shapes: list[Shape], camera: Camera, size: tuple[int, int]) -> np.ndarray:
    """(height, width) index of the solid shape that each pixel shows, -1 for the background; quick, without shading."""
    return _Scene(shapes).cast(camera.position, _grid(camera, *size), _SOLID)[0].reshape(size[::-1])


class _Scene:
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
        self.data = [mujoco.MjData(self.model) for _ in range(_THREADS)]
        for data in self.data:
            mujoco.mj_kinematics(self.model, data)
        self.smooth = {
            i: SmoothNormals(np.asarray(s.vertices), np.asarray(s.faces))
            for i, s in enumerate(shapes)
            if s.kind == "mesh"
        }
        self.paint = {i: cKDTree(s.paint_points) for i, s in enumerate(shapes) if s.paint_points is not None}

    def cast(
        self, origin: np.ndarray, rays: np.ndarray, group: int, thread: int = 0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Shape index (-1: none), distance and normal of the first hits of unit rays (..., 3) of one group."""
        count = rays.size // 3
        index, distance, normal = np.full(count, -1, np.int32), np.full(count, -1.0), np.zeros(3 * count)
        groups = np.zeros(6, np.uint8)
        groups[group] = 1
        if count:
            mujoco.mj_multiRay(
                self.model, self.data[thread], np.asarray(origin, float), np.ravel(rays), groups, True, -1,
                index, distance, normal, count, mujoco.mjMAXVAL,
            )  # fmt: skip
        shape = rays.shape[:-1]
        return index.reshape(shape), distance.reshape(shape), normal.reshape(rays.shape)

    def render(self, camera: Camera, width: int, height: int) -> np.ndarray:
        """(height, width, 3) uint8."""
        pixel = np.arange(width * height)
        row, column = np.divmod(pixel, width)
        image, seen, normal = self._see(camera, _grid(camera, width, height), column % 4 + 4 * (row % 4), width)
        edge = np.flatnonzero(_edges(seen.reshape(height, width), normal.reshape(height, width, 3)))
        step = (np.arange(SAMPLES) + 0.5) / SAMPLES
        x = np.add.outer(column[edge], np.tile(step, SAMPLES)).ravel()
        y = np.add.outer(row[edge], np.repeat(step, SAMPLES)).ravel()
        fine, _, _ = self._see(camera, camera.rays(x, y, width, height), np.arange(len(x)) % _EDGE_SETS, None)
        image[edge] = fine.reshape(len(edge), SAMPLES**2, 3).mean(1)
        return (255 * np.clip(image, 0, 1) + 0.5).astype(np.uint8).reshape(height, width, 3)

    def _see(
        self, camera: Camera, rays: np.ndarray, lamp_set: np.ndarray, width: int | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What rays (n, 3) show.

        Args:
          camera: where they begin.
          rays: unit directions.
          lamp_set: (n,) which of the sets of lamps lights each point.
          width: pixels in a row where the rays are those of a whole picture, whose light is then smoothed.

        Returns:
          Colours (n, 3) sRGB, numbers (n,) that differ where other shapes are seen, and normals (n, 3).
        """
        index, distance, normal = self.cast(camera.position, rays, _SOLID)
        colour = _background(rays)
        seen = index >= 0
        colour[seen] = self._shade(camera, index, distance, normal, rays, lamp_set, seen, width)
        if all(shape.alpha >= 1 for shape in self.shapes):
            return colour, index, normal
        glass, nearer, glass_normal = self.cast(camera.position, rays, _GLASS)
        seen = (glass >= 0) & ((index < 0) | (nearer < distance))
        alpha = np.array([shape.alpha for shape in self.shapes])[glass[seen]][:, None]
        lit = self._shade(camera, glass, nearer, glass_normal, rays, lamp_set, seen, width)
        colour[seen] = alpha * lit + (1 - alpha) * colour[seen]
        return colour, (len(self.shapes) + 1) * index + np.where(seen, glass, -1), normal

    def _shade(
        self,
        camera: Camera,
        index: np.ndarray,
        distance: np.ndarray,
        normal: np.ndarray,
        ray: np.ndarray,
        lamp_set: np.ndarray,
        seen: np.ndarray,
        width: int | None,
    ) -> np.ndarray:
        """sRGB of the points that rays `seen` (n,) hit, as many as there are; other arguments as in `_see`."""
        pixel, pixels = np.flatnonzero(seen), len(seen)
        index, distance, normal, ray, lamp_set = (a[seen] for a in (index, distance, normal, ray, lamp_set))
        point = camera.position + distance[:, None] * ray
        albedo = np.array([shape.colour for shape in self.shapes], float)[index]
        shine = np.array([shape.shine for shape in self.shapes])[index]
        bent = normal.copy()
        for i in {*self.smooth, *self.paint}:
            here = index == i
            if not here.any():
                continue
            shape = self.shapes[i]
            turn = Rotation.from_quat(shape.quaternion, scalar_first=True)
            local = turn.inv().apply(point[here] - shape.position)
            if i in self.smooth:
                bent[here] = turn.apply(self.smooth[i](local, turn.inv().apply(normal[here])))
            if i in self.paint:
                albedo[here] = _painted(self.paint[i], np.asarray(shape.paint_colours), local)
        right = camera.axes()[0]
        key = _KEY @ np.stack([right, np.cross([0.0, 0.0, 1.0], right), [0.0, 0.0, 1.0]])
        key = key / np.linalg.norm(key)
        sets = _EDGE_SETS if width is None else _SETS
        light = np.stack(self._light(point + 2 * _SKIN * normal, bent, key, lamp_set, sets), -1)
        if width is not None:
            for stride in (1, 2):
                light = _blur(light, index, normal, pixel, (pixels, width), stride)
        seen_key, open_sky = light.T
        half = key - ray
        half = half / np.linalg.norm(half, axis=1, keepdims=True)
        gloss = shine * seen_key * np.clip((bent * half).sum(1), 0, None) ** 60
        total = _KEY_STRENGTH * seen_key * np.clip(bent @ key, 0, None)
        sky = 2 * np.clip(_facing(bent, _dome(_DOME_LAMPS)), 0, None).mean(1)
        total += _DOME_STRENGTH * open_sky * sky + _BOUNCE * (1 - bent[:, 2])
        return np.clip(albedo**2.2 * total[:, None] + 0.35 * gloss[:, None], 0, 1) ** (1 / 2.2)

    def _light(
        self, start: np.ndarray, normal: np.ndarray, key: np.ndarray, lamp_set: np.ndarray, sets: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Shares of the key light and of the sky (n,) that reach points (n, 3), each judged by one set of lamps."""
        seen, sky, whole = np.zeros(len(start)), np.full(len(start), 1e-9), np.full(len(start), 1e-9)
        keys, dome = _disc(key, _KEY_LAMPS, 0.14), _dome(_DOME_LAMPS)

        def light(thread: int) -> None:
            for one in range(thread, sets, _THREADS):
                mine = np.flatnonzero(lamp_set == one)
                towards_key = mine[normal[mine] @ key > 0]
                for lamp in keys[one::sets]:
                    seen[towards_key] += self._lit(start[towards_key], lamp, thread) * sets / _KEY_LAMPS
                for lamp in dome[one::sets]:
                    facing = _facing(normal[mine], lamp)
                    here, facing = mine[facing > 0], facing[facing > 0]
                    sky[here] += self._lit(start[here], lamp, thread) * facing
                    whole[here] += facing

        with ThreadPoolExecutor(min(_THREADS, os.cpu_count() or 1)) as pool:
            list(pool.map(light, range(_THREADS)))
        return seen, sky / whole

    def _lit(self, point: np.ndarray, lamp: np.ndarray, thread: int) -> np.ndarray:
        """(n,) whether a lamp in direction (3,) of the unit sphere is seen from points (n, 3)."""
        if not len(point):
            return np.zeros(0)
        origin = point.mean(0) + _FAR * lamp
        rays = point - origin
        length = np.linalg.norm(rays, axis=1, keepdims=True)
        _, distance, _ = self.cast(origin, rays / length, _SOLID, thread)
        return (distance < 0) | (distance > length[:, 0] - _SKIN)


def _facing(normal: np.ndarray, lamps: np.ndarray) -> np.ndarray:
    """Wrapped Lambert terms of normals (n, 3) towards lamps ([k,] 3): a lamp of the dome is a patch of sky."""
    return 0.75 * (normal @ lamps.T) + 0.25


def _painted(tree: cKDTree, colours: np.ndarray, point: np.ndarray) -> np.ndarray:
    """(n, 3) colours of the nearest paint points, with a soft border."""
    distance, near = tree.query(point, k=min(4, len(colours)))
    distance, near = distance.reshape(len(point), -1), near.reshape(len(point), -1)
    weight = 1 / (distance**2 + 1e-8) ** 2
    return (weight[..., None] * colours[near]).sum(1) / weight.sum(1, keepdims=True)


def _grid(camera: Camera, width: int, height: int) -> np.ndarray:
    """(height * width, 3) rays through the centres of a picture's pixels, row by row."""
    y, x = np.indices((height, width)).reshape(2, -1) + 0.5
    return camera.rays(x, y, width, height)


def _edges(seen: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(height, width) whether a pixel and one of its eight neighbours show other shapes or sides of a shape."""
    edge = np.zeros(seen.shape, bool)
    for axis in (0, 1):
        here, there = (slice(None),) * axis + (slice(1, None),), (slice(None),) * axis + (slice(None, -1),)
        differ = (seen[here] != seen[there]) | ((normal[here] * normal[there]).sum(-1) < 0.9) & (seen[here] >= 0)
        edge[here] |= differ
        edge[there] |= differ
    return edge


def _blur(
    value: np.ndarray, index: np.ndarray, normal: np.ndarray, pixel: np.ndarray, grid: tuple[int, int], stride: int
) -> np.ndarray:
    """Averages value (n, c) over 3 x 3 pixels `stride` apart, among points of one shape that face the same way.

    Binomial filters with strides of one and two, one after the other, weigh 4 x 4 interleaved lamp sets equally. `grid` is the number of pixels and a row's width.
    """
    pixels, width = grid
    place = np.full(pixels, -1)
    place[pixel] = np.arange(len(pixel))
    place = np.pad(place.reshape(-1, width), stride, constant_values=-1)
    row, column = np.divmod(pixel, width)
    total, weights = np.zeros(value.shape), np.zeros(len(value))
    for y, x in np.ndindex(3, 3):
        other = place[row + stride * y, column + stride * x]
        alike = (other >= 0) & (index[other] == index) & ((normal[other] * normal).sum(-1) > 0.8)
        weight = alike * float((2 - abs(y - 1)) * (2 - abs(x - 1)))
        total += weight[:, None] * value[other]
        weights += weight
    return total / weights[:, None]


def _disc(direction: np.ndarray, count: int, radius: float) -> np.ndarray:
    """(count, 3) directions around a unit direction, spread over a disc by the golden angle."""
    side = np.cross(direction, [0.0, 0.0, 1.0])
    side = side / np.linalg.norm(side)
    other = np.cross(direction, side)
    step = np.arange(count) + 0.5
    r, angle = radius * np.sqrt(step / count), step * np.pi * (3 - np.sqrt(5))
    spread = direction + (r * np.cos(angle))[:, None] * side + (r * np.sin(angle))[:, None] * other
    return spread / np.linalg.norm(spread, axis=1, keepdims=True)


def _dome(count: int) -> np.ndarray:
    """(count, 3) directions spread evenly over the upper half of the sphere."""
    step = np.arange(count) + 0.5
    z, angle = 0.08 + 0.92 * step / count, step * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], -1)


def _background(rays: np.ndarray) -> np.ndarray:
    """sRGB of the sky along unit rays (..., 3): a soft vertical gradient."""
    share = np.clip(0.5 + 0.9 * rays[..., 2:], 0, 1)
    return share * _TOP + (1 - share) * _BOTTOM
