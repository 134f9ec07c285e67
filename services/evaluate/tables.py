"""Tables of an evaluation: rows of constraints, and of variations of masses, sensors and
references.
"""

import pathlib
from collections.abc import Sequence, Set
from typing import NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.objects.pool import object_scale
from congrasp.common.runtime.entry import compiling_entry
from congrasp.common.task.methods import takes
from congrasp.services.evaluate.experiment import Experiment, Result, Variation
from congrasp.services.evaluate.heading_rules import HeadingRules, heading_rules
from congrasp.services.evaluate.many_objects import evaluate_pools
from congrasp.services.evaluate.plan import from_references
from congrasp.services.evaluate.pools import PoolLoaders
from congrasp.services.evaluate.references import reference_policy
from congrasp.services.evaluate.scores import TABLES, Row, known_rows
from congrasp.services.evaluate.variations import NOISE, PEERS, SENSING, Center, payload

_TABLES_OF_HEADINGS = {"sensing", "objects", "payload", "peers"}
"""Tables whose rows are the heading alone, under variations or on many objects."""
_OTHER_TABLES = {"noise", *_TABLES_OF_HEADINGS}
"""Tables whose rows are not those of `TABLES`."""


class Evaluation(NamedTuple):
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
    pools: PoolLoaders | None = None,
    stored: pathlib.Path | None = None,
    *,
    keep: bool = False,
) -> Evaluation:
    """Evaluates the rows of some tables.

    Args:
      experiment: policy, evaluated as the method of its task, objects, engine and numbers. The
        table `objects` has as many episodes in total, on objects of its own.
      tables: keys of `TABLES`, `objects`, `noise`, `sensing`, `payload`, `peers`, or `all` for all
        of these.
      pools: pools of the table `objects`, if it is requested.
      stored: folder for the results of rows and pools, to resume from; rows with kept episodes are
        not stored.
      keep: keeps episodes for pictures.

    Raises:
      CongraspError: the policy's method has no row in these tables, or no object allows one.
    """
    task = experiment.policy.task
    requested = set(tables)
    if "all" in tables:
        requested = {*TABLES, *_OTHER_TABLES}
    if not takes(task.method, Variation().constraint):
        requested -= _TABLES_OF_HEADINGS
    tables_of_constraints = [table for table in TABLES if table in requested]
    known = known_rows(tables_of_constraints, task)
    constraints = [name for name in known if takes(task.method, name)]
    if not constraints and not requested & _OTHER_TABLES:
        raise CongraspError(
            f"The method '{task.method}' has no row in these tables.", "Pass another --table."
        )
    evaluation = Evaluation(experiment, [], [], [], "")
    if constraints or requested & _OTHER_TABLES - {"objects"}:
        folder = None
        if stored is not None and not keep:
            folder = stored / "rows"
        evaluation = _evaluate_rows(experiment, constraints, requested, keep, folder)
    if "objects" in requested and pools:
        folder = None if stored is None else stored / "pools"
        evaluation.rows.extend(evaluate_pools(experiment, pools, folder))
    return evaluation


def _evaluate_rows(
    experiment: Experiment,
    constraints: Sequence[str],
    tables: Set[str],
    keep: bool,
    stored: pathlib.Path | None,
) -> Evaluation:
    """Evaluates the rows of some constraints, and the variations of some tables."""
    experiment.track("Generating constraints", None)
    references = ""
    if "noise" in tables or any(map(from_references, constraints)):
        references = _describe_references(experiment)
    variations, left_out = experiment.allowed(map(Variation, constraints))
    rules = None
    sampled = experiment.constraints is None and experiment.policy.task.headings == "all"
    if "single" in tables and sampled and Variation() in variations:
        variations.insert(variations.index(Variation()) + 1, Center())
        rules = heading_rules(experiment)
    variations += _variations(experiment, tables)
    results = experiment.run(variations, keep=keep, stored=stored)
    rows = [result.row for result in results]
    return Evaluation(experiment, results, rows, left_out, references, rules)


def _variations(experiment: Experiment, tables: Set[str]) -> list[Variation]:
    """Returns the variations of those tables that have some."""
    variations: list[Variation] = []
    if "noise" in tables:
        variations += NOISE
    if "sensing" in tables:
        variations += SENSING
    if "payload" in tables:
        task = experiment.policy.task
        scale = object_scale(experiment.hand, task)
        variations += payload(scale, constant_mass=task.constant_mass)
    if "peers" in tables:
        variations += PEERS
    return variations


def _describe_references(experiment: Experiment) -> str:
    """Generates references if none were given, and describes their source."""
    references = experiment.references
    if references is None:
        return "References come from the constraint sets."
    _, policy_name = reference_policy(experiment.policy)
    grasps = references.grasps[:, 0]
    text = f"References: grasps of {policy_name}, {np.median(grasps):.0f} per object (median)."
    without_grasp = [
        obj.name for obj, count in zip(experiment.objects, grasps, strict=True) if count == 0
    ]
    if not without_grasp:
        return text
    return (
        f"{text} Without a grasp, the hand closed around the object is used: "
        f"{', '.join(without_grasp)}."
    )
