"""Benchmarks, as ratios against a reference in the same run, and how a run ends on a signal."""

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


def pieces(
    objects: pathlib.Path,
    hand: str = "human",
    counts: tuple[int, ...] = (8, 16, 32, 48),
    vertices: tuple[int, ...] = (32, 64),
    repeats: int = 5,
) -> int:
    """What convex pieces and their vertices cost a physics step (MuJoCo C), and what they gain in shape.

    Args:
      objects: Folder of objects or meshes; their pieces are joined to fewer for each budget.
      hand: The hand that closes around them.
      counts: Most pieces of an object; rates are compared with the first.
      vertices: Most vertices of a piece.
      repeats: Measurements of each; medians are printed.

    Examples:
      congrasp bench pieces --objects my-objects
      congrasp bench pieces --objects my-objects --counts 8 32 --vertices 32
    """
    from congrasp.services.assets.objects.named import objects_of
    from congrasp.services.bench.pieces import bench_pieces

    bench_pieces(objects_of(objects), hand, counts, vertices, repeats)
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


def shutdown(repeats: int = 100, within: float = 45.0, seed: int = 0) -> int:
    """Whether a run with a learner and two actors ends within 5 s of a signal, and leaves no process behind.

    Starts one again and again, and sends SIGINT and SIGTERM in turn at random times, also while it starts. The exit
    code is 1 if any took longer or left something.

    Args:
      repeats: How often.
      within: Seconds in which the times lie; after some 30 it trains.
      seed: Seed of the times.

    Examples:
      congrasp bench shutdown
      congrasp bench shutdown --repeats 10
    """
    from congrasp.services.bench.shutdown import bench_shutdown

    return 0 if bench_shutdown(repeats, within, seed) else 1


def security(repeats: int = 5, seconds: float = 5.0, turns: int = 3, attacks: tuple[str, ...] = ()) -> int:
    """What mutual TLS with access control costs beside plain TCP, and what hostile and slow peers cost honest ones.

    Over the loopback interface. The flood is 1 MB of rubbish at a time, as fast as it is answered. The attacks are in
    services/bench/attackers.py; each is measured beside the same honest work alone, and beside processes that take as
    much processor time and do nothing else.

    Args:
      repeats: Measurements of each cost, alternating; medians are printed. 0 for none.
      seconds: Length of each measurement beside an attack; 0 for none.
      turns: Measurements beside each attack, alternating; medians are printed.
      attacks: On a policy server: unread, silent, huge. On a learner: greedy, greedy-3, silent-learner, slow, slow-3.
        All of them if none is named.

    Examples:
      congrasp bench security
      congrasp bench security --seconds 2 --repeats 3
    """
    from congrasp.services.bench.attacks import bench_attacks
    from congrasp.services.bench.security import bench_security

    if repeats:
        bench_security(repeats)
    if seconds:
        bench_attacks(seconds, turns, attacks)
    return 0


def transport(senders: int = 1, seconds: float = 5.0, repeats: int = 3, actors: int = 4, versions: int = 100) -> int:
    """Rollouts of 8 MB into one learner, beside bare Zenoh and bare PUSH/PULL (pyzmq); 4 MB of weights to its actors.

    Args:
      senders: Actor processes that send rollouts.
      seconds: Length of one measurement.
      repeats: Measurements of each kind of ingest, alternating; medians are printed.
      actors: Actor processes that wait for weights.
      versions: Publications of weights, four a second.

    Examples:
      congrasp bench transport
      congrasp bench transport --senders 4
    """
    from congrasp.services.bench.transport import bench_transport

    bench_transport(senders, seconds, repeats, actors, versions)
    return 0


def staleness(lag: int = 4, seeds: int = 5, updates: int = 40, worlds: int = 32) -> int:
    """Return of the decoupled objective and of plain PPO on old rollouts, beside on-policy training, on a small task.

    Args:
      lag: Versions by which every rollout is behind.
      seeds: Trainings of each kind.
      updates: Updates of each training.
      worlds: Episodes in one update.

    Examples:
      congrasp bench staleness
      congrasp bench staleness --lag 8 --seeds 3
    """
    from congrasp.services.bench.staleness import bench_staleness

    bench_staleness(lag, seeds, updates, worlds)
    return 0


def faults(actors: int = 2, repeats: int = 20, kinds: tuple[str, ...] = (), seed: int = 0) -> int:
    """What kills, stops, freezes, full disks and damaged files cost a real run of what it had acknowledged: nothing.

    Every kind of fault has a run of its own, whose journals are read twice, by code that has nothing in common. The
    exit code is 1 if anything was lost, duplicated, unmatched or corrupted.

    Args:
      actors: Actor processes.
      repeats: Faults of each kind.
      kinds: Kinds of faults: sigterm, ctrl-c, kill-learner, kill-actor, kill-all, freeze-learner, freeze-actor,
        full-disk (which needs the right to mount), damage-checkpoint, damage-accepted (rollouts), damage-journal,
        damage-policy. All of them if none is named.
      seed: Seed of the moments, and of the bits that are flipped.

    Examples:
      congrasp bench faults
      congrasp bench faults --repeats 5
    """
    from congrasp.services.bench.faults import bench_faults

    return 0 if bench_faults(actors, repeats, kinds, seed) else 1


def recovery(actors: int = 3, repeats: int = 3) -> int:
    """Seconds until a run notices and gets over killed and stopped actors and a killed learner, and its audit.

    Args:
      actors: Actor processes.
      repeats: How often each is killed.

    Examples:
      congrasp bench recovery
      congrasp bench recovery --actors 4
    """
    from congrasp.services.bench.recovery import bench_recovery

    bench_recovery(actors, repeats)
    return 0


def recording(actors: int = 2, seconds: float = 20.0, turns: int = 3) -> int:
    """Throughput of a small run with and without a recorder, in turns, and what of its time goes into transport.

    Args:
      actors: Actor processes.
      seconds: Length of a turn.
      turns: Turns of each kind.

    Examples:
      congrasp bench recording
      congrasp bench recording --actors 1 --turns 5
    """
    from congrasp.services.bench.recording import bench_recording

    bench_recording(actors, seconds, turns)
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


def measures(engine: PhysicsName = "auto", environments: int = 64, threads: int = 0, repeats: int = 5) -> int:
    """Seconds of an evaluation's episodes with measures of plausibility beside the same without them.

    The pretrained human policy grasps held-out procedural objects. Lifts and pushes after the hold are not part of it.

    Args:
      engine: Engine; auto takes warp on an NVIDIA GPU and native on a CPU.
      environments: Episodes that run side by side.
      threads: Threads of the native engine; 0 takes all cores.
      repeats: Measurements of each, alternating; medians and their ratio are printed.

    Examples:
      congrasp bench measures
      congrasp bench measures --environments 256
    """
    from congrasp.common.runtime.parallel import cores
    from congrasp.services.bench.measures import bench_measures

    bench_measures(engine, environments, threads or cores(), repeats)
    return 0


COMMANDS = {
    "physics": physics,
    "pieces": pieces,
    "measures": measures,
    "query": query,
    "shutdown": shutdown,
    "security": security,
    "transport": transport,
    "staleness": staleness,
    "faults": faults,
    "recovery": recovery,
    "recording": recording,
    "scaling": scaling,
    "startup": startup,
}
