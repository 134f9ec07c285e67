"""Content of the page: the request, a hand, and a motion with its lanes, markers and reward terms.

The newest motions are kept here, and are offered as files for download.
"""

import functools
import itertools
import pathlib
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.actors.initial_hand import initial_hand
from congrasp.common.episode.episode import Episode
from congrasp.common.episode.motion_file import save_motion
from congrasp.common.errors import CongraspError
from congrasp.common.hands.skin import skin_of
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.resting import rest_tilts
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import CONSTRAINTS, get_constraint, known
from congrasp.common.task.constraints.markers import Ghost, Marker
from congrasp.common.task.constraints.specs import ErrorSpec
from congrasp.common.task.reward import GRASP
from congrasp.common.task.types import Goal, Surface
from congrasp.common.wire.codec import Message
from congrasp.services.appearance.surface_colours import paint_surface
from congrasp.services.export.formats import FORMATS, export_motions
from congrasp.services.grasp.approaches import surface_of
from congrasp.services.record.episode_file import save_episode
from congrasp.services.studio.drawing import vector
from congrasp.services.studio.routes import Download
from congrasp.services.studio.state import Studio, tool_of
from congrasp.services.viz.camera import Camera
from congrasp.services.viz.film import Film, save_episode_video
from congrasp.services.viz.hand_shapes import link_frames, skin_colours
from congrasp.services.viz.render import render_episode_frames
from congrasp.services.viz.sheets import png_of

TOUCH = 0.05
"""Least force of a link in contact, N."""
_UNITS = {"rad": (180 / np.pi, "°"), "m": (100.0, " cm"), "": (100.0, " %")}
_CONSTRAINT_WEIGHTS = itertools.chain.from_iterable(c.weights for c in CONSTRAINTS)
MEANINGS = {term.name: term.meaning for term in GRASP}
MEANINGS |= {weight.name: weight.meaning for weight in _CONSTRAINT_WEIGHTS}
"""Descriptions of the reward terms by name."""
_ABOVE = np.cos(np.radians(45.0))
MAX_MOTIONS = 30
"""Number of motions kept; the oldest is dropped first."""
DATA = ("npz", "mcap", *FORMATS)
"""Formats in which a motion is saved without a job."""
DRAWN = ("mp4", "png")
"""Formats that a job renders."""
_PICTURE_PIXELS = (1280, 720)
_VIDEO_PIXELS = (854, 480)


def describe(studio: Studio) -> dict[str, Any]:
    """The page's content for a request, in the object frame; resting pose and start are in the
    world frame.
    """
    resolution = studio.resolution
    goal = resolution.goal
    obj = studio.obj
    hand = studio.hand
    rest = obj.rest_poses[studio.rest]
    requested = [constraint for constraint in known(studio.task) if constraint.name in studio.asked]
    sides = np.ptp(obj.visual_vertices, axis=0)
    start = _start(hand, studio.task, *_batch_of_one(studio, goal))
    markers_of_request: list[Marker] = []
    for constraint in requested:
        markers_of_request += constraint.markers(studio.goal[constraint.name], constraint.blocks)
    heading_overridden = any("heading" in constraint.overrides for constraint in requested)
    return {
        "hand": hand.name,
        "object": {
            "name": obj.name,
            "size_cm": [round(100 * float(side), 1) for side in sides],
            "mass_g": round(1000 * obj.mass),
            "faces": len(studio.canvas.faces),
            "tilts_deg": np.degrees(rest_tilts(obj)).round().tolist(),
        },
        "rest": {
            "index": studio.rest,
            "position": rest[:3].tolist(),
            "quaternion": rest[3:].tolist(),
        },
        "asked": sorted(studio.asked),
        "constraints": list(_rows(studio)),
        "arrow": _lists(studio.arrow._asdict()),
        "roll_deg": round(float(np.degrees(studio.arrow.roll(studio.up))), 1),
        "active": {
            "masks": {block: bool(on) for block, on in goal.active.items()},
            **_lists(goal["heading"]._asdict()),
            "overruled": bool(resolution.redirected) or heading_overridden,
        },
        "explanation": studio.explanation,
        "trouble": studio.trouble,
        "start": _lists(_frames(hand, *start)),
        "markers": [
            {"kind": kind, **_lists(fields)} for kind, fields in _shapes(hand, markers_of_request)
        ],
        "painted": studio.canvas.paint.version,
        "avoid_share": round(float(studio.canvas.avoid.mean()), 3),
    }


