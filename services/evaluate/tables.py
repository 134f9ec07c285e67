"""Tables of an evaluation: their rows, as variations of one experiment, and the effect of the rules
for headings.
"""

import dataclasses
import math
import pathlib
import zlib
from collections.abc import Sequence, Set
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.actors.initial import InitialConditions
from congrasp.common.config import Split
from congrasp.common.errors import CongraspError
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.motors import coupled
from congrasp.common.objects.pool import object_scale
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.entry import compiling_entry
from congrasp.common.task.config import SensingConfig, TaskConfig
from congrasp.common.task.methods import takes
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.sampling.headings import Headings, opposed_at
from congrasp.common.task.sampling.reach import feasible
from congrasp.common.task.sampling.set_bank import bank_of
from congrasp.common.task.sampling.set_file import load_for
from congrasp.services.evaluate.episodes import identity
from congrasp.services.evaluate.experiment import Experiment, Result, Variation
from congrasp.services.evaluate.paper import CAPTURED_SETS, CENTER_GROUP
from congrasp.services.evaluate.plan import from_references, repeated_rests
from congrasp.services.evaluate.pools import Pools, evaluate_pools
from congrasp.services.evaluate.references import reference_policy
from congrasp.services.evaluate.scores import TABLES, Row, known_rows

MASSES = (0.05, 0.1, 0.25, 0.5, 1.0, 1.5, 2.0)
"""Masses of the table `payload`, kg."""
# Tables whose rows are not constraints
_OTHERS = {
    "noise",
    "sensing",
    "objects",
    "payload",
    "peers",
}
_LIFT = np.array([0, 0, 10, 0, 0, 0, 0])
"""z coordinate of the resting pose, m: higher than any hand reaches down."""


@dataclasses.dataclass(frozen=True)
class Center(Variation):
    """Headings that only keep the hand's centre above the table."""

    label: str = CENTER_GROUP

    def bank(self, experiment: Experiment) -> ConstraintBank:
        """See `Variation.bank`."""
        return experiment.by_center


@dataclasses.dataclass(frozen=True)
class Noise(Variation):
    """References with errors like captured ones; errors of the row are relative to the request,
    including noise.

    * joints: an independent normal error of standard deviation `level` on every finger joint,
      clipped to its limits.
    * depth: a displacement of the wrist along the hand's heading axis, into the object, uniform up
      to `level`.
    * jitter: an independent normal error of standard deviation `level` on every coordinate of every
      waypoint.
    """

    kind: str = ""
    """joints, depth or jitter; empty for no noise."""
    level: float = 0.0
    """rad for joints, m otherwise."""

    def bank(self, experiment: Experiment) -> ConstraintBank:
        """See `Variation.bank`."""
        bank, rng = experiment.bank_for(self.constraint), np.random.default_rng(experiment.seed)
        if self.kind == "joints":
            q, hand = np.asarray(bank.pose_q), experiment.hand
            noisy = np.clip(q + rng.normal(0.0, self.level, q.shape), hand.lower, hand.upper)
            return bank._replace(pose_q=coupled(hand, noisy).astype(np.float32))
        if self.kind == "depth":
            position, quaternion = np.asarray(bank.pose_position), np.asarray(bank.pose_quaternion)
            turn = Rotation.from_quat(quaternion.reshape(-1, 4), scalar_first=True)
            inward = turn.apply(grasp_frame(experiment.hand).heading).reshape(position.shape)
            depth = rng.uniform(0.0, self.level, (*position.shape[:-1], 1))
            return bank._replace(pose_position=(position + depth * inward).astype(np.float32))
        if self.kind == "jitter":
            path = np.asarray(bank.trajectory_position)
            noisy = path + rng.normal(0.0, self.level, path.shape)
            return bank._replace(trajectory_position=noisy.astype(np.float32))
        return bank


