"""Views of an episode: the one that shows most of fingers, contacts and object, and its camera."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError
from congrasp.common.hands.skin import MATERIALS, skin_of
from congrasp.common.io.arrays import numbers_in
from congrasp.common.task.constraints.markers import Polyline
from congrasp.services.viz.camera import Camera, fit
from congrasp.services.viz.episode_scene import TOUCH, object_at
from congrasp.services.viz.hand_shapes import capsule_shapes
from congrasp.services.viz.raster import visible
from congrasp.services.viz.shapes import Shape

_AZIMUTHS_DEG = range(0, 360, 30)
_ELEVATIONS_DEG = (16, 28, 40)
"""Directions that are compared."""
_LEAST_ASIDE_DEG = 75.0
"""Least angle between the azimuths of the two views of a picture."""
_SMALL_ROWS = 72
"""Rows of the pictures by which directions are compared."""
_SMALL_ASPECT = 4 / 3
_CONTACT = 2.0
_FINGER = 1.0
_OBJECT = 1.0
"""Weights of the seen shares of touching links, of all fingers and of the object."""
_BROAD = 2.5
"""Weight of the object's broad side."""
_BEHIND = 1.5
_BEFORE = 0.8
"""Weights against a view along the forearm, from behind and from before the hand."""
_LARGEST_FALL_M = 0.1
"""Fall up to which the camera follows an object."""


class View(NamedTuple):
    """Direction from a scene to the camera, degrees."""

    azimuth: float
    """Around the vertical: 0 looks from +x, 90 from +y."""
    elevation: float
    """Above the table."""

    @property
    def direction(self) -> np.ndarray:
        """(3,) from the scene to the camera."""
        azimuth = np.radians(self.azimuth)
        elevation = np.radians(self.elevation)
        return np.array(
            [
                np.cos(azimuth) * np.cos(elevation),
                np.sin(azimuth) * np.cos(elevation),
                np.sin(elevation),
            ]
        )


def view_of(text: str) -> View | None:
    """Parses a view, azimuth and elevation; None for an empty text.

    Raises:
      CongraspError: the text is not a view.
    """
    if not text:
        return None
    numbers = numbers_in(text).tolist()
    if len(numbers) == 2 and abs(numbers[0]) <= 360 and -10 <= numbers[1] <= 85:
        return View(*numbers)
    raise CongraspError(
        f"--camera is '{text}'.",
        "Write degrees around the table, from -360 to 360, and above it, from -10 to 85: --camera "
        '"120 25"',
    )


