"""Pictures of shapes: one soft key light, the light of the sky, shadows by rays from the lamps, smooth edges.

Every pixel takes one ray, and `SAMPLES` x `SAMPLES` where it lies on an edge. Which share of each light reaches a point
is judged by few of its lamps; neighbouring pixels take turns with them, and the result is smoothed within each shape.
"""

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from services.viz.raycast import GAMMA, THREADS, Camera, Hits, Scene, Shape, background

SAMPLES = 2
"""Rays along each side of a pixel that lies on an edge."""
_FAR = 4.0  # distance of the lamps from what they light, m
_SKIN = 4e-4  # how far before the surface shadow rays may end, m
_KEY_SIZE = 0.14
_KEY_STRENGTH, _SKY_STRENGTH, _BOUNCE, _SHINE = 0.72, 0.46, 0.05, 0.35
_KEY_LAMPS, _SKY_LAMPS = 16, 32
_SETS, _EDGE_SETS = 16, 4  # into how many sets the lamps are split, for pixels and for samples of edges
_ALIKE = 0.8  # cosine between normals that may share their light


def render_scene(shapes: list[Shape], camera: Camera, size: tuple[int, int] = (640, 480)) -> np.ndarray:
    """Draws the shapes.

    Args:
      shapes: what to draw; the world's z axis points up.
      camera: from where.
      size: width and height in pixels.

    Returns:
      (height, width, 3) uint8 sRGB.
    """
    return _Picture(Scene(shapes), camera, *size).render()


def visible(scene: Scene, camera: Camera, size: tuple[int, int]) -> np.ndarray:
    """(height, width) index of the solid shape that each pixel shows, -1 for the background; quick, without shading."""
    picture = _Picture(scene, camera, *size)
    return picture.scene.cast(camera.position, picture.rays).what.reshape(size[::-1])


