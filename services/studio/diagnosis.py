"""Why nothing held: how the shown attempt failed, and which constraint it takes to leave out."""

import dataclasses
from collections.abc import Callable, Iterator

from congrasp.common.request import GraspRequest
from congrasp.common.task.constraints import get_constraint
from congrasp.common.wire.codec import Message
from congrasp.services.evaluate.failures import cause

Held = Callable[[GraspRequest, str], int]
"""(request, what is left out of it) -> how many of the attempts under it hold."""


def why_nothing_held(
    episode: Message, request: GraspRequest, explanation: list[str], held: Held, *, attempts: int, drop_height: float
) -> str:
    """A few sentences for the user.

    Args:
      episode: the attempt that is shown.
      request: what it was asked for.
      explanation: what the priority rules do with it, strongest constraint first.
      held: attempts it again under a weaker request.
      attempts: how many there are at once.
      drop_height: m below where it was at which the object has fallen.
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
