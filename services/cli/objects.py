"""Objects to grasp: generate them, import meshes, list and show them."""

import pathlib
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from congrasp.common.errors import CongraspError
from congrasp.common.hands.files import HUMAN
from congrasp.common.objects.store import Catalogue, digest
from congrasp.services.assets.objects.options import ImportOptions, size_in_words
from congrasp.services.cli.console import (
    bars,
    in_range,
    report_error,
    save_drawing,
    say,
    show_facts,
    show_table,
    tracked,
)

if TYPE_CHECKING:
    from congrasp.common.objects.spec import GraspObject
    from congrasp.common.task.sampling.headings import Headings

_COLOURS = {"red": (255, 0, 0), "green": (0, 255, 0), "blue": (0, 0, 255), "yellow": (255, 255, 0)}


def generate(
    out: pathlib.Path = pathlib.Path("objects"),
    count: int = 24,
    seed: int = 0,
    families: tuple[str, ...] = (),
) -> int:
    """Make procedural objects and store them in a folder.

    Args:
      out: Folder for the objects.
      count: Number of objects.
      seed: Seed of the first; the others follow. Training never uses seeds from one million upward.
      families: Families, in turn, or groups of them: basic (if none is named), household, all
        (both), scans.

    Examples:
      congrasp objects generate --count 100
      congrasp objects generate --families mug knife --out tools
    """
    from congrasp.common.objects import procedural

    in_range(1, count=count)
    catalogue = Catalogue(out)
    turns = procedural.family_turns(count, seed, families)
    with tracked() as track:
        advance = track("Generating", count)
        for i, family in enumerate(turns):
            catalogue.add(procedural.generate(seed + i, family))
            advance(i + 1)
    print(f"{count} objects are in {out}.")
    return 0


def import_meshes(
    paths: Annotated[tuple[str, ...], tyro.conf.Positional],
    out: pathlib.Path = pathlib.Path("objects"),
    mesh: Annotated[ImportOptions, tyro.conf.OmitArgPrefixes] = ImportOptions(),  # noqa: B008
) -> int:
    """Import objects from meshes: decompose and weigh them, find their resting poses, and store
    them in a folder.

    A path is a mesh file (STL, OBJ, PLY, GLB), a folder with `graspable.*` and `non_graspable.*`, a
    folder with convex pieces `contact*`, `<name>.*` and `<name>_<part>.*`, or a folder of such
    files and folders. The exit code is 1 if a shape is unreliable: its pieces are more than 5 mm or
    half of its volume off.

    Args:
      paths: Mesh files and folders.
      out: Folder for the objects.
      mesh: Conversion of meshes to objects.

    Examples:
      congrasp objects import examples/mug.obj
      congrasp objects import scans/ --unit mm --density 300 --out my-objects
    """
    from congrasp.services.assets.objects.meshes import import_sources
    from congrasp.services.assets.objects.sources import distinct, find_sources

    if not paths:
        raise CongraspError("There is nothing to import.", "Pass mesh files or folders.")
    sources, done, failures, unreliable = [], 0, 0, 0
    for path in dict.fromkeys(paths):
        try:
            sources += find_sources(path)
        except CongraspError as error:
            report_error(error)
            failures += 1
    catalogue, named = Catalogue(out), distinct(sources)
    for before, source in zip(sources, named, strict=True):
        if source.name != before.name:
            say(f"{source.name}: that is {source.path}, for there is another {before.name}.")
    with bars() as progress:
        task = progress.add_task("Importing", total=len(named))
        for _, obj in import_sources(named, mesh):
            if isinstance(obj, CongraspError):
                report_error(obj)
                failures += 1
            else:
                earlier = (
                    file.read_bytes() if (file := catalogue.path(obj.name)).is_file() else None
                )
                if earlier not in (None, catalogue.add(obj).read_bytes()):
                    say(f"{obj.name}: it replaced another object of that name in {out}.")
                done += 1
                sides = obj.visual_vertices.max(0) - obj.visual_vertices.min(0)
                say(*(f"{obj.name}: {text}." for text in (size_in_words(sides), *obj.notes)))
                if not obj.shape_reliable:
                    unreliable += 1
                    print(
                        f"{obj.name}: its shape is unreliable. Repair the mesh, or raise "
                        f"--max-pieces."
                    )
            progress.advance(task)
    if done:
        doubtful = f", {unreliable} of them with an unreliable shape" if unreliable else ""
        print(f"{done} of {done + failures} imported to {out}{doubtful}.")
    return 2 if failures else 1 if unreliable else 0


