"""Draws the pictures of the pages again: `make pictures`, or `python -m tests.pictures`."""

import os
import pathlib
import shlex
import shutil
import string
import subprocess
import sys
from typing import Annotated

import tyro

from tests.benchmarks.gallery import gallery
from tests.pictures import provenance
from tests.pictures.table import IMAGES, Picture


def draw(
    names: Annotated[tuple[str, ...], tyro.conf.Positional] = (),
    scans: pathlib.Path | None = None,
    captures: pathlib.Path | None = None,
    hands: pathlib.Path | None = None,
    run: pathlib.Path | None = None,
    work: pathlib.Path = pathlib.Path("runs/pictures"),
    attempts: int = 16,
) -> int:
    """Draws pictures again, and writes the file next to each.

    A picture whose inputs are not named stays, and is listed at the end.

    Args:
      names: Files of docs/images, or 'gallery'; by default all.
      scans: MyoSuite's folder `simhive/object_sim`.
      captures: Folder with MyoSuite's captured sequences.
      hands: Folder with the packages of hands of others (docs/hands-of-others.md).
      run: Folder of a finished training.
      work: Folder for the results of the commands.
      attempts: Attempts of each grasp of the gallery.
    """
    inputs = {"scans": scans, "captures": captures, "hands": hands, "run": run}
    places = {name: str(path.resolve()) for name, path in inputs.items() if path is not None}
    places["root"] = str(provenance.ROOT)
    places["gallery"] = str((work / "gallery").resolve())
    failures: list[str] = []
    if not names or "gallery" in names:
        if scans is None:
            failures.append("gallery: it needs --scans")
        else:
            gallery(scans, work / "gallery", attempts=attempts)
    folders: dict[str, pathlib.Path] = {}
    for picture in IMAGES:
        if names and picture.name not in names:
            continue
        is_drawn = picture.command in folders  # by the command of an earlier picture
        folder = folders.setdefault(picture.command, work / picture.name.partition(".")[0])
        problem = _draw(picture, places, folder, is_drawn=is_drawn)
        if problem:
            failures.append(f"{picture.name}: {problem}")
        else:
            print(f"{picture.name} is drawn.", flush=True)
    for failure in failures:
        print(failure, file=sys.stderr)
    return min(len(failures), 1)


def _draw(picture: Picture, places: dict[str, str], folder: pathlib.Path, *, is_drawn: bool) -> str:
    """Draws one picture; returns the reason if it stays, otherwise an empty text.

    Args:
      picture: the picture.
      places: paths of the inputs, by their names.
      folder: working folder of the command.
      is_drawn: True if the command has already run in the folder.
    """
    target = provenance.ROOT / "docs" / "images" / picture.name
    if picture.redrawn:
        missing = _needs(picture) - places.keys()
        if missing:
            return f"it needs --{', --'.join(sorted(missing))}"
        if not is_drawn:
            try:
                _run(picture.command, places, folder)
            except subprocess.CalledProcessError as error:
                return f"'{shlex.join(error.cmd)}' failed with {error.returncode}"
        if not (folder / picture.output).is_file():
            return f"its command wrote no {picture.output}"
        shutil.copyfile(folder / picture.output, target)
    origin = provenance.current(picture.command, picture.policies, rendered=picture.rendered)
    provenance.write(target, origin)
    return ""


def _needs(picture: Picture) -> set[str]:
    """Names of the inputs of a picture's command."""
    needs = {name for _, name, _, _ in string.Formatter().parse(picture.command) if name}
    if "object_sim/" in picture.command:
        needs.add("scans")
    return needs


def _run(commands: str, places: dict[str, str], folder: pathlib.Path) -> None:
    """Runs command lines one after the other in a folder.

    Raises:
      CalledProcessError: a command found no grasp that holds, or failed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _link(folder / "examples", str(provenance.ROOT / "examples"))
    if "scans" in places:
        _link(folder / "object_sim", places["scans"])
    paths = [str(provenance.ROOT), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    for command in commands.format(**places).split("; "):
        words = shlex.split(command)
        words = [sys.executable, *words[1:]] if words[0] == "python" else words
        subprocess.run(words, cwd=folder, env=environment, check=True)


def _link(link: pathlib.Path, target: str) -> None:
    """Makes a folder known under the name that the commands use."""
    link.unlink(missing_ok=True)
    link.symlink_to(target, target_is_directory=True)


if __name__ == "__main__":
    sys.exit(tyro.cli(draw))
