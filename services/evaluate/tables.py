"""Rows of an evaluation's tables, for one policy."""

import dataclasses
import pathlib
from collections.abc import Callable, Sequence, Set
from typing import NamedTuple

import numpy as np

from congrasp.common.config import Split
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.objects.pool import object_scale
from congrasp.common.objects.spec import GraspObject
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.runtime.engines import PhysicsName
from congrasp.common.runtime.parallel import cores
from congrasp.common.task.methods import takes
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.sampling.sets import bank_of, load_for
from congrasp.services.evaluate import loads, sensing
from congrasp.services.evaluate.evaluator import Evaluator
from congrasp.services.evaluate.exam import Exam, exam_pool
from congrasp.services.evaluate.heading_rules import HeadingRules
from congrasp.services.evaluate.noise import LEVELS
from congrasp.services.evaluate.paper import CAPTURED_SETS
from congrasp.services.evaluate.plan import from_references
from congrasp.services.evaluate.pools import folder_pools, procedural_pools
from congrasp.services.evaluate.protocol import NOMINAL_FRICTION, two_seconds
from congrasp.services.evaluate.references import reference_policy
from congrasp.services.evaluate.scores import TABLES, Row, known_rows
from congrasp.services.evaluate.unseen import evaluate_objects

MANY = 50_000
"""Most procedural objects of the table `objects` by default."""
_OTHERS = {"noise", "sensing", "objects", "payload", "peers"}  # tables whose rows are not constraints
Track = Callable[[str, int | None], Callable[[int], None]]
"""(label, total if known) -> function to call with the number done."""


@dataclasses.dataclass(frozen=True)
class Setup:
    """Settings of an evaluation."""

    episodes: int
    """Episodes of each row; of the table `objects` in total."""
    physics: PhysicsName
    """Engine, except `auto`."""
    exam: Exam = "figures"
    """Set of procedural objects."""
    pool: int = 0
    """Number of procedural objects; 0 uses `exam.POOL`, and for the table `objects` one per episode, at most `MANY`."""
    batch: int = 0
    """Number of parallel worlds; 0 uses the engine's default."""
    seed: int = 0
    friction: float = NOMINAL_FRICTION
    given: Sequence[GraspObject] = ()
    """Objects of rows by constraint; procedural ones if empty."""
    bank: ConstraintBank | None = None
    """Constraints of the objects, if given."""
    paper: str = "hands"
    """Table of the paper for comparison (`services.evaluate.paper`)."""
    folder: pathlib.Path | None = None
    """Objects of the table `objects`; procedural ones if None."""
    keep: pathlib.Path | None = None
    """Folder for results of its pools, to resume from."""


class Found(NamedTuple):
    """Results of one policy."""

    evaluator: Evaluator | None
    """Evaluator of the rows by constraint; None if there are none."""
    names: list[str]
    """Names of the evaluated rows by constraint."""
    left_out: list[CongraspError]
    """Reasons for skipped rows."""
    noisy: list[Row]
    """Rows under noise of references."""
    rows: list[Row]
    """All rows."""
    references: str
    """Source of reference poses and trajectories; empty if no row has any."""
    heading_rules: HeadingRules | None = None
    """Effect of the rules for headings; None without the table `single` of sampled headings."""


