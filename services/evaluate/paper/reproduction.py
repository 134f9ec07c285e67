"""Reproduction of the paper's tables: evaluates every part, compares, and writes the result."""

import dataclasses
import itertools
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from congrasp.actors.physics import resolve_physics
from congrasp.common.errors import CongraspError
from congrasp.common.runtime.engines import engine_title
from congrasp.common.task.methods import get_method
from congrasp.services.evaluate.experiment import Track
from congrasp.services.evaluate.lineup import Entrant, PolicyKey
from congrasp.services.evaluate.pages import Picture, curves_of
from congrasp.services.evaluate.paper.comparison import compare
from congrasp.services.evaluate.paper.evaluation import PartResult, PartSettings, evaluate_part
from congrasp.services.evaluate.paper.page import Reproduction, write_reproduction
from congrasp.services.evaluate.paper.parts import (
    list_parts,
    required_policies,
)
from congrasp.services.evaluate.plan import NOMINAL_FRICTION


class Training(NamedTuple):
    """A finished training."""

    run_dir: pathlib.Path
    seconds: float


@dataclasses.dataclass(frozen=True)
class AvailablePolicies:
    """Policies of a reproduction."""

    entrants: Mapping[PolicyKey, Entrant]
    absent: Mapping[PolicyKey, str]
    """Reasons for missing policies."""
    trainings: Mapping[PolicyKey, Training] = dataclasses.field(default_factory=dict)
    """Trainings of those that this reproduction trained."""
    failures: Sequence[str] = ()
    """Errors of failed trainings."""


@dataclasses.dataclass(frozen=True)
class Request:
    """Request for a reproduction."""

    out: pathlib.Path
    hands: tuple[str, ...]
    """Hands; the first is used in all tables except that of hands."""
    methods: tuple[str, ...]
    captured: tuple[pathlib.Path, ...]
    noise: bool
    """Includes rows under noise, which are in none of the paper's tables."""
    command: str
    """Command line of the request."""
    settings: PartSettings


def reproduce(
    request: Request,
    policies: AvailablePolicies,
    track: Track,
    notify: Callable[[str], None] = lambda text: None,
) -> Reproduction:
    """Evaluates all parts and writes the result; a failure does not stop the rest.

    Args:
      request: the request.
      policies: its policies; parts of missing ones are skipped.
      track: shows progress.
      notify: called with messages for the user.

    Raises:
      CongraspError: nothing could be evaluated, or the result cannot be written.
    """
    settings = dataclasses.replace(
        request.settings, physics=resolve_physics(request.settings.physics)
    )
    parts = list_parts(
        required_policies(request.hands, request.methods), request.captured, noise=request.noise
    )
    parts = [part for part in parts if part.policy in policies.entrants]
    failures = list(policies.failures)
    results: list[PartResult] = []
    advance = track("Parts", len(parts))
    for number, part in enumerate(parts, 1):
        entrant = policies.entrants[part.policy]
        try:
            result = evaluate_part(part, entrant, settings, request.out, track)
        except CongraspError as error:
            failures.append(f"{part.name}: {error}")
            notify(failures[-1])
        else:
            results.append(result)
            notify(f"{part.name}: {result.outcome()}")
        advance(number)
    if not results:
        raise CongraspError(
            "Nothing could be evaluated.",
            failures[0] if failures else "Pass --hands with a hand that has a policy.",
        )
    reproduction = Reproduction(
        results=results,
        cells=compare(results, policies.absent, request.hands),
        policies=_describe_policies(policies),
        failures=failures,
        conditions=_conditions(settings),
        command=request.command,
        curves=_training_curves(policies.trainings),
        seconds={
            "training": sum(training.seconds for training in policies.trainings.values()),
            "evaluation": sum(result.about["seconds"] for result in results),
        },
    )
    write_reproduction(reproduction, request.out)
    return reproduction


def _describe_policies(policies: AvailablePolicies) -> list[tuple[PolicyKey, str]]:
    """Returns each policy with its file and training, or the reason why it is missing."""
    descriptions = []
    for policy, entrant in policies.entrants.items():
        if not get_method(policy.method).learns:
            descriptions.append((policy, "needs none"))
            continue
        text = (
            f"{entrant.file.name}, version {entrant.policy.version}, "
            f"{entrant.policy.transitions:,} environment steps"
        )
        training = policies.trainings.get(policy)
        if training is not None:
            text += f", trained in {training.seconds / 60:.0f} min"
        descriptions.append((policy, text))
    for policy, reason in policies.absent.items():
        descriptions.append((policy, f"none: {reason}"))
    return descriptions


def _conditions(settings: PartSettings) -> str:
    """Returns a sentence on objects, engine and seed."""
    return (
        f"{settings.episodes} episodes a row on {settings.pool} held-out procedural objects, "
        f"{settings.many} on many objects, {engine_title(settings.physics)}, friction "
        f"{NOMINAL_FRICTION:g}, seed {settings.seed}."
    )


def _training_curves(trainings: Mapping[PolicyKey, Training]) -> list[Picture]:
    """Returns the first figure of each training's recordings."""
    curves = []
    for policy, training in trainings.items():
        for curve in itertools.islice(curves_of(training.run_dir), 1):
            title = f"Training of {policy.name}: {curve.title}"
            curves.append(dataclasses.replace(curve, title=title))
    return curves
