"""Video of motions from a fixed camera: hand, arm, object and table, without simulation-only elements."""

import pathlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from congrasp.common.hands.skin import Skin
from congrasp.common.runtime.parallel import cores
from congrasp.services.export.frames import skin_of_motion
from congrasp.services.export.motion_file import GraspMotion
from congrasp.services.viz.raster import render_scene
from congrasp.services.viz.scene import Camera, Shape
from congrasp.services.viz.shapes import arm_shapes, fit, object_shape, skin_shape, table_shape
from congrasp.services.viz.sheets import save_video

SIZE = (320, 240)
"""Width and height in pixels."""
_DIRECTION = np.array([0.8, -1.0, 0.7])  # from the table's middle to the camera
_STEP = 10  # frames between those that the camera must contain
_KEYFRAMES = ("-g", "2")  # for random access in training
_COUNTED = 64  # pixels between those that are returned


class Film(NamedTuple):
    """A video."""

    calibration: dict[str, Any]
    """See `calibration`."""
    pixels: list[np.ndarray]
    """(n, 3) from 0 to 1 for each motion: some pixels of every frame."""


def film(path: pathlib.Path, motions: Sequence[GraspMotion], frame_rate: int) -> Film:
    """Writes the video of all motions in sequence, from a camera that shows all of them."""
    camera, pixels = camera_for(motions), list[np.ndarray]()

    def frames() -> Iterator[np.ndarray]:
        """Yields every frame, and keeps some of its pixels."""
        for motion in motions:
            kept = []
            for picture in pictures(motion, camera):
                kept.append(picture.reshape(-1, 3)[::_COUNTED] / 255)
                yield picture
            pixels.append(np.concatenate(kept))

    save_video(path, frames(), SIZE, frame_rate, _KEYFRAMES)
    return Film(calibration(camera), pixels)


def camera_for(motions: Sequence[GraspMotion]) -> Camera:
    """Returns a camera that shows hands and objects of all motions."""
    points = np.concatenate([_extent(motion) for motion in motions])
    return fit(points[ConvexHull(points).vertices], _DIRECTION, SIZE[0] / SIZE[1])


def _extent(motion: GraspMotion) -> np.ndarray:
    """(n, 3) points of the hand's skin and of the object at some frames of a motion."""
    found = []
    skin = skin_of_motion(motion)
    for frame in {*range(0, len(motion.time), _STEP), len(motion.time) - 1}:
        hand, thing = _shapes(motion, skin, frame)[:2]
        found += [hand.vertices, Rotation.from_quat(thing.quaternion, scalar_first=True).apply(thing.vertices)]
        found[-1] = found[-1] + thing.position
    return np.concatenate(found)


def pictures(motion: GraspMotion, camera: Camera) -> Iterator[np.ndarray]:
    """(height, width, 3) uint8 of every frame of a motion."""
    skin = skin_of_motion(motion)
    with ThreadPoolExecutor(cores()) as pool:
        frames = range(len(motion.time))
        yield from pool.map(lambda frame: render_scene(_shapes(motion, skin, frame), camera, SIZE), frames)


def calibration(camera: Camera) -> dict[str, Any]:
    """Parameters of the pinhole camera in the convention of computer vision: x right, y down, z forward."""
    right, up, forward = camera.axes()
    focal = SIZE[1] / 2 / np.tan(np.radians(camera.field_of_view) / 2)
    return {
        "model": "pinhole, no distortion; x right, y down, z forward; pixel (0, 0) is the upper left one's centre",
        "width": SIZE[0],
        "height": SIZE[1],
        "intrinsics": [[focal, 0.0, SIZE[0] / 2 - 0.5], [0.0, focal, SIZE[1] / 2 - 0.5], [0.0, 0.0, 1.0]],
        "camera_to_world": [*np.column_stack([right, -up, forward, camera.position]).tolist(), [0.0, 0.0, 0.0, 1.0]],
    }


def _shapes(motion: GraspMotion, skin: Skin, frame: int) -> list[Shape]:
    """Shapes of the hand, the object, the arm, and the table while it is present."""
    hand = skin_shape(skin, motion.link_position[frame], motion.link_quaternion[frame])
    own = motion.colours
    mesh = motion.object_vertices, motion.object_faces
    paint = None if own is None else (own.points, own.values / 255)
    thing = object_shape(mesh, motion.object_position[frame], motion.object_quaternion[frame], paint)
    arm = arm_shapes(motion.arm, frame) if motion.arm else []
    return [hand, thing, *arm, *([table_shape(motion.object_position[0])] if motion.table[frame] else [])]
