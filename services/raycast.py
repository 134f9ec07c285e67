"""Pictures of capsules, boxes and meshes by casting rays with MuJoCo: no OpenGL, EGL or display is needed.

Every pixel takes `SAMPLES` x `SAMPLES` rays to find what it shows, but is shaded once unless it holds an edge. Light
comes from one soft key light and a dome; shadows are found by casting rays from each lamp to the shaded points.
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
"""Rays along each side of a pixel."""
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
_KEY_LAMPS, _DOME_LAMPS = 3, 8  # in each of four sets that neighbouring pixels take turns with
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

    def rays(self, width: int, height: int) -> np.ndarray:
        """(height, width, 3) unit directions through the centres of the pixels."""
        tangent = np.tan(np.radians(self.field_of_view) / 2)
        x = (2 * (np.arange(width) + 0.5) / width - 1) * tangent * width / height
        y = (1 - 2 * (np.arange(height) + 0.5) / height) * tangent
        right, up, forward = self.axes()
        rays = forward + x[None, :, None] * right + y[:, None, None] * up
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
    rays = camera.rays(*size)
    return _Scene(shapes).cast(camera.position, rays, _SOLID)[0]


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
        self.data = [mujoco.MjData(self.model) for _ in range(4)]
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
        rays = camera.rays(SAMPLES * width, SAMPLES * height)
        rays = rays.reshape(height, SAMPLES, width, SAMPLES, 3).swapaxes(1, 2).reshape(-1, SAMPLES**2, 3)
        index, distance, normal = self.cast(camera.position, rays, _SOLID)
        image = self._layer(camera, rays, index, distance, normal, _background(rays[:, :1]), width)
        if any(shape.alpha < 1 for shape in self.shapes):
            glass, nearer, normal = self.cast(camera.position, rays, _GLASS)
            hidden = (index >= 0) & (distance < nearer)
            image = self._layer(camera, rays, np.where(hidden, -1, glass), nearer, normal, image[:, None], width)
        return (255 * np.clip(image, 0, 1) + 0.5).astype(np.uint8).reshape(height, width, 3)

    def _layer(
        self,
        camera: Camera,
        rays: np.ndarray,
        index: np.ndarray,
        distance: np.ndarray,
        normal: np.ndarray,
        below: np.ndarray,
        width: int,
    ) -> np.ndarray:
        """(pixels, 3) sRGB of what rays (pixels, samples, 3) hit, over the picture `below` (pixels, 1, 3)."""
        pixels, samples = index.shape
        # A pixel is shaded once where its samples agree, and for every sample where it holds an edge.
        flat = (index == index[:, :1]).all(1) & ((normal * normal[:, :1]).sum(-1) > 0.9).all(1)
        shaded = (index >= 0) & (~flat[:, None] | (np.arange(samples) == 0))
        pixel, sample = np.nonzero(shaded)
        point = camera.position + distance[shaded][:, None] * rays[shaded]
        lit = self._shade(camera, index[shaded], point, normal[shaded], rays[shaded], pixel, sample, (pixels, width))
        colour = np.repeat(below, samples, 1)
        alpha = np.array([shape.alpha for shape in self.shapes])[index[shaded]][:, None]
        colour[shaded] = alpha * lit + (1 - alpha) * colour[shaded]
        return np.where(flat[:, None], colour[:, 0], colour.mean(1))

    def _shade(
        self,
        camera: Camera,
        index: np.ndarray,
        point: np.ndarray,
        normal: np.ndarray,
        ray: np.ndarray,
        pixel: np.ndarray,
        sample: np.ndarray,
        grid: tuple[int, int],
    ) -> np.ndarray:
        """(n, 3) sRGB of points (n, 3) with flat normals (n, 3), seen along unit rays (n, 3) by a pixel's sample."""
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
        lamp_set = ((pixel % grid[1]) % 2 + 2 * ((pixel // grid[1]) % 2) + sample) % 4
        seen, sky = self._light(point + 2 * _SKIN * normal, bent, key, lamp_set)
        place = np.where(sample == 0, pixel, -1)
        softened = np.stack([seen, sky], -1)
        for _ in range(2):
            softened = _blur(softened, index, normal, place, grid)
        seen, sky = softened.T
        half = key - ray
        half = half / np.linalg.norm(half, axis=1, keepdims=True)
        gloss = shine * seen * np.clip((bent * half).sum(1), 0, None) ** 60
        light = _KEY_STRENGTH * seen * np.clip(bent @ key, 0, None) + _DOME_STRENGTH * sky + _BOUNCE * (1 - bent[:, 2])
        return np.clip(albedo**2.2 * light[:, None] + 0.35 * gloss[:, None], 0, 1) ** (1 / 2.2)

    def _light(
        self, start: np.ndarray, normal: np.ndarray, key: np.ndarray, lamp_set: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Share of the key light (n,) and light of the sky (n,) at points (n, 3), each lit by one of four lamp sets."""
        seen, sky = np.zeros(len(start)), np.zeros(len(start))
        keys, dome = _disc(key, 4 * _KEY_LAMPS, 0.14), _dome(4 * _DOME_LAMPS)

        def light(one: int) -> None:
            mine = np.flatnonzero(lamp_set == one)
            towards_key = mine[normal[mine] @ key > 0]
            for lamp in keys[one::4]:
                seen[towards_key] += self._lit(start[towards_key], lamp, one) / _KEY_LAMPS
            for lamp in dome[one::4]:
                # Wrapped Lambert: a lamp of the dome stands for a patch of sky.
                facing = 0.75 * (normal[mine] @ lamp) + 0.25
                here, facing = mine[facing > 0], facing[facing > 0]
                sky[here] += 2 / _DOME_LAMPS * self._lit(start[here], lamp, one) * facing

        with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
            list(pool.map(light, range(4)))
        return seen, sky

    def _lit(self, point: np.ndarray, lamp: np.ndarray, thread: int) -> np.ndarray:
        """(n,) whether a lamp in direction (3,) of the unit sphere is seen from points (n, 3)."""
        if not len(point):
            return np.zeros(0)
        origin = point.mean(0) + _FAR * lamp
        rays = point - origin
        length = np.linalg.norm(rays, axis=1, keepdims=True)
        _, distance, _ = self.cast(origin, rays / length, _SOLID, thread)
        return (distance < 0) | (distance > length[:, 0] - _SKIN)


def _painted(tree: cKDTree, colours: np.ndarray, point: np.ndarray) -> np.ndarray:
    """(n, 3) colours of the nearest paint points, with a soft border."""
    distance, near = tree.query(point, k=min(4, len(colours)))
    distance, near = distance.reshape(len(point), -1), near.reshape(len(point), -1)
    weight = 1 / (distance**2 + 1e-8) ** 2
    return (weight[..., None] * colours[near]).sum(1) / weight.sum(1, keepdims=True)


def _blur(
    value: np.ndarray, index: np.ndarray, normal: np.ndarray, pixel: np.ndarray, grid: tuple[int, int]
) -> np.ndarray:
    """Averages value (n, c) over the 3 x 3 pixels around, among points of one shape that face the same way.

    The binomial filter weighs the four interleaved lamp sets equally. Points with a negative `pixel` stay as they are.
    """
    pixels, width = grid
    place = np.full(pixels, -1)
    mine = np.flatnonzero(pixel >= 0)
    place[pixel[mine]] = mine
    place = np.pad(place.reshape(-1, width), 1, constant_values=-1)
    row, column = pixel[mine] // width + 1, pixel[mine] % width + 1
    total, weights = np.zeros((len(mine), value.shape[1])), np.zeros(len(mine))
    for y, x in np.ndindex(3, 3):
        other = place[row + y - 1, column + x - 1]
        alike = (other >= 0) & (index[other] == index[mine]) & ((normal[other] * normal[mine]).sum(-1) > 0.8)
        weight = alike * float((2 - abs(y - 1)) * (2 - abs(x - 1)))
        total += weight[:, None] * value[other]
        weights += weight
    result = value.copy()
    result[mine] = total / weights[:, None]
    return result


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