def _rows(studio: Studio) -> Iterator[dict[str, Any]]:
    """Name, title, drawing tool and labelled flags of each constraint of the policy."""
    for constraint in known(studio.task):
        fields = studio.fields.get(constraint.name, {})
        flags: dict[str, dict[str, bool]] = {}
        for field, labels in constraint.labels(studio.hand).items():
            flags[field] = dict(zip(labels, fields[field].tolist(), strict=True))
        yield {
            "name": constraint.name,
            "title": constraint.title,
            "tool": tool_of(constraint),
            "flags": flags,
        }


def _lists(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Arrays as JSON."""
    return {name: np.asarray(value).tolist() for name, value in fields.items()}


def _batch_of_one(studio: Studio, goal: Goal) -> tuple[Goal, Surface, np.ndarray]:
    """The goal, the object's surface and its resting pose (7,), with a batch axis."""
    rest = np.asarray(studio.obj.rest_poses[studio.rest], np.float32)
    surface = surface_of(studio.task, studio.obj)
    return jax.tree.map(lambda array: np.asarray(array)[None], (goal, surface, rest))


@functools.partial(jax.jit, static_argnums=(0, 1))
def _start(
    hand: Hand, task: TaskConfig, goal: Goal, surface: Surface, rest: jax.Array
) -> tuple[jax.Array, ...]:
    """Finger angles (F,) and wrist pose (3,), (4,) at the start of a grasp, world frame."""
    q, position, quaternion = initial_hand(hand, task, goal, surface, rest)
    return q[0], position[0], quaternion[0]


def _frames(hand: Hand, q: Any, position: Any, quaternion: Any) -> dict[str, np.ndarray]:
    """Link frames, positions (L, 3) and quaternions (L, 4), of finger angles and a wrist pose, in
    that pose's frame.
    """
    wrist = Rotation.from_quat(quaternion, scalar_first=True)
    positions, quaternions = link_frames(hand, np.asarray(q, float), position, wrist)
    return {"position": positions, "quaternion": quaternions}


def _shapes(hand: Hand, markers: Iterable[Marker]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Kind and fields of each marker, object frame; a ghost of a whole hand has its link frames as
    fields.
    """
    for marker in markers:
        if not isinstance(marker, Ghost):
            yield type(marker).__name__.lower(), marker._asdict()
        elif marker.q is not None:
            yield "ghost", _frames(hand, marker.q, marker.position, marker.quaternion)


def hand_message(hand: Hand) -> Message:
    """A hand's skin (see `common.hands.skin`), and its links' names."""
    skin = skin_of(hand)
    links, weights = skin.influences()
    arrays = {
        "skin_points": skin.points,
        "skin_normals": skin.normals,
        "skin_faces": skin.faces,
        "skin_joints": links.astype(np.int32),
        "skin_weights": weights,
        "skin_origins": skin.origins.astype(np.float32),
        "skin_colours": skin_colours(skin),
    }
    return Message(arrays, {"hand": hand.name, "links": [link.name for link in hand.links]})


class Lane(NamedTuple):
    """One constraint over T steps."""

    met: np.ndarray
    """(T,) bool."""
    counts: np.ndarray
    """(T,) bool: the constraint applies to this step (a heading to the grasp, a path to the
    approach).
    """
    legend: str
    """Measured quantity, and its tolerance."""
    errors: Mapping[str, np.ndarray]
    """(T,) errors by their units, `share` without unit; the number of links by `links`."""


def lanes(episode: Episode) -> dict[str, Lane]:
    """The lanes of an episode by name: contact, then the active constraints whose errors are
    recorded.
    """
    recorded = episode.require_recorded()
    _, end = episode.grasp_span
    table = np.arange(episode.steps) < end
    links = (np.linalg.norm(episode.link_force, axis=-1) > TOUCH).sum(-1)
    contact = Lane(
        links >= 2, ~table, "two links or more touch the object", {"links": links.astype(float)}
    )
    lane_of = {"contact": contact}
    for constraint in CONSTRAINTS:
        if constraint.name not in episode.constraints:
            continue
        errors = []
        for spec in constraint.errors:
            if not spec.block or episode.active.get(spec.block):
                errors.append(spec)
        if all(spec.name in recorded.errors for spec in errors):
            lane_of[constraint.name] = _lane(errors, recorded.errors, table)
    return lane_of


def _lane(
    errors: Sequence[ErrorSpec], recorded: Mapping[str, np.ndarray], table: np.ndarray
) -> Lane:
    """The lane of one constraint from its recorded errors (T,) by name."""
    within: list[np.ndarray] = []
    parts: list[str] = []
    errors_by_unit: dict[str, np.ndarray] = {}
    for spec in errors:
        values = recorded[spec.name]
        within.append(values <= spec.tolerance)
        factor, unit = _UNITS[spec.unit]
        parts.append(f"{spec.meaning}: {factor * spec.tolerance:.0f}{unit} at most")
        errors_by_unit[spec.unit or "share"] = values
    counts = table if errors[0].window == "approach" else ~table
    return Lane(np.all(within, 0), counts, "; ".join(parts), errors_by_unit)


def for_page(episode: Episode) -> Message:
    """The episode for the page's player: poses, forces, rewards, object, lanes, and markers
    `KIND/CONSTRAINT/FIELD`.
    """
    recorded = episode.require_recorded()
    arrays: dict[str, Any] = {
        "link_position": episode.link_position,
        "link_quaternion": episode.link_quaternion,
        "object_position": episode.object_position,
        "object_quaternion": episode.object_quaternion,
        "contact_force": episode.link_force,
        "table": episode.table,
        "visual_vertices": episode.object_vertices,
        "visual_faces": episode.object_faces,
        "surface_points": episode.surface_points,
        "surface_avoid": episode.surface_avoid,
        **_coloured_mesh(episode),
    }
    terms: dict[str, str] = {}
    for term, values in recorded.rewards.items():
        arrays[f"reward/{term}"] = values
        terms[term] = MEANINGS.get(term, "")
    legends: dict[str, str] = {}
    for name, lane in lanes(episode).items():
        legends[name] = lane.legend
        arrays[f"lane/{name}/met"] = lane.met
        arrays[f"lane/{name}/counts"] = lane.counts
        for unit, value in lane.errors.items():
            arrays[f"lane/{name}/{unit}"] = np.asarray(value, np.float32)
    arrays |= _marker_arrays(episode)
    meta = {
        **episode.about,
        "hand": recorded.hand_reference,
        "object": episode.object,
        "control_dt": episode.control_dt,
        "success": episode.success,
        "metrics": episode.metrics,
        "lanes": legends,
        "terms": terms,
    }
    return Message(arrays, meta)


def _coloured_mesh(episode: Episode) -> dict[str, np.ndarray]:
    """The object's mesh with colours, if it has some."""
    if episode.colours is None:
        return {}
    vertices, faces, vertex_colours = paint_surface(
        episode.object_vertices, episode.object_faces, episode.colours
    )
    return {"visual_vertices": vertices, "visual_faces": faces, "visual_colours": vertex_colours}


def _marker_arrays(episode: Episode) -> dict[str, np.ndarray]:
    """Fields of the markers of an episode by `KIND/CONSTRAINT/FIELD`."""
    hand = episode.known_hand()
    arrays: dict[str, np.ndarray] = {}
    for name, marker in episode.markers():
        for kind, marker_fields in _shapes(hand, [marker]):
            fields = marker_fields
            if kind == "paint":
                fields = {"avoid": episode.surface_avoid}
            for field, value in fields.items():
                arrays[f"{kind}/{name}/{field}"] = np.asarray(value, np.float32)
    return arrays


class Motions:
    """The newest motions, by number."""

    def __init__(self) -> None:
        """Begins without motions."""
        self._episodes: dict[str, Episode] = {}
        self._number = 0

    def keep(self, episode: Episode) -> str:
        """Keeps a motion; returns its number."""
        self._number += 1
        self._episodes[str(self._number)] = episode
        while len(self._episodes) > MAX_MOTIONS:
            del self._episodes[next(iter(self._episodes))]
        return str(self._number)

    def get(self, key: str) -> Episode:
        """A motion by its number; a CongraspError if there is none."""
        if key not in self._episodes:
            raise CongraspError(
                f"There is no motion '{key[:60]}'.",
                "Press Grasp, or choose a motion from the list.",
            )
        return self._episodes[key]

    def delete(self, key: str) -> None:
        """Deletes a motion, if there is one of this number."""
        self._episodes.pop(key, None)

    def view(self) -> list[dict[str, Any]]:
        """List entries of the motions, the newest first."""
        return [_list_entry(key, episode) for key, episode in reversed(self._episodes.items())]


def _request_in_words(episode: Episode) -> str:
    """Request of a motion in words: its constraints, and the direction of the approach, world
    frame.
    """
    turn = Rotation.from_quat(episode.object_quaternion[0], scalar_first=True)
    down = -float(turn.apply(np.asarray(episode.goal["heading_direction"], float))[2])
    if down > _ABOVE:
        approach = "from above"
    elif down < -_ABOVE:
        approach = "from below"
    else:
        approach = "from the side"
    titles = [get_constraint(name).title for name in episode.constraints[1:]]
    return ", ".join([*titles, approach])


def _list_entry(key: str, episode: Episode) -> dict[str, Any]:
    """List entry of a motion."""
    metrics = episode.metrics
    return {
        "id": key,
        "object": episode.object,
        "asked": _request_in_words(episode),
        "success": episode.success,
        "held": metrics.get("held", 0.0) > 0,
        "note": episode.about.get("note", ""),
        "version": episode.version,
        "steps": episode.steps,
        "metrics": {name: value for name, value in metrics.items() if np.isfinite(value)},
    }


def data_file(episode: Episode, key: str, kind: str) -> Download:
    """A motion as a file of one of `DATA`; formats that are folders become zip archives.

    Raises:
      CongraspError: there is no such kind, or a package for it is absent.
    """
    if kind not in DATA:
        raise CongraspError(
            f"A motion cannot be saved as '{kind[:20]}'.", f"Choose from: {', '.join(DATA)}."
        )
    with tempfile.TemporaryDirectory(prefix="congrasp-export-") as folder:
        path = pathlib.Path(folder) / f"motion{FORMATS.get(kind, f'.{kind}')}"
        try:
            if kind == "npz":
                save_motion(path, episode.normalised())
            elif kind == "mcap":
                save_episode(path, "studio", episode)
            else:
                export_motions([episode.normalised()], kind, path)
        except ModuleNotFoundError as error:
            raise CongraspError(
                f"This needs the package '{error.name}'.", "Run: pip install 'congrasp[export]'"
            ) from None
        suffix = path.suffix
        if path.is_dir():
            path = pathlib.Path(shutil.make_archive(str(path), "zip", path))
            suffix = f"-{kind}.zip"
        return Download(_name(episode, key, suffix), path.read_bytes())


def drawing(
    episode: Episode,
    key: str,
    kind: str,
    view: Mapping[str, Any],
    frame: int,
    progress: Callable[[float], None],
) -> Download:
    """A motion as MP4, or one of its frames as PNG, from the page's camera.

    Args:
      episode: the motion.
      key: its key, for the file's name.
      kind: one of `DRAWN`.
      view: the page's camera: position and target (3,) in the world, m, and its vertical
        field_of_view in degrees.
      frame: control step of the PNG.
      progress: called with the completed share, from 0 to 1, of an MP4.

    Raises:
      CongraspError: the kind, the camera or the frame is invalid.
    """
    if kind not in DRAWN:
        raise CongraspError(
            f"A motion cannot be drawn as '{str(kind)[:20]}'.", f"Choose from: {', '.join(DRAWN)}."
        )
    camera = _camera(view)
    if kind == "png":
        if not isinstance(frame, int) or not 0 <= frame < episode.steps:
            raise CongraspError(f"The motion has no frame {ascii(frame)[:20]}.")
        (image,) = render_episode_frames(episode, [frame], _PICTURE_PIXELS, camera)
        return Download(_name(episode, key, f"-{frame}.png"), png_of(image))
    with tempfile.TemporaryDirectory(prefix="congrasp-video-") as folder:
        path = pathlib.Path(folder) / "motion.mp4"
        save_episode_video(path, episode, Film(_VIDEO_PIXELS, overlays=True), camera, progress)
        return Download(_name(episode, key, ".mp4"), path.read_bytes())


def _camera(view: Mapping[str, Any]) -> Camera:
    """The page's camera."""
    if not isinstance(view, Mapping):
        raise CongraspError("The camera must have a position, a target and a field of view.")
    position = vector("camera's position", view.get("position"))
    target = vector("camera's target", view.get("target"))
    angle = float(vector("camera's field of view", [view.get("field_of_view"), 0.0, 0.0])[0])
    if np.linalg.norm((target - position)[:2]) < 1e-6 or not 1 <= angle <= 120:
        raise CongraspError(
            "The camera looks straight down, or its field of view is not 1 to 120 degrees."
        )
    return Camera(position, target, angle)


def _name(episode: Episode, key: str, suffix: str) -> str:
    """Name of a motion's file."""
    number = "".join(c if c.isalnum() else "-" for c in key)[-40:]
    return f"{episode.object}-{number}{suffix}"