def views(episode: Episode, steps: Sequence[int]) -> tuple[View, View]:
    """The best view of some steps, and the best one from its side.

    The middle and the last one of the steps are compared.
    """
    compared = sorted({len(steps) // 2, len(steps) - 1})
    pictured = [_PicturedStep(episode, steps[i]) for i in compared]
    options = []
    for elevation in _ELEVATIONS_DEG:
        options += [View(float(azimuth), elevation) for azimuth in _AZIMUTHS_DEG]
    scores = np.zeros(len(options))
    for step in pictured:
        scores += [step.score(view) for view in options]
    best = options[int(np.argmax(scores))]
    is_aside = np.array([_angle(view, best) >= _LEAST_ASIDE_DEG for view in options])
    return best, options[int(np.argmax(np.where(is_aside, scores, -np.inf)))]


def _angle(first: View, second: View) -> float:
    """Angle between the azimuths of two views, degrees, at most 180."""
    return abs((first.azimuth - second.azimuth + 180) % 360 - 180)


def best_view(episode: Episode, steps: Sequence[int]) -> View:
    """The view that shows most of fingers, contacts and object in some steps."""
    return views(episode, steps)[0]


def camera_of(
    episode: Episode,
    steps: Sequence[int],
    aspect: float = 4 / 3,
    view: View | None = None,
    *,
    overlays: bool = False,
) -> Camera:
    """A camera that fits hand and object in all of the steps, by default from the best view."""
    if view is None:
        view = best_view(episode, steps)
    points = np.concatenate([extent(episode, step, overlays=overlays) for step in steps])
    hull = points[ConvexHull(points).vertices]  # a camera that fits these fits all
    return fit(hull, view.direction, aspect)


class _PicturedStep:
    """A step with the hand as capsules, for the comparison of views."""

    def __init__(self, episode: Episode, step: int):
        """Places hand and object."""
        hand = episode.known_hand()
        position = episode.link_position[step]
        quaternion = episode.link_quaternion[step]
        force = np.linalg.norm(episode.link_force[step], axis=-1)
        capsules = capsule_shapes(hand, position, quaternion)
        self._object = object_at(episode, step, painted=False)
        self._shapes = [*capsules, self._object]
        self._capsule_areas = np.array([_side_area(capsule) for capsule in capsules])
        self._is_finger = hand.capsule_links > 0
        self._is_touching = force[hand.capsule_links] > TOUCH
        self._points = extent(episode, step, overlays=False)
        wrist = Rotation.from_quat(quaternion[0], scalar_first=True)
        back = -hand.keypoints[len(hand.links) :].mean(0)
        self._forearm = wrist.apply(back / np.linalg.norm(back))
        x, y, z = np.ptp(episode.object_vertices, axis=0)
        sides = np.array([y * z, z * x, x * y])
        self._box_faces = sides / np.linalg.norm(sides)
        self._object_turn = Rotation.from_quat(self._object.quaternion, scalar_first=True)

    def score(self, view: View) -> float:
        """Weighted shares of touching links, fingers and object that a view shows.

        Each share is from 0 to about 1. A box with faces F along its axes has the silhouette
        |d| · F from a direction d, at most |F|.
        """
        camera = fit(self._points, view.direction, _SMALL_ASPECT)
        size = (round(_SMALL_ROWS * _SMALL_ASPECT), _SMALL_ROWS)
        counts = _counts(self._shapes, camera, size)
        unhidden = _counts([self._object], camera, size)[0]
        seen = self._seen_shares(counts[:-1], camera)
        contact = 0.0
        if self._is_touching.any():
            contact = float(seen[self._is_touching].mean())
        along = float(self._forearm @ view.direction)
        weight_along = _BEHIND if along > 0 else _BEFORE
        object_share = counts[-1] / max(unhidden, 1)
        broad = np.abs(self._object_turn.inv().apply(view.direction)) @ self._box_faces
        return float(
            _CONTACT * contact
            + _FINGER * seen[self._is_finger].mean()
            + _OBJECT * object_share
            + _BROAD * broad
            - weight_along * along**2
        )

    def _seen_shares(self, counts: np.ndarray, camera: Camera) -> np.ndarray:
        """(C,) share of each capsule that a picture shows, from its number of pixels."""
        distance = np.linalg.norm(camera.target - camera.position)
        height = 2 * np.tan(np.radians(camera.field_of_view) / 2) * distance
        pixels_per_m = _SMALL_ROWS / height
        return np.minimum(counts / (self._capsule_areas * pixels_per_m**2), 1.0)


def _side_area(capsule: Shape) -> float:
    """Area of a capsule from its side, as a rectangle, m²."""
    radius, half_length = capsule.size
    return 2 * radius * (2 * half_length + 2 * radius)


def _counts(shapes: Sequence[Shape], camera: Camera, size: tuple[int, int]) -> np.ndarray:
    """(n,) number of pixels that show each shape."""
    seen = visible(shapes, camera, size)
    return np.bincount(seen[seen >= 0], minlength=len(shapes))


def extent(episode: Episode, step: int, *, overlays: bool = False) -> np.ndarray:
    """(N, 3) points that a picture of a step must contain, m, world frame.

    These are the skin without sleeve, the object's box and, with `overlays`, trajectories. An
    object that has fallen far is left out.
    """
    around = hand_points(episode, step)
    fall = episode.object_position[0, 2] - episode.object_position[step, 2]
    if fall > _LARGEST_FALL_M:
        return around
    return np.concatenate([around, object_points(episode, step, overlays=overlays)])


def hand_points(episode: Episode, step: int) -> np.ndarray:
    """(N, 3) points of the skin without its sleeve, m, world frame."""
    skin = skin_of(episode.known_hand())
    turns = Rotation.from_quat(episode.link_quaternion[step], scalar_first=True)
    points = skin.posed(episode.link_position[step], turns.as_matrix())[0]
    return points[skin.material != MATERIALS.index("sleeve")]


def object_points(episode: Episode, step: int, *, overlays: bool = False) -> np.ndarray:
    """(N, 3) corners of the object's box, and with `overlays` its trajectories, m, world frame."""
    low = episode.object_vertices.min(0)
    high = episode.object_vertices.max(0)
    is_high = np.indices((2, 2, 2)).reshape(3, -1).T
    points = [np.where(is_high, high, low)]
    if overlays:
        points += [marker.points for _, marker in episode.markers() if isinstance(marker, Polyline)]
    turn = Rotation.from_quat(episode.object_quaternion[step], scalar_first=True)
    return turn.apply(np.concatenate(points)) + episode.object_position[step]
