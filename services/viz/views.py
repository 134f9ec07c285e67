"""Recorded episodes: the appearance of a control step, and cameras that show most of fingers,
contacts and object.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.common.hands import known_hand
from congrasp.common.hands.skin import MATERIALS, skin_of
from congrasp.common.hands.spec import Hand
from congrasp.common.io.inputs import numbers_in
from congrasp.common.objects.spec import Colours
from congrasp.common.task.constraints.markers import Arrow, Ghost, Paint, Polyline
from congrasp.common.wire.codec import Message
from congrasp.services.record.episode import markers
from congrasp.services.record.palette import HEADING, WAYPOINT, region_colours
from congrasp.services.viz.raster import visible
from congrasp.services.viz.shapes import (
    Camera,
    Shape,
    arrow,
    beads,
    capsule_shapes,
    fit,
    object_shape,
    posed_hand,
    skin_shape,
    table_shape,
)

TOUCHING = (0.13, 0.74, 0.63)
TOUCH = 1e-3
"""Least force of a link in contact, N."""
_FULL_CONTACT = 2.0  # force at which the contact colour of a link is strongest, N
# Radius around the arrow's line to search for the surface, gap before it, m
_ARROW_SEARCH, _ARROW_GAP = (
    0.012,
    0.004,
)


def episode_shapes(episode: Message, step: int, *, overlays: bool = True) -> list[Shape]:
    """Hand, object and table of one control step; with `overlays` also the active constraints and
    contacts.
    """
    bodies = _bodies(episode, step, overlays=overlays)
    return bodies + (
        _constraints(known_hand(episode.meta["hand"]), episode, step) if overlays else []
    )


def _bodies(episode: Message, step: int, *, overlays: bool) -> list[Shape]:
    """Hand, object and table of one control step of an episode."""
    arrays = episode.arrays
    hand = known_hand(episode.meta["hand"])
    force = np.linalg.norm(arrays["contact_force"][step], axis=-1)
    share = (
        np.where(force > TOUCH, 0.3 + 0.3 * np.minimum(force / _FULL_CONTACT, 1.0), 0.0) * overlays
    )
    links = arrays["link_position"][step], arrays["link_quaternion"][step]
    shapes = [
        skin_shape(skin_of(hand), *links, TOUCHING, share),
        _object(episode, step, painted=overlays),
    ]
    if arrays["table"][step]:
        shapes.append(table_shape(arrays["object_position"][0]))
    return shapes


def _object(episode: Message, step: int, *, painted: bool = True) -> Shape:
    """The object at a step in its original colours, or painted with its two regions if they are a
    constraint.
    """
    arrays = episode.arrays
    avoid = np.asarray(arrays["surface_avoid"], bool)
    paint = None
    if painted and avoid.any() and any(isinstance(marker, Paint) for _, marker in markers(arrays)):
        paint = region_colours(arrays["surface_points"], avoid)
    elif "colour_values" in arrays:
        paint = Colours(arrays["colour_points"], arrays["colour_values"])
    mesh = arrays["visual_vertices"], arrays["visual_faces"]
    return object_shape(
        mesh, arrays["object_position"][step], arrays["object_quaternion"][step], paint
    )


def _constraints(hand: Hand, episode: Message, step: int) -> list[Shape]:
    """Markers of the active constraints, which are given in the object's frame; the object is
    painted already.
    """
    arrays = episode.arrays
    origin = np.asarray(arrays["object_position"][step], float)
    turn = Rotation.from_quat(arrays["object_quaternion"][step], scalar_first=True)
    shapes: list[Shape] = []
    for _, marker in markers(arrays):
        if isinstance(marker, Arrow):
            direction = turn.apply(marker.direction)
            tip = turn.apply(_outside(marker, arrays["surface_points"])) + origin
            shapes += arrow(tip - 0.08 * direction, tip, 0.0028, HEADING)
        elif isinstance(marker, Polyline):
            shapes.append(beads(turn.apply(marker.points) + origin, 0.0035, WAYPOINT))
        elif isinstance(marker, Ghost) and marker.q is not None:
            wrist = turn * Rotation.from_quat(marker.quaternion, scalar_first=True)
            position = turn.apply(marker.position) + origin
            shapes.append(
                posed_hand(
                    hand, marker.q, position, wrist, HEADING, np.ones(len(hand.links)), alpha=0.25
                )
            )
    return shapes


def _outside(marker: Arrow, surface: np.ndarray) -> np.ndarray:
    """(3,) m, end of an arrow to a point inside the object: before its line enters the surface (P,
    3).
    """
    off = surface - marker.tip
    along = off @ marker.direction
    across = np.linalg.norm(off - along[:, None] * marker.direction, axis=-1)
    depth = max(0.0, -float(along[across < _ARROW_SEARCH].min(initial=0.0))) + _ARROW_GAP
    return np.asarray(marker.tip - depth * marker.direction)


# Degrees, of the cameras that are compared
_AZIMUTHS, _ELEVATIONS = (
    np.arange(0, 360, 30),
    (16, 28, 40),
)
_ASIDE = 75.0  # least angle between the azimuths of the two views of a picture, degrees
_ROWS = 72  # of the pictures by which cameras are compared
_CONTACT, _FINGER, _OBJECT, _BROAD, _BEHIND, _BEFORE = 2.0, 1.0, 1.0, 1.0, 1.5, 0.8
"""Weights of the seen shares of touching links, of all fingers and of the object, of the object's
broad side, and of a view along the forearm from behind and from the front of the hand."""
_FALL = 0.1  # m that the camera follows a falling object


class View(NamedTuple):
    """Direction from a scene to the camera, degrees."""

    azimuth: float
    """Around the vertical: 0 looks from +x, 90 from +y."""
    elevation: float
    """Above the table."""

    @property
    def direction(self) -> np.ndarray:
        """(3,) from the scene to the camera."""
        azimuth, elevation = np.radians(self.azimuth), np.radians(self.elevation)
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
      CongraspError: the text is no view.
    """
    if not text:
        return None
    given = numbers_in(text).tolist()
    if len(given) == 2 and abs(given[0]) <= 360 and -10 <= given[1] <= 85:
        return View(*given)
    raise CongraspError(
        f"--camera is '{text}'.",
        "Write degrees around the table, from -360 to 360, and above it, from -10 to 85: --camera "
        '"120 25"',
    )


