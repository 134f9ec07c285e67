"""Grasps of many objects in turn: finished ones are skipped, and a failure does not stop the
others.

A grasp has five steps: the object is imported, the options become a request, attempts are
simulated, the best of them becomes a motion, and the motion is written as files.
"""

import dataclasses
import json
import pathlib
import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import distinct_names, file_name
from congrasp.common.io.spelling import check_spelling
from congrasp.common.objects.resting import upright_rest
from congrasp.common.objects.spec import GraspObject
from congrasp.common.request import GraspRequest
from congrasp.common.runtime.progress import Progress, ignore_progress
from congrasp.services.assets.objects.masses import with_mass
from congrasp.services.assets.objects.named import ObjectAt, located, objects_at
from congrasp.services.assets.objects.options import ImportOptions, check_options
from congrasp.services.assets.objects.sizes import size_in_words
from congrasp.services.grasp.files import OBJECT, THUMBNAIL, read_result, save_grasp
from congrasp.services.grasp.grasper import Grasper
from congrasp.services.grasp.keys import identity_of_constraints, identity_of_options, key_of
from congrasp.services.grasp.motion import Grasp
from congrasp.services.grasp.parse import read_request
from congrasp.services.grasp.result import Result
from congrasp.services.viz.film import Film
from congrasp.services.viz.import_sheet import import_sheet, mesh_of_file
from congrasp.services.viz.raster import compile_loops
from congrasp.services.viz.sheets import save_png
from congrasp.services.viz.version import RENDERER_VERSION
from congrasp.services.viz.views import View


class Settings(NamedTuple):
    """Settings shared by the grasps of all objects."""

    out: pathlib.Path
    options: ImportOptions
    constraints: dict[str, Any]
    """See `services.grasp.parse.read_request`."""
    film: Film | None
    """Style of a video; None for no video."""
    view: View | None
    """Viewpoint of pictures and video; None takes the one that shows most of the grasp."""
    pictures: bool
    again: bool
    """Repeats finished objects."""
    rest: str = ""
    """Resting pose: `upright` or a number from 1 on; any if empty."""

    @property
    def draws(self) -> bool:
        """True if pictures or a video are drawn."""
        return self.pictures or self.film is not None

    @property
    def drawn(self) -> list[Any]:
        """Version of the renderer, style of the video and viewpoint, as result.json has them."""
        film = list(self.film) if self.film else None
        view = list(self.view) if self.view else None
        return [RENDERER_VERSION, film, view]


class _Job(NamedTuple):
    """Grasp of one object, and where its files go."""

    entry: ObjectAt
    settings: Settings
    folder: pathlib.Path
    key: str
    """Changes with any input of the grasp."""


def grasp_object(
    entry: ObjectAt, grasper: Grasper, settings: Settings, progress: Progress
) -> Result:
    """Grasps one object and writes its folder, unless the folder is complete already."""
    try:
        job = _job(entry, grasper, settings)
        facts = _facts_before(job)
        if facts is not None:
            return Result(entry.name, facts, skipped=True)
        if settings.draws:
            # Compiling takes seconds of one core; meanwhile the import waits for another process.
            threading.Thread(target=compile_loops).start()
        obj = _object_of(job, progress)
        request = _request_for(obj, grasper, job)
        _save_import_picture(job, grasper, obj, request, progress)
        attempted = grasper.attempt(obj, request, progress)
        grasp = grasper.motion(attempted, progress)
        facts = _save(job, obj, grasp, progress)
    except CongraspError as error:
        return Result(entry.name, {}, str(error))
    return Result(entry.name, facts)


def find_objects(
    texts: Sequence[str], folder: str = "objects"
) -> tuple[list[ObjectAt], list[Result]]:
    """The objects that a user names (`located`), and errors of names without objects.

    Objects of the same name are numbered, since each name becomes that of a folder.
    """
    entries: list[ObjectAt] = []
    errors: list[Result] = []
    for text in texts:
        try:
            entries += objects_at(located(text, folder))
        except CongraspError as error:
            errors.append(Result(pathlib.Path(text).name, {}, str(error)))
    names = distinct_names(entry.name for entry in entries)
    return [entry._replace(name=name) for entry, name in zip(entries, names, strict=True)], errors


def import_object(
    entry: ObjectAt, options: ImportOptions, progress: Progress = ignore_progress
) -> GraspObject:
    """Loads an object; only scale and mass of the options apply to object files and generated
    objects.

    Raises:
      CongraspError: an option is out of range, or the object cannot be read or imported.
    """
    check_options(options)
    if entry.source:
        return entry.load(options, progress)
    return with_mass(entry.load().scaled(options.scale), options.mass, options.material)


