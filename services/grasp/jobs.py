"""Grasps of many objects in turn: finished ones are skipped, and a failure does not stop the
others.
"""

import dataclasses
import hashlib
import json
import pathlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import distinct_names, file_name
from congrasp.common.io.spelling import check_spelling
from congrasp.common.objects.resting import upright_rest
from congrasp.common.objects.spec import GraspObject
from congrasp.services.assets.objects.materials import with_mass
from congrasp.services.assets.objects.named import ObjectAt, located, objects_at
from congrasp.services.assets.objects.options import ImportOptions, check_options, size_in_words
from congrasp.services.grasp.files import OBJECT, THUMBNAIL, finished, key_of, save_grasp
from congrasp.services.grasp.grasper import Grasper, Progress
from congrasp.services.grasp.parse import read_request
from congrasp.services.viz.film import Film
from congrasp.services.viz.import_sheet import import_sheet, mesh_of_file
from congrasp.services.viz.sheets import contact_sheet, save_png
from congrasp.services.viz.version import RENDERER_VERSION
from congrasp.services.viz.views import View

SHEET, SUMMARY = "summary.png", "summary.json"
_COLUMNS = 6


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


class Result(NamedTuple):
    """The outcome for one object."""

    name: str
    facts: dict[str, Any]
    """Content of the result file; empty if there is an error."""
    error: str = ""
    skipped: bool = False
    """It was finished before."""

    @property
    def held(self) -> bool:
        """True if the object is held, and its shape is close to that of its file."""
        return bool(self.facts.get("success")) and self.facts["shape_reliable"]

    def line(self) -> str:
        """Summary in one line."""
        if self.error:
            return self.error
        facts = self.facts
        outcome = "held" if facts["success"] else "not held"
        if not facts["shape_reliable"]:
            outcome += (
                ", but its shape is unreliable (see its notes; repair the mesh, or raise "
                "--max-pieces)"
            )
        outcome += ", also against pushes of 1 N" if facts.get("push_survival") else ""
        best = f"best of {facts['attempts']} attempts, {facts['attempts_held']} of which hold it"
        errors = [
            f"{what} {_shown(facts, stem)}"
            for stem, what in _ERRORS.items()
            if f"{stem}_m" in facts
        ]
        if "affordance_ratio" in facts:
            errors.append(
                f"{100 * facts['affordance_ratio']:.0f} % of the contacts in the avoid region"
            )
        lying = [facts["cause"].rstrip(".")] if facts.get("cause") else []
        lying += (
            [f"in resting pose {facts['rest']}, not the likeliest"] if facts["rest"] > 1 else []
        )
        return "; ".join(
            [
                facts["size"],
                outcome,
                *lying,
                best,
                *errors,
                f"strongest link {facts['force_link_max']:.1f} N",
            ]
        )


_ERRORS = {"heading": "heading off by", "pose": "pose off by", "trajectory": "trajectory off by"}


def _shown(facts: dict[str, Any], stem: str) -> str:
    """Angle and distance of one kind of error."""
    return f"{np.degrees(facts[f'{stem}_rad']):.0f}° and {1000 * facts[f'{stem}_m']:.0f} mm"


def find_objects(
    texts: Sequence[str], folder: str = "objects"
) -> tuple[list[ObjectAt], list[Result]]:
    """The objects that a user names (`located`), and errors of names without objects.

    Objects of the same name are numbered, since each name becomes that of a folder.
    """
    found: list[ObjectAt] = []
    errors: list[Result] = []
    for text in texts:
        try:
            found += objects_at(located(text, folder))
        except CongraspError as error:
            errors.append(Result(pathlib.Path(text).name, {}, str(error)))
    return [
        one._replace(name=name)
        for one, name in zip(found, distinct_names(one.name for one in found), strict=True)
    ], errors