@dataclasses.dataclass(frozen=True)
class Sensors(Variation):
    """A tracker, a friction and an error of the gains; by default a tracker with 30 Hz, 5 mm, 3
    degrees and 60 ms.

    A policy of the full state gets the tracker's pose instead of the true one, and keeps its
    contact forces and velocities. Errors and losses use the same random numbers at all levels.
    """

    position_noise: float = 0.005
    """Standard deviation of each coordinate, m."""
    rotation_noise: float = math.radians(3.0)
    """Standard deviation about each axis, rad."""
    delay: float = 0.06
    """s."""
    rate: float = 30.0
    """Hz."""
    dropout: float = 0.0
    """Share of lost samples."""
    friction: float | None = None
    """Sliding friction between hand and object; None: that of the evaluation."""
    gains: float = 1.0
    """Factor on the finger servos' gains."""
    latency: float = 0.0
    """Seconds until the servos follow a target."""

    def task(self, task: TaskConfig) -> TaskConfig:
        """Returns the task in which a policy observes trackers, with room for the longest delay of
        `SENSING`.
        """
        delay, latency = (
            (0.0, max(getattr(level, name) for level in SENSING)) for name in ("delay", "latency")
        )
        sensing = SensingConfig(delay=delay, latency=latency, settle=task.sensing.settle)
        return dataclasses.replace(task, sensing=sensing)

    def episodes(self, conditions: InitialConditions, control_dt: float) -> InitialConditions:
        """See `Variation.episodes`."""
        values = {
            "period": max(1.0 / (self.rate * control_dt), 1.0),
            "delay": round(self.delay / control_dt),
            "position_noise": self.position_noise,
            "rotation_noise": self.rotation_noise,
            "dropout": self.dropout,
            "latency": round(self.latency / control_dt),
        }
        sensors, start = conditions.sensors, conditions.reset_state
        friction = (
            start.friction
            if self.friction is None
            else jnp.full_like(start.friction, self.friction)
        )
        return conditions._replace(
            sensors=sensors._replace(
                **{k: jnp.full_like(getattr(sensors, k), value) for k, value in values.items()}
            ),
            reset_state=start._replace(
                friction=friction, gain_scale=jnp.full_like(start.gain_scale, self.gains)
            ),
        )


@dataclasses.dataclass(frozen=True)
class Load(Variation):
    """Mass of an object and friction of an episode, each uniform in a range; by default those of
    the evaluation.

    The inertia is scaled with the mass. Objects are replaced instead of scaling the mass of an
    episode: engines derive the softness of contacts from the mass at compilation, and diverge far
    from it.
    """

    mass: tuple[float, float] | None = None
    """kg; the object's name determines the position in the range."""
    friction: tuple[float, float] | None = None
    """Sliding friction between hand and object; the episode determines the position in the
    range.
    """
    factor: float = 1.0
    """Factor on the object's mass, if no mass is given."""

    def objects(self, objects: Sequence[GraspObject]) -> list[GraspObject]:
        """See `Variation.objects`."""
        found = []
        for obj in objects:
            mass = self.factor * obj.mass
            if self.mass:
                mass = (
                    self.mass[0]
                    + (self.mass[1] - self.mass[0]) * zlib.crc32(obj.name.encode()) / 2**32
                )
            found.append(dataclasses.replace(obj, mass=mass, inertia=obj.inertia * mass / obj.mass))
        return found

    def episodes(self, conditions: InitialConditions, control_dt: float) -> InitialConditions:
        """See `Variation.episodes`."""
        if not self.friction:
            return conditions
        low, high = self.friction
        share = (
            np.array([zlib.crc32(episode.tobytes()) for episode in identity(conditions)]) / 2**32
        )
        friction = (low + (high - low) * share).astype(np.float32)
        return conditions._replace(reset_state=conditions.reset_state._replace(friction=friction))


NOISE = (
    Noise("pose"),
    Noise("pose", "joints 0.1 rad", "joints", 0.1),
    Noise("pose", "joints 0.2 rad", "joints", 0.2),
    Noise("pose", "depth 0.5 cm", "depth", 0.005),
    Noise("pose", "depth 1 cm", "depth", 0.01),
    Noise("trajectory"),
    Noise("trajectory", "jitter 0.5 cm", "jitter", 0.005),
    Noise("trajectory", "jitter 1 cm", "jitter", 0.01),
)
"""Rows of the table `noise` (paper, noisy constraints)."""
SENSING = (
    Sensors(
        label="the true pose", position_noise=0.0, rotation_noise=0.0, delay=0.0, rate=math.inf
    ),
    Sensors(label="5 mm 3°, 30 Hz, 60 ms"),
    Sensors(label="no noise", position_noise=0.0, rotation_noise=0.0),
    Sensors(label="10 mm 6°", position_noise=0.01, rotation_noise=math.radians(6.0)),
    Sensors(label="no delay", delay=0.0),
    Sensors(label="100 ms", delay=0.1),
    Sensors(label="10 Hz", rate=10.0),
    Sensors(label="10 % dropped", dropout=0.1),
    Sensors(label="30 % dropped", dropout=0.3),
    Sensors(label="friction 0.5", friction=0.5),
    Sensors(label="gains -20 %", gains=0.8),
    Sensors(label="gains +20 %", gains=1.2),
    Sensors(label="targets 20 ms late", latency=0.02),
    Sensors(label="targets 40 ms late", latency=0.04),
)
"""Rows of the table `sensing`; each but the first differs from the second, a typical tracker, in
one setting.
"""
PEERS = (
    Load(label="RobustDexGrasp: 0.25 kg, friction 0.8", mass=(0.25, 0.25), friction=(0.8, 0.8)),
    Load(label="dexsuite: 0.04-0.5 kg, friction 0.5-1", mass=(0.04, 0.5), friction=(0.5, 1.0)),
)
"""Rows of the table `peers`: conditions of RobustDexGrasp (arXiv:2504.05287) and of Isaac Lab's
dexsuite.
"""


