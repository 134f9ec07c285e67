"""Objects to grasp: generate them, import meshes, list and show them."""

import dataclasses
import pathlib
import sys
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from common.errors import CongraspError
from common.objects import store
from common.objects.procedural import FAMILIES, family_turns, generate
from common.objects.spec import GraspObject
from common.objects.store import Catalogue
from common.task.sampling.headings import above, clear_table, feasible, sample_headings
from services.assets.objects.meshes import ImportOptions, import_source
from services.assets.objects.sources import SUFFIXES, find_sources
from services.cli.objects_affordance import ObjectsAffordance
from services.cli.progress import bars

_console = Console(highlight=False)


@dataclasses.dataclass(frozen=True)
class ObjectsGenerate:
    """Makes procedural objects and stores them in a folder."""

    out: str = "objects"
    """Folder for the objects."""
    count: int = 24
    """Number of objects."""
    seed: int = 0
    """Seed of the first; the others follow. Training never uses seeds from one million upward."""
    families: tuple[str, ...] = ()
    """Families, in turn; all if none is named."""

    def run(self) -> int:
        """Runs the command; returns its exit code."""
        if self.count < 1:
            raise CongraspError(f"--count is {self.count}.", "Ask for at least one object.")
        catalogue = Catalogue(self.out)
        families = family_turns(self.count, self.seed, self.families)
        with bars(_console) as progress:
            task = progress.add_task("Generating", total=self.count)
            for i, family in enumerate(families):
                catalogue.add(generate(self.seed + i, family))
                progress.advance(task)
        _console.print(f"{self.count} objects are in {escape(self.out)}.")
        return 0


@dataclasses.dataclass(frozen=True)
class ObjectsImport:
    """Makes objects of meshes: decomposes them, weighs them, finds their resting poses, and stores them in a folder.

    A path is a mesh file (STL, OBJ, PLY, GLB), a folder with `graspable.*` and `non_graspable.*`, a folder with convex
    pieces `contact*` beside `<name>.*` and `<name>_<part>.*`, or a folder of such files and folders.
    """

    paths: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Mesh files and folders."""
    out: str = "objects"
    """Folder for the objects."""
    options: Annotated[ImportOptions, tyro.conf.OmitArgPrefixes] = dataclasses.field(default_factory=ImportOptions)
    """How meshes become objects."""

    def run(self) -> int:
        """Runs the command; returns its exit code: 2 if anything could not be imported."""
        if not self.paths:
            raise CongraspError("There is nothing to import.", "Name mesh files or folders.")
        sources, done, failures = [], 0, 0
        for path in self.paths:
            try:
                sources.extend(find_sources(path))
            except CongraspError as error:
                failures += _complain(error)
        catalogue = Catalogue(self.out)
        with bars(_console) as progress:
            task = progress.add_task("Importing", total=len(sources))
            for source in sources:
                progress.update(task, description=f"Importing {escape(source.name)}")
                try:
                    obj, notes = import_source(source, self.options)
                    catalogue.add(obj)
                    done += 1
                    for note in notes:
                        progress.console.print(f"{escape(source.name)}: {escape(note)}.")
                except CongraspError as error:
                    failures += _complain(error)
                progress.advance(task)
        if done:
            _console.print(f"{done} of {done + failures} imported; they are in {escape(self.out)}.")
        return 2 if failures else 0


@dataclasses.dataclass(frozen=True)
class ObjectsList:
    """Lists the objects of a folder, or the families of the generator."""

    folder: Annotated[str, tyro.conf.Positional] = "objects"
    """Folder of objects."""
    families: bool = False
    """List the generator's families instead."""

    def run(self) -> int:
        """Runs the command; returns its exit code: 2 if a file is damaged."""
        if self.families:
            _console.print("\n".join(FAMILIES))
            return 0
        catalogue = Catalogue(self.folder)
        names, failures = catalogue.list(), 0
        table = Table("name", "family", "size (cm)", "mass (g)", "pieces", "O+", "O-", "poses")
        for name in names:
            try:
                obj = catalogue.get(name)
            except CongraspError as error:
                failures += _complain(error)
                continue
            row = (name, obj.family, _size(obj), f"{1000 * obj.mass:.0f}", str(len(obj.pieces)), *_parts(obj))
            table.add_row(*map(escape, row), str(len(obj.rest_poses)))
        _console.print(table if names else f"{escape(self.folder)} holds no object.")
        return 2 if failures else 0


