"""The caches of compiled programs, kernels and constraint banks as one tar file for other machines.

The first member, `caches.json`, holds the versions and the device for which the caches were filled.
The names of the others are CACHE/PATH, with a cache of `cache_folders`.
"""

import contextlib
import importlib.util
import io
import json
import os
import pathlib
import tarfile
from collections.abc import Iterator, Mapping
from typing import Any

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import cache_folder, replacement, write_atomically

_MANIFEST = "caches.json"
_PROGRAMS = "jax"
"""Name of the cache of compiled programs."""
_NOT_HIDDEN = "[!.]*"  # hidden files are those that another process is writing
_REMEDY = "Pass a file that 'congrasp warmup --export' wrote."


def export_caches(path: pathlib.Path) -> None:
    """Writes everything in the caches of compiled programs, kernels and banks into a tar file.

    Raises:
      CongraspError: the file cannot be written.
    """
    with replacement(path) as file, tarfile.open(fileobj=file, mode="w") as archive:
        text = json.dumps(machine_facts()).encode()
        manifest = tarfile.TarInfo(_MANIFEST)
        manifest.size = len(text)
        archive.addfile(manifest, io.BytesIO(text))
        for name, folder in cache_folders().items():
            _add_folder(archive, name, folder)


def _add_folder(archive: tarfile.TarFile, name: str, folder: pathlib.Path) -> None:
    """Adds the regular files of a cache to an archive."""
    for file in sorted(folder.rglob(_NOT_HIDDEN)):
        if not file.is_file() or file.is_symlink():
            continue
        # Another process may remove it meanwhile
        with contextlib.suppress(FileNotFoundError):
            archive.add(file, f"{name}/{file.relative_to(folder).as_posix()}", recursive=False)


def import_caches(path: pathlib.Path) -> int:
    """Adds the files of `export_caches` to the caches of this machine, and returns their number.

    Files that are already in the caches stay as they are.

    Raises:
      CongraspError: the file cannot be read, is not of this command, or was made for other versions
        or another device.
    """
    folders = cache_folders()
    targets: dict[tarfile.TarInfo, pathlib.Path] = {}
    with _opened(path) as archive:
        # All names are checked before the first file is written
        for member in archive.getmembers():
            if member.name != _MANIFEST:
                targets[member] = _target(member, folders, path)
        for member, target in targets.items():
            if not target.exists():
                write_atomically(target, _content(archive, member))
    return len(targets)


def _target(
    member: tarfile.TarInfo, folders: Mapping[str, pathlib.Path], archive_path: pathlib.Path
) -> pathlib.Path:
    """Returns the file of a cache into which a member is written.

    Raises:
      CongraspError: the member is not a file of a cache, or the cache cannot be written.
    """
    name, _, inside = member.name.partition("/")
    if name == _PROGRAMS and name not in folders:
        raise CongraspError(
            "The cache of compiled programs cannot be written.", "Set JAX_COMPILATION_CACHE_DIR."
        )
    if name not in folders or not _is_inside(member, inside, folders[name]):
        raise CongraspError(
            f"{archive_path} has an entry that is no file of a cache: {member.name!a:.80}.",
            _REMEDY,
        )
    return folders[name] / inside


def _is_inside(member: tarfile.TarInfo, name: str, folder: pathlib.Path) -> bool:
    """Returns True if a member is a regular file of this name in the folder, and no link leads out
    of there.
    """
    if not member.isreg() or member.sparse:
        return False
    target = folder / name
    is_normalized = ".." not in target.parts and f"{folder}/{name}" == str(target)
    return is_normalized and target.resolve().is_relative_to(folder.resolve())


@contextlib.contextmanager
def _opened(path: pathlib.Path) -> Iterator[tarfile.TarFile]:
    """Opens a file of `export_caches`, and checks that it is for this machine."""
    try:
        with tarfile.open(path, "r:") as archive:
            manifest = json.loads(_content(archive, archive.getmember(_MANIFEST)))
            _check_machine(manifest, path)
            yield archive
    except OSError as error:
        raise CongraspError(f"{path} cannot be read: {error.strerror}.", _REMEDY) from None
    except (tarfile.TarError, ValueError, KeyError, TypeError):
        raise CongraspError(f"{path} is not a file of caches, or is damaged.", _REMEDY) from None


def _check_machine(manifest: Mapping[str, Any], path: pathlib.Path) -> None:
    """Raises a CongraspError for caches of other versions or another device."""
    for name, value in machine_facts().items():
        if manifest[name] != value:
            raise CongraspError(
                f"{path} was made for {name} {manifest[name]!a:.80}, but this machine has {value}.",
                "Run 'congrasp warmup' here instead.",
            )


def _content(archive: tarfile.TarFile, member: tarfile.TarInfo) -> bytes:
    """Returns the content of a regular file; raises a ValueError for another member."""
    file = archive.extractfile(member) if member.isreg() else None
    if file is None:
        raise ValueError(f"{member.name} is not a file")
    return file.read()


def machine_facts() -> dict[str, Any]:
    """Versions and device for which programs and kernels are compiled."""
    import jax

    warp_version = None
    if importlib.util.find_spec("warp"):
        warp_version = importlib.import_module("warp").config.version
    return {
        "JAX": jax.__version__,
        "Warp": warp_version,
        "device": jax.local_devices()[0].device_kind,
    }


def cache_folders() -> dict[str, pathlib.Path]:
    """Folders of this machine's caches by their names in a file."""
    folders = {"banks": cache_folder("banks")}
    programs = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if programs:
        folders[_PROGRAMS] = pathlib.Path(programs)
    if importlib.util.find_spec("warp"):
        warp = importlib.import_module("warp")
        warp.config.log_level = warp.LOG_WARNING
        warp.init()
        folders["warp"] = pathlib.Path(warp.config.kernel_cache_dir)
    return folders
