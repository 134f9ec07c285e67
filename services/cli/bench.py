"""Benchmarks of this machine, as ratios against a reference in the same run."""

import dataclasses
import pathlib

from congrasp.actors.physics import PhysicsName
from congrasp.common.runtime.resources import cores
from congrasp.services.train.presets import get_preset


def physics(
    environments: int = 64, threads: int = 0, repeats: int = 5, engines: tuple[str, ...] = ()
) -> int:
    """Measure the control steps per second of actors and of the bare engine, for each engine of the
    machine.

    The bare `native` engine repeats the actor's states with nothing but `mj_step`.

    Args:
      environments: Number of parallel environments.
      threads: Threads of the native engine; 0 uses all cores.
      repeats: Measurements of each, alternating; medians and their ratio are printed, and the ratio
        of the best.
      engines: Engines to measure; by default those that suit the machine.

    Examples:
      congrasp bench physics
      congrasp bench physics --engines native warp --environments 1024
    """
    from congrasp.services.bench.physics import bench_physics, default_engines

    bench_physics(environments, threads or cores(), repeats, engines or default_engines())
    return 0


def query(repeat: int = 1000, concurrency: int = 1, states: int = 1) -> int:
    """Measure the latency of a policy server in a separate process, with an untrained policy, over
    loopback.

    The clients also use the machine; the server's processor time per answer is printed as well.

    Args:
      repeat: Total number of queries.
      concurrency: Number of concurrent clients.
      states: States in one query, up to 64; each gets an answer.

    Examples:
      congrasp bench query
      congrasp bench query --repeat 5000 --concurrency 4
    """
    from congrasp.services.bench.query import bench_query
    from congrasp.services.serve.load import Load

    bench_query(Load(repeat, concurrency, states))
    return 0


@dataclasses.dataclass(frozen=True)
class Scaling:
    """Measure trained steps per second of several learner ranks relative to one: weak scaling, a
    batch per rank.

    Starts real processes for each number of ranks in turn; starting, compiling and the first
    updates are not measured. On GPUs every rank needs a separate one.

    Examples:
      congrasp bench scaling --ranks 1 2 4 8
      congrasp bench scaling --preset quickstart --physics native --seconds 30
    """

    ranks: tuple[int, ...] = (1, 2)
    """Numbers of ranks, for example 1 2 4; efficiency is against the first."""
    seconds: float = 90.0
    """Seconds of measurement, for each number of ranks."""
    preset: str = "human"
    """Named configuration of the run."""
    environments: int = 0
    """Environments in one actor; 0: those of the preset."""
    physics: PhysicsName = "auto"
    """Engine; auto takes warp on an NVIDIA GPU and native on a CPU."""
    actors: int | None = None
    """Actor processes of each rank; by default none on GPUs, where each rank runs one in its
    process, otherwise one."""
    deadline: float = 600.0
    """Deadline of one number of ranks, s."""
    out: pathlib.Path = pathlib.Path("scaling.json")
    """File for the results as JSON."""

    def __call__(self) -> int:
        """Measures, prints and writes the results."""
        from congrasp.services.bench.scaling import bench_scaling

        preset = get_preset(self.preset, environments=self.environments)
        bench_scaling(
            dataclasses.replace(preset, physics=self.physics),
            self.ranks,
            seconds=self.seconds,
            actors=self.actors,
            deadline=self.deadline,
            out=self.out,
        )
        return 0


def startup(
    preset: str = "human",
    environments: int = 0,
    objects: int = 0,
    physics: PhysicsName = "auto",
    deadline: float = 600.0,
) -> int:
    """Measure the seconds from the start of a training to its first update, by stage, with empty
    and with full caches.

    Learner and actor run in one process, as on a GPU. Warp's kernel cache is used unchanged. The
    machine's other caches are neither used nor changed.

    Args:
      preset: Named configuration of the run.
      environments: Environments; 0: those of the preset.
      objects: Objects in the pool; 0: those of the preset.
      physics: Engine; auto takes warp on an NVIDIA GPU and native on a CPU.
      deadline: Deadline of one start, s.

    Examples:
      congrasp bench startup
      congrasp bench startup --preset human --environments 1024
    """
    from congrasp.services.bench.startup import bench_startup

    config = get_preset(preset, environments=environments)
    pool = dataclasses.replace(config.objects, count=objects or config.objects.count)
    bench_startup(dataclasses.replace(config, objects=pool), physics, deadline)
    return 0


COMMANDS = {"physics": physics, "query": query, "scaling": Scaling, "startup": startup}
