"""`congrasp warmup`: compiled programs ahead of time, and the caches of one machine for others."""

import pathlib
from typing import Annotated

import tyro
from rich.console import Console

import congrasp.actors.physics  # noqa: F401 - registers the engines that --physics offers
from congrasp.common.errors import CongraspError
from congrasp.common.io.files import check_output
from congrasp.common.runtime.engines import PhysicsName
from congrasp.services.cli.cache_archive import export_caches, import_caches
from congrasp.services.ops.lifetime import on_signal


def warmup(
    preset: str = "human",
    hand: str | None = None,
    physics: PhysicsName = "auto",
    environments: int = 0,
    rollout_steps: int = 0,
    export: pathlib.Path | None = None,
    source: Annotated[pathlib.Path | None, tyro.conf.arg(name="import")] = None,
) -> int:
    """Prepare this machine for `congrasp train`: compile its programs and GPU kernels, and compute
    its constraint bank.

    The command computes the first update of such a training and discards it. This fills the caches
    in JAX_COMPILATION_CACHE_DIR (compiled programs; by default congrasp/jax in the user's cache
    folder), WARP_CACHE_PATH (GPU kernels; by default warp in the user's cache folder) and
    congrasp/banks in the user's cache folder (XDG_CACHE_HOME). You can fill them while a container
    image is built, or copy them as one file to machines with the same type of GPU and the same
    versions. Other numbers of environments or steps need other programs. On several GPUs, run this
    command before `congrasp train --ranks`; otherwise each rank compiles.

    Args:
      preset: Preset of the training.
      hand: Name or file of the hand; by default the hand of the preset.
      physics: Physics engine; auto takes warp on an NVIDIA GPU and native on a CPU.
      environments: Number of environments of an actor; 0 uses that of the preset.
      rollout_steps: Number of control steps of a rollout; 0 uses that of the preset.
      export: Tar file to which the content of the caches is written afterwards.
      source: File of --export from which the caches are filled instead. It contains programs that
        will run on this machine, so import only files that you trust.

    Examples:
      congrasp warmup --preset human
      congrasp warmup --preset full --hand my_hand --environments 4096
      congrasp warmup --preset human --export caches.tar
      congrasp warmup --import caches.tar
    """
    from congrasp.common.runtime.stages import record_import_stage
    from congrasp.services.train.command import first_update
    from congrasp.services.train.learn import until_first_update
    from congrasp.services.train.presets import get_preset

    record_import_stage()
    console = Console(highlight=False, soft_wrap=True)
    if source is not None and export is not None:
        raise CongraspError(
            "--import and --export were given together.", "Run one after the other."
        )
    if source is not None:
        count = import_caches(source)
        console.print(f"{count} files of {source} are in the caches.", markup=False)
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


COMMAND = warmup
