"""Objects that a user points to: folders of object files, object files, and meshes to import."""

import logging
import pathlib
from collections.abc import Callable

from common.errors import CongraspError
from common.objects import store
from common.objects.spec import GraspObject
from services.assets.objects.meshes import ImportOptions, import_source
from services.assets.objects.sources import find_sources

_log = logging.getLogger(__name__)


def objects_of(
    path: pathlib.Path, track: Callable[[str, int | None], Callable[[int], None]] | None = None
) -> list[GraspObject]:
    """Every object of a path, which is what 'congrasp objects import' made or what it takes.

    Args:
      path: a folder of object files or one of them; or meshes, see `services.assets.objects.sources.find_sources`.
      track: (what is done, how much) -> what is told how much is done; import may take long.

    Raises:
      CongraspError: there is nothing of the kind, or it cannot be read or imported.
    """
    files = [path] if path.suffix == store.SUFFIX else sorted(path.glob(f"*{store.SUFFIX}"))
    if files:
        return [store.load(file) for file in files]
    sources = find_sources(path)
    advance = track("Importing objects", len(sources)) if track else lambda done: None
    objects = []
    for source in sources:
        obj, notes = import_source(source, ImportOptions())
        for note in notes:
            _log.warning("%s: %s", source.name, note)
        objects.append(obj)
        advance(len(objects))
    return objects


def one_object(path: pathlib.Path, options: ImportOptions) -> GraspObject:
    """The one object of a path; see `objects_of`.

    Raises:
      CongraspError: there is none or there are several, or it cannot be imported.
    """
    if path.suffix == store.SUFFIX:
        return store.load(path)
    sources = find_sources(path)
    if len(sources) > 1:
        raise CongraspError(f"{path} holds {len(sources)} objects.", "Name one of them.")
    return import_source(sources[0], options)[0]
