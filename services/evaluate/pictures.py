"""Pictures of an evaluation's episodes: sheets with the cause of each failure, and an interactive
grasp.
"""

import base64
import json
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands import known_hand
from congrasp.common.hands.skin import skin_of
from congrasp.common.wire.codec import Message
from congrasp.services.evaluate.experiment import Experiment, Result
from congrasp.services.record.episode import phases_of
from congrasp.services.record.palette import OBJECT
from congrasp.services.viz.render import episode_strip, grasp_steps
from congrasp.services.viz.shapes import Shape, skin_colours, table_shape
from congrasp.services.viz.sheets import contact_sheet, save_png
from congrasp.services.viz.triangles import triangles_of

FRAME_SECONDS = 0.04
"""Time between two frames of an interactive grasp."""
_FRAMES = 5
_SIZE = (300, 225)
_PUSHED = 0.05  # tolerated displacement of an object before the table is removed, m


def cause(episode: Message, drop_height: float) -> str:
    """Cause of an episode's end with the object `drop_height` (m) or more below its initial height,
    or `held`.
    """
    metrics = episode.meta["metrics"]
    if metrics.get("diverged"):
        return "the physics diverged"
    if metrics["held"]:
        return "held"
    moment = "the lift began" if "lift" in phases_of(episode.meta) else "the table was removed"
    if metrics["moved_at_removal"] > _PUSHED:
        return f"pushed away before {moment}"
    if not metrics["links_at_removal"]:
        return f"not touched when {moment}"
    seconds = (fall_step(episode, drop_height) - grasp_steps(episode)[1]) * episode.meta[
        "control_dt"
    ]
    return f"slipped {seconds:.2f} s after {moment}"


def fall_step(episode: Message, drop_height: float) -> int:
    """Step at which the object is `drop_height` (m) below its height at the table's removal, or the
    last one.

    In a lift the height is relative to the wrist.
    """
    removal = grasp_steps(episode)[1]
    height = np.asarray(episode.arrays["object_position"])[:, 2]
    if "lift" in phases_of(episode.meta):
        height = height - episode.arrays["link_position"][:, 0, 2]
    below = np.flatnonzero(height[removal:] < height[removal] - drop_height)
    return removal + int(below[0]) if len(below) else len(height) - 1


def failure_sheets(
    experiment: Experiment, results: Sequence[Result], successes: int, failures: int
) -> Iterator[tuple[str, np.ndarray, Sequence[str]]]:
    """Draws kept episodes of rows up to the step at which the object has fallen, or to the end,
    failures first.

    Args:
      experiment: experiment of the rows.
      results: rows with kept episodes.
      successes: most successes to show for each row.
      failures: most failures to show for each row.

    Yields:
      For each row with an episode: its name, the sheet (H, W, 3) uint8, and the outcome of each
      episode.
    """
    policy, drop_height = experiment.policy, experiment.task.drop_height
    for result in results:
        name, episodes = result.variation.constraint, result.examples(successes, failures)
        if not episodes:
            continue
        causes = [cause(episode, drop_height) for episode in episodes]
        title = (
            f"{policy.spec.hand_name} hand, version {policy.version}, {name}: {len(episodes)} "
            f"episodes, failures first"
        )
        strips = [
            (episode, episode.meta["object"], f": {outcome}", fall_step(episode, drop_height))
            for episode, outcome in zip(episodes, causes, strict=True)
        ]
        yield name, _sheet(strips, title), causes


def save_noise_examples(results: Sequence[Result], path: pathlib.Path) -> None:
    """Draws a kept episode that holds the object under the worst of each kind of noise, if there is
    one, as PNG.

    Args:
      results: rows of `services.evaluate.variations.NOISE`; the last one of each kind is the worst.
      path: the file to write.

    Raises:
      CongraspError: the file cannot be written.
    """
    worst = {
        result.variation.label.partition(" ")[0]: result
        for result in results
        if result.variation.label
    }
    strips = [
        (
            episode,
            f"{variation.constraint}, {variation.label}: {episode.meta['object']}",
            ", held",
            None,
        )
        for variation, _, _, held, _ in worst.values()
        for episode in held[:1]
    ]
    if strips:
        text = "Requested: the blue hand or the violet path, with noise. Executed: the grey hand"
        save_png(path, _sheet(strips, text))