def rest_pose(obj: GraspObject, text: str) -> int:
    """Returns the index of a resting pose from its number, counted from 1, or `upright`: the file's
    z axis points up.

    Raises:
      CongraspError: the object has no such resting pose.
    """
    count = len(obj.rest_poses)
    if text == "upright":
        upright = upright_rest(obj)
        if upright is None:
            raise CongraspError(
                f"The z axis of '{obj.name}' points up in none of its {count} resting poses.",
                f"Set --rest to a number from 1 to {count}; 'congrasp objects rests {obj.name} "
                f"--png rests.png' draws them.",
            )
        return upright
    if not text.isdecimal() or len(text) > 4 or not 1 <= int(text) <= count:
        raise CongraspError(
            f"--rest is '{text}'.",
            f"Pass a number from 1 to {count}, the resting poses of '{obj.name}', or upright.",
        )
    return int(text) - 1


def _job(entry: ObjectAt, grasper: Grasper, settings: Settings) -> _Job:
    """Folder and key of an object's grasp."""
    folder = settings.out / file_name(entry.name, "the folder of an object")
    check_spelling(folder)
    key = key_of(
        entry.digest(),
        identity_of_options(settings.options),
        identity_of_constraints(settings.constraints),
        grasper.identity,
        settings.rest,
    )
    return _Job(entry=entry, settings=settings, folder=folder, key=key)


def _facts_before(job: _Job) -> dict[str, Any] | None:
    """Facts of a finished grasp that has all requested files; None without one."""
    settings = job.settings
    if settings.again:
        return None
    facts = read_result(job.folder, job.key)
    if facts is None:
        return None
    if settings.film is not None and facts.get("drawn") != json.loads(json.dumps(settings.drawn)):
        return None
    if settings.pictures and not (job.folder / THUMBNAIL).exists():
        return None
    return facts


def _object_of(job: _Job, progress: Progress) -> GraspObject:
    """Step 1: the object of a job."""
    progress("Importing", 0, 0)
    return import_object(job.entry, job.settings.options, progress)


def _request_for(obj: GraspObject, grasper: Grasper, job: _Job) -> GraspRequest:
    """Step 2: the request for an object."""
    settings = job.settings
    request = read_request(
        obj, grasper.hand, grasper.task.trajectory_points, **settings.constraints
    )
    if settings.rest:
        request = dataclasses.replace(request, rest=rest_pose(obj, settings.rest))
    return request


def _save_import_picture(
    job: _Job, grasper: Grasper, obj: GraspObject, request: GraspRequest, progress: Progress
) -> None:
    """Draws an imported object and its part to avoid, which may explain why a grasp fails."""
    source = job.entry.source
    if not source or not job.settings.pictures:
        return
    progress("Drawing the object", 0, 0)
    avoid = None if request.avoid is None else np.asarray(request.avoid)
    sheet = import_sheet(grasper.hand, obj, mesh_of_file(source), avoid)
    save_png(job.folder / OBJECT, sheet)


def _save(job: _Job, obj: GraspObject, grasp: Grasp, progress: Progress) -> dict[str, Any]:
    """Step 5: writes the files of a grasp; returns the content of result.json."""
    settings = job.settings
    notes = [*obj.notes, *_notes_on_mass(obj, job)]
    if grasp.arm:
        notes.append(grasp.arm.note())
    about = {
        "key": job.key,
        "file": str(job.entry.path),
        "size": size_in_words(np.ptp(obj.visual_vertices, axis=0)),
        "object_mass": obj.mass,
        "shape_reliable": obj.shape_reliable,
        "notes": notes,
        "rules": list(grasp.active),
        "physics": grasp.motion.about.get("physics", "native"),
        "drawn": settings.drawn,
    }
    save_grasp(
        job.folder,
        grasp,
        film=settings.film,
        pictures=settings.pictures,
        about=about,
        view=settings.view,
        progress=progress,
    )
    return {**grasp.facts(), **about}


def _notes_on_mass(obj: GraspObject, job: _Job) -> list[str]:
    """Notes on the source of a mesh's mass, if the user has not set it."""
    options = job.settings.options
    if not job.entry.source or options.mass is not None:
        return []
    if options.density is not None:
        basis = f"by {options.density:g} kg/m³"
    elif options.material:
        basis = f"of {options.material}"
    else:
        basis = "by its surface and volume"
    return [f"its mass is {1000 * obj.mass:.0f} g, {basis} (--material or --mass sets another)"]
