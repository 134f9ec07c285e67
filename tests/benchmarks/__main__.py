"""Benchmarks that inject faults, attack or compare with peers: `python -m tests.benchmarks NAME` in the repository."""

import pathlib
import sys

from congrasp.common.errors import CongraspError
from congrasp.common.runtime.engines import PhysicsName
from congrasp.services.cli.parser import of_group


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
      python -m tests.benchmarks pieces --objects my-objects
      python -m tests.benchmarks pieces --objects my-objects --counts 8 32 --vertices 32
    """
    from congrasp.services.assets.objects.named import objects_of
    from tests.benchmarks.pieces import bench_pieces

    bench_pieces(objects_of(objects), hand, counts, vertices, repeats)
    return 0


def gallery(
    scans: pathlib.Path,
    work: pathlib.Path = pathlib.Path("runs/gallery"),
    out: pathlib.Path = pathlib.Path("docs/gallery"),
    attempts: int = 16,
) -> int:
    """Grasps of 24 objects as a page with pictures and short films.

    Args:
      scans: Folder of the scanned objects; the others come with the repository.
      work: Folder for the grasps; those that are finished in it are drawn again, not made again.
      out: Folder for page and pictures.
      attempts: Grasps that are simulated side by side, for each object.

    Examples:
      python -m tests.benchmarks gallery --scans my-objects
      python -m tests.benchmarks gallery --scans my-objects --out pictures
    """
    from tests.benchmarks.gallery import make_gallery

    results = []
    for result in make_gallery(scans, work, out, attempts):
        print(f"{result.name}: {result.line()}", flush=True)
        results.append(result)
    return 0 if all(result.held for result in results) else 1


def speeds(
    grasps: pathlib.Path = pathlib.Path("runs/gallery"),
    out: pathlib.Path = pathlib.Path("docs/notes/speeds.png"),
    count: int = 12,
) -> int:
    """Wrist speed of the gallery's grasps over time, with the range of human reaches, as one sheet.

    Args:
      grasps: Folder of the gallery's grasps.
      out: The picture.
      count: Number of grasps, by the order of their names.

    Examples:
      python -m tests.benchmarks speeds
      python -m tests.benchmarks speeds --grasps runs/gallery --out speeds.svg
    """
    from tests.benchmarks.speeds import bench_speeds

    bench_speeds(grasps, out, count)
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
      python -m tests.benchmarks measures
      python -m tests.benchmarks measures --environments 256
    """
    from congrasp.common.runtime.parallel import cores
    from tests.benchmarks.measures import bench_measures

    bench_measures(engine, environments, threads or cores(), repeats)
    return 0


def robot(seconds: float = 600.0, kill_every: float = 30.0, out: pathlib.Path = pathlib.Path("runs/robot")) -> int:
    """The ROS 2 node over Zenoh against a simulated hand that lifts an object, while the policy server is killed.

    Args:
      seconds: How long.
      kill_every: Seconds from one kill to the next.
      out: Folder for the node's output.

    Examples:
      python -m tests.benchmarks robot
      python -m tests.benchmarks robot --seconds 60 --kill-every 20
    """
    from tests.benchmarks.robot import bench_robot

    out.mkdir(parents=True, exist_ok=True)
    return int(not bench_robot(seconds, kill_every, out))


def sensors(policies: tuple[str, ...] = ("allegro", "allegro-student"), episodes: int = 24) -> int:
    """Grasps with all measurements, without contact forces, and without velocities either, in simulated time.

    Args:
      policies: Policy files, or names of pretrained policies.
      episodes: Number of procedural objects, one episode each.

    Examples:
      python -m tests.benchmarks sensors
      python -m tests.benchmarks sensors --policies allegro-student --episodes 4
    """
    from tests.benchmarks.sensors import bench_sensors

    bench_sensors(policies, episodes)
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
      python -m tests.benchmarks shutdown
      python -m tests.benchmarks shutdown --repeats 10
    """
    from tests.benchmarks.shutdown import bench_shutdown

    return 0 if bench_shutdown(repeats, within, seed) else 1


def security(repeats: int = 5, seconds: float = 5.0, turns: int = 3, attacks: tuple[str, ...] = ()) -> int:
    """What mutual TLS with access control costs beside plain TCP, and what hostile and slow peers cost honest ones.

    Over the loopback interface. The flood is 1 MB of rubbish at a time, as fast as it is answered. The attacks are in
    tests/benchmarks/attackers.py; each is measured beside the same honest work alone, and beside processes that take as
    much processor time and do nothing else.

    Args:
      repeats: Measurements of each cost, alternating; medians are printed. 0 for none.
      seconds: Length of each measurement beside an attack; 0 for none.
      turns: Measurements beside each attack, alternating; medians are printed.
      attacks: On a policy server: unread, silent, huge. On a learner: greedy, greedy-3, silent-learner, slow, slow-3.
        All of them if none is named.

    Examples:
      python -m tests.benchmarks security
      python -m tests.benchmarks security --seconds 2 --repeats 3
    """
    from tests.benchmarks.attacks import bench_attacks
    from tests.benchmarks.security import bench_security

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
      python -m tests.benchmarks transport
      python -m tests.benchmarks transport --senders 4
    """
    from tests.benchmarks.transport import bench_transport

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
      python -m tests.benchmarks staleness
      python -m tests.benchmarks staleness --lag 8 --seeds 3
    """
    from tests.benchmarks.staleness import bench_staleness

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
      python -m tests.benchmarks faults
      python -m tests.benchmarks faults --repeats 5
    """
    from tests.benchmarks.faults import bench_faults

    return 0 if bench_faults(actors, repeats, kinds, seed) else 1


