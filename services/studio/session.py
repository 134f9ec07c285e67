"""The session of a browser: studio, policy, objects, motions, training window and routes; and the
page.
"""

import contextlib
import functools
import json
import math
import pathlib
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

from congrasp.actors.attempts import PLAIN, Phases
from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError
from congrasp.common.hands import known_hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.wire.codec import Message
from congrasp.services.assets.objects.masses import with_mass
from congrasp.services.assets.objects.materials import MATERIALS
from congrasp.services.assets.objects.units import METRES
from congrasp.services.studio.browser_sessions import Sessions
from congrasp.services.studio.catalogue import (
    Catalogue,
    Importer,
    Thumbnails,
    Uploads,
    open_catalogue,
)
from congrasp.services.studio.grasping import Loaders, PolicyGrasping, Progress
from congrasp.services.studio.jobs import Jobs
from congrasp.services.studio.page import (
    DATA,
    DRAWN,
    Motions,
    data_file,
    describe,
    drawing,
    for_page,
    hand_message,
)
from congrasp.services.studio.routes import BadRequest, Download, Get, Picture, Routes
from congrasp.services.studio.server import PageServer
from congrasp.services.studio.state import ACTIONS, History, Studio
from congrasp.services.studio.training import TrainingWindow

_T = TypeVar("_T")
LIGHTEST_G = 1
HEAVIEST_G = 5000
LONGEST = Phases(approach=10.0, lift=0.5, hold=10.0)
_UNCHANGED_WEIGHT: dict[str, Any] = {"mass_g": 0.0, "material": ""}
"""Leaves the mass of the object unchanged."""
_DRAWING = "drawing"
"""Result of a job that rendered a picture or a video, in place of a motion's number."""
_MAX_INDEX_DIGITS = 5
_LATEST = 1e10
"""Seconds since 1970 beyond which nothing was recorded."""
_MIN_SEARCH_S = 0.1
_MAX_SEARCH_S = 3600.0