def views(episode: Message, steps: Sequence[int]) -> tuple[View, View]:
    """The view that shows most of fingers, contacts and object in some steps, and the best one from
    its side.
    """
    pictured = [_Pictured(episode, steps[i]) for i in sorted({len(steps) // 2, len(steps) - 1})]
    options = [
        View(float(azimuth), elevation) for elevation in _ELEVATIONS for azimuth in _AZIMUTHS
    ]
    scores = [sum(step.score(view) for step in pictured) for view in options]
    best = options[int(np.argmax(scores))]
    aside = [abs((view.azimuth - best.azimuth + 180) % 360 - 180) >= _ASIDE for view in options]
    return best, options[int(np.argmax(np.where(aside, scores, -np.inf)))]


def camera_of(
    episode: Message,
    steps: Sequence[int],
    aspect: float = 4 / 3,
    view: View | None = None,
    *,
    overlays: bool = False,
) -> Camera:
    """A camera that fits hand and object in all of the steps, from a view, by default the best
    one.
    """
    points = np.concatenate([_extent(episode, step, overlays=overlays) for step in steps])
    points = points[ConvexHull(points).vertices]  # a camera that fits these fits all
    return fit(points, (view or views(episode, steps)[0]).direction, aspect)


class _Pictured:
    """A step with the hand as capsules, for the comparison of views."""

    def __init__(self, episode: Message, step: int):
        arrays = episode.arrays
        hand = known_hand(episode.meta["hand"])
        links = arrays["link_position"][step], arrays["link_quaternion"][step]
        self._capsules = capsule_shapes(hand, *links)
        self._shapes = [*self._capsules, *episode_shapes(episode, step, overlays=False)[1:2]]
        self._areas = np.array(
            [2 * r * (2 * half + 2 * r) for r, half in (c.size for c in self._capsules)]
        )
        self._finger = hand.capsule_links > 0
        self._touching = (
            np.linalg.norm(arrays["contact_force"][step], axis=-1)[hand.capsule_links] > TOUCH
        )
        self._points = _extent(episode, step, overlays=False)
        wrist = Rotation.from_quat(links[1][0], scalar_first=True)
        back = -hand.keypoints[len(hand.links) :].mean(0)
        self._back = wrist.apply(back / np.linalg.norm(back))
        x, y, z = np.ptp(arrays["visual_vertices"], axis=0)
        # Of its box
        self._faces = np.array([y * z, z * x, x * y]) / np.linalg.norm([y * z, z * x, x * y])
        self._object = Rotation.from_quat(arrays["object_quaternion"][step], scalar_first=True)

    def score(self, view: View) -> float:
        """Weighted shares of touching links, fingers and object that a view shows, each from 0 to
        about 1.

        A box with faces F along its axes has the silhouette |d| · F from a direction d, at most
        |F|.
        """
        camera = fit(self._points, view.direction, 4 / 3)
        size = (_ROWS * 4 // 3, _ROWS)
        counts = _counts(self._shapes, camera, size)
        unhidden = _counts(self._shapes[-1:], camera, size)[0]
        across = (
            2
            * np.tan(np.radians(camera.field_of_view) / 2)
            * np.linalg.norm(camera.target - camera.position)
        )
        seen = np.minimum(counts[:-1] / (self._areas * (_ROWS / across) ** 2), 1.0)
        contact = seen[self._touching].mean() if self._touching.any() else 0.0
        along = float(self._back @ view.direction)
        hidden = (_BEHIND if along > 0 else _BEFORE) * along**2
        whole = counts[-1] / max(unhidden, 1)
        broad = np.abs(self._object.inv().apply(view.direction)) @ self._faces
        return float(
            _CONTACT * contact
            + _FINGER * seen[self._finger].mean()
            + _OBJECT * whole
            + _BROAD * broad
            - hidden
        )


def _counts(shapes: Sequence[Shape], camera: Camera, size: tuple[int, int]) -> np.ndarray:
    """(n,) number of samples that show each shape."""
    seen = visible(shapes, camera, size)
    return np.bincount(seen[seen >= 0], minlength=len(shapes))


def _extent(episode: Message, step: int, *, overlays: bool) -> np.ndarray:
    """(N, 3) points that a picture of a step must contain: skin without sleeve, the object's box,
    trajectory overlays.

    An object that has fallen more than `_FALL` is omitted.
    """
    arrays = episode.arrays
    hand = known_hand(episode.meta["hand"])
    turns = Rotation.from_quat(arrays["link_quaternion"][step], scalar_first=True)
    skin = skin_of(hand)
    around = skin.posed(arrays["link_position"][step], turns.as_matrix())[0]
    around = around[skin.material != MATERIALS.index("sleeve")]
    if arrays["object_position"][step, 2] < arrays["object_position"][0, 2] - _FALL:
        return around
    turn = Rotation.from_quat(arrays["object_quaternion"][step], scalar_first=True)
    low, high = arrays["visual_vertices"].min(0), arrays["visual_vertices"].max(0)
    points = [np.where(np.indices((2, 2, 2)).reshape(3, -1).T, high, low)]
    if overlays:
        points += [marker.points for _, marker in markers(arrays) if isinstance(marker, Polyline)]
    return np.concatenate(
        [around, turn.apply(np.concatenate(points)) + arrays["object_position"][step]]
    )