def payload(scale: float, *, constant_mass: bool) -> tuple[Load, ...]:
    """Rows of the table `payload`: fixed masses, the objects' masses, and masses scaled with
    lengths if different.

    Args:
      scale: factor on the lengths of the hand's objects.
      constant_mass: setting of the task; True if the evaluated objects keep their mass when scaled.
    """
    masses = tuple(Load(label=f"{mass:g} kg", mass=(mass, mass)) for mass in MASSES)
    own = 1.0 if constant_mass else scale**-3
    found = (*masses, Load(label="masses of the objects", factor=own))
    literal = Load(label=f"masses scaled with the lengths x {scale:g}", factor=own * scale**3)
    return found if scale == 1.0 else (*found, literal)


@dataclasses.dataclass(frozen=True)
class HeadingRules:
    """Shares of all pairs of a sampled heading and a resting pose."""

    kept: float
    """Pairs used by episodes."""
    from_below: float
    """Pairs dropped because the hand would come from below."""
    no_room: float
    """Pairs dropped because the hand would be in the table."""
    moved: float
    """Share of the kept pairs whose position moves back from the table."""
    kept_by_center: float
    """Pairs kept if only the hand's centre must be above the table."""
    opposed: float
    """Share of the headings by the paper's rules alone that have surfaces to press on from both
    sides.
    """

    def sentence(self, hand: str) -> str:
        """Summary, such as "Headings of the human hand: 24 % of those sampled are kept …"."""
        shares = (
            self.kept,
            self.from_below,
            self.no_room,
            self.moved,
            self.kept_by_center,
            1 - self.opposed,
        )
        kept, below, room, moved, by_center, lost = (f"{100 * share:.0f} %" for share in shares)
        return (
            f"Headings of the {hand} hand: {kept} of the sampled ones are kept, {below} dropped "
            f"because they come from "
            f"below and {room} because the table leaves the hand no room; {moved} of the kept ones "
            f"are moved back from "
            f"the table. By the paper's rules, with the hand's centre above the table, {by_center} "
            f"are kept; {lost} of "
            "these rules' headings have no surfaces to press on from both sides, which the full "
            "rules do not sample. "
            "The paper states no such rules."
        )


def heading_rules(experiment: Experiment) -> HeadingRules:
    """Effect of the rules on the sampled headings of the whole surface, over all resting poses of
    the objects.
    """
    bank, by_center, objects = experiment.bank, experiment.by_center, experiment.scaled
    total, below, opposed = 0, 0, []
    for n, obj in enumerate(objects):
        headings = _sampled(bank, n)
        opposed.append(opposed_at(_sampled(by_center, n), obj, np.zeros(len(obj.points), bool)))
        for rest in obj.rest_poses:
            total += len(headings.direction)
            below += int((~feasible(headings, rest + _LIFT)).sum())
    kept, moved = _kept(bank)
    return HeadingRules(
        kept=kept / total,
        from_below=below / total,
        no_room=1 - (kept + below) / total,
        moved=moved / kept,
        kept_by_center=_kept(by_center)[0] / total,
        opposed=float(np.mean(opposed)),
    )


def _sampled(bank: ConstraintBank, n: int) -> Headings:
    """Sampled headings of the whole surface of an object, before they are moved."""
    axes = (getattr(bank, f"heading_{name}")[n, 0] for name in Headings._fields)
    return Headings(*(np.asarray(axis, np.float64) for axis in axes))


def _kept(bank: ConstraintBank) -> tuple[int, int]:
    """Numbers of pairs of a heading and a resting pose that a bank keeps, and of those moved
    back.
    """
    index, back = np.asarray(bank.heading_index)[:, 0], np.asarray(bank.heading_back)[:, 0]
    kept = moved = 0
    for n, r in np.argwhere(~repeated_rests(np.asarray(bank.rest))):
        found, first = np.unique(index[n, r], return_index=True)
        kept += len(found)
        moved += int((back[n, r][first] > 0).sum())
    return kept, moved


