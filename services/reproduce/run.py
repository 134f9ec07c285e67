"""Flow of `congrasp reproduce`: trains missing policies, evaluates every part, writes the result."""

import dataclasses
import gc
import itertools
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax

from congrasp.actors.physics import resolve_physics
from congrasp.common.errors import CongraspError
from congrasp.common.policy.pretrained import pretrained_file
from congrasp.common.runtime.engines import engine_title
from congrasp.common.task.methods import get_method
from congrasp.services.evaluate.lineup import Entrant, read_entrant
from congrasp.services.evaluate.report import curves_of
from congrasp.services.evaluate.tables import Track
from congrasp.services.reproduce import training
from congrasp.services.reproduce.comparison import compare
from congrasp.services.reproduce.evaluation import Numbers, Result, evaluate_part
from congrasp.services.reproduce.page import Account, page, write
from congrasp.services.reproduce.plan import BASELINES, RequiredPolicy, parts, policies

RUNS = "policies"
"""Folder of trainings within the output folder."""


@dataclasses.dataclass(frozen=True)
class Request:
    """Request for a reproduction."""

    out: pathlib.Path
    hands: tuple[str, ...]
    """Hands; the first is used in all tables except that of hands."""
    methods: tuple[str, ...]
    given: Mapping[RequiredPolicy, Entrant]
    """Policies that need no training."""
    captured: tuple[pathlib.Path, ...]
    quick: bool
    """Uses pretrained policies instead of training."""
    options: tuple[str, ...]
    """Further options of trainings."""
    patience: float
    """Limit of each training, s."""
    command: str
    """Command line of the request."""


class _Policies(NamedTuple):
    """Policies available for evaluation."""

    entrants: dict[RequiredPolicy, Entrant]
    absent: dict[RequiredPolicy, str]
    """Reasons for missing policies."""


def to_train(request: Request) -> list[RequiredPolicy]:
    """Returns the policies that the request would have to train."""
    if request.quick:
        return []
    found = policies(request.hands, request.methods)
    return [policy for policy in found if get_method(policy.method).learns and _file(request, policy) is None]


def reproduce(
    request: Request,
    numbers: Numbers,
    track: Track,
    note: Callable[[str], None] = lambda text: None,
) -> Account:
    """Trains, evaluates and writes; a failure does not stop the rest.

    Args:
      request: the request.
      numbers: sizes and settings of the evaluation; the engine may be `auto`.
      track: shows progress.
      note: called with messages for the user.

    Raises:
      CongraspError: nothing could be evaluated, or the result cannot be written.
    """
    page()  # fails before anything else if a package is missing
    shown: set[RequiredPolicy] = set()

    def show(policy: RequiredPolicy, line: str) -> None:
        """Shows a bar for each training; its output is in its log."""
        if policy not in shown:
            shown.add(policy)
            track(f"Training {policy.name} (log: {request.out / RUNS / policy.name}.log)", None)

    failed = training.train_all(
        request.out / RUNS,
        to_train(request),
        options=request.options,
        patience=request.patience,
        progress=show,
    )
    for text in failed.values():
        note(text)
    found = _policies(request, failed)
    results: list[Result] = []
    failures = list(failed.values())
    # Not earlier: trainings have the whole device memory until this process initialises its engine.
    numbers = dataclasses.replace(numbers, physics=resolve_physics(numbers.physics))
    whole = parts(policies(request.hands, request.methods), request.captured, noise=not request.quick)
    wanted = [part for part in whole if part.policy in found.entrants]
    advance = track("Parts", len(wanted))
    for done, part in enumerate(wanted, 1):
        try:
            result = evaluate_part(part, found.entrants[part.policy], numbers, request.out, track)
        except CongraspError as error:
            failures.append(f"{part.name}: {error}")
            note(failures[-1])
        else:
            results.append(result)
            note(f"{part.name}: {_outcome(result)}")
            if result.fresh:  # no other part uses its compiled programs
                jax.clear_caches()
                gc.collect()
        advance(done)
    if not results:
        raise CongraspError(
            "Nothing could be evaluated.", failures[0] if failures else "Pass --hands with a hand that has a policy."
        )
    account = _account(request, numbers, found, results, failures)
    write(account, request.out)
    return account


def _outcome(result: Result) -> str:
    """One line about a part."""
    if not result.fresh:
        return "evaluated before"
    rates = ", ".join(f"{row.constraint} {100 * row.success:.1f} %" for row in result.rows if not row.group)
    return f"{rates} ({result.about['seconds']:.0f} s)"


def _file(request: Request, policy: RequiredPolicy) -> pathlib.Path | None:
    """Returns a policy's file, if it exists."""
    if policy in request.given:
        return request.given[policy].file
    if request.quick and policy.method == "ours":
        return pretrained_file(policy.hand)
    return training.trained(request.out / RUNS, policy)


def _policies(request: Request, failed: Mapping[RequiredPolicy, str]) -> _Policies:
    """Reads the available policies; methods without learning use the full system's hand and geometry."""
    found = _Policies({}, {})
    for policy in policies(request.hands, request.methods):
        learns = get_method(policy.method).learns
        file = _file(request, policy if learns else RequiredPolicy(policy.hand, "ours"))
        if policy in request.given:
            found.entrants[policy] = request.given[policy]
        elif file is not None:
            found.entrants[policy] = read_entrant(file, policy.method)
        elif policy in failed:
            found.absent[policy] = failed[policy]
        else:
            found.absent[policy] = "not trained with --quick" if request.quick else "it was not trained"
    for method in set(BASELINES) - set(request.methods):
        found.absent[RequiredPolicy(request.hands[0], method)] = "not requested"
    return found


def _account(
    request: Request, numbers: Numbers, found: _Policies, results: Sequence[Result], failures: Sequence[str]
) -> Account:
    """Collects the content of the page."""
    runs = request.out / RUNS
    trainings = {policy: training.seconds(runs, policy) or 0.0 for policy in found.entrants}
    seconds = {
        "training": sum(trainings.values()),
        "evaluation": sum(result.about["seconds"] for result in results),
    }
    where = []
    for policy, one in found.entrants.items():
        took = f", trained in {trainings[policy] / 60:.0f} min" if trainings[policy] else ""
        version = f"{one.file.name}, version {one.policy.version}, {one.policy.transitions:,} environment steps"
        where.append((policy, version + took if get_method(policy.method).learns else "needs none"))
    where += [(policy, f"none: {reason}") for policy, reason in found.absent.items()]
    curves = [
        dataclasses.replace(curve, title=f"Training of {policy.name}: {curve.title}")
        for policy in found.entrants
        if trainings[policy]
        for curve in itertools.islice(curves_of(runs / policy.name), 1)
    ]
    conditions = (
        f"{numbers.episodes} episodes a row on {numbers.pool} held-out procedural objects, {numbers.many} on many "
        f"objects, {engine_title(numbers.physics)}, friction {numbers.friction:g}, seed {numbers.seed}."
    )
    cells = compare(results, found.absent, request.hands)
    return Account(list(results), cells, where, list(failures), conditions, request.command, curves, seconds)