def _sheet(strips: Sequence[tuple[Message, str, str, int | None]], title: str) -> np.ndarray:
    """Draws key frames of episodes: each with its first caption, the end of its last one, and its
    last step.
    """
    images: list[np.ndarray] = []
    labels: list[str] = []
    for episode, first, last, until in strips:
        frames, captions = episode_strip(episode, _FRAMES, _SIZE, first, last, until=until)
        images += frames
        labels += captions
    return contact_sheet(images, labels, columns=_FRAMES, title=title)


def turntable(episode: Message) -> Mapping[str, Any]:
    """Returns the data of an episode for motion.html: skin, object and table as one skinned mesh.

    They move with bones: the hand's links, then the object, then the world. The matrix of a bone
    maps resting points to the world frame.

    Returns:
      `data`, JSON whose arrays are base64 of little-endian numbers: for V points `position` and
      `normal` (V, 3) float32, `colour` (V, 3) uint8 sRGB, `bones` (V, 4) and `weights` (V, 4) uint8
      of 255; `faces` (F, 3) uint32; and `frames` (T, B, 12) float32, the upper three rows of each
      bone's matrix. Then `seconds` between two frames, the frame of the table's `removal`, the
      `table`'s first and last corner in `faces`, and the `centre` (3,) and `radius`, m, of the
      grasp.
    """
    arrays, hand = episode.arrays, known_hand(episode.meta["hand"])
    every = max(1, round(FRAME_SECONDS / float(episode.meta["control_dt"])))
    steps = np.arange(0, len(arrays["table"]), every)
    frames, bones = _frames(episode, steps), len(hand.links)
    skin, table = skin_of(hand), table_shape(arrays["object_position"][0])
    links, weights = skin.influences()
    body = Shape(
        "mesh", (0, 0), OBJECT, vertices=arrays["visual_vertices"], faces=arrays["visual_faces"]
    )
    parts = [(skin.points, skin.normals, skin_colours(skin), skin.faces, links, weights)]
    for bone, shape in ((bones, body), (bones + 1, table)):
        found = triangles_of([shape], fine=False)
        count = len(found.points)
        moved = np.tile([bone, 0, 0, 0], (count, 1)), np.tile([1.0, 0, 0, 0], (count, 1))
        parts.append(
            (found.points, found.normals, np.tile(shape.colour, (count, 1)), found.faces, *moved)
        )
    counts = np.cumsum([0, *(len(part[0]) for part in parts)])
    points, normals, colours, _, bone_of, weight = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    faces = np.concatenate(
        [part[3] + first for part, first in zip(parts, counts[:-1], strict=True)]
    )
    seen = np.concatenate(
        [frames[:, :bones, :, 3] @ np.eye(3), arrays["object_position"][steps][:, None]], 1
    )
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
    places = np.concatenate(
        [arrays["link_position"][steps], arrays["object_position"][steps][:, None]], 1
    )
    turns = np.concatenate(
        [arrays["link_quaternion"][steps], arrays["object_quaternion"][steps][:, None]], 1
    )
    rotations = (
        Rotation.from_quat(turns.reshape(-1, 4), scalar_first=True)
        .as_matrix()
        .reshape(*turns.shape[:2], 3, 3)
    )
    origins = np.concatenate([skin.origins, np.zeros((1, 3))])
    moved = np.concatenate(
        [rotations, (places - np.einsum("tbij,bj->tbi", rotations, origins))[..., None]], -1
    )
    world = np.broadcast_to(np.eye(3, 4), (len(steps), 1, 3, 4))
    return np.concatenate([moved, world], 1)


def _encoded(array: np.ndarray, kind: str) -> str:
    """Encodes an array's numbers as base64."""
    return base64.b64encode(np.ascontiguousarray(array, np.dtype(kind)).tobytes()).decode()
