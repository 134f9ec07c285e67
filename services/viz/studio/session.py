"""One user's studio with its policy, objects and motions, beside the window on a training: what the page talks to."""

import json
import pathlib
import shutil
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from common.config import TaskConfig
from common.errors import CongraspError
from common.hands import get_hand
from common.hands.skin import skin_of
from common.hands.spec import Hand
from common.objects.spec import GraspObject
from common.request import GraspRequest
from common.wire.codec import Message
from services.export.motion_file import motion_of_episode, save_motion
from services.export.motion_formats import FORMATS, export_motions
from services.record.channels import JsonChannels
from services.record.scene import episode_entries
from services.record.writer import LogWriter
from services.viz.shapes import skin_colours
from services.viz.studio.jobs import Jobs, Progress
from services.viz.studio.lanes import for_page
from services.viz.studio.recordings import Recordings
from services.viz.studio.server import Download, Get, Post
from services.viz.studio.state import Studio
from services.viz.studio.training import TrainingWindow

EXPORTS = ("npz", "mcap", *FORMATS)
"""What a motion can be saved as."""
MOTIONS = 30
"""Motions that stay to be played and exported."""


class Grasping(Protocol):
    """A policy that can be asked for a grasp."""

    hand: Hand
    task: TaskConfig

    def newest(self) -> dict[str, Any]:
        """Where the policy comes from and its version, after a look for newer weights."""

    def grasp(self, obj: GraspObject, request: GraspRequest, progress: Progress) -> Message:
        """The episode of a grasp."""


class Catalogue:
    """Objects to choose from, by name; they are made or imported when they are chosen."""

    def __init__(self, makers: Mapping[str, Callable[[], GraspObject]]):
        """The first is what a studio begins with."""
        self._makers = dict(makers)
        self._made: dict[str, GraspObject] = {}

    @property
    def names(self) -> list[str]:
        """What there is."""
        return list(self._makers)

    def add(self, name: str, maker: Callable[[], GraspObject]) -> str:
        """One more; returns the name that it got."""
        free = next(n for n in (name, *(f"{name} ({i})" for i in range(2, 10_000))) if n not in self._makers)
        self._makers[free] = maker
        return free

    def drop(self, name: str) -> None:
        """One less."""
        self._makers.pop(name, None)

    def get(self, name: str) -> GraspObject:
        """The object; a CongraspError if there is none or it cannot be imported."""
        if name not in self._makers:
            raise CongraspError(f"There is no object '{name[:60]}'.", "Choose one of the list.")
        if name not in self._made:
            self._made[name] = self._makers[name]()
        return self._made[name]


