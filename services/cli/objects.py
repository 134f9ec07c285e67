"""Objects to grasp: generate them, import meshes, list and show them."""

import dataclasses
import pathlib
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from congrasp.common.errors import CongraspError
from congrasp.common.objects.store import Catalogue
from congrasp.services.cli.console import (
    in_range,
    report_error,
    save_drawing,
    say,
    show_facts,
    show_table,
    tracked,
)
from congrasp.services.cli.object_facts import object_facts, part_names, size_text
from congrasp.services.cli.object_import import import_meshes

if TYPE_CHECKING:
    from congrasp.common.objects.spec import GraspObject

_LIST_COLUMNS = (
    "name",
    "family",
    "size (cm)",
    "mass (g)",
    "pieces",
    "graspable",
    "avoid",
    "poses",
)
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
      seed: Seed of the first object; each further object has the next seed. Training never uses
        seeds from one million upward.
      families: Families of the objects, which are used in turn, or groups of families: basic (the
        default), household, all (both), scans.

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


def list_objects(
    folder: Annotated[str, tyro.conf.Positional] = "objects",
    families: bool = False,
    png: pathlib.Path | None = None,
) -> int:
    """List the objects of a folder, or the families of the generator.

    Args:
      folder: Folder of objects.
      families: List the generator's families instead.
      png: PNG file to write: a picture of every object, with the graspable region in green and the
        avoid region in red.

    Examples:
      congrasp objects list my-objects --png my-objects.png
      congrasp objects list --families
    """
    from congrasp.common.objects.procedural import FAMILIES

    if families:
        print("\n".join(FAMILIES))
        return 0
    catalogue = Catalogue(folder)
    names = catalogue.list()
    objects = []
    rows = []
    for name in names:
        try:
            obj = catalogue.get(name)
        except CongraspError as error:
            report_error(error)
            continue
        objects.append(obj)
        rows.append(_row(name, obj))
    if names:
        show_table(_LIST_COLUMNS, rows)
    else:
        print(f"{folder} contains no objects.")
    if png is not None and objects:
        from congrasp.services.viz.object_sheet import overview

        save_drawing(png, overview(objects))
    all_are_readable = len(objects) == len(names)
    return 0 if all_are_readable else 2


def _row(name: str, obj: "GraspObject") -> tuple[str, ...]:
    """Row of an object in the list (`_LIST_COLUMNS`), with the name of its file."""
    graspable, avoided = part_names(obj)
    return (
        name,
        obj.family,
        size_text(obj),
        f"{1000 * obj.mass:.0f}",
        str(len(obj.pieces)),
        graspable,
        avoided,
        str(len(obj.rest_poses)),
    )


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
      png: PNG file to write: the labelled surface, the convex pieces, and headings on the table.

    Examples:
      congrasp objects show mug:7 --png mug.png
      congrasp objects show mug_7 --folder my-objects
    """
    from congrasp.common.task.sampling.heading_sampler import sample_headings
    from congrasp.services.assets.objects.named import find_object

    obj = find_object(object, folder)
    headings = sample_headings(obj, np.random.default_rng(0), use_affordance=False)
    say(obj.name)
    show_facts(object_facts(obj, headings))
    if png is not None:
        from congrasp.services.viz.object_sheet import object_sheet

        assert headings is not None, "only the graspable region may be out of reach"
        save_drawing(png, object_sheet(obj, headings))
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
      png: PNG file to write, with a thumbnail of each resting pose.

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


@dataclasses.dataclass(frozen=True)
class Affordance:
    """Divide an object's surface into graspable region and avoid region.

    The graspable region is the mesh of a part, a painted colour, or the side of a plane. It must
    cover at least a tenth of the surface. Constraint sets and evaluation then use it.

    Examples:
      congrasp objects affordance examples/mug.obj --part-mesh examples/handle.obj --invert
      congrasp objects affordance mug_7 --half-space 0 0 1 0.02 --name upper-mug
    """

    object: Annotated[str, tyro.conf.Positional]
    """A name in the folder, an object file, a mesh, or FAMILY:SEED of the generator, such as
    mug:7."""
    part_mesh: pathlib.Path | None = None
    """A mesh of the graspable part, in the frame and unit of the object's file."""
    painted: pathlib.Path | None = None
    """A PLY file of the object with coloured vertices, in the same frame and unit."""
    colour: str = "green"
    """Colour of the graspable region in the painted file: red, green, blue, yellow, or #rrggbb."""
    half_space: tuple[float, ...] = ()
    """Four numbers: a direction in the object's frame and a distance in metres. The surface beyond
    this distance along the direction, measured from the centre of mass, is graspable."""
    invert: bool = False
    """Use the selected region as the avoid region, and the rest as the graspable region."""
    name: str = ""
    """Name of the new object; by default the object is replaced."""
    folder: str = "objects"
    """Folder of objects, in which the new object is stored."""

    def __call__(self) -> int:
        """Stores the divided object, and prints the share of its graspable region."""
        from congrasp.services.assets.objects.affordance import two_parts
        from congrasp.services.assets.objects.named import find_object

        self._check()
        obj = find_object(self.object, self.folder)
        graspable = self._selection(obj) != self.invert
        if graspable.all():
            raise CongraspError(
                f"The selected part covers the whole surface of '{obj.name}'.",
                "Select a smaller part.",
            )
        labelled = two_parts(obj, graspable, self.name)
        file = Catalogue(self.folder).add(labelled)
        share = 1 - labelled.non_graspable_points.mean()
        print(
            f"{share:.0%} of the surface of {labelled.name} is graspable; the object is in {file}."
        )
        return 0

    def _check(self) -> None:
        """Raises a CongraspError unless exactly one region is defined, and completely."""
        is_defined = (self.part_mesh is not None, self.painted is not None, bool(self.half_space))
        if sum(is_defined) != 1:
            raise CongraspError(
                "The graspable region must be defined by exactly one option.",
                "Pass one of --part-mesh, --painted and --half-space.",
            )
        if len(self.half_space) not in (0, 4):
            raise CongraspError(
                f"--half-space has {len(self.half_space)} numbers, not four.",
                "Write a direction and a distance in metres, such as 0 0 1 0.02.",
            )

    def _selection(self, obj: "GraspObject") -> np.ndarray:
        """Returns the mask of the selected surface points."""
        from congrasp.services.assets.objects import affordance

        if self.part_mesh is not None:
            return affordance.on_part_mesh(obj, self.part_mesh)
        if self.painted is not None:
            return affordance.find_painted(obj, self.painted, _colour(self.colour))
        return affordance.in_half_space(obj, self.half_space[:3], self.half_space[3])


def _colour(text: str) -> tuple[int, int, int]:
    """Parses a colour name or #rrggbb to red, green and blue, 0 to 255."""
    if text in _COLOURS:
        return _COLOURS[text]
    digits = text.removeprefix("#")
    try:
        channels = bytes.fromhex(digits)
    except ValueError:
        channels = b""
    if digits == text or len(channels) != 3:
        raise CongraspError(
            f"--colour is '{text}'.", f"Write #rrggbb, or one of: {', '.join(_COLOURS)}."
        )
    red, green, blue = channels
    return red, green, blue


COMMANDS = {
    "generate": generate,
    "import": import_meshes,
    "list": list_objects,
    "show": show,
    "rests": rests,
    "affordance": Affordance,
}