def grasp_object(at: ObjectAt, grasper: Grasper, settings: Settings, progress: Progress) -> Result:
    """Grasps one object and writes its folder, unless it is finished already."""
    try:
        folder = settings.out / file_name(at.name, "the folder of an object")
        check_spelling(folder)
        given = {
            name: [
                _identity(part) for part in ([str(text)] if isinstance(text, str | bool) else text)
            ]
            for name, text in settings.constraints.items()
            if text
        }
        options = dataclasses.asdict(dataclasses.replace(settings.options, cache_dir=""))
        key = key_of(at.digest(), options, given, grasper.identity, settings.rest)
        before = None if settings.again else finished(folder, key)
        drawn = [
            RENDERER_VERSION,
            settings.film and [*settings.film],
            settings.view and [*settings.view],
        ]
        filmed = settings.film is None or (
            before and json.loads(json.dumps(drawn)) == before.get("drawn")
        )
        if (
            before is not None
            and filmed
            and (not settings.pictures or (folder / THUMBNAIL).exists())
        ):
            return Result(at.name, before, skipped=True)
        progress("Importing", 0, 1)
        obj = _load(at, settings.options)
        request = read_request(
            obj, grasper.hand, grasper.task.trajectory_points, **settings.constraints
        )
        if settings.rest:
            request = dataclasses.replace(request, rest=rest_pose(obj, settings.rest))
        if settings.pictures and at.source:
            save_png(
                folder / OBJECT,
                import_sheet(grasper.hand, obj, mesh_of_file(at.source), request.avoid),
            )
        found = grasper.grasp(obj, request, progress)
        progress("Drawing", 0, 1)
        about = {
            "key": key,
            "file": str(at.path),
            "size": size_in_words(np.ptp(obj.visual_vertices, axis=0)),
            "object_mass": obj.mass,
            "shape_reliable": obj.shape_reliable,
            "notes": [
                *obj.notes,
                *_notes(at, obj, settings.options),
                *([found.arm.note()] if found.arm else []),
            ],
            "rules": list(found.active),
            "drawn": drawn,
        }
        film, pictures, view = settings.film, settings.pictures, settings.view
        save_grasp(folder, found, about=about, film=film, pictures=pictures, view=view)
        return Result(at.name, {**found.facts(), **about})
    except CongraspError as error:
        return Result(at.name, {}, str(error))


def rest_pose(obj: GraspObject, text: str) -> int:
    """Returns the index of a resting pose from its number, counted from 1, or `upright`: the file's
    z axis points up.

    Raises:
      CongraspError: the object has no such resting pose.
    """
    count = len(obj.rest_poses)
    if text == "upright":
        if (upright := upright_rest(obj)) is None:
            raise CongraspError(
                f"'{obj.name}' does not rest with its z axis up in any of its {count} resting "
                f"poses.",
                f"Set --rest to a number from 1 to {count}: congrasp objects rests {obj.name} "
                f"--png rests.png",
            )
        return upright
    if not text.isdecimal() or len(text) > 4 or not 1 <= int(text) <= count:
        raise CongraspError(
            f"--rest is '{text}'.", f"'{obj.name}' has resting poses 1 to {count}; or set upright."
        )
    return int(text) - 1


def _notes(at: ObjectAt, obj: GraspObject, options: ImportOptions) -> list[str]:
    """Notes on the source of a mesh's mass, if the user has not set it."""
    if not at.source or options.mass is not None:
        return []
    basis = f"of {options.material}" if options.material else "by its surface and volume"
    if options.density is not None:
        basis = f"by {options.density:g} kg/m³"
    return [f"its mass is {1000 * obj.mass:.0f} g, {basis} (--material or --mass sets another)"]


def _load(at: ObjectAt, options: ImportOptions) -> GraspObject:
    """Loads the object; only scale and mass of the options apply to object files and generated
    objects.
    """
    check_options(options)
    if at.source:
        return at.load(options)
    return with_mass(at.load().scaled(options.scale), options.mass, options.material)


def _identity(text: str) -> str:
    """Identity of a constraint: the content of its file, if it names one."""
    for name, part in ((text, "0"), text.rpartition(":")[::2]):  # a number, or a joint
        if name and pathlib.Path(name).is_file():
            return f"{hashlib.sha256(pathlib.Path(name).read_bytes()).hexdigest()}:{part}"
    return text


def save_summary(out: pathlib.Path, hand: str, results: Sequence[Result]) -> None:
    """Writes the results of a hand as JSON, and the last frames of all grasps as one picture."""
    held = sum(result.held for result in results)
    rows = [
        {"name": r.name, "error": r.error} if r.error else {"name": r.name, **r.facts}
        for r in results
    ]
    summary = {"hand": hand, "objects": len(rows), "succeeded": held, "results": rows}
    write_atomically(out / SUMMARY, json.dumps(summary, indent=2).encode())
    drawn = [
        result
        for result in results
        if (out / result.name / THUMBNAIL).exists() and not result.error
    ]
    if drawn:
        images = [
            np.asarray(Image.open(out / result.name / THUMBNAIL).convert("RGB")) for result in drawn
        ]
        labels = [
            f"{result.name}: {_verdict(result)}, {result.facts['attempts_held']} of "
            f"{result.facts['attempts']}"
            for result in drawn
        ]
        title = f"{hand} hand: {held} of {len(rows)} objects held for two seconds without the table"
        save_png(
            out / SHEET,
            contact_sheet(images, labels, columns=min(_COLUMNS, len(drawn)), title=title),
        )


def _verdict(result: Result) -> str:
    """Outcome in the label of a picture."""
    if not result.facts["shape_reliable"]:
        return "SHAPE UNRELIABLE"
    return "held" if result.held else "NOT HELD"
