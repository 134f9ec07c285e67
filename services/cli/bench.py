"""Benchmarks of this machine, as ratios against a reference in the same run."""

import pathlib

from congrasp.actors.physics import PhysicsName


def physics(environments: int = 64, threads: int = 0, repeats: int = 5, engines: tuple[str, ...] = ()) -> int:
    """Actors' control steps a second beside the bare engine's, for each engine that the machine has.

    The bare `native` engine goes through the states that the actor has just gone through, with nothing but `mj_step`.

    Args:
      environments: Environments that run side by side.
      threads: Threads of the native engine; 0 takes all cores.
      repeats: Measurements of each, alternating; medians and their ratio are printed, and the ratio of the best.
      engines: Engines to measure; those that the machine is made for if none is named.

    Examples:
      congrasp bench physics
      congrasp bench physics --engines native warp --environments 1024
    """
    from congrasp.common.runtime.parallel import cores
    from congrasp.services.bench import physics as bench

    bench.bench_physics(environments, threads or cores(), repeats, list(engines) or bench.engines())  # type: ignore[arg-type]
    return 0


def query(repeat: int = 1000, concurrency: int = 1, states: int = 1) -> int:
    """Latency of a policy server in a process of its own that serves an untrained policy, over the loopback interface.

    The clients take their share of the machine; the server's own processor time for an answer is printed beside.

    Args:
      repeat: Queries in all.
      concurrency: Clients at the same time.
      states: States in one query, up to 64; each gets an answer.

    Examples:
      congrasp bench query
      congrasp bench query --repeat 5000 --concurrency 4
    """
    from congrasp.services.bench.query import bench_query

    bench_query(repeat, concurrency, states)
    return 0


def scaling(
    ranks: tuple[int, ...] = (1, 2),
    seconds: float = 90.0,
    preset: str = "human",
    environments: int = 0,
    physics: PhysicsName = "auto",
    actors: int | None = None,
    deadline: float = 600.0,
    out: pathlib.Path = pathlib.Path("scaling.json"),
) -> int:
    """Trained steps a second of several learner ranks beside one: weak scaling, every rank with a batch of its own.

    Starts real processes for each number of ranks in turn; starting, compiling and the first updates are not measured.
    On GPUs every rank needs one of its own.

    Args:
      ranks: Numbers of ranks, for example 1 2 4; efficiency is against the first.
      seconds: Seconds of measurement, for each number of ranks.
      preset: Named configuration of the run.
      environments: Environments in one actor; 0: those of the preset.
      physics: Engine; auto takes warp on an NVIDIA GPU and native on a CPU.
      actors: Actor processes of each rank; by default none on GPUs, where one lives inside each rank, otherwise one.
      deadline: Seconds that one number of ranks may take in all.
      out: File for the results as JSON.

    Examples:
      congrasp bench scaling --ranks 1 2 4 8
      congrasp bench scaling --preset quickstart --physics native --seconds 30
    """
    import dataclasses

    from congrasp.services.bench.scaling import bench_scaling
    from congrasp.services.train.presets import get_preset

    config = get_preset(preset)
    config = dataclasses.replace(config, physics=physics, environments=environments or config.environments)
    bench_scaling(config, ranks, seconds=seconds, actors=actors, deadline=deadline, out=out)
    return 0


def startup(
    preset: str = "human",
    environments: int = 0,
    objects: int = 0,
    physics: PhysicsName = "auto",
    deadline: float = 600.0,
) -> int:
    """Seconds from the start of a training to its first update, stage by stage: with empty caches, and again with them.

    Learner and actor live in one process, as on a GPU. Warp's kernels have a cache of their own, which is used as it
    is. The machine's caches are neither used nor changed.

    Args:
      preset: Named configuration of the run.
      environments: Environments; 0: those of the preset.
      objects: Objects in the pool; 0: those of the preset.
      physics: Engine; auto takes warp on an NVIDIA GPU and native on a CPU.
      deadline: Seconds that one start may take.

    Examples:
      congrasp bench startup
      congrasp bench startup --preset human --environments 1024
    """
    import dataclasses

    from congrasp.services.bench.startup import bench_startup
    from congrasp.services.train.presets import get_preset

    config = get_preset(preset)
    pool = dataclasses.replace(config.objects, count=objects or config.objects.count)
    config = dataclasses.replace(config, environments=environments or config.environments, objects=pool)
    bench_startup(config, physics, deadline)
    return 0


COMMANDS = {
    "physics": physics,
    "query": query,
    "scaling": scaling,
    "startup": startup,
}
