"""Pictures of an evaluation's episodes: sheets with the cause of each failure, and an interactive
grasp.
"""

import base64
import json
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.episode.episode import Episode
from congrasp.common.hands.skin import skin_of
from congrasp.services.appearance.palette import OBJECT
from congrasp.services.evaluate.experiment import Experiment, Result
from congrasp.services.viz.hand_shapes import skin_colours
from congrasp.services.viz.render import episode_strip
from congrasp.services.viz.shapes import Shape, table_shape
from congrasp.services.viz.sheets import contact_sheet, save_png
from congrasp.services.viz.triangles import triangles_of

FRAME_S = 0.04
"""Time between two frames of an interactive grasp."""
_FRAMES = 5
_SIZE = (300, 225)
_PUSHED = 0.05
"""Tolerated displacement of an object before the table is removed, m."""
_MARGIN = 0.05
"""Margin around hand and object in the view of an interactive grasp, m."""


def cause(episode: Episode, drop_height: float) -> str:
    """Cause of an episode's end with the object `drop_height` (m) or more below its initial height,
    or `held`.
    """
    metrics = episode.metrics
    if metrics.get("diverged"):
        return "the physics diverged"
    if metrics["held"]:
        return "held"
    moment = "the lift began" if "lift" in episode.phases else "the table was removed"
    if metrics["moved_at_removal"] > _PUSHED:
        return f"pushed away before {moment}"
    if not metrics["links_at_removal"]:
        return f"not touched when {moment}"
    _, removal = episode.grasp_span
    steps = fall_step(episode, drop_height) - removal
    return f"slipped {steps * episode.control_dt:.2f} s after {moment}"


def fall_step(episode: Episode, drop_height: float) -> int:
    """Step at which the object has fallen by `drop_height` (m) since the table's removal; the last
    step if it has not.

    In a lift the height is relative to the wrist.
    """
    _, removal = episode.grasp_span
    height = episode.object_position[:, 2]
    if "lift" in episode.phases:
        height = height - episode.wrist_position[:, 2]
    below = np.flatnonzero(height[removal:] < height[removal] - drop_height)
    if not len(below):
        return len(height) - 1
    return removal + int(below[0])


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
    policy = experiment.policy
    drop_height = experiment.task.drop_height
    for result in results:
        name = result.variation.constraint
        episodes = result.examples(successes, failures)
        if not episodes:
            continue
        causes = []
        strips = []
        for episode in episodes:
            outcome = cause(episode, drop_height)
            causes.append(outcome)
            strips.append(
                _Strip(
                    episode,
                    first_caption=episode.object,
                    last_caption=f": {outcome}",
                    last_step=fall_step(episode, drop_height),
                )
            )
        title = (
            f"{policy.spec.hand_name} hand, version {policy.version}, {name}: {len(episodes)} "
            f"episodes, failures first"
        )
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
    worst_of_kind = {}
    for result in results:
        kind, _, _ = result.variation.label.partition(" ")
        if kind:
            worst_of_kind[kind] = result
    strips = []
    for result in worst_of_kind.values():
        if not result.held:
            continue
        episode = result.held[0]
        variation = result.variation
        caption = f"{variation.constraint}, {variation.label}: {episode.object}"
        strips.append(_Strip(episode, first_caption=caption, last_caption=", held"))
    if strips:
        text = "Requested: the blue hand or the violet path, with noise. Executed: the grey hand"
        save_png(path, _sheet(strips, text))


class _Strip(NamedTuple):
    """Key frames of an episode in a sheet."""

    episode: Episode
    first_caption: str
    last_caption: str
    """Added to the caption of the last frame."""
    last_step: int | None = None
    """Step of the last frame; None for the episode's last one."""


def _sheet(strips: Sequence[_Strip], title: str) -> np.ndarray:
    """Draws a sheet (H, W, 3) uint8 with a line of key frames for each episode."""
    images: list[np.ndarray] = []
    captions: list[str] = []
    for strip in strips:
        frames, frame_captions = episode_strip(
            strip.episode,
            _FRAMES,
            _SIZE,
            strip.first_caption,
            strip.last_caption,
            last_step=strip.last_step,
        )
        images += frames
        captions += frame_captions
    return contact_sheet(images, captions, columns=_FRAMES, title=title)


class _SkinnedMesh(NamedTuple):
    """A mesh whose points move with up to four bones each."""

    points: np.ndarray
    """(V, 3) in the bones' resting frames, m."""
    normals: np.ndarray
    """(V, 3)."""
    colours: np.ndarray
    """(V, 3), 0 to 1."""
    faces: np.ndarray
    """(F, 3)."""
    bones: np.ndarray
    """(V, 4) indices of bones."""
    weights: np.ndarray
    """(V, 4), with the sum 1."""


