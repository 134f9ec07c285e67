"""`congrasp objects import`: meshes to objects."""

import dataclasses
import pathlib
from typing import TYPE_CHECKING, Annotated

import tyro

from congrasp.common.errors import CongraspError
from congrasp.common.objects.store import Catalogue
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.assets.objects.sizes import size_in_words
from congrasp.services.cli.console import bars, report_error, say

if TYPE_CHECKING:
    from collections.abc import Sequence

    from congrasp.common.objects.spec import GraspObject
    from congrasp.services.assets.objects.sources import Source


@dataclasses.dataclass
class _Counts:
    """Numbers of objects by the outcome of their import."""

    imported: int = 0
    unreliable: int = 0
    """Imported objects whose shape is unreliable."""
    failed: int = 0
    """Objects and paths that could not be imported."""

    @property
    def exit_code(self) -> int:
        """Exit code of the command: 2 if something could not be imported, 1 if a shape is
        unreliable, else 0.
        """
        if self.failed:
            return 2
        return 1 if self.unreliable else 0


def import_meshes(
    paths: Annotated[tuple[str, ...], tyro.conf.Positional],
    out: pathlib.Path = pathlib.Path("objects"),
    conversion: Annotated[ImportOptions, tyro.conf.OmitArgPrefixes] = ImportOptions(),  # noqa: B008
) -> int:
    """Import objects from meshes: decompose and weigh them, find their resting poses, and store
    them in a folder.

    A path is a mesh file (STL, OBJ, PLY, GLB), a folder with `graspable.*` and `non_graspable.*`, a
    folder with convex pieces `contact*`, `<name>.*` and `<name>_<part>.*`, or a folder of such
    files and folders.

    The exit code is 2 if something could not be imported, and else 1 if a shape is unreliable: its
    pieces are more than 5 mm or half of its volume off.

    Args:
      paths: Mesh files and folders.
      out: Folder for the objects.
      conversion: Conversion of meshes to objects.

    Examples:
      congrasp objects import examples/mug.obj
      congrasp objects import scans/ --unit mm --density 300 --out my-objects
    """
    from congrasp.services.assets.objects.meshes import import_sources
    from congrasp.services.assets.objects.sources import with_distinct_names

    if not paths:
        raise CongraspError("There is nothing to import.", "Pass mesh files or folders.")
    counts = _Counts()
    sources = _sources_of(paths, counts)
    catalogue = Catalogue(out)
    renamed = with_distinct_names(sources)
    _report_new_names(sources, renamed)
    with bars() as progress:
        bar = progress.add_task("Importing", total=len(renamed))
        for _index, imported in import_sources(renamed, conversion):  # in the order of completion
            if isinstance(imported, CongraspError):
                report_error(imported)
                counts.failed += 1
            else:
                _store(imported, catalogue, out)
                counts.imported += 1
                counts.unreliable += not imported.shape_reliable
            progress.advance(bar)
    _report_total(counts, out)
    return counts.exit_code


def _sources_of(paths: tuple[str, ...], counts: _Counts) -> "list[Source]":
    """Returns the sources of all paths, each once, with names that may repeat; reports and counts
    paths without any.
    """
    from congrasp.services.assets.objects.sources import find_unnumbered_sources

    sources: dict[pathlib.Path, Source] = {}
    for path in dict.fromkeys(paths):
        try:
            for source in find_unnumbered_sources(path):
                sources.setdefault(source.path.resolve(), source)
        except CongraspError as error:
            report_error(error)
            counts.failed += 1
    return list(sources.values())


def _report_new_names(sources: "Sequence[Source]", renamed: "Sequence[Source]") -> None:
    """Prints the new name of each source whose name an earlier one has."""
    for source, new in zip(sources, renamed, strict=True):
        if new.name != source.name:
            say(f"{new.path} is stored as {new.name}: another object has the name {source.name}.")


def _store(obj: "GraspObject", catalogue: Catalogue, folder: pathlib.Path) -> None:
    """Stores an object in the catalogue of a folder, and prints its size and its notes."""
    file = catalogue.path(obj.name)
    previous = file.read_bytes() if file.is_file() else None
    stored = catalogue.add(obj).read_bytes()
    if previous is not None and previous != stored:
        say(f"{obj.name}: it replaced another object of that name in {folder}.")
    sides = obj.visual_vertices.max(0) - obj.visual_vertices.min(0)
    say(f"{obj.name}: {size_in_words(sides)}.")
    say(*(f"{obj.name}: {note}." for note in obj.notes))
    if not obj.shape_reliable:
        say(f"{obj.name}: its shape is unreliable. Repair the mesh, or raise --max-pieces.")


def _report_total(counts: _Counts, folder: pathlib.Path) -> None:
    """Prints the numbers of imported and unreliable objects, if any was imported."""
    if not counts.imported:
        return
    total = counts.imported + counts.failed
    unreliable = ""
    if counts.unreliable:
        unreliable = f", {counts.unreliable} of them with an unreliable shape"
    say(f"{counts.imported} of {total} imported to {folder}{unreliable}.")
