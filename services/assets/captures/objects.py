"""Meshes of a data set's objects: search and import."""

import dataclasses
import pathlib
from collections.abc import Callable, Mapping

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import file_name
from congrasp.common.objects.spec import GraspObject
from congrasp.services.assets.captures.sequence import Dropped
from congrasp.services.assets.objects.mesh_files import SUFFIXES
from congrasp.services.assets.objects.meshes import import_sources
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.assets.objects.sources import Source, find_sources


@dataclasses.dataclass(frozen=True)
class Meshes:
    """Folders searched for the meshes of objects, in this order."""

    folders: tuple[pathlib.Path, ...]

    def beside(self, *folders: pathlib.Path) -> "Meshes":
        """Returns the search folders followed by those of the data set."""
        return Meshes((*self.folders, *folders))

    def has(self, name: str) -> bool:
        """True if there is a mesh of that name."""
        return self._look(name, "") is not None

    def find(self, sequence: str, name: str, inside: str = "") -> pathlib.Path:
        """Finds the mesh file `<name>.*`, or the folder `<name>` with one.

        Args:
          sequence: name of the sequence that needs it.
          name: name of the object.
          inside: file in the folder, if it has several.

        Raises:
          Dropped: there is no such mesh.
        """
        found = self._look(name, inside)
        if found is None:
            where = f" in {', '.join(map(str, self.folders))}" if self.folders else ""
            raise Dropped(sequence, "no mesh", f"there is no mesh of '{name}'{where}: pass its folder with --meshes")
        return found

    def _look(self, name: str, inside: str) -> pathlib.Path | None:
        """Returns the first mesh of a name."""
        file_name(name, "the mesh of an object")
        for folder in self.folders:
            for suffix in SUFFIXES:
                if (file := folder / f"{name}{suffix}").is_file():
                    return file
            if inside and (folder / name / inside).is_file():
                return folder / name / inside
            if (folder / name).is_dir():
                return folder / name
        return None


def import_meshes(
    meshes: Mapping[pathlib.Path, str], progress: Callable[[str], None]
) -> dict[pathlib.Path, GraspObject | CongraspError]:
    """Imports meshes in metres, one per core at a time, with their files' axes, to which captured poses refer.

    Args:
      meshes: files or folders, with the data set's names of their objects.
      progress: called with one line of text for each finished object: its name and the count so far.

    Returns:
      The object of each mesh, or the error.
    """
    sources, found = {}, dict[pathlib.Path, GraspObject | CongraspError]()
    for mesh, name in meshes.items():
        try:
            sources[mesh] = _source(mesh, name)
        except CongraspError as error:
            found[mesh] = error
    paths = list(sources)
    made = import_sources([sources[path] for path in paths], ImportOptions(unit="m", up="z"))
    for done, (i, outcome) in enumerate(made, 1):
        found[paths[i]] = outcome
        progress(f"{meshes[paths[i]]} ({done} of {len(paths)})")
    return found


def _source(mesh: pathlib.Path, name: str) -> Source:
    """Returns the files of one object, under a data set's name.

    Raises:
      CongraspError: there are none, or they belong to several objects.
    """
    sources = find_sources(mesh)
    if len(sources) > 1:
        raise CongraspError(f"{mesh} holds {len(sources)} objects.", "Pass the folder of one, or its file.")
    return dataclasses.replace(sources[0], name=name)
