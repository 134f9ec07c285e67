"""Pictures of shapes without OpenGL, EGL or a display: triangles into a depth buffer."""

import functools
from collections.abc import Sequence

import numpy as np

from congrasp.services.appearance.palette import OBJECT
from congrasp.services.viz.camera import Camera, fit
from congrasp.services.viz.kernels import NOTHING, Mesh, averaged, cover, repeated, shade
from congrasp.services.viz.lighting import FEW, MANY, ON_TABLE, light_on
from congrasp.services.viz.shapes import Shape, points_of, table_shape
from congrasp.services.viz.triangles import Triangles, joined, triangles_of

SAMPLES = 2
"""Samples along each side of a pixel."""
_NEAREST_M = 0.01
"""Depth from which a camera sees."""
_LARGE_PICTURE = 500_000
"""Pixels from which a picture is large."""
_BALL_RADIUS_M = 0.05
_BALL_VIEW = (1.0, 0.0, 1.0)
_BALL_SIZE = (8, 6)
"""Picture by which the loops are compiled."""
_BACKGROUND_TOP = np.array([0.93, 0.945, 0.965], np.float32)
_BACKGROUND_BOTTOM = np.array([0.80, 0.82, 0.85], np.float32)
"""Colours of the background, sRGB."""


def render_scene(
    shapes: Sequence[Shape], camera: Camera, size: tuple[int, int] = (640, 480)
) -> np.ndarray:
    """Draws the shapes.

    Args:
      shapes: shapes to draw, in a world frame with the z axis up.
      camera: the camera.
      size: width and height in pixels.

    Returns:
      (height, width, 3) uint8 sRGB.
    """
    width, height = size
    solid = [shape for shape in shapes if shape.alpha >= 1]
    table = triangles_of(shape for shape in solid if shape.kind == "table")
    bodies = _turned(triangles_of(shape for shape in solid if shape.kind != "table"), camera)
    casting = triangles_of((shape for shape in solid if shape.shadow), fine=False)
    key = camera.key_light()
    lamps = MANY if width * height > _LARGE_PICTURE else FEW
    coarse = _Picture.empty(camera, width, height)  # a table has no edge: one sample a pixel
    coarse.add(table, light_on(table.points, table.normals, casting, key, ON_TABLE))
    picture = coarse.finer()
    picture.add(bodies, light_on(bodies.points, bodies.normals, casting, key, lamps))
    for alpha in sorted({shape.alpha for shape in shapes if shape.alpha < 1}):
        glass = _turned(triangles_of(shape for shape in shapes if shape.alpha == alpha), camera)
        unshadowed = np.ones((len(glass.points), 2), np.float32)
        picture.add(glass, unshadowed, alpha)
    return averaged(picture.image, SAMPLES)


def render_fitted(
    shapes: Sequence[Shape],
    view: Sequence[float] | np.ndarray,
    size: tuple[int, int],
    around: Sequence[Shape] = (),
) -> np.ndarray:
    """Renders shapes from the nearest camera that sees them.

    Args:
      shapes: shapes that the picture contains.
      view: (3,) direction from the shapes to the camera.
      size: width and height in pixels.
      around: further shapes, which may leave the picture.

    Returns:
      (height, width, 3) uint8 sRGB.
    """
    width, height = size
    camera = fit(points_of(shapes), np.array(view), width / height)
    return render_scene([*shapes, *around], camera, size)


@functools.cache
def compile_loops() -> None:
    """Compiles the loops of the renderer, or loads them from the cache, by a picture of a ball on a
    table.

    The first call in a process takes seconds if the cache is empty.
    """
    ball = Shape("sphere", (_BALL_RADIUS_M, 0.0), OBJECT)
    render_fitted([ball], _BALL_VIEW, _BALL_SIZE, around=[table_shape(np.zeros(3))])


