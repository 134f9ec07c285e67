"""Path of a film's camera: it keeps hand and object in view and moves closer as they meet.

The direction of view is constant. Where the picture has room for the hand, the object fills a third
of its width.
"""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import convolve1d, maximum_filter1d
from scipy.spatial import ConvexHull

from congrasp.common.episode.episode import Episode
from congrasp.services.viz.camera import FIELD_OF_VIEW, Camera, fit, tangents
from congrasp.services.viz.views import View, extent, object_points

_OBJECT_SHARE = 1 / 3
"""Share of the object in the width of the picture."""
_SMOOTHING_S = 0.2
"""Standard deviation of the smoothing of the path."""
_WINDOW = 3.0
"""Half width of the smoothing, in standard deviations."""


def following_cameras(
    episode: Episode, steps: Sequence[int], aspect: float, view: View, *, overlays: bool = False
) -> list[Camera]:
    """A camera for each of the steps, evenly spaced control steps of an episode.

    Args:
      episode: the episode.
      steps: the control steps.
      aspect: width of the picture over its height.
      view: direction from the scene to the camera.
      overlays: the trajectories of constraints stay in view, too.
    """
    seconds_per_frame = _spacing(steps) * episode.control_dt
    weights = _smoothing_weights(seconds_per_frame)
    hulls = [_hull(extent(episode, step, overlays=overlays)) for step in steps]
    fitted = [fit(points, view.direction, aspect) for points in hulls]
    targets = convolve1d([camera.target for camera in fitted], weights, axis=0, mode="nearest")
    axes = fitted[0].axes()
    needed = np.array(
        [
            _distance(points, target, axes, aspect)
            for points, target in zip(hulls, targets, strict=True)
        ]
    )
    closest = _distance_of_object(episode, steps[0], axes, aspect)
    # The maximum over the window makes every mean at least the distance that its frame needs.
    highest = maximum_filter1d(np.maximum(needed, closest), len(weights), mode="nearest")
    distances = convolve1d(highest, weights, mode="nearest")
    return [
        Camera(target + distance * view.direction, target, FIELD_OF_VIEW)
        for target, distance in zip(targets, distances, strict=True)
    ]


def _spacing(steps: Sequence[int]) -> float:
    """Control steps between two frames."""
    if len(steps) < 2:
        return 1.0
    return max((steps[-1] - steps[0]) / (len(steps) - 1), 1e-9)


def _smoothing_weights(seconds_per_frame: float) -> np.ndarray:
    """(2 n + 1,) weights of a Gaussian mean over frames."""
    deviation = _SMOOTHING_S / seconds_per_frame
    reach = int(np.ceil(_WINDOW * deviation))
    offsets = np.arange(-reach, reach + 1)
    weights = np.exp(-0.5 * (offsets / deviation) ** 2)
    return np.asarray(weights / weights.sum())


def _hull(points: np.ndarray) -> np.ndarray:
    """The corners of the convex hull of points (N, 3)."""
    return points[ConvexHull(points).vertices]


def _distance(points: np.ndarray, target: np.ndarray, axes: np.ndarray, aspect: float) -> float:
    """Least distance from the target at which a camera sees all points (N, 3), m."""
    across, up = tangents(aspect)
    x, y, z = axes @ (points - target).T
    sideways = np.maximum(np.abs(x) / across, np.abs(y) / up)
    return float((sideways - z).max())


def _distance_of_object(episode: Episode, step: int, axes: np.ndarray, aspect: float) -> float:
    """Distance at which the object has its share of the picture's width, m."""
    across = axes[0] @ object_points(episode, step).T
    width_at_one = 2 * np.tan(np.radians(FIELD_OF_VIEW) / 2) * aspect
    return float(np.ptp(across) / (_OBJECT_SHARE * width_at_one))