def list_objects(
    folder: Annotated[str, tyro.conf.Positional] = "objects",
    families: bool = False,
    png: pathlib.Path | None = None,
) -> int:
    """List the objects of a folder, or the families of the generator.

    Args:
      folder: Folder of objects.
      families: List the generator's families instead.
      png: Picture to write: every object, its graspable region green and its avoid region red.

    Examples:
      congrasp objects list my-objects --png my-objects.png
      congrasp objects list --families
    """
    from congrasp.common.objects.procedural import FAMILIES

    if families:
        print("\n".join(FAMILIES))
        return 0
    catalogue, found, rows, failures = Catalogue(folder), [], [], 0
    names = catalogue.list()
    for name in names:
        try:
            obj = catalogue.get(name)
        except CongraspError as error:
            report_error(error)
            failures += 1
            continue
        found.append(obj)
        weight, pieces, poses = (
            f"{1000 * obj.mass:.0f}",
            str(len(obj.pieces)),
            str(len(obj.rest_poses)),
        )
        rows.append((name, obj.family, _size(obj), weight, pieces, *_parts(obj), poses))
    if names:
        show_table(
            ("name", "family", "size (cm)", "mass (g)", "pieces", "graspable", "avoid", "poses"),
            rows,
        )
    else:
        print(f"{folder} holds no object.")
    if png is not None and found:
        from congrasp.services.viz.object_sheet import overview

        save_drawing(png, overview(found))
    return 2 if failures else 0


def show(
    object: Annotated[str, tyro.conf.Positional],
    folder: str = "objects",
    png: pathlib.Path | None = None,
) -> int:
    """Print the facts of an object, and draw it.

    Args:
      object: A name in the folder, an object file, a mesh, or FAMILY:SEED of the generator, such as
        mug:7.
      folder: Folder of objects.
      png: Picture to write: labelled surface, convex pieces, headings on the table.

    Examples:
      congrasp objects show mug:7 --png mug.png
      congrasp objects show mug_7 --folder my-objects
    """
    from congrasp.common.task.sampling.heading_sampler import sample_headings
    from congrasp.services.assets.objects.named import find_object

    obj = find_object(object, folder)
    share = obj.graspable[obj.labels].mean()
    graspable, avoided = _parts(obj)
    free, on_graspable = (
        sample_headings(obj, np.random.default_rng(0), use_affordance=affordance)
        for affordance in (False, True)
    )
    kinds = [piece.kind for piece in obj.pieces]
    facts = {
        "family": obj.family,
        "size": f"{_size(obj)} cm",
        "mass": f"{1000 * obj.mass:.1f} g",
        "principal inertia": " ".join(f"{1e6 * v:.1f}" for v in np.linalg.eigvalsh(obj.inertia))
        + " kg.mm²",
        "pieces": ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds)),
        "pieces against the mesh": _errors(obj),
        "graspable region": f"{graspable} ({share:.0%} of the surface)",
        "avoid region": avoided or "nothing",
        "digest": digest(obj),
    }
    for i, texts in enumerate(
        zip(_reach(obj, free), _reach(obj, on_graspable, region=True), strict=True)
    ):
        facts[f"resting pose {i + 1}"] = (
            f"{100 * obj.rest_poses[i][2]:.1f} cm high; headings within reach of the human hand "
            f"{texts[0]}, on the "
            f"graspable region {texts[1]}"
        )
    say(obj.name)
    show_facts(facts)
    if png is not None:
        from congrasp.services.viz.object_sheet import object_sheet

        assert free is not None, "only the graspable region may be out of reach"
        save_drawing(png, object_sheet(obj, free))
    return 0


def rests(
    object: Annotated[str, tyro.conf.Positional],
    folder: str = "objects",
    png: pathlib.Path | None = None,
) -> int:
    """List and draw an object's resting poses, the most likely first, for `congrasp grasp --rest`.

    Args:
      object: A name in the folder, an object file, a mesh, or FAMILY:SEED of the generator, such as
        mug:7.
      folder: Folder of objects.
      png: Picture to write: a thumbnail of each.

    Examples:
      congrasp objects rests mug:7 --png rests.png
      congrasp objects rests examples/mug.obj
    """
    from congrasp.common.objects.resting import rest_tilts
    from congrasp.services.assets.objects.named import find_object

    obj = find_object(object, folder)
    tilts = np.degrees(rest_tilts(obj))
    rows = [
        (str(i), f"{100 * pose[2]:.1f}", f"{tilt:.0f}")
        for i, (pose, tilt) in enumerate(zip(obj.rest_poses, tilts, strict=True), 1)
    ]
    show_table(("--rest", "centre of mass (cm)", "z axis from up (°)"), rows)
    if png is not None:
        from congrasp.services.viz.object_sheet import rests_sheet

        save_drawing(png, rests_sheet(obj))
    return 0