class Session:
    """Everything behind the page; its routes are `routes`."""

    def __init__(
        self,
        hands: Loaders,
        objects: Catalogue,
        importer: Importer,
        window: TrainingWindow | None = None,
    ):
        """Loads the first hand's policy and the first object.

        Args:
          hands: loaders of policies, by name.
          objects: objects to choose from.
          importer: makes objects from uploaded meshes.
          window: state of a run, or None.
        """
        self._hands = hands
        self._objects = objects
        self._window = window
        self._folder = tempfile.TemporaryDirectory(prefix="congrasp-view-")
        self._uploads = Uploads(pathlib.Path(self._folder.name), objects, importer)
        self._lock = threading.RLock()
        self._jobs = Jobs()
        self._motions = Motions()
        self._thumbnails = Thumbnails()
        self._drawn: Download | None = None
        self._weight = dict(_UNCHANGED_WEIGHT)
        self._weight_is_newer = False
        """True if the weight was set after the last object began to load: it is meant for that."""
        self._phases = PLAIN
        self._hand = next(iter(hands))
        self._object = objects.names[0]
        self._shown = 0
        self._take_hand(hands[self._hand](), objects.get(self._object))
        describe(self._studio)  # compiles the rules
        self.routes = Routes(self._gets(), {"/api/do": self._do, "/api/upload": self._upload})

    def _gets(self) -> dict[str, Get]:
        """Handlers of GET requests, by path."""
        return {
            "/api/state": lambda query: self.state(),
            "/api/job": lambda query: self._jobs.state(),
            "/api/hand": lambda query: self.hand(query.get("name", "")),
            "/api/object": lambda query: self.mesh(),
            "/api/rest": lambda query: self.rest_picture(query.get("index", "")),
            "/api/paint": lambda query: Message({"avoid": self._studio.canvas.paint.shown}, {}),
            "/api/motion": lambda query: for_page(self.motion(query.get("id", ""))),
            "/api/export": lambda query: self.export(query.get("id", ""), query.get("kind", "")),
            "/api/drawn": lambda query: self.drawn(),
            "/api/training": lambda query: self.training(query.get("names", "")),
            "/api/episodes": lambda query: self.episodes_around(
                query.get("time", ""), query.get("seconds", "")
            ),
        }

    def close(self) -> None:
        """Rejects further jobs, and removes uploaded meshes."""
        self._jobs.close()
        self._folder.cleanup()

    def state(self) -> dict[str, Any]:
        """State of studio, policy, objects, motions and job for the page."""
        with self._lock:
            upload = self._uploads.of(self._object)
            upload_view: dict[str, Any] | None = None
            upload_notes: Sequence[str] = []
            if upload is not None:
                upload_view = upload.view()
                upload_notes = upload.notes
            return {
                "studio": describe(self._studio),
                "history": self._history.view(),
                "hands": list(self._hands),
                "hand": self._hand,
                "objects": self._objects.names,
                "chosen": self._object,
                "shown": self._shown,
                "upload": upload_view,
                "notes": upload_notes,
                "policy": self._grasping.newest(),
                "motions": self._motions.view(),
                "training": self._window is not None,
                "weight": {**self._weight, "materials": list(MATERIALS)},
                "phases": self._phases._asdict(),
                "saves": [*DRAWN, *DATA],
                "drawn": DRAWN,
                "job": self._jobs.state(),
            }

    def hand(self, name: str) -> Message:
        """The studio's hand, or another that a motion may name (see `hand_message`)."""
        with self._lock:
            hand = self._studio.hand
        if name != hand.name:
            hand = known_hand(name)
        return hand_message(hand)

    def mesh(self) -> Message:
        """The painted mesh of the object."""
        with self._lock:
            canvas = self._studio.canvas
            name = self._studio.obj.name
        arrays = {"vertices": canvas.vertices, "faces": canvas.faces}
        if canvas.colours is not None:
            arrays["colours"] = canvas.colours
        return Message(arrays, {"name": name})

    def rest_picture(self, index: str) -> Picture:
        """The object in one of its resting poses, from 0."""
        with self._lock:
            obj = self._studio.obj
        rest = -1  # none
        if index.isdecimal() and len(index) <= _MAX_INDEX_DIGITS:
            rest = int(index)
        return self._thumbnails.picture(obj, rest)

    def motion(self, key: str) -> Episode:
        """A motion: one of the studio, `actor:NAME` for an actor's newest episode, `record:ID` for
        a recorded one.
        """
        kind, _, name = key.partition(":")
        if kind == "actor" and self._window is not None:
            return self._window.episode(name)
        if kind == "record" and self._window is not None and self._window.recordings is not None:
            return self._window.recordings.episode(name)
        with self._lock:
            return self._motions.get(key)

    def export(self, key: str, kind: str) -> Download:
        """A motion as a file of one of `DATA`."""
        return data_file(self.motion(key), key, kind)

    def drawn(self) -> Download:
        """The picture or video that was rendered last; a CongraspError if there is none."""
        if self._drawn is None:
            raise CongraspError(
                "No picture or video has been rendered yet.", "Save a motion as mp4 or png."
            )
        return self._drawn

    def training(self, names: str) -> dict[str, Any]:
        """Content of the training window; `names` are the curves, separated by commas."""
        if self._window is None:
            raise CongraspError(
                "The studio is not connected to a run.",
                "Start it with --connect, or with --recordings.",
            )
        return self._window.view([name for name in names.split(",") if name])

    def episodes_around(self, time: str, seconds: str) -> dict[str, Any]:
        """Episodes that were recorded around a time."""
        if self._window is None or self._window.recordings is None:
            raise CongraspError(
                "The studio has no recordings.", "Start it with --recordings FOLDER."
            )
        try:
            recorded_at = float(time)
            distance_s = float(seconds)
        except ValueError:
            recorded_at = math.nan
            distance_s = math.nan
        if not (0.0 <= recorded_at < _LATEST and math.isfinite(distance_s)):
            raise BadRequest("A search for episodes needs two finite numbers: time and seconds.")
        distance_s = min(max(distance_s, _MIN_SEARCH_S), _MAX_SEARCH_S)
        searched_s, episodes = self._window.recordings.around(recorded_at, distance_s)
        return {"seconds": searched_s, "episodes": episodes}

    def _do(self, query: Mapping[str, str], body: bytes) -> dict[str, Any]:
        """Runs one action of the user; returns the new state."""
        try:
            request = json_object(body)
            action = request.pop("action")
        except (ValueError, KeyError, RecursionError):
            raise CongraspError("The request is not a JSON object with an 'action'.") from None
        with self._lock:
            actions = self._actions()
            if not isinstance(action, str) or action not in actions:
                raise CongraspError(
                    f"There is no action '{str(action)[:40]}'.",
                    f"Choose from: {', '.join(actions)}.",
                )
            try:
                actions[action](**request)
            except (TypeError, ValueError, OverflowError) as error:
                raise CongraspError(f"Invalid value for '{action}': {error}.") from None
        return self.state()

    def _actions(self) -> dict[str, Callable[..., Any]]:
        """Actions of the user by name; those of the studio can be undone."""
        actions: dict[str, Callable[..., Any]] = {
            "hand": self._choose_hand,
            "object": self._choose_object,
            "unit": self._choose_unit,
            "weigh": self._weigh,
            "time": self._time,
            "grasp": self._grasp,
            "draw_motion": self._draw_motion,
            "delete": lambda id: self._motions.delete(str(id)),
            "undo": self._history.undo,
            "redo": self._history.redo,
        }
        for name in ACTIONS:
            actions[name] = functools.partial(self._history.do, name)
        return actions

    def _upload(self, query: Mapping[str, str], body: bytes) -> dict[str, Any]:
        """Imports a mesh and then shows its object; waits for the user's choice if several units
        fit.
        """
        upload = self._uploads.take(query.get("name", ""), body)
        with self._lock:
            if upload.unit:
                load = functools.partial(self._uploads.load, upload, upload.unit)
                return self._import(upload.path.name, load)
            self._jobs.require_idle()
            self._uploads.pending = upload
            return self._jobs.state()

    def _choose_unit(self, unit: str) -> None:
        """Imports the uploaded mesh again in another unit."""
        upload = self._uploads.of(self._object)
        if upload is None or unit not in METRES:
            raise CongraspError(
                f"The unit cannot be '{str(unit)[:20]}'.",
                "Open a mesh, then choose m, cm, mm or in.",
            )
        replaces = "" if self._uploads.pending else self._object
        load = functools.partial(self._uploads.load, upload, unit, replaces)
        self._import(upload.path.name, load)

    def _weigh(self, mass_g: float = 0, material: str = "") -> None:
        """Sets the object's mass: `mass_g`, else by a material, else its original mass. An object
        that is loading gets it, too.
        """
        if mass_g and not LIGHTEST_G <= mass_g <= HEAVIEST_G:
            raise CongraspError(
                f"The mass is {mass_g:g} g.",
                f"Write {LIGHTEST_G} to {HEAVIEST_G} g, or leave the field empty.",
            )
        obj = self._objects.get(self._object)
        mass_kg = mass_g / 1000 if mass_g else None
        self._studio.obj = with_mass(obj, mass_kg, material)
        self._weight = {"mass_g": mass_g, "material": material}
        self._weight_is_newer = True

    def _time(self, **phases: float) -> None:
        """Sets approach (s), lift (m) or hold (s) of further grasps."""
        for name, value in phases.items():
            limit = getattr(LONGEST, name, None)
            if limit is None or not 0 <= float(value) <= limit:
                ranges = [
                    f"{phase} 0 to {longest:g}" for phase, longest in LONGEST._asdict().items()
                ]
                raise CongraspError(
                    f"The {name[:20]} cannot be {str(value)[:20]}.",
                    f"Write (s, m, s): {', '.join(ranges)}.",
                )
        values = {name: float(value) for name, value in phases.items()}
        self._phases = self._phases._replace(**values)

    def _import(self, file: str, load: Callable[[], str]) -> dict[str, Any]:
        """Begins an import by `load`, which returns the object's name, and then shows the
        object.
        """
        return self._load(
            f"importing {file}: repair and convex pieces, up to a minute", load, self._show
        )

    def _choose_hand(self, name: str) -> None:
        """Loads the policy of another hand."""
        if name not in self._hands:
            raise CongraspError(
                f"There is no policy for the hand '{name}'.",
                f"Choose from the hands {', '.join(self._hands)}.",
            )

        def show(grasping: PolicyGrasping) -> None:
            """Begins a request for it."""
            self._hand = name
            self._take_hand(grasping, self._studio.obj)

        self._load(f"loading the policy of the hand {name}", self._hands[name], show)

    def _load(
        self, text: str, load: Callable[[], _T], show: Callable[[_T], None]
    ) -> dict[str, Any]:
        """Begins a job that loads something, and shows it afterwards; returns the state of the
        job.
        """

        def work(progress: Progress) -> None:
            """Loads it."""
            progress(text, 0.2)
            loaded = load()
            with self._lock:
                show(loaded)

        state = self._jobs.start(text, work)
        self._weight_is_newer = False
        return state

    def _take_hand(self, grasping: PolicyGrasping, obj: GraspObject) -> None:
        """Opens a studio for a policy's hand."""
        self._grasping = grasping
        self._studio = Studio(grasping.hand, grasping.task, obj)
        self._history = History(self._studio)

    def _choose_object(self, name: str) -> None:
        """Makes or imports another object."""
        if name not in self._objects.names:
            self._objects.get(name)
        self._load(f"loading {name}", lambda: self._objects.get(name), lambda obj: self._show(name))
        self._uploads.pending = None

    def _show(self, name: str) -> None:
        """Shows an object of the catalogue."""
        self._studio.take(self._objects.get(name))
        self._history = History(self._studio)
        self._object = name
        self._shown += 1
        weight = _UNCHANGED_WEIGHT
        if self._weight_is_newer:
            weight = self._weight
        self._weigh(**weight)

    def _grasp(self) -> None:
        """Begins the requested grasp, whose motion is kept."""
        request = self._studio.request
        obj = self._studio.labelled
        grasping = self._grasping
        phases = self._phases

        def work(progress: Progress) -> str:
            """Grasps; returns the motion's key."""
            episode = grasping.grasp(obj, request, phases, progress)
            with self._lock:
                return self._motions.keep(episode)

        self._jobs.start("grasping", work)

    def _draw_motion(self, id: str, kind: str, camera: Mapping[str, Any], frame: int = 0) -> None:
        """Begins to render a motion as one of `DRAWN`, for `drawn`."""
        key = str(id)
        episode = self.motion(key)
        text = f"drawing the {kind}"

        def work(progress: Progress) -> str:
            """Draws it."""
            self._drawn = drawing(
                episode, key, kind, camera, frame, lambda share: progress(text, share)
            )
            return _DRAWING

        self._jobs.start(text, work)


