"""Meshes of a data set's objects: where they are, and the objects that congrasp makes of them."""

import dataclasses
import pathlib

from common.errors import CongraspError
from common.inputs import file_name
from common.objects.spec import GraspObject
from services.assets.captures.sequence import Dropped
from services.assets.objects.meshes import import_source
from services.assets.objects.options import ImportOptions
from services.assets.objects.sources import SUFFIXES, find_sources


@dataclasses.dataclass(frozen=True)
class Meshes:
    """Folders in which the meshes of objects are looked for, in this order."""

    folders: tuple[pathlib.Path, ...]

    def beside(self, *folders: pathlib.Path) -> "Meshes":
        """These, and then the data set's own folders."""
        return Meshes((*self.folders, *folders))

    def has(self, name: str) -> bool:
        """Whether there is a mesh of that name."""
        return self._look(name, "") is not None

    def find(self, sequence: str, name: str, inside: str = "") -> pathlib.Path:
        """The mesh file `<name>.*`, or the folder `<name>` with one.

        Args:
          sequence: that needs it.
          name: of the object.
          inside: the file in the folder, where that has several.

        Raises:
          Dropped: there is none.
        """
        found = self._look(name, inside)
        if found is None:
            where = f" in {', '.join(map(str, self.folders))}" if self.folders else ""
            raise Dropped(sequence, "no mesh", f"there is no mesh of '{name}'{where}: name its folder with --meshes")
        return found

    def _look(self, name: str, inside: str) -> pathlib.Path | None:
        """The first mesh of a name."""
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


def load_object(mesh: pathlib.Path, name: str) -> GraspObject:
    """The object of a mesh in metres, under a data set's name; imports are remembered.

    Raises:
      CongraspError: the mesh cannot be used, or is a folder of several objects.
    """
    sources = find_sources(mesh)
    if len(sources) > 1:
        raise CongraspError(f"{mesh} holds {len(sources)} objects.", "Name the folder of one, or its file.")
    return import_source(dataclasses.replace(sources[0], name=name), ImportOptions(unit="m"))
