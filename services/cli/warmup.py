"""`congrasp warmup`: compiled programs ahead of time."""

import congrasp.actors.physics  # noqa: F401 - registers the engines that --physics offers
from congrasp.common.runtime.engines import PhysicsName


def warmup(
    preset: str = "human",
    hand: str | None = None,
    physics: PhysicsName = "auto",
    environments: int = 0,
    rollout_steps: int = 0,
) -> int:
    """Compile the programs of `congrasp train` on this machine in advance: kernels, programs, the constraint bank.

    Makes the first update of such a training and discards it. It fills the caches in JAX_COMPILATION_CACHE_DIR
    (compiled programs; by default congrasp/jax in the user's cache folder), WARP_CACHE_PATH (GPU kernels; by default
    warp in that folder) and congrasp/banks in the user's cache folder (XDG_CACHE_HOME). They can be filled while a
    container image is built, and copied to machines with the same kind of GPU and the same versions. Other numbers of
    environments or steps need other programs. On several GPUs, run it before `congrasp train --ranks`: otherwise each
    rank compiles.

    Args:
      preset: Named configuration that will be trained.
      hand: The hand, by its name or its file; by default the preset's.
      physics: Engine; auto takes warp on an NVIDIA GPU and native on a CPU.
      environments: Environments of an actor; 0: those of the preset.
      rollout_steps: Control steps of a rollout; 0: those of the preset.

    Examples:
      congrasp warmup --preset human
      congrasp warmup --preset full --hand my_hand --environments 4096
    """
    from rich.console import Console

    from congrasp.common.runtime.stages import imported
    from congrasp.services.ops.shutdown import on_signal
    from congrasp.services.train.command import first_update
    from congrasp.services.train.learn import until_first_update
    from congrasp.services.train.presets import get_preset

    imported()
    console = Console(highlight=False)
    config = get_preset(preset, hand, environments=environments, rollout_steps=rollout_steps)
    with on_signal() as stop, console.status("compiling"):
        until_first_update(config, physics, stop, lambda: console.print(first_update(), soft_wrap=True))
    return stop.exit_code


COMMAND = warmup
