"""Provenance of a picture: a JSON file next to it, and its faults."""

import dataclasses
import json
import pathlib
from collections.abc import Iterator, Mapping

from congrasp.common.io.files import write_atomically
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import pretrained_file
from congrasp.services.viz.version import RENDERER_VERSION

ROOT = pathlib.Path(__file__).resolve().parents[2]
FOLDERS = ("docs/images", "docs/gallery")
"""Folders whose pictures have a provenance."""
SUFFIXES = (".png", ".jpg", ".gif", ".mp4")
_ENDING = ".json"


@dataclasses.dataclass(frozen=True)
class Provenance:
    """Origin of a picture."""

    command: str
    """Command line that draws it."""
    policies: Mapping[str, str]
    """`actor_sha256` of the policies that it shows, by the names of their files."""
    renderer: int | None
    """Version of the renderer; None for a picture that the renderer does not draw."""


def sidecar(picture: pathlib.Path) -> pathlib.Path:
    """The file next to a picture."""
    return picture.with_name(picture.name + _ENDING)


def picture_of(file: pathlib.Path) -> pathlib.Path:
    """The picture of a file next to it."""
    return file.with_name(file.name.removesuffix(_ENDING))


def current(command: str, policies: tuple[str, ...], *, rendered: bool) -> Provenance:
    """Provenance of a picture that is drawn now.

    Args:
      command: its command line.
      policies: names of the shipped policies that it shows.
      rendered: True if the renderer draws it.
    """
    renderer = RENDERER_VERSION if rendered else None
    return Provenance(command, {name: actor_sha256(name) for name in policies}, renderer)


def actor_sha256(policy: str) -> str:
    """SHA-256 of the actor of a shipped policy, such as `human` or `allegro-student`."""
    hand = policy.partition("-")[0]
    file = pretrained_file(hand).with_name(f"{policy}.safetensors")
    return bundles.load(file).actor_sha256


def write(picture: pathlib.Path, provenance: Provenance) -> None:
    """Writes the file next to a picture."""
    text = json.dumps(dataclasses.asdict(provenance), indent=2) + "\n"
    write_atomically(sidecar(picture), text.encode())


def read(picture: pathlib.Path) -> Provenance:
    """Reads the file next to a picture."""
    return Provenance(**json.loads(sidecar(picture).read_text()))


def pictures(root: pathlib.Path = ROOT) -> list[pathlib.Path]:
    """The pictures of the folders."""
    files = []
    for folder in FOLDERS:
        files += [file for file in (root / folder).iterdir() if file.suffix in SUFFIXES]
    return sorted(files)


def orphans(root: pathlib.Path = ROOT) -> list[pathlib.Path]:
    """Files whose picture is absent."""
    files = []
    for folder in FOLDERS:
        files += (root / folder).glob(f"*{_ENDING}")
    return sorted(file for file in files if not picture_of(file).is_file())


def faults(picture: pathlib.Path, expected: Provenance) -> Iterator[str]:
    """Yields the deviations of a picture from its entry in the table, the policies and renderer.

    Args:
      picture: the picture.
      expected: provenance of the same picture if it were drawn now.
    """
    if not sidecar(picture).is_file():
        yield f"{sidecar(picture).name} is absent"
        return
    actual = read(picture)
    if actual.command != expected.command:
        yield f"its command is '{actual.command}', not '{expected.command}'"
    if actual.policies != expected.policies:
        yield f"its policies are {actual.policies}, not {expected.policies}"
    if actual.renderer != expected.renderer:
        yield f"its renderer is version {actual.renderer}, not {expected.renderer}"