def turntable(episode: Episode) -> Mapping[str, Any]:
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
    hand = episode.known_hand()
    control_dt = episode.control_dt
    steps_per_frame = max(1, round(FRAME_S / control_dt))
    steps = np.arange(0, episode.steps, steps_per_frame)
    frames = _frames(episode, steps)
    object_bone = len(hand.links)
    skin = skin_of(hand)
    links, weights = skin.influences()
    hand_mesh = _SkinnedMesh(
        skin.points, skin.normals, skin_colours(skin), skin.faces, links, weights
    )
    obj = Shape(
        "mesh", (0, 0), OBJECT, vertices=episode.object_vertices, faces=episode.object_faces
    )
    table_mesh = _rigid_mesh(table_shape(episode.object_position[0]), object_bone + 1)
    mesh = _join([hand_mesh, _rigid_mesh(obj, object_bone), table_mesh])
    removal = int(np.sum(episode.table[steps]))
    centre, radius = _bounds(episode, steps, frames, removal)
    data = {
        "position": _encode(mesh.points, "<f4"),
        "normal": _encode(mesh.normals, "<f4"),
        "colour": _encode(np.round(255 * mesh.colours), "u1"),
        "bones": _encode(mesh.bones, "u1"),
        "weights": _encode(np.round(255 * mesh.weights), "u1"),
        "faces": _encode(mesh.faces, "<u4"),
        "frames": _encode(frames, "<f4"),
        "count": object_bone + 2,
        "seconds": steps_per_frame * control_dt,
        "removal": removal,
        "table": [3 * (len(mesh.faces) - len(table_mesh.faces)), 3 * len(mesh.faces)],
        "centre": centre.round(4).tolist(),
        "radius": round(radius, 4),
    }
    return {"data": json.dumps(data), "object": episode.object}


def _rigid_mesh(shape: Shape, bone: int) -> _SkinnedMesh:
    """Returns a shape's mesh, which moves with one bone."""
    triangles = triangles_of([shape], fine=False)
    count = len(triangles.points)
    return _SkinnedMesh(
        triangles.points,
        triangles.normals,
        np.tile(shape.colour, (count, 1)),
        triangles.faces,
        np.tile([bone, 0, 0, 0], (count, 1)),
        np.tile([1.0, 0, 0, 0], (count, 1)),
    )


def _join(meshes: Sequence[_SkinnedMesh]) -> _SkinnedMesh:
    """Joins meshes into one."""
    faces = []
    first = 0
    for mesh in meshes:
        faces.append(mesh.faces + first)
        first += len(mesh.points)
    columns = [np.concatenate(column) for column in zip(*meshes, strict=True)]
    return _SkinnedMesh(*columns)._replace(faces=np.concatenate(faces))


def _bounds(
    episode: Episode, steps: np.ndarray, frames: np.ndarray, removal: int
) -> tuple[np.ndarray, float]:
    """Returns centre (3,) and radius, m, of hand and object in the second half of the approach.

    Args:
      episode: the episode.
      steps: (T,) steps of the frames.
      frames: (T, B, 3, 4) matrices of all bones.
      removal: frame of the table's removal.
    """
    links = frames[:, :-2, :, 3]
    obj = episode.object_position[steps][:, None]
    positions = np.concatenate([links, obj], 1)[removal // 2 : removal + 1].reshape(-1, 3)
    centre = (positions.min(0) + positions.max(0)) / 2
    radius = float(np.linalg.norm(positions - centre, axis=-1).max()) + _MARGIN
    return centre, radius


def _frames(episode: Episode, steps: np.ndarray) -> np.ndarray:
    """Matrices (T, B, 3, 4) of all bones at some steps."""
    skin = skin_of(episode.known_hand())
    positions = np.concatenate(
        [episode.link_position[steps], episode.object_position[steps][:, None]], 1
    )
    quaternions = np.concatenate(
        [episode.link_quaternion[steps], episode.object_quaternion[steps][:, None]], 1
    )
    matrices = Rotation.from_quat(quaternions.reshape(-1, 4), scalar_first=True).as_matrix()
    rotations = matrices.reshape(*quaternions.shape[:2], 3, 3)
    origins = np.concatenate([skin.origins, np.zeros((1, 3))])
    translations = positions - np.einsum("tbij,bj->tbi", rotations, origins)
    moving = np.concatenate([rotations, translations[..., None]], -1)
    world = np.broadcast_to(np.eye(3, 4), (len(steps), 1, 3, 4))
    return np.concatenate([moving, world], 1)


def _encode(array: np.ndarray, kind: str) -> str:
    """Encodes an array's numbers as base64."""
    return base64.b64encode(np.ascontiguousarray(array, np.dtype(kind)).tobytes()).decode()