class Found(NamedTuple):
    """Results of one policy."""

    experiment: Experiment
    results: list[Result]
    """Results of all rows but those of many objects."""
    rows: list[Row]
    """All rows."""
    left_out: list[CongraspError]
    """Reasons for skipped rows."""
    references: str
    """Source of reference poses and trajectories; empty if no row has any."""
    heading_rules: HeadingRules | None = None
    """Effect of the rules for headings; None without the table `single` of sampled headings."""

    def of(self, kind: type[Variation]) -> list[Result]:
        """Results of one kind of variation: `Variation` itself for constraints without a change."""
        return [result for result in self.results if type(result.variation) is kind]


@compiling_entry
def evaluate_tables(
    experiment: Experiment,
    tables: Sequence[str],
    pools: Pools | None = None,
    kept: pathlib.Path | None = None,
    *,
    keep: bool = False,
) -> Found:
    """Evaluates the rows of some tables.

    Args:
      experiment: policy, evaluated as the method of its task, objects, engine and numbers. The
        table `objects` has as many episodes in total, on objects of its own.
      tables: keys of `TABLES`, `objects`, `noise`, `sensing`, `payload`, `peers`, or `all` for all
        of these.
      pools: pools of the table `objects`, if it is wanted.
      kept: folder for the results of rows and pools, to resume from; rows with kept episodes are
        not stored.
      keep: keeps episodes for pictures.

    Raises:
      CongraspError: the policy's method has no row in these tables, or no object allows one.
    """
    task, wanted = experiment.policy.task, {*TABLES, *_OTHERS} if "all" in tables else set(tables)
    names = [
        name
        for name in known_rows((k for k in TABLES if k in wanted), task)
        if takes(task.method, name)
    ]
    if not takes(task.method, Variation().constraint):
        wanted -= _OTHERS - {"noise"}
    if not names and not wanted & _OTHERS:
        raise CongraspError(
            f"The method '{task.method}' has no row in these tables.", "Pass another --table."
        )
    found = Found(experiment, [], [], [], "")
    if names or wanted & _OTHERS - {"objects"}:
        found = _rows(experiment, names, wanted, keep, kept and kept / "rows")
    if "objects" in wanted and pools:
        found.rows.extend(evaluate_pools(experiment, pools, kept and kept / "pools"))
    return found


def _rows(
    experiment: Experiment,
    names: Sequence[str],
    wanted: Set[str],
    keep: bool,
    stored: pathlib.Path | None,
) -> Found:
    """Evaluates constraints of these names, and the rows at levels of some tables."""
    experiment.track("Generating constraints", None)
    source, task = "", experiment.policy.task
    if "noise" in wanted or any(map(from_references, names)):
        source = _source(experiment)
    variations, left_out = experiment.allowed(map(Variation, names))
    rules = None
    sampled = experiment.constraints is None and task.headings == "all"
    if "single" in wanted and sampled and Variation() in variations:
        variations.insert(variations.index(Variation()) + 1, Center())
        rules = heading_rules(experiment)
    scale = object_scale(experiment.hand, task)
    levels = {
        "noise": NOISE,
        "sensing": SENSING,
        "payload": payload(scale, constant_mass=task.constant_mass),
        "peers": PEERS,
    }
    variations += [variation for table in levels if table in wanted for variation in levels[table]]
    results = experiment.run(variations, keep=keep, stored=None if keep else stored)
    return Found(experiment, results, [result.row for result in results], left_out, source, rules)


def _source(experiment: Experiment) -> str:
    """Generates references if none were given, and describes their source."""
    if (made := experiment.references) is None:
        return "References come from the constraint sets."
    _, who = reference_policy(experiment.policy)
    whole = made.grasps[:, 0]
    closed = [obj.name for obj, count in zip(experiment.objects, whole, strict=True) if not count]
    text = f"References: grasps of {who}, {np.median(whole):.0f} per object (median)."
    return text + (
        f" Without a grasp, the hand closed around the object is used: {', '.join(closed)}."
        if closed
        else ""
    )


class Captured(NamedTuple):
    """Objects with their constraint sets."""

    objects: list[GraspObject]
    bank: ConstraintBank
    hand: str
    """Hand of the sets."""
    paper: str
    """Table of the paper for their data set (`services.evaluate.paper`); empty for none."""


def captured(folder: pathlib.Path, split: Split, objects: Sequence[GraspObject]) -> Captured:
    """Returns the objects that have a constraint set with a heading of the split in a folder, and
    the sets.

    Raises:
      CongraspError: none has one, or a set belongs to another object.
    """
    chosen, sets = load_for(folder, objects, split)
    if not sets:
        raise CongraspError(
            f"{folder} holds no constraint set ({split}) of these objects.",
            "Pass folders that belong together, or another --split.",
        )
    sources = {made.meta.get("source", "") for made in sets}
    paper = CAPTURED_SETS.get(sources.pop(), "") if len(sources) == 1 else ""
    return Captured(chosen, bank_of(sets, split), sets[0].meta["hand"], paper)