def evaluate_tables(
    policy: PolicyBundle, tables: Sequence[str], setup: Setup, track: Track, *, keep: bool = False
) -> Found:
    """Evaluates the rows of some tables.

    Args:
      policy: policy, evaluated as the method of its task.
      tables: keys of `TABLES`, `objects`, `noise`, `sensing`, `payload`, `peers`, or `all` for all of these.
      setup: objects, engine and numbers.
      track: shows progress.
      keep: keeps episodes for `Evaluator.examples`.

    Raises:
      CongraspError: the policy's method has no row in these tables, or no object allows one.
    """
    method, wanted = policy.task.method, {*TABLES, *_OTHERS} if "all" in tables else set(tables)
    names = [name for name in known_rows((key for key in TABLES if key in wanted), policy.task) if takes(method, name)]
    if not takes(method, "heading"):
        wanted -= _OTHERS - {"noise"}
    if not names and not wanted & _OTHERS:
        raise CongraspError(f"The method '{method}' has no row in these tables.", "Pass another --table.")
    rows: list[Row] = []
    noisy: list[Row] = []
    left_out: list[CongraspError] = []
    evaluator: Evaluator | None = None
    rules, source = None, ""
    if names or wanted & _OTHERS - {"objects"}:
        evaluator = _evaluator(policy, setup, track)
        if "noise" in wanted or any(from_references(name) for name in names):
            source = _references(evaluator, track)
        if names:
            names, left_out = evaluator.allowed(names)
            advance = track("Episodes", len(names) * setup.episodes)
            rows = evaluator.rows(names, setup.episodes, advance, keep=keep)
        if "single" in wanted and "heading" in names and setup.bank is None and policy.task.headings == "all":
            advance = track("Episodes with other rules for headings", setup.episodes)
            by_center, rules = evaluator.row_by_center(setup.episodes, advance)
            rows.insert(names.index("heading") + 1, by_center)
        if "noise" in wanted:
            advance = track("Episodes under noise", len(LEVELS) * setup.episodes)
            noisy = evaluator.rows_under_noise(advance, setup.episodes)
        rows += noisy + _rows_at_levels(evaluator, policy, wanted, setup.episodes, track)
    if "objects" in wanted:
        rows += _object_rows(policy, setup, track)
    return Found(evaluator, names, left_out, noisy, rows, source, rules)


def _rows_at_levels(
    evaluator: Evaluator, policy: PolicyBundle, wanted: Set[str], episodes: int, track: Track
) -> list[Row]:
    """Evaluates rows of the tables `sensing`, `payload` and `peers`, if requested."""
    rows: list[Row] = []
    if "sensing" in wanted:
        advance = track("Episodes with a robot's sensors", len(sensing.LEVELS) * episodes)
        rows += evaluator.rows_under_sensing(advance, episodes)
    scale = object_scale(get_hand(policy.spec.hand), policy.task)
    levels = {"payload": loads.payload(scale, constant_mass=policy.task.constant_mass), "peers": loads.PEERS}
    for table in sorted(wanted & levels.keys()):
        advance = track("Episodes under loads", len(levels[table]) * episodes)
        rows += evaluator.rows_under_loads(levels[table], advance, episodes)
    return rows


def _evaluator(policy: PolicyBundle, setup: Setup, track: Track) -> Evaluator:
    """Returns an evaluator of given objects, or of procedural ones of an evaluation set."""
    track("Generating constraints", None)
    return Evaluator(
        policy,
        setup.given or exam_pool(setup.exam, setup.pool),
        physics=setup.physics,
        batch=setup.batch,
        threads=cores(),
        seed=setup.seed,
        friction=setup.friction,
        hold_steps=two_seconds(policy.task),
        bank=setup.bank,
        paper=setup.paper,
    )


def _references(evaluator: Evaluator, track: Track) -> str:
    """Generates references if none were given, and describes their source."""
    advance = track("Reference grasps", None)
    made = evaluator.references(lambda done, of: advance(done))
    if made is None:
        return "References come from the constraint sets."
    _, who = reference_policy(evaluator.bundle)
    whole = made.grasps[:, 0]
    closed = [obj.name for obj, count in zip(evaluator.objects, whole, strict=True) if not count]
    text = f"References: grasps of {who}, {np.median(whole):.0f} per object (median)."
    return text + (
        f" Without a grasp, the hand closed around the object is used: {', '.join(closed)}." if closed else ""
    )


def _object_rows(policy: PolicyBundle, setup: Setup, track: Track) -> list[Row]:
    """Evaluates rows of the heading on many objects."""
    if setup.folder:
        pools = folder_pools(setup.folder, setup.physics)
    else:
        pools = procedural_pools(setup.pool or min(setup.episodes, MANY), setup.physics, setup.exam)
    return evaluate_objects(
        policy,
        pools,
        setup.episodes,
        physics=setup.physics,
        batch=setup.batch,
        threads=cores(),
        seed=setup.seed,
        friction=setup.friction,
        keep=setup.keep,
        progress=track("Episodes on many objects", setup.episodes),
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
    """Returns the objects that have a constraint set with a heading of the split in a folder, and the sets.

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
