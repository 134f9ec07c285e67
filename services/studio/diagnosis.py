"""Diagnosis of failed grasps: the cause in the shown attempt, and the constraint that prevents a hold."""

import dataclasses
from collections.abc import Callable, Iterator

from congrasp.common.request import GraspRequest
from congrasp.common.task.constraints import get_constraint
from congrasp.common.wire.codec import Message
from congrasp.services.evaluate.pictures import cause

Held = Callable[[GraspRequest, str], int]
"""(weaker request, name of the omitted constraint) -> number of attempts that hold."""


def why_nothing_held(
    episode: Message, request: GraspRequest, explanation: list[str], held: Held, *, attempts: int, drop_height: float
) -> str:
    """Explains a failed grasp to the user in a few sentences.

    Args:
      episode: the shown attempt.
      request: its request.
      explanation: effects of the priority rules on it, strongest constraint first.
      held: repeats the attempts under a weaker request.
      attempts: number of attempts.
      drop_height: drop at which the object counts as fallen, m.
    """
    text = f"None of {attempts} attempts held. The one shown: {cause(episode, drop_height)}."
    found = {name: held(weaker, name) for name, weaker in _weaker(request)}
    best = max(found, key=lambda name: found[name], default="")
    if best and found[best]:
        title = get_constraint(best).title
        return f"{text} The {title} decided: without it {found[best]} of {attempts} hold."
    guides = [name for name in request.constraints if "heading" in get_constraint(name).overrides]
    advice = f"{explanation[0]} Try another {get_constraint(guides[-1] if guides else 'heading').title}."
    return f"{text} None holds without any one of the constraints either. {advice}" if found else f"{text} {advice}"


def _weaker(request: GraspRequest) -> Iterator[tuple[str, GraspRequest]]:
    """The request without one of its optional constraints, for each of them."""
    for name in request.constraints:
        if get_constraint(name).optional:
            kept = {other: fields for other, fields in request.constraints.items() if other != name}
            avoid = None if name == "affordance" else request.avoid
            yield name, dataclasses.replace(request, constraints=kept, avoid=avoid)