@dataclasses.dataclass(frozen=True)
class ObjectsShow:
    """Prints the facts of an object, and draws it."""

    object: Annotated[str, tyro.conf.Positional]
    """A name in the folder, an object file, a mesh, or FAMILY:SEED of the generator, such as mug:7."""
    folder: str = "objects"
    """Folder of objects."""
    png: str = ""
    """Picture to write: labelled surface, convex pieces, headings on the table."""

    def run(self) -> int:
        """Runs the command; returns its exit code."""
        obj = find_object(self.object, self.folder)
        share = obj.graspable[obj.labels].mean()
        plus_parts, minus_parts = _parts(obj)
        free, plus = (
            sample_headings(obj, np.random.default_rng(0), use_affordance=affordance) for affordance in (False, True)
        )
        table = Table(show_header=False, box=None)
        rows = {
            "family": obj.family,
            "size": f"{_size(obj)} cm",
            "mass": f"{1000 * obj.mass:.1f} g",
            "principal inertia": " ".join(f"{1e6 * v:.1f}" for v in np.linalg.eigvalsh(obj.inertia)) + " kg.mm²",
            "pieces": ", ".join(_counted([piece.kind for piece in obj.pieces])),
            "O+": f"{plus_parts} ({share:.0%} of the surface)",
            "O-": minus_parts or "nothing",
            "digest": store.digest(obj),
        }
        for i, pose in enumerate(obj.rest_poses):
            counts = []
            for headings in (free, plus):
                if headings is None:
                    counts.append("none")
                    continue
                cleared = clear_table(headings, pose)
                reachable = feasible(cleared, pose)
                counts.append(f"{reachable.mean():.0%} ({(reachable & above(cleared, pose)).mean():.0%} from above)")
            rows[f"resting pose {i + 1}"] = (
                f"{100 * pose[2]:.1f} cm high; headings within reach {counts[0]}, on O+ {counts[1]}"
            )
        for key, value in rows.items():
            table.add_row(key, escape(value))
        _console.print(f"[bold]{escape(obj.name)}[/bold]")
        _console.print(table)
        if self.png:
            from services.cli.objects_picture import draw_object

            assert free is not None, "only O+ may be out of reach"
            draw_object(obj, free, pathlib.Path(self.png))
            _console.print(f"The picture is {escape(self.png)}.")
        return 0


SUBCOMMANDS: dict[str, Callable[..., Any]] = {
    "generate": ObjectsGenerate,
    "import": ObjectsImport,
    "list": ObjectsList,
    "show": ObjectsShow,
    "affordance": ObjectsAffordance,
}


def parse(arguments: Sequence[str]) -> Callable[[], int]:
    """The command that the arguments name, ready to run."""
    chosen = tyro.extras.subcommand_cli_from_dict(
        SUBCOMMANDS, prog="congrasp objects", description=__doc__, args=list(arguments)
    )
    return chosen.run


def find_object(text: str, folder: str = "objects") -> GraspObject:
    """The object that a user means: an object file, a mesh, FAMILY:SEED, or a name in a folder.

    Raises:
      CongraspError: there is no such object.
    """
    path = pathlib.Path(text)
    if path.suffix == store.SUFFIX:
        return store.load(path)
    if path.suffix.lower() in SUFFIXES or path.is_dir():
        sources = find_sources(path)
        if len(sources) > 1:
            raise CongraspError(f"{text} holds {len(sources)} objects.", "Name one of them.")
        return import_source(sources[0], ImportOptions())[0]
    family, colon, seed = text.partition(":")
    if colon and seed.isdigit():
        return generate(int(seed), family)
    if not Catalogue(folder).path(text).is_file():
        raise CongraspError(
            f"There is no object '{text}' in {folder}.",
            "Name an object of the folder, an object file, a mesh, or FAMILY:SEED such as mug:7.",
        )
    return Catalogue(folder).get(text)


def _complain(error: CongraspError) -> int:
    print(f"congrasp: error: {error}", file=sys.stderr)
    return 1


def _size(obj: GraspObject) -> str:
    return " x ".join(f"{100 * side:.1f}" for side in np.ptp(obj.visual_vertices, axis=0))


def _parts(obj: GraspObject) -> tuple[str, str]:
    """The names of the parts in O+ and in O-."""
    plus, minus = (
        ", ".join(name for name, graspable in zip(obj.part_names, obj.graspable, strict=True) if graspable == wanted)
        for wanted in (True, False)
    )
    return plus, minus


def _counted(words: list[str]) -> list[str]:
    return [f"{words.count(word)} {word}" for word in dict.fromkeys(words)]
