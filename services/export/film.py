"""Video of motions from a camera that shows all of them."""

import pathlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from congrasp.common.episode.episode import Episode
from congrasp.common.hands.skin import Skin
from congrasp.common.runtime.resources import cores
from congrasp.services.export.surfaces import skin_of_motion
from congrasp.services.viz.camera import Camera, fit
from congrasp.services.viz.hand_shapes import skin_shape
from congrasp.services.viz.raster import render_scene
from congrasp.services.viz.shapes import Shape, arm_shapes, object_shape, table_shape
from congrasp.services.viz.sheets import save_video

SIZE = (320, 240)
"""Width and height of the video, pixels."""
_CAMERA_DIRECTION = np.array([0.8, -1.0, 0.7])
"""Direction from the table's middle to the camera."""
_EXTENT_STEP = 10
"""Every tenth frame of a motion, and its last, determine what the camera must contain."""
_KEYFRAMES = ("-g", "2")
"""Options of the encoder: every second frame is a keyframe, for random access in training."""
_PIXEL_STEP = 64
"""Every 64th pixel of a frame is in the statistics."""


class Film(NamedTuple):
    """Video of motions."""

    calibration: dict[str, Any]
    """See `calibration`."""
    pixels: list[np.ndarray]
    """(n, 3) from 0 to 1 for each motion: some pixels of every frame."""


def film(path: pathlib.Path, motions: Sequence[Episode], frame_rate: int) -> Film:
    """Writes the video of all motions in sequence, from a camera that shows all of them.

    Args:
      path: the file to write.
      motions: the motions.
      frame_rate: frames per second.
    """
    camera = camera_for(motions)
    pixels: list[np.ndarray] = []

    def frames() -> Iterator[np.ndarray]:
        """Yields every frame, and samples its pixels."""
        for motion in motions:
            samples = []
            for picture in pictures(motion, camera):
                samples.append(picture.reshape(-1, 3)[::_PIXEL_STEP] / 255)
                yield picture
            pixels.append(np.concatenate(samples))

    save_video(path, frames(), SIZE, frame_rate, _KEYFRAMES)
    return Film(calibration(camera), pixels)


def camera_for(motions: Sequence[Episode]) -> Camera:
    """Returns a camera that shows hands and objects of all motions."""
    points = np.concatenate([_extent(motion) for motion in motions])
    corners = points[ConvexHull(points).vertices]
    return fit(corners, _CAMERA_DIRECTION, SIZE[0] / SIZE[1])


def _extent(motion: Episode) -> np.ndarray:
    """(n, 3) points of the hand's skin and of the object at some frames of a motion."""
    points: list[np.ndarray] = []
    skin = skin_of_motion(motion)
    for frame in {*range(0, len(motion.time), _EXTENT_STEP), len(motion.time) - 1}:
        hand = _hand(motion, skin, frame)
        assert hand.vertices is not None
        points.append(hand.vertices)
        shape = _object(motion, frame)
        turn = Rotation.from_quat(shape.quaternion, scalar_first=True)
        points.append(turn.apply(shape.vertices) + shape.position)
    return np.concatenate(points)


def pictures(motion: Episode, camera: Camera) -> Iterator[np.ndarray]:
    """Yields the picture (height, width, 3) uint8 sRGB of every frame of a motion."""
    skin = skin_of_motion(motion)

    def picture(frame: int) -> np.ndarray:
        """Renders one frame."""
        return render_scene(_shapes(motion, skin, frame), camera, SIZE)

    with ThreadPoolExecutor(cores()) as pool:
        yield from pool.map(picture, range(len(motion.time)))


def calibration(camera: Camera) -> dict[str, Any]:
    """Parameters of the pinhole camera in the convention of computer vision: x right, y down, z
    forward.
    """
    width, height = SIZE
    right, up, forward = camera.axes()
    focal_length = height / 2 / np.tan(np.radians(camera.field_of_view) / 2)  # pixels
    axes_and_position = np.column_stack([right, -up, forward, camera.position])
    return {
        "model": (
            "pinhole, no distortion; x right, y down, z forward; pixel (0, 0) is the upper left "
            "one's centre"
        ),
        "width": width,
        "height": height,
        "intrinsics": [
            [focal_length, 0.0, width / 2 - 0.5],
            [0.0, focal_length, height / 2 - 0.5],
            [0.0, 0.0, 1.0],
        ],
        "camera_to_world": [
            *axes_and_position.tolist(),
            [0.0, 0.0, 0.0, 1.0],
        ],
    }


def _shapes(motion: Episode, skin: Skin, frame: int) -> list[Shape]:
    """Shapes of the hand, the object, the arm, and the table while it is present."""
    shapes = [_hand(motion, skin, frame), _object(motion, frame)]
    if motion.arm:
        shapes += arm_shapes(motion.arm, frame)
    if motion.table[frame]:
        shapes.append(table_shape(motion.object_position[0]))
    return shapes


def _hand(motion: Episode, skin: Skin, frame: int) -> Shape:
    """Shape of the hand in a frame."""
    return skin_shape(skin, motion.link_position[frame], motion.link_quaternion[frame])


def _object(motion: Episode, frame: int) -> Shape:
    """Shape of the object in a frame."""
    mesh = (motion.object_vertices, motion.object_faces)
    position = motion.object_position[frame]
    return object_shape(mesh, position, motion.object_quaternion[frame], motion.colours)
