"""Import of meshes: one object at a time or many in parallel, with a cache of finished imports."""

import collections
import contextlib
import dataclasses
import hashlib
import pathlib
import queue
import threading
from collections.abc import Iterator, Sequence

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import cache_folder
from congrasp.common.io.inputs import read_file
from congrasp.common.objects import store
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.progress import Progress, ignore_progress
from congrasp.common.runtime.resources import cores, memory
from congrasp.services.assets.objects.assembly import assemble
from congrasp.services.assets.objects.decompose import (
    MAX_PROCESSOR_S,
    MAX_WALL_CLOCK_RATIO,
    MIN_CHILD_MEMORY_BYTES,
)
from congrasp.services.assets.objects.file_kinds import CHECK, MAX_BYTES
from congrasp.services.assets.objects.options import ImportOptions, check_options
from congrasp.services.assets.objects.sources import Source

_CACHE_VERSION = 17
"""A new one imports every object again: its pieces, mass or colours are made in another way."""
_DRAWS_VERSION = 8
"""A new one changes the surface points of every object, and with them all measurements."""
_PATIENCE_S = 600.0
"""Time beyond the limits of an object's decompositions."""


def import_source(
    source: Source, options: ImportOptions, progress: Progress = ignore_progress
) -> GraspObject:
    """Imports one object, or reads it from the cache; its `notes` are for the user.

    Its origin moves to the centre of mass; its orientation stays that of the file. Parts come from
    part files; an object without them is labelled by two halves, the slimmer one graspable if a
    hand can close on it (`cut_to_hold`).

    Args:
      source: the files.
      options: options of the import.
      progress: called with the activities of the import.

    Raises:
      CongraspError: an option is invalid, or a mesh cannot be used; the message names it, its fault
        and the remedy.
    """
    check_options(options)
    key = _key(source, options)
    folder = pathlib.Path(options.cache_dir) if options.cache_dir else cache_folder("objects")
    cached = folder / f"{key}-{_CACHE_VERSION}-{options.up}{store.SUFFIX}"
    if cached.is_file():
        try:
            return store.load(cached)
        except CongraspError:
            pass  # it is damaged, and replaced below
    obj = assemble(source, options, seed=int(key, 16), progress=progress)
    with contextlib.suppress(CongraspError):  # of a full disk, or of a read-only folder
        store.save(obj, cached)
    return obj


def import_sources(
    sources: Sequence[Source], options: ImportOptions
) -> Iterator[tuple[int, GraspObject | CongraspError]]:
    """Imports objects in parallel, one for each core if memory suffices.

    Each decomposition is a separate process with a deadline and a memory limit, for which daemon
    threads of this process wait.

    Yields:
      Index of each source, and its object or error, in the order in which they finish.

    Raises:
      CongraspError: an option is invalid, or no import ends for much longer than the deadlines of
        the decompositions.
    """
    check_options(options)
    todo = collections.deque(range(len(sources)))
    done: queue.SimpleQueue[tuple[int, GraspObject | Exception]] = queue.SimpleQueue()

    def work() -> None:
        """Imports until no source is left."""
        with contextlib.suppress(IndexError):
            while True:
                i = todo.popleft()
                try:
                    done.put((i, import_source(sources[i], options)))
                except Exception as error:  # raised in the caller's thread
                    done.put((i, error))

    processes_in_memory = max(1, memory() // MIN_CHILD_MEMORY_BYTES)
    for _ in range(min(len(sources), cores(), processes_in_memory)):
        threading.Thread(target=work, daemon=True).start()
    most_meshes = max((len(source.visuals) for source in sources), default=0)
    patience = MAX_WALL_CLOCK_RATIO * most_meshes * MAX_PROCESSOR_S + _PATIENCE_S
    try:
        for _ in sources:
            i, result = done.get(timeout=patience)
            if isinstance(result, Exception) and not isinstance(result, CongraspError):
                raise result
            yield i, result
    except queue.Empty:
        raise CongraspError(
            f"No import has finished for {patience:.0f} s.", "Import fewer objects at once."
        ) from None
    finally:
        todo.clear()


def _key(source: Source, options: ImportOptions) -> str:
    """24 hex digits of an import's files and options, also the seed of its surface points."""
    settings = dataclasses.replace(options, cache_dir="")
    content = hashlib.sha256(f"{_DRAWS_VERSION} {source.name} {settings}".encode())
    for file in source.files():
        description = f" {file.path.name} {file.role} {file.part} "
        content.update(description.encode(errors="surrogateescape"))
        content.update(hashlib.sha256(read_file(file.path, MAX_BYTES, CHECK)).digest())
    return content.hexdigest()[:24]