def visible(shapes: Sequence[Shape], camera: Camera, size: tuple[int, int]) -> np.ndarray:
    """(height, width) index of the solid shape that each pixel shows, -1 for the background."""
    solid = [i for i, shape in enumerate(shapes) if shape.alpha >= 1]
    parts = [triangles_of([shapes[i]], fine=False) for i in solid]
    counts = [len(part.faces) for part in parts]
    shape_of_face = np.array([*np.repeat(solid, counts), NOTHING])
    return shape_of_face[_Picture.empty(camera, *size).owners(joined(parts))]


def _turned(triangles: Triangles, camera: Camera) -> Triangles:
    """Triangles with the normals of open surfaces, which may wind either way, towards the
    camera.
    """
    first, second, third = np.moveaxis(triangles.corners, 1, 0)
    outwards = np.cross(second - first, third - first)
    is_away = np.einsum("ij,ij->i", outwards, first - camera.position) > 0
    turned = triangles.faces[is_away & ~triangles.closed]
    normals = triangles.normals.copy()
    normals[turned] = -triangles.normals[turned]
    return triangles._replace(normals=normals)


class _Picture:
    """A picture in progress: (height, width, 3) sRGB, and the inverse depth of each sample."""

    def __init__(self, camera: Camera, image: np.ndarray, nearness: np.ndarray):
        """Begins with an image and the nearness of what it shows."""
        self._camera = camera
        self.image = image
        self._nearness = nearness

    @classmethod
    def empty(cls, camera: Camera, width: int, height: int) -> "_Picture":
        """Returns a picture of the background."""
        share = np.linspace(1, 0, height, dtype=np.float32)[:, None, None]
        column = share * _BACKGROUND_TOP + (1 - share) * _BACKGROUND_BOTTOM
        image = np.broadcast_to(column, (height, width, 3)).copy()
        return cls(camera, image, np.zeros((height, width), np.float32))

    def finer(self) -> "_Picture":
        """Returns the same picture with more samples."""
        image = repeated(self.image, SAMPLES)
        nearness = repeated(self._nearness[..., None], SAMPLES)[..., 0]
        return _Picture(self._camera, image, nearness)

    def add(self, triangles: Triangles, light: np.ndarray, alpha: float = 1.0) -> None:
        """Draws triangles where they are nearest, with the shares of light (V, 2) at their
        points.
        """
        corners, nearness = self._projected(triangles.points)
        top, owner = self._covered(corners, nearness, triangles)
        columns = [
            triangles.points,
            triangles.normals,
            triangles.colours,
            light,
            triangles.shine[:, None],
            triangles.opacity[:, None],
        ]
        values = np.concatenate(columns, axis=-1, dtype=np.float32)
        mesh = Mesh(corners, nearness, triangles.faces, values, triangles.chart)
        eye = self._camera.position
        shade(mesh, triangles.texture, owner, eye, self._camera.key_light(), alpha, self.image)
        if alpha >= 1:
            self._nearness = top

    def owners(self, triangles: Triangles) -> np.ndarray:
        """(height, width) index of the triangle that each sample shows, or `NOTHING`."""
        corners, nearness = self._projected(triangles.points)
        return self._covered(corners, nearness, triangles)[1]

    def _projected(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(V, 2) columns and rows of points (V, 3), and (V,) one over their depths."""
        x, y, depth = self._camera.axes() @ (points - self._camera.position).T
        # Omits triangles that are not entirely before the camera
        depth = np.where(depth > _NEAREST_M, depth, np.nan)
        height, width = self._nearness.shape
        focus = height / 2 / np.tan(np.radians(self._camera.field_of_view) / 2)
        column = width / 2 + focus * x / depth - 0.5
        row = height / 2 - focus * y / depth - 0.5
        return np.stack([column, row], -1), 1 / depth

    def _covered(
        self, corners: np.ndarray, nearness: np.ndarray, triangles: Triangles
    ) -> tuple[np.ndarray, np.ndarray]:
        """Inverse depth of each sample with the triangles in the picture, and the index of the one
        that it shows.
        """
        top = self._nearness.copy()
        owner = np.full(self._nearness.shape, NOTHING, np.int32)
        cover(corners, nearness, triangles.faces, triangles.closed, top, owner)
        return top, owner
