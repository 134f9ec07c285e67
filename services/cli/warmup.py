"""`congrasp warmup`: compiled programs ahead of time, and the caches of one machine for others."""

import contextlib
import importlib.util
import io
import json
import os
import pathlib
import tarfile
from collections.abc import Iterator
from typing import Annotated, Any

import tyro
from rich.console import Console

import congrasp.actors.physics  # noqa: F401 - registers the engines that --physics offers
from congrasp.common.errors import CongraspError
from congrasp.common.io.files import cache_folder, check_output, replacement, write_atomically
from congrasp.common.runtime.engines import PhysicsName
from congrasp.services.ops.lifetime import on_signal

_MANIFEST = "caches.json"


def warmup(
    preset: str = "human",
    hand: str | None = None,
    physics: PhysicsName = "auto",
    environments: int = 0,
    rollout_steps: int = 0,
    export: pathlib.Path | None = None,
    source: Annotated[pathlib.Path | None, tyro.conf.arg(name="import")] = None,
) -> int:
    """Compile the programs of `congrasp train` on this machine in advance: kernels, programs, the
    constraint bank.

    Makes the first update of such a training and discards it. It fills the caches in
    JAX_COMPILATION_CACHE_DIR (compiled programs; by default congrasp/jax in the user's cache
    folder), WARP_CACHE_PATH (GPU kernels; by default warp in that folder) and congrasp/banks in the
    user's cache folder (XDG_CACHE_HOME). They can be filled while a container image is built, and
    carried as one file to machines with the same kind of GPU and the same versions. Other numbers
    of environments or steps need other programs. On several GPUs, run it before `congrasp train
    --ranks`: otherwise each rank compiles.

    Args:
      preset: Named configuration that will be trained.
      hand: The hand, by its name or its file; by default the preset's.
      physics: Engine; auto takes warp on an NVIDIA GPU and native on a CPU.
      environments: Environments of an actor; 0: those of the preset.
      rollout_steps: Control steps of a rollout; 0: those of the preset.
      export: Tar file into which everything in these caches is then written.
      source: Such a file, from which the caches are filled instead. It holds programs that will run
        here: import only files that you trust.

    Examples:
      congrasp warmup --preset human
      congrasp warmup --preset full --hand my_hand --environments 4096
      congrasp warmup --preset human --export caches.tar
      congrasp warmup --import caches.tar
    """
    from congrasp.common.runtime.stages import imported
    from congrasp.services.train.command import first_update
    from congrasp.services.train.learn import until_first_update
    from congrasp.services.train.presets import get_preset

    imported()
    console = Console(highlight=False, soft_wrap=True)
    if source is not None and export is not None:
        raise CongraspError(
            "--import and --export were given together.", "Run one after the other."
        )
    if source is not None:
        console.print(f"{import_caches(source)} files of {source} are in the caches.", markup=False)
        return 0
    if export is not None:
        check_output("--export", export, is_folder=False)
        export.absolute().parent.mkdir(parents=True, exist_ok=True)
    config = get_preset(preset, hand, environments=environments, rollout_steps=rollout_steps)
    with on_signal() as stop, console.status("compiling"):
        until_first_update(config, physics, stop, lambda: console.print(first_update()))
    if export is not None and not stop.exit_code:
        export_caches(export)
    return stop.exit_code


def export_caches(path: pathlib.Path) -> None:
    """Writes everything in the caches of compiled programs, kernels and banks into a tar file.

    Raises:
      CongraspError: the file cannot be written.
    """
    with replacement(path) as file, tarfile.open(fileobj=file, mode="w") as archive:
        manifest = tarfile.TarInfo(_MANIFEST)
        text = json.dumps(_machine()).encode()
        manifest.size = len(text)
        archive.addfile(manifest, io.BytesIO(text))
        for name, folder in _folders().items():
            for member in sorted(folder.rglob("[!.]*")):
                if not member.is_file() or member.is_symlink():
                    continue
                # Another process may remove it meanwhile.
                with contextlib.suppress(FileNotFoundError):
                    inside = member.relative_to(folder)
                    archive.add(member, f"{name}/{inside}", recursive=False)


def import_caches(path: pathlib.Path) -> int:
    """Adds the files of `export_caches` to the caches of this machine, and returns their number.

    Raises:
      CongraspError: the file cannot be read, is not of this command, or was made for other versions
        or another device.
    """
    folders, members = _folders(), dict[tarfile.TarInfo, pathlib.Path]()
    with _opened(path) as archive:
        for member in archive.getmembers():
            if member.name == _MANIFEST:
                continue
            name, _, inside = member.name.partition("/")
            if name == "jax" and name not in folders:
                raise CongraspError(
                    "The cache of compiled programs cannot be written.",
                    "Set JAX_COMPILATION_CACHE_DIR.",
                )
            if name not in folders or not _is_inside(member, inside, folders[name]):
                raise CongraspError(
                    f"{path} has an entry that is no file of a cache: {member.name!a:.80}.", _REMEDY
                )
            members[member] = folders[name] / inside
        for member, target in members.items():
            if not target.exists():
                write_atomically(target, _content(archive, member))
    return len(members)


def _is_inside(member: tarfile.TarInfo, name: str, folder: pathlib.Path) -> bool:
    """True if a member is a regular file that has this name in the folder, and no link leads out of
    there.
    """
    target = folder / name
    if (
        not member.isreg()
        or member.sparse
        or ".." in target.parts
        or f"{folder}/{name}" != str(target)
    ):
        return False
    return target.resolve().is_relative_to(folder.resolve())


_REMEDY = "Pass a file that 'congrasp warmup --export' wrote."


@contextlib.contextmanager
def _opened(path: pathlib.Path) -> Iterator[tarfile.TarFile]:
    """A file of `export_caches` that is for this machine."""
    try:
        with tarfile.open(path, "r:") as archive:
            made_for = json.loads(_content(archive, archive.getmember(_MANIFEST)))
            for what, value in _machine().items():
                if made_for[what] != value:
                    raise CongraspError(
                        f"{path} was made for {what} {made_for[what]!a:.80}, but this machine has "
                        f"{value}.",
                        "Run 'congrasp warmup' here instead.",
                    )
            yield archive
    except OSError as error:
        raise CongraspError(f"{path} cannot be read: {error.strerror}.", _REMEDY) from None
    except (tarfile.TarError, ValueError, KeyError, TypeError):
        raise CongraspError(f"{path} is not a file of caches, or is damaged.", _REMEDY) from None


def _content(archive: tarfile.TarFile, member: tarfile.TarInfo) -> bytes:
    """Content of a regular file."""
    file = archive.extractfile(member) if member.isreg() else None
    if file is None:
        raise ValueError(f"{member.name} is no file")
    return file.read()


def _machine() -> dict[str, Any]:
    """Versions and device for which programs and kernels are compiled."""
    import jax

    warp = importlib.util.find_spec("warp") and importlib.import_module("warp")
    return {
        "JAX": jax.__version__,
        "Warp": warp.config.version if warp else None,
        "device": jax.local_devices()[0].device_kind,
    }


def _folders() -> dict[str, pathlib.Path]:
    """Folders of the caches by their names in a file."""
    folders = {"banks": cache_folder("banks")}
    if programs := os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        folders["jax"] = pathlib.Path(programs)
    if importlib.util.find_spec("warp"):
        warp = importlib.import_module("warp")
        warp.config.log_level = warp.LOG_WARNING
        warp.init()
        folders["warp"] = pathlib.Path(warp.config.kernel_cache_dir)
    return folders


COMMAND = warmup