def _reach(obj: "GraspObject", headings: "Headings | None", *, region: bool = False) -> list[str]:
    """Share of the headings, or of those on the graspable region, that the human hand can use in
    each resting pose.
    """
    from congrasp.common.hands.closure import outline
    from congrasp.common.task.sampling.reach import above, within_reach

    if headings is None:
        return ["none"] * len(obj.rest_poses)
    texts = []
    avoid = obj.non_graspable_points if region else None
    found = within_reach(headings, obj, obj.rest_poses, outline(HUMAN), avoid)
    for pose, cleared, reachable in zip(obj.rest_poses, *found, strict=True):
        texts.append(
            f"{reachable.mean():.0%} ({(reachable & above(cleared, pose)).mean():.0%} from above)"
        )
    return texts


def set_affordance(  # noqa: PLR0913
    object: Annotated[str, tyro.conf.Positional],
    part_mesh: pathlib.Path | None = None,
    painted: pathlib.Path | None = None,
    colour: str = "green",
    half_space: tuple[float, ...] = (),
    invert: bool = False,
    name: str = "",
    folder: str = "objects",
) -> int:
    """Divide an object's surface into graspable region and avoid region.

    The graspable region is the mesh of a part, a painted colour, or the side of a plane. It must
    cover at least a tenth of the surface. Constraint sets and evaluation then use it.

    Args:
      object: A name in the folder, an object file, a mesh, or FAMILY:SEED of the generator, such as
        mug:7.
      part_mesh: A mesh of the graspable part, in the frame and unit of the object's file.
      painted: A PLY file of the object with coloured vertices, in the same frame and unit.
      colour: Colour of the graspable region in the painted file: red, green, blue, yellow, or
        #rrggbb.
      half_space: Three numbers of a direction and one in metres: the region farther than that along
        the direction is graspable. In the object's frame, whose origin is its centre of mass.
      invert: Use the selection as the avoid region, and the rest as the graspable one.
      name: Name of the new object; by default it replaces the old one.
      folder: Folder of objects, to which the new one goes.

    Examples:
      congrasp objects affordance examples/mug.obj --part-mesh examples/handle.obj --invert
      congrasp objects affordance mug_7 --half-space 0 0 1 0.02 --name upper-mug
    """
    from congrasp.services.assets.objects import affordance
    from congrasp.services.assets.objects.named import find_object

    if [part_mesh, painted, half_space or None].count(None) != 2:
        raise CongraspError(
            "The graspable region is not defined.",
            "Pass one of --part-mesh, --painted and --half-space.",
        )
    if len(half_space) not in (0, 4):
        raise CongraspError(
            f"--half-space has {len(half_space)} numbers, not four.",
            "Write a direction and a distance in metres, such as 0 0 1 0.02.",
        )
    obj = find_object(object, folder)
    if part_mesh is not None:
        found = affordance.on_part_mesh(obj, part_mesh)
    elif painted is not None:
        found = affordance.painted(obj, painted, _colour(colour))
    else:
        found = affordance.in_half_space(obj, half_space[:3], half_space[3])
    if (found != invert).all():
        raise CongraspError(
            f"All of the surface of '{obj.name}' would be graspable, so nothing is divided.",
            "Choose a smaller part.",
        )
    labelled = affordance.two_parts(obj, found != invert, name)
    file = Catalogue(folder).add(labelled)
    share = 1 - labelled.non_graspable_points.mean()
    print(f"{share:.0%} of the surface of {labelled.name} may be grasped; it is in {file}.")
    return 0


def _size(obj: "GraspObject") -> str:
    """Sides of its box in cm."""
    sides = 100 * (obj.visual_vertices.max(0) - obj.visual_vertices.min(0))
    return " x ".join(f"{side:.1f}" for side in sides)


def _errors(obj: "GraspObject") -> str:
    """Describes the errors of its pieces, if it was imported."""
    if obj.surface_error is None:
        return "the object is its pieces"
    volume = "" if obj.volume_error is None else f", volume {obj.volume_error:+.1%}"
    return f"surface {1000 * obj.surface_error:.1f} mm off at most{volume}"


def _parts(obj: "GraspObject") -> tuple[str, str]:
    """Names of the parts of the graspable and of the avoid region."""
    named = list(zip(obj.part_names, obj.graspable, strict=True))
    graspable, avoided = (
        ", ".join(name for name, allowed in named if allowed == wanted) for wanted in (True, False)
    )
    return graspable, avoided


def _colour(text: str) -> tuple[int, int, int]:
    """Parses a colour name or #rrggbb to red, green and blue, 0 to 255."""
    if text in _COLOURS:
        return _COLOURS[text]
    try:
        red, green, blue = bytes.fromhex(text.removeprefix("#")) if text.startswith("#") else b""
    except ValueError:
        raise CongraspError(
            f"--colour is '{text}'.", f"Write #rrggbb, or one of: {', '.join(_COLOURS)}."
        ) from None
    return red, green, blue


COMMANDS = {
    "generate": generate,
    "import": import_meshes,
    "list": list_objects,
    "show": show,
    "rests": rests,
    "affordance": set_affordance,
}
