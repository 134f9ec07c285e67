"""The rows of an evaluation's tables, for one policy."""

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
"""Most procedural objects of the table `objects`, where their number is not given."""
_OTHERS = {"noise", "sensing", "objects", "payload", "peers"}  # tables whose rows are no constraints
Track = Callable[[str, int | None], Callable[[int], None]]
"""(what is done, its total if known) -> what to call with the amount done."""


@dataclasses.dataclass(frozen=True)
class Setup:
    """How policies are evaluated, and on what."""

    episodes: int
    """Of each row; of the table `objects` in all."""
    physics: PhysicsName
    """Not `auto`."""
    exam: Exam = "figures"
    """Which procedural objects."""
    pool: int = 0
    """Procedural objects; 0 takes `exam.POOL`, for the table `objects` one an episode, at most `MANY`."""
    batch: int = 0
    """Worlds side by side; 0 chooses by the engine."""
    seed: int = 0
    friction: float = NOMINAL_FRICTION
    given: Sequence[GraspObject] = ()
    """Objects of rows by constraint; procedural ones if there are none."""
    bank: ConstraintBank | None = None
    """Their constraints, where those are given too."""
    paper: str = "hands"
    """Which of the paper's tables rows stand beside (`services.evaluate.paper`)."""
    folder: pathlib.Path | None = None
    """Objects of the table `objects`; procedural ones if there is none."""
    keep: pathlib.Path | None = None
    """Where results of its pools are kept, to resume from."""


class Found(NamedTuple):
    """Results for one policy."""

    evaluator: Evaluator | None
    """Of the rows by constraint; None if there are none."""
    names: list[str]
    """Rows by constraint that were evaluated."""
    left_out: list[CongraspError]
    """Why others were not."""
    noisy: list[Row]
    """Rows under noise of references."""
    rows: list[Row]
    """All rows."""
    references: str
    """Where reference poses and trajectories come from; empty if no row has any."""
    heading_rules: HeadingRules | None = None
    """Effect of the rules for headings; None without the table `single` of sampled headings."""


def evaluate_tables(
    policy: PolicyBundle, tables: Sequence[str], setup: Setup, track: Track, *, keep: bool = False
) -> Found:
    """The rows of some tables.

    Args:
      policy: as the method that its task names.
      tables: keys of `TABLES`, `objects`, `noise`, `sensing`, `payload`, `peers`, or `all` for all of these.
      setup: objects, engine and numbers.
      track: shows progress.
      keep: keep episodes for `Evaluator.examples`.

    Raises:
      CongraspError: the policy's method has no row in these tables, or no object allows one.
    """
    method, wanted = policy.task.method, {*TABLES, *_OTHERS} if "all" in tables else set(tables)
    names = [name for name in known_rows((key for key in TABLES if key in wanted), policy.task) if takes(method, name)]
    if not takes(method, "heading"):
        wanted -= _OTHERS - {"noise"}
    if not names and not wanted & _OTHERS:
        raise CongraspError(f"The method '{method}' has no row in these tables.", "Name another --table.")
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
    """Rows of the tables `sensing`, `payload` and `peers`, if they are wanted."""
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
    """An evaluator of given objects, or of an exam's procedural ones."""
    track("Making constraints", None)
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
    """Makes the references, where none were given, and says where they come from."""
    advance = track("Reference grasps", None)
    made = evaluator.references(lambda done, of: advance(done))
    if made is None:
        return "References are those of the constraint sets."
    _, who = reference_policy(evaluator.bundle)
    whole = made.grasps[:, 0]
    closed = [obj.name for obj, count in zip(evaluator.objects, whole, strict=True) if not count]
    text = f"References: grasps of {who}, {np.median(whole):.0f} an object (median), the last fifth held out."
    return text + (f" The hand closed around the object where it holds none: {', '.join(closed)}." if closed else "")


def _object_rows(policy: PolicyBundle, setup: Setup, track: Track) -> list[Row]:
    """Rows of the heading on many objects."""
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
    """Objects and the constraint sets that are evaluated on them."""

    objects: list[GraspObject]
    bank: ConstraintBank
    hand: str
    """For which the sets were made."""
    paper: str
    """The paper's table of their data set (`services.evaluate.paper`); empty for none."""


def captured(folder: pathlib.Path, split: Split, objects: Sequence[GraspObject]) -> Captured:
    """The objects that have a constraint set with a heading of the split in a folder, and the sets.

    Raises:
      CongraspError: none has one, or a set is not for its object.
    """
    chosen, sets = load_for(folder, objects, split)
    if not sets:
        raise CongraspError(
            f"{folder} holds no constraint set ({split}) of these objects.",
            "Name folders that belong together, or take another --split.",
        )
    sources = {made.meta.get("source", "") for made in sets}
    paper = CAPTURED_SETS.get(sources.pop(), "") if len(sources) == 1 else ""
    return Captured(chosen, bank_of(sets, split), sets[0].meta["hand"], paper)
