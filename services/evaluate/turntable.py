"""Interactive grasp for a page: skin, object and table as one skinned mesh, in the format of motion.html.

Hand, object and table move with bones: the hand's links, then the object, then the world. The matrix of a bone maps
resting points to the world frame.
"""

import base64
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands import known_hand
from congrasp.common.hands.skin import skin_of
from congrasp.common.wire.codec import Message
from congrasp.services.record.palette import OBJECT
from congrasp.services.viz.scene import Shape
from congrasp.services.viz.shapes import skin_colours, table_shape
from congrasp.services.viz.triangles import triangles_of

FRAME_SECONDS = 0.04


def turntable(episode: Message) -> Mapping[str, Any]:
    """Returns the data of an episode for motion.html.

    Returns:
      `data`, JSON whose arrays are base64 of little-endian numbers: for V points `position` and `normal` (V, 3)
      float32, `colour` (V, 3) uint8 sRGB, `bones` (V, 4) and `weights` (V, 4) uint8 of 255; `faces` (F, 3) uint32; and
      `frames` (T, B, 12) float32, the upper three rows of each bone's matrix. Then `seconds` between two frames, the
      frame of the table's `removal`, the `table`'s first and last corner in `faces`, and the `centre` (3,) and
      `radius`, m, of the grasp.
    """
    arrays, hand = episode.arrays, known_hand(episode.meta["hand"])
    every = max(1, round(FRAME_SECONDS / float(episode.meta["control_dt"])))
    steps = np.arange(0, len(arrays["table"]), every)
    frames, bones = _frames(episode, steps), len(hand.links)
    skin, table = skin_of(hand), table_shape(arrays["object_position"][0])
    links, weights = skin.influences()
    body = Shape("mesh", (0, 0), OBJECT, vertices=arrays["visual_vertices"], faces=arrays["visual_faces"])
    parts = [(skin.points, skin.normals, skin_colours(skin), skin.faces, links, weights)]
    for bone, shape in ((bones, body), (bones + 1, table)):
        found = triangles_of([shape], fine=False)
        count = len(found.points)
        moved = np.tile([bone, 0, 0, 0], (count, 1)), np.tile([1.0, 0, 0, 0], (count, 1))
        parts.append((found.points, found.normals, np.tile(shape.colour, (count, 1)), found.faces, *moved))
    counts = np.cumsum([0, *(len(part[0]) for part in parts)])
    points, normals, colours, _, bone_of, weight = (np.concatenate(column) for column in zip(*parts, strict=True))
    faces = np.concatenate([part[3] + first for part, first in zip(parts, counts[:-1], strict=True)])
    seen = np.concatenate([frames[:, :bones, :, 3] @ np.eye(3), arrays["object_position"][steps][:, None]], 1)
    removal = int(np.sum(arrays["table"][steps]))
    held = seen[removal // 2 : removal + 1].reshape(-1, 3)
    centre = (held.min(0) + held.max(0)) / 2
    data = {
        "position": _encoded(points, "<f4"),
        "normal": _encoded(normals, "<f4"),
        "colour": _encoded(np.round(255 * colours), "u1"),
        "bones": _encoded(bone_of, "u1"),
        "weights": _encoded(np.round(255 * weight), "u1"),
        "faces": _encoded(faces, "<u4"),
        "frames": _encoded(frames, "<f4"),
        "count": bones + 2,
        "seconds": every * float(episode.meta["control_dt"]),
        "removal": removal,
        "table": [3 * (len(faces) - len(parts[-1][3])), 3 * len(faces)],
        "centre": centre.round(4).tolist(),
        "radius": round(float(np.linalg.norm(held - centre, axis=-1).max()) + 0.05, 4),
    }
    return {"data": json.dumps(data), "object": episode.meta["object"]}


def _frames(episode: Message, steps: np.ndarray) -> np.ndarray:
    """Matrices (T, B, 3, 4) of all bones at some steps."""
    arrays, skin = episode.arrays, skin_of(known_hand(episode.meta["hand"]))
    places = np.concatenate([arrays["link_position"][steps], arrays["object_position"][steps][:, None]], 1)
    turns = np.concatenate([arrays["link_quaternion"][steps], arrays["object_quaternion"][steps][:, None]], 1)
    rotations = Rotation.from_quat(turns.reshape(-1, 4), scalar_first=True).as_matrix().reshape(*turns.shape[:2], 3, 3)
    origins = np.concatenate([skin.origins, np.zeros((1, 3))])
    moved = np.concatenate([rotations, (places - np.einsum("tbij,bj->tbi", rotations, origins))[..., None]], -1)
    world = np.broadcast_to(np.eye(3, 4), (len(steps), 1, 3, 4))
    return np.concatenate([moved, world], 1)


def _encoded(array: np.ndarray, kind: str) -> str:
    """Encodes an array's numbers as base64."""
    return base64.b64encode(np.ascontiguousarray(array, np.dtype(kind)).tobytes()).decode()