def json_object(body: bytes) -> dict[str, Any]:
    """A JSON object; a ValueError for anything else."""
    value = json.loads(body)
    if not isinstance(value, dict):
        raise ValueError("not an object")
    return value


@contextlib.contextmanager
def open_page(
    hands: Loaders,
    objects: pathlib.Path | None,
    window: TrainingWindow | None,
    host: str,
    port: int,
    names: Sequence[str] = (),
) -> Iterator[str]:
    """Offers the page, with a session for each browser, while the block runs; yields its address.

    Args:
      hands: loaders of policies, by name; all browsers share their programs.
      objects: the user's objects, before the procedural ones (see `catalogue.open_catalogue`).
      window: state of a run, or None.
      host: see `PageServer`, also for `port` and `names`.

    Raises:
      CongraspError: the port is busy, or a policy or an object cannot be loaded.
    """
    shared = {name: functools.cache(load) for name, load in hands.items()}
    opened: list[Sessions] = []  # the port is taken before the programs compile
    with contextlib.closing(
        PageServer(lambda browser: opened[0].routes(browser), host, port, names)
    ) as server:
        opened.append(
            Sessions(lambda: Session(shared, open_catalogue(objects), Importer(), window))
        )
        with contextlib.closing(opened[0]):
            yield server.url