class _Picture:
    """One scene from one camera."""

    def __init__(self, scene: Scene, camera: Camera, width: int, height: int):
        self.scene, self._camera, self._width, self._height = scene, camera, width, height
        self._row, self._column = np.divmod(np.arange(width * height), width)
        self.rays = camera.rays(self._column + 0.5, self._row + 0.5, width, height)
        self._key = camera.key_light()
        self._keys, self._sky = _disc(self._key, _KEY_LAMPS, _KEY_SIZE), _dome(_SKY_LAMPS)

    def render(self) -> np.ndarray:
        """(height, width, 3) uint8."""
        solid, glass = self._cast(self.rays)
        light = self._grid_light(solid)
        image = self._colour(self.rays, solid, glass, light)
        edge = np.flatnonzero(self._edges(solid, glass))
        step = (np.arange(SAMPLES) + 0.5) / SAMPLES
        x = np.add.outer(self._column[edge], np.tile(step, SAMPLES)).ravel()
        y = np.add.outer(self._row[edge], np.repeat(step, SAMPLES)).ravel()
        rays = self._camera.rays(x, y, self._width, self._height)
        fine_solid, fine_glass = self._cast(rays)
        fine_light = self._borrow(solid, light, fine_solid, np.repeat(edge, SAMPLES**2))
        alone = (fine_solid.what >= 0) & np.isnan(fine_light[:, 0])
        fine_light[alone] = self._light(
            fine_solid.at(alone), rays[alone], np.flatnonzero(alone) % _EDGE_SETS, _EDGE_SETS
        )
        fine = self._colour(rays, fine_solid, fine_glass, fine_light)
        image[edge] = fine.reshape(len(edge), SAMPLES**2, 3).mean(1)
        return (255 * np.clip(image, 0, 1) + 0.5).astype(np.uint8).reshape(self._height, self._width, 3)

    def _cast(self, rays: np.ndarray) -> tuple[Hits, Hits]:
        """Solid shapes, and what is seen through before them."""
        solid = self.scene.cast(self._camera.position, rays)
        glass = self.scene.cast(self._camera.position, rays, glass=True)
        hidden = (solid.what >= 0) & (solid.distance < glass.distance)
        return solid, glass._replace(what=np.where(hidden, -1, glass.what))

    def _colour(self, rays: np.ndarray, solid: Hits, glass: Hits, light: np.ndarray) -> np.ndarray:
        """(n, 3) sRGB of rays (n, 3), with the light (n, 2) of the solid shapes; glass is lit by everything."""
        colour = background(np.clip(0.5 + 0.9 * rays[:, 2:], 0, 1))
        seen = solid.what >= 0
        colour[seen] = self._shade(solid.at(seen), rays[seen], light[seen])
        seen = glass.what >= 0
        alpha = np.array([shape.alpha for shape in self.scene.shapes])[glass.what[seen], None]
        lit = self._shade(glass.at(seen), rays[seen], np.ones((int(seen.sum()), 2)))
        colour[seen] = alpha * lit + (1 - alpha) * colour[seen]
        return colour

    def _shade(self, hits: Hits, rays: np.ndarray, light: np.ndarray) -> np.ndarray:
        """(n, 3) sRGB of what unit rays (n, 3) hit; `light` (n, 2): shares of key light and sky."""
        albedo, normal = self.scene.surface(hits, self._camera.position + hits.distance[:, None] * rays)
        shine = np.array([shape.shine for shape in self.scene.shapes])[hits.what]
        half = self._key - rays
        half = half / np.linalg.norm(half, axis=1, keepdims=True)
        gloss = _SHINE * shine * light[:, 0] * np.clip((normal * half).sum(1), 0, None) ** 60
        total = _KEY_STRENGTH * light[:, 0] * np.clip(normal @ self._key, 0, None)
        total += _SKY_STRENGTH * light[:, 1] * 2 * np.clip(_facing(normal, self._sky), 0, None).mean(1)
        total += _BOUNCE * (1 - normal[:, 2])
        return np.clip(albedo**GAMMA * total[:, None] + gloss[:, None], 0, 1) ** (1 / GAMMA)

    def _grid_light(self, hits: Hits) -> np.ndarray:
        """(pixels, 2) light of a whole picture's pixels, zero in the background."""
        light = np.zeros((len(self.rays), 2))
        seen = hits.what >= 0
        pixel, mine = np.flatnonzero(seen), hits.at(seen)
        lamp_set = self._column % 4 + 4 * (self._row % 4)
        light[seen] = self._light(mine, self.rays[seen], lamp_set[seen], _SETS)
        # One after the other, binomial filters with these strides weigh 4 x 4 interleaved lamp sets equally.
        for stride in (1, 2):
            total, weights = np.zeros((len(pixel), 2)), np.zeros(len(pixel))
            for y, x in np.ndindex(3, 3):
                other, alike = self._neighbours(hits, mine, pixel, stride * (y - 1), stride * (x - 1))
                weight = alike * float((2 - abs(y - 1)) * (2 - abs(x - 1)))
                total += weight[:, None] * light[other]
                weights += weight
            light[seen] = total / weights[:, None]
        return light

    def _borrow(self, hits: Hits, light: np.ndarray, fine: Hits, pixel: np.ndarray) -> np.ndarray:
        """(n, 2) light for samples of edges: that of an adjacent pixel that shows the same surface, NaN without one."""
        total, count = np.zeros((len(pixel), 2)), np.zeros((len(pixel), 1))
        for y, x in np.ndindex(3, 3):
            other, alike = self._neighbours(hits, fine, pixel, y - 1, x - 1)
            total += alike[:, None] * light[other]
            count += alike[:, None]
        return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)

    def _neighbours(
        self, hits: Hits, mine: Hits, pixel: np.ndarray, down: int, right: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """The pixels some way from `pixel` (n,), and whether they show the same side of the shape as `mine`."""
        row, column = self._row[pixel] + down, self._column[pixel] + right
        inside = (row >= 0) & (row < self._height) & (column >= 0) & (column < self._width)
        other = np.where(inside, row * self._width + column, 0)
        same = inside & (mine.what >= 0) & (hits.what[other] == mine.what)
        return other, same & ((hits.normal[other] * mine.normal).sum(-1) > _ALIKE)

    def _light(self, hits: Hits, rays: np.ndarray, lamp_set: np.ndarray, sets: int) -> np.ndarray:
        """(n, 2) shares of the key light and of the sky that reach what was hit, judged by one set of lamps each."""
        start = self._camera.position + hits.distance[:, None] * rays + 2 * _SKIN * hits.normal
        key, sky, whole = np.zeros(len(start)), np.full(len(start), 1e-9), np.full(len(start), 1e-9)

        def judge(thread: int) -> None:
            """Lights the points of every so many'th set of lamps."""
            for one in range(thread, sets, THREADS):
                mine = np.flatnonzero(lamp_set == one)
                towards = mine[hits.normal[mine] @ self._key > 0]
                for lamp in self._keys[one::sets]:
                    key[towards] += self._reached(start[towards], lamp, thread) * sets / _KEY_LAMPS
                for lamp in self._sky[one::sets]:
                    facing = _facing(hits.normal[mine], lamp)
                    here, facing = mine[facing > 0], facing[facing > 0]
                    sky[here] += self._reached(start[here], lamp, thread) * facing
                    whole[here] += facing

        with ThreadPoolExecutor(min(THREADS, os.cpu_count() or 1)) as pool:
            list(pool.map(judge, range(THREADS)))
        return np.stack([key, sky / whole], -1)

    def _reached(self, points: np.ndarray, lamp: np.ndarray, thread: int) -> np.ndarray:
        """(n,) whether points (n, 3) see a lamp in the direction (3,)."""
        if not len(points):
            return np.zeros(0)
        origin = points.mean(0) + _FAR * lamp
        rays = points - origin
        length = np.linalg.norm(rays, axis=1)
        distance = self.scene.cast(origin, rays / length[:, None], thread=thread).distance
        return (distance < 0) | (distance > length - _SKIN)

    def _edges(self, solid: Hits, glass: Hits) -> np.ndarray:
        """(pixels,) whether a pixel and one of its eight neighbours show other shapes or sides of a shape."""
        shown = (solid.what * (len(self.scene.shapes) + 1) + glass.what).reshape(self._height, self._width)
        normal = solid.normal.reshape(self._height, self._width, 3)
        edge = np.zeros(shown.shape, bool)
        for axis in (0, 1):
            here, there = (slice(None),) * axis + (slice(1, None),), (slice(None),) * axis + (slice(None, -1),)
            differ = (shown[here] != shown[there]) | ((normal[here] * normal[there]).sum(-1) < 0.9) & (shown[here] >= 0)
            edge[here] |= differ
            edge[there] |= differ
        return edge.ravel()


def _facing(normal: np.ndarray, lamps: np.ndarray) -> np.ndarray:
    """Wrapped Lambert terms of normals (n, 3) towards lamps ([k,] 3): a lamp of the sky stands for a patch of it."""
    return 0.75 * (normal @ lamps.T) + 0.25


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