class Session:
    """Everything behind the page; its routes are `gets` and `posts`."""

    def __init__(
        self,
        hands: Mapping[str, Callable[[], Grasping]],
        objects: Catalogue,
        take_mesh: Callable[[pathlib.Path], tuple[GraspObject, list[str]]],
        window: TrainingWindow | None = None,
        recordings: Recordings | None = None,
    ):
        """Loads the first hand's policy and the first object.

        Args:
          hands: by name, what loads a policy.
          objects: what can be chosen.
          take_mesh: imports an uploaded mesh, with notes for the user.
          window: what is known of a run, or None.
          recordings: its episodes on disk, or None.
        """
        self._hands, self._objects, self._take_mesh = hands, objects, take_mesh
        self._window, self._recordings = window, recordings
        self._folder = tempfile.TemporaryDirectory(prefix="congrasp-view-")
        self._lock = threading.RLock()
        self._jobs = Jobs()
        self._motions: dict[str, Message] = {}
        self._number = 0
        self._hand = next(iter(hands))
        self._object = objects.names[0]
        self._notes: list[str] = []
        self._grasping = hands[self._hand]()
        self._studio = Studio(self._grasping.hand, self._grasping.task, objects.get(self._object))
        self._studio.view()  # compiles the rules
        self.gets: dict[str, Get] = {
            "/api/state": lambda query: self.state(),
            "/api/job": lambda query: self._jobs.state(),
            "/api/hand": lambda query: hand_message(query.get("name", self._hand)),
            "/api/object": lambda query: self.mesh(),
            "/api/paint": lambda query: Message({"avoid": self._studio.canvas.shown}, {}),
            "/api/motion": lambda query: for_page(self.motion(query.get("id", ""))),
            "/api/export": lambda query: self.export(query.get("id", ""), query.get("kind", "")),
            "/api/training": lambda query: self.training(query.get("names", "")),
            "/api/episodes": lambda query: self.episodes_around(query.get("time", ""), query.get("seconds", "")),
        }
        self.posts: dict[str, Post] = {"/api/do": self._do, "/api/upload": self._upload}

    def close(self) -> None:
        """Ends what runs, and removes uploaded meshes."""
        self._jobs.close()
        self._folder.cleanup()

    def state(self) -> dict[str, Any]:
        """What the page shows of studio, policy, objects, motions and job."""
        with self._lock:
            return {
                "studio": self._studio.view(),
                "hands": list(self._hands),
                "hand": self._hand,
                "objects": self._objects.names,
                "chosen": self._object,
                "notes": self._notes,
                "policy": self._grasping.newest(),
                "motions": [self._described(key) for key in self._motions][::-1],
                "training": self._window is not None,
                "recordings": self._recordings is not None,
                "exports": EXPORTS,
                "job": self._jobs.state(),
            }

    def mesh(self) -> Message:
        """The object's mesh that is painted on."""
        with self._lock:
            vertices, faces = self._studio.canvas.vertices, self._studio.canvas.faces
            return Message({"vertices": vertices, "faces": faces}, {"name": self._studio.obj.name})

    def motion(self, key: str) -> Message:
        """A motion: one of the studio, `actor:NAME` for an actor's newest episode, `record:ID` for a recorded one."""
        kind, _, name = key.partition(":")
        if kind == "actor" and self._window is not None:
            return self._window.episode(name)
        if kind == "record" and self._recordings is not None:
            return self._recordings.episode(name)
        with self._lock:
            if key not in self._motions:
                raise CongraspError(f"There is no motion '{key[:60]}'.", "Press Grasp, or choose one of the list.")
            return self._motions[key]

    def export(self, key: str, kind: str) -> Download:
        """A motion as a file of one of `EXPORTS`; what is a folder comes as a zip archive."""
        if kind not in EXPORTS:
            raise CongraspError(f"A motion cannot be exported as '{kind[:20]}'.", f"Choose from: {', '.join(EXPORTS)}.")
        episode = self.motion(key)
        with tempfile.TemporaryDirectory(prefix="congrasp-export-") as folder:
            path = pathlib.Path(folder) / f"motion{FORMATS.get(kind, f'.{kind}')}"
            try:
                if kind == "npz":
                    save_motion(path, motion_of_episode(episode))
                elif kind == "mcap":
                    writer = LogWriter(pathlib.Path(folder), "motion", run="studio")
                    writer.write(*episode_entries("studio", episode, 0, 0, JsonChannels()))
                    writer.close()
                    path = writer.files[0]
                else:
                    export_motions([motion_of_episode(episode)], kind, path)
            except ModuleNotFoundError as error:
                raise CongraspError(
                    f"This needs the package '{error.name}'.", "Run: pip install 'congrasp[export]'"
                ) from None
            if path.is_dir():
                path = pathlib.Path(shutil.make_archive(str(path), "zip", path))
            number = "".join(c if c.isalnum() else "-" for c in key)[-40:]
            suffix = f".{kind}" if kind in ("npz", "mcap") else FORMATS[kind] or f"-{kind}.zip"
            return Download(f"{episode.meta['object']}-{number}{suffix}", path.read_bytes())

    def training(self, names: str) -> dict[str, Any]:
        """What the window shows; `names`: curves, separated by commas."""
        if self._window is None:
            raise CongraspError("The studio follows no run.", "Start it with --connect, or with --recordings.")
        return self._window.view([name for name in names.split(",") if name])

    def episodes_around(self, time: str, seconds: str) -> dict[str, Any]:
        """Episodes that were recorded around a time."""
        if self._recordings is None:
            raise CongraspError("No recordings were named.", "Start the studio with --recordings FOLDER.")
        try:
            when, around = float(time), float(seconds)
        except ValueError:
            raise CongraspError("A search for episodes needs two numbers: time and seconds.") from None
        reach, episodes = self._recordings.around(when, min(max(around, 0.1), 3600.0))
        return {"seconds": reach, "episodes": episodes}

    def _do(self, query: Mapping[str, str], body: bytes) -> dict[str, Any]:
        """One action of the user; answers with the new state."""
        try:
            request = json_object(body)
            action = request.pop("action")
        except (ValueError, KeyError):
            raise CongraspError("The request is not a JSON object with an 'action'.") from None
        actions: dict[str, Callable[..., Any]] = {
            "hand": self._choose_hand,
            "object": self._choose_object,
            "grasp": self._grasp,
            "forget": self._forget,
            **{name: getattr(self._studio, name) for name in _ACTIONS},
        }
        if action not in actions:
            raise CongraspError(f"The studio cannot do '{str(action)[:40]}'.", f"It can: {', '.join(actions)}.")
        with self._lock:
            try:
                actions[action](**request)
            except TypeError as error:
                raise CongraspError(f"'{action}' takes other values ({error}).") from None
        return self.state()

    def _upload(self, query: Mapping[str, str], body: bytes) -> dict[str, Any]:
        """A mesh to import; the object of its name is chosen when that is done."""
        name = pathlib.PurePosixPath(query.get("name", "").replace("\\", "/")).name
        if not body:
            raise CongraspError(f"{name or 'The file'} is empty (0 bytes).", "Export or download it again.")
        path = pathlib.Path(self._folder.name) / (name or "mesh")
        path.write_bytes(body)

        def work(progress: Progress) -> None:
            """Imports it."""
            progress(f"importing {name}: repair and convex pieces, up to a minute", 0.1)
            try:
                obj, notes = self._take_mesh(path)
            except CongraspError as error:  # the user knows the file, not where it was put
                raise CongraspError(str(error).replace(str(path), name)) from None
            with self._lock:
                self._show(self._objects.add(obj.name, lambda: obj), notes)

        return self._jobs.start(f"importing {name}", work)

    def _choose_hand(self, name: str) -> None:
        """Loads the policy of another hand."""
        if name not in self._hands:
            raise CongraspError(f"There is no policy for the hand '{name}'.", f"There is: {', '.join(self._hands)}.")

        def work(progress: Progress) -> None:
            """Loads it."""
            progress(f"loading the policy of the hand {name}", 0.2)
            grasping = self._hands[name]()
            with self._lock:
                self._hand, self._grasping = name, grasping
                self._studio = Studio(grasping.hand, grasping.task, self._studio.obj)

        self._jobs.start(f"loading the policy of the hand {name}", work)

    def _choose_object(self, name: str) -> None:
        """Makes or imports another object."""

        def work(progress: Progress) -> None:
            """Makes it."""
            progress(f"loading {name}", 0.2)
            self._objects.get(name)
            with self._lock:
                self._show(name)

        if name not in self._objects.names:
            self._objects.get(name)
        self._jobs.start(f"loading {name}", work)

    def _show(self, name: str, notes: Sequence[str] = ()) -> None:
        """Puts an object that is there into the studio."""
        self._studio.take(self._objects.get(name))
        self._object, self._notes = name, list(notes)

    def _grasp(self) -> None:
        """Begins the grasp that is requested; its motion is kept."""
        request, obj = self._studio.request, self._studio.labelled
        grasping = self._grasping

        def work(progress: Progress) -> str:
            """Grasps; returns the motion's key."""
            episode = grasping.grasp(obj, request, progress)
            with self._lock:
                self._number += 1
                self._motions[str(self._number)] = episode
                while len(self._motions) > MOTIONS:
                    del self._motions[next(iter(self._motions))]
                return str(self._number)

        self._jobs.start("grasping", work)

    def _forget(self, id: str) -> None:
        """Deletes a motion."""
        self._motions.pop(id, None)

    def _described(self, key: str) -> dict[str, Any]:
        """What a list shows of a motion."""
        episode = self._motions[key]
        meta, metrics = episode.meta, episode.meta.get("metrics", {})
        return {
            "id": key,
            "object": meta["object"],
            "success": bool(meta["success"]),
            "held": bool(metrics.get("held", 0.0) > 0),
            "note": meta.get("note", ""),
            "version": meta.get("version"),
            "steps": len(episode.arrays["table"]),
            "metrics": {name: float(value) for name, value in metrics.items() if np.isfinite(value)},
        }


_ACTIONS = (
    *("set_rest_pose", "ask", "choose", "set_heading", "snap_heading", "roll", "paint", "fill"),
    *("close_hand", "draw", "suggest"),
)
"""Methods of `Studio` that a page may call, with their arguments by name."""


def hand_message(name: str) -> Message:
    """A hand's skin (see `common.hands.skin`), and its links' names."""
    hand = get_hand(name)
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
    return Message(arrays, {"hand": name, "links": [link.name for link in hand.links]})


def json_object(body: bytes) -> dict[str, Any]:
    """A JSON object; a ValueError for anything else."""
    value = json.loads(body)
    if not isinstance(value, dict):
        raise ValueError("not an object")
    return value