def recovery(actors: int = 3, repeats: int = 3) -> int:
    """Seconds until a run notices and gets over killed and stopped actors and a killed learner, and its audit.

    Args:
      actors: Actor processes.
      repeats: How often each is killed.

    Examples:
      python -m tests.benchmarks recovery
      python -m tests.benchmarks recovery --actors 4
    """
    from tests.benchmarks.recovery import bench_recovery

    bench_recovery(actors, repeats)
    return 0


def recording(actors: int = 2, seconds: float = 20.0, turns: int = 3) -> int:
    """Throughput of a small run with and without a recorder, in turns, and what of its time goes into transport.

    Args:
      actors: Actor processes.
      seconds: Length of a turn.
      turns: Turns of each kind.

    Examples:
      python -m tests.benchmarks recording
      python -m tests.benchmarks recording --actors 1 --turns 5
    """
    from tests.benchmarks.recording import bench_recording

    bench_recording(actors, seconds, turns)
    return 0


def arms(
    objects: pathlib.Path,
    robots: pathlib.Path,
    arms: tuple[str, ...] = ("panda", "ur5e", "iiwa", "xarm7"),
    hand: str = "allegro",
    attempts: int = 16,
    out: pathlib.Path | None = None,
) -> int:
    """Grasps of objects on several arms: how many get a motion, and what forbids the rest.

    Every arm chooses among the same attempts of the policy.

    Args:
      objects: Folder of objects.
      robots: Folder with NAME/robot.xml, such as models/assets/robots of robosuite.
      arms: Names in it.
      hand: The hand that they carry.
      attempts: Of the policy, for each object.
      out: JSON file of errors, shares of limits and refusals.

    Examples:
      python -m tests.benchmarks arms --objects my-objects --robots robots
      python -m tests.benchmarks arms --objects my-objects --robots robots --arms panda --hand sharpa
    """
    from tests.benchmarks.arms import bench_arms

    bench_arms(objects, robots, arms, hand, attempts, out)
    return 0


def creep(
    policies: tuple[str, ...] = ("human", "sharpa", "allegro"), objects: int = 24, episodes: int = 24, threads: int = 0
) -> int:
    """Creep of held objects in mm and degrees, under the old and the new settings of friction and solver.

    Args:
      policies: Policy files, or names of pretrained policies.
      objects: Number of procedural objects.
      episodes: Least number of episodes of a policy.
      threads: Threads of the physics; 0 takes all cores.

    Examples:
      python -m tests.benchmarks creep
      python -m tests.benchmarks creep --policies human --objects 8 --episodes 8
    """
    from congrasp.common.runtime.parallel import cores
    from tests.benchmarks.creep import bench_creep

    bench_creep(policies, objects, episodes, threads or cores())
    return 0


COMMANDS = {
    "pieces": pieces,
    "gallery": gallery,
    "speeds": speeds,
    "measures": measures,
    "robot": robot,
    "sensors": sensors,
    "shutdown": shutdown,
    "security": security,
    "transport": transport,
    "staleness": staleness,
    "faults": faults,
    "recovery": recovery,
    "recording": recording,
    "arms": arms,
    "creep": creep,
}

if __name__ == "__main__":
    try:
        sys.exit(of_group(COMMANDS, "python -m tests.benchmarks", __doc__)(sys.argv[1:])())
    except CongraspError as error:
        sys.exit(f"error: {error}")
