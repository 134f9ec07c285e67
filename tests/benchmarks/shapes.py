"""Errors of the convex pieces of imported meshes, the time of an import, and if a busy machine gets
the same pieces.
"""

import contextlib
import dataclasses
import hashlib
import json as json_module
import pathlib
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence

import numpy as np
import trimesh
from rich.console import Console
from rich.table import Table

from congrasp.common.errors import CongraspError
from congrasp.common.objects.spec import GraspObject
from congrasp.services.assets.objects.fidelity import MAX_SURFACE_ERROR_M, MAX_VOLUME_ERROR
from congrasp.services.assets.objects.meshes import import_source
from congrasp.services.assets.objects.named import ObjectAt, objects_at
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.assets.objects.sources import Source, find_sources
from tests.children import BUSY, following

_DEFINITION = (
    f"Within: surface error at most {1000 * MAX_SURFACE_ERROR_M:g} mm and volume error at most "
    f"{MAX_VOLUME_ERROR:.0%}. s: processor time of the import and its child processes."
)


@dataclasses.dataclass(frozen=True)
class ShapeErrors:
    """Errors of one imported object, and the time of its import."""

    name: str
    pieces: int
    surface_mm: float
    volume_percent: float | None
    """None for an open mesh that encloses no volume."""
    seconds: float
    """Processor time of the first import."""
    same_pieces: bool
    """True if all imports have the same pieces, bit for bit."""

    @property
    def within(self) -> bool:
        """True if both errors are within the tolerances."""
        is_volume_close = abs(self.volume_percent or 0.0) <= 100 * MAX_VOLUME_ERROR
        return is_volume_close and self.surface_mm <= 1000 * MAX_SURFACE_ERROR_M


def shapes(
    objects: tuple[pathlib.Path, ...],
    repeats: int = 1,
    busy: int = 0,
    max_pieces: int = 48,
    own_pieces: bool = False,
    json: pathlib.Path | None = None,
) -> int:
    """Errors of the convex pieces of imported meshes, and the time of an import.

    The exit code is 1 if two imports of an object differ.

    Args:
      objects: Mesh files, folders of them, or FAMILY:FIRST-LAST of the generator, whose visual
        meshes are imported.
      repeats: Imports of each object on the machine as it is.
      busy: Processes that keep cores busy during one more import of each object.
      max_pieces: Largest number of convex pieces of an object.
      own_pieces: Use the convex pieces next to a mesh.
      json: File for the results.

    Examples:
      python -m tests.benchmarks shapes --objects ../shared/objects --repeats 2 --busy 4
      python -m tests.benchmarks shapes --objects household:1000000-1000041 --json shapes.json
    """
    results = []
    console = Console()
    with tempfile.TemporaryDirectory(prefix="congrasp-") as name:
        for source in _sources(objects, pathlib.Path(name), own_pieces):
            try:
                result = measure(source, repeats, busy, max_pieces)
            except CongraspError as error:
                console.print(f"{source.name}: {error}")
                continue
            results.append(result)
            console.print(_line(result))
    console.print(_table(results))
    console.print(_DEFINITION)
    if json is not None:
        rows = [dataclasses.asdict(result) | {"within": result.within} for result in results]
        json.write_text(json_module.dumps(rows, indent=1) + "\n")
    return 0 if all(result.same_pieces for result in results) else 1


def measure(source: Source, repeats: int, busy: int, max_pieces: int) -> ShapeErrors:
    """Imports an object several times without a cache, and measures the first import.

    Args:
      source: the object.
      repeats: imports on the machine as it is.
      busy: processes that keep cores busy during one more import; none without any.
      max_pieces: largest number of convex pieces.
    """
    before = _processor_seconds()
    first = _imported(source, max_pieces)
    seconds = _processor_seconds() - before
    digests = {pieces_digest(first)}
    for _ in range(repeats - 1):
        digests.add(pieces_digest(_imported(source, max_pieces)))
    if busy:
        with _busy_processes(busy):
            digests.add(pieces_digest(_imported(source, max_pieces)))
    volume_percent = None if first.volume_error is None else 100 * first.volume_error
    return ShapeErrors(
        name=source.name,
        pieces=len(first.pieces),
        surface_mm=1000 * (first.surface_error or 0.0),
        volume_percent=volume_percent,
        seconds=seconds,
        same_pieces=len(digests) == 1,
    )


def pieces_digest(obj: GraspObject) -> str:
    """Returns the SHA-256 of the positions and vertices of an object's pieces."""
    digest = hashlib.sha256()
    for piece in obj.pieces:
        digest.update(np.asarray(piece.pos, np.float64).tobytes())
        digest.update(np.asarray(piece.vertices, np.float64).tobytes())
    return digest.hexdigest()


def _sources(
    paths: Sequence[pathlib.Path], folder: pathlib.Path, own_pieces: bool
) -> Iterator[Source]:
    """Yields the objects at paths; meshes of generated ones are written to a folder."""
    for path in paths:
        if ":" in path.name and not path.exists():
            for entry in objects_at(path):
                yield _generated(entry, folder)
            continue
        for source in find_sources(path):
            yield source if own_pieces else dataclasses.replace(source, pieces=())


def _generated(entry: ObjectAt, folder: pathlib.Path) -> Source:
    """The visual mesh of a generated object as a file."""
    obj = entry.load()
    file = folder / f"{obj.name}.stl"
    trimesh.Trimesh(obj.visual_vertices, obj.visual_faces).export(file)
    return find_sources(file)[0]


def _imported(source: Source, max_pieces: int) -> GraspObject:
    """An object that no cache has."""
    with tempfile.TemporaryDirectory(prefix="congrasp-") as cache:
        options = ImportOptions(unit="guess", max_pieces=max_pieces, cache_dir=cache)
        return import_source(source, options)


def _processor_seconds() -> float:
    """Processor time of this process and of its children that have ended, s."""
    usages = [
        resource.getrusage(resource.RUSAGE_SELF),
        resource.getrusage(resource.RUSAGE_CHILDREN),
    ]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


@contextlib.contextmanager
def _busy_processes(count: int) -> Iterator[None]:
    """Keeps cores busy."""
    command = [sys.executable, "-c", BUSY]
    processes = [subprocess.Popen(command, env=following()) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _line(result: ShapeErrors) -> str:
    """One line of progress."""
    return " ".join([result.name, *_cells(result)[1:]])


def _cells(result: ShapeErrors) -> list[str]:
    """The cells of an object's row."""
    volume = "open" if result.volume_percent is None else f"{result.volume_percent:+.1f} %"
    return [
        result.name,
        str(result.pieces),
        f"{result.surface_mm:.1f} mm",
        volume,
        f"{result.seconds:.1f} s",
        "within" if result.within else "",
        "same" if result.same_pieces else "different",
    ]


def _table(results: Sequence[ShapeErrors]) -> Table:
    """The table of all objects."""
    count = sum(result.within for result in results)
    table = Table(title=f"{count} of {len(results)} objects within the tolerances")
    for column in ("object", "pieces", "surface", "volume", "s", "within", "imports"):
        table.add_column(column, justify="left" if column == "object" else "right")
    for result in results:
        table.add_row(*_cells(result))
    return table
