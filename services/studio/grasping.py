"""Grasps of a policy for the studio: as drawn, or a variation if that fails; and the reason if none
holds.
"""

import dataclasses
import functools
import pathlib
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.actors.attempts import Attempts, Outcome, Phases
from congrasp.actors.initial import RequestedEpisodes
from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.hands import get_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.policy.pretrained import hands_with_policy, policy_file
from congrasp.common.request import GraspRequest
from congrasp.common.runtime.parallel import cores
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import get_constraint, known, require_known
from congrasp.common.task.constraints.priority import explain
from congrasp.common.transport.base import Transport
from congrasp.common.wire.codec import Message
from congrasp.services.evaluate.pictures import cause
from congrasp.services.grasp.approaches import repeated, surface_of
from congrasp.services.grasp.costs import costs
from congrasp.services.grasp.reach import with_planned_reach
from congrasp.services.serve.server import Source, follow_file, follow_run
from congrasp.services.studio.state import tool_of

ATTEMPTS = 8
"""Number of parallel grasps: the drawn one, and variations of it."""
_ASIDE, _TILT, _ROLL = 0.006, np.radians(6.0), np.radians(10.0)
"""Standard deviations of the variations: m per axis, rad, rad."""
_COMPILING = 60
"""Seconds of the first grasp on two cores of a laptop, with an empty compilation cache."""
_OTHER = 2.0
"""Cost of deviating from the drawn grasp, in addition to the costs of `services.grasp.costs`."""
SECONDS = "{seconds}"
"""Placeholder in the text of a job for its elapsed seconds."""
Progress = Callable[[str, float], None]
"""(current activity, completed share from 0 to 1)."""
Loaders = Mapping[str, Callable[[], "PolicyGrasping"]]
"""Loaders of policies, by the names that the page shows."""
Held = Callable[[GraspRequest, str], int]
"""(weaker request, name of the omitted constraint) -> number of attempts that hold."""


class PolicyGrasping:
    """A policy of a file or of a run in training; every grasp uses its newest weights."""

    def __init__(self, source: Source, name: str):
        """Loads the policy; compiles nothing yet.

        Args:
          source: source of its weights.
          name: its name on the page.

        Raises:
          CongraspError: the source has no policy yet.
        """
        first = source(-1)
        if first is None:
            raise CongraspError(
                f"There is no policy of {name} yet.",
                "Start the studio when the run has published one.",
            )
        self._source, self._name, self._policy = source, name, first
        self._trouble = ""
        self.hand = get_hand(first.spec.hand)
        self.task = first.task.evaluated()
        self._attempts = Attempts(self.hand, self.task, first, threads=cores())
        self._compiled, self._free = False, threading.Lock()

    def newest(self) -> dict[str, Any]:
        """Source and version; `trouble` is the reason why newer weights were not taken, or
        empty.
        """
        return {"source": self._name, "version": self._policy.version, "trouble": self._trouble}

    def refresh(self) -> None:
        """Takes newer weights, if there are any that fit."""
        try:
            newer = self._source(self._policy.version)
            if newer is not None:
                self._attempts.renew(newer)
                self._policy = newer
            self._trouble = ""
        except TransportError:
            self._trouble = "The learner is disconnected; these are its last weights."
        except CongraspError as error:
            self._trouble = str(error)

    def grasp(
        self, obj: GraspObject, request: GraspRequest, phases: Phases, progress: Progress
    ) -> Message:
        """Returns the episode of the drawn grasp, or of a variation that clearly holds or meets the
        constraints better.

        `note` in its metadata names a variation, or explains why none held.

        Raises:
          CongraspError: the policy lacks a constraint, or no reach leads to the grasp.
        """
        if not self._free.acquire(blocking=False):
            progress(f"waiting for the grasp of another browser, {SECONDS} s", 0.0)
            self._free.acquire()
        try:
            return self._grasp(obj, request, phases, progress)
        finally:
            self._free.release()

    def _grasp(
        self, obj: GraspObject, request: GraspRequest, phases: Phases, progress: Progress
    ) -> Message:
        """Does the work of `grasp`; the caller holds the lock."""
        self._attempts.phases = phases
        first_time = not self._compiled
        progress(
            f"compiling, {SECONDS} s of about {_COMPILING}" if first_time else "newest weights",
            0.02,
        )
        self.refresh()
        require_known(request.constraints, self.task)
        outcome, aside = self._attempt(obj, request, lambda share: progress("grasping", share))
        self._compiled = True
        index = _best(
            outcome, tuple(request.constraints), self.task.approach_steps - 1, phases.lift
        )
        about = {"actor": "studio", "note": _note(outcome, index, aside)}
        episode = self._attempts.episode(outcome, index, surface_of(self.task, obj), obj, about)
        if phases.approach:
            progress("reach", 1.0)
            episode = with_planned_reach(
                episode, self.hand, obj, phases.approach, self._attempts.speed
            )
        if (outcome.metrics["held"] > 0).any():
            return episode

        def held(weaker: GraspRequest, without: str) -> int:
            """Returns the number of attempts that hold under a weaker request."""
            text = f"nothing held; without the {get_constraint(without).title}"
            found, _ = self._attempt(obj, weaker, lambda share: progress(text, share))
            return int((found.metrics["held"] > 0).sum())

        asked = tuple(name for name in request.constraints if get_constraint(name).optional)
        note = why_nothing_held(
            episode,
            request,
            explain(asked, bool(outcome.redirected[index])),
            held,
            attempts=ATTEMPTS,
            drop_height=self.task.drop_height,
        )
        return Message(episode.arrays, {**episode.meta, "note": note})

    def _attempt(
        self, obj: GraspObject, request: GraspRequest, progress: Callable[[float], None]
    ) -> tuple[Outcome, np.ndarray]:
        """Outcome of a request and its variations, and the distance (B,) of each from the request,
        m.
        """
        episodes, aside = _episodes(self.hand, self.task, obj, request)
        steps = self._attempts.simulated_steps
        return self._attempts.run(obj, episodes, lambda step: progress(step / steps)), aside


def pretrained() -> Loaders:
    """The pretrained and custom policies, by the names of their hands."""
    return {
        name: functools.partial(
            PolicyGrasping, follow_file(policy_file(None, name)), "pretrained policy"
        )
        for name in hands_with_policy()
    }


def of_file(path: pathlib.Path) -> Loaders:
    """The policy of a file, reread whenever it changes."""
    return {"of the policy": functools.partial(PolicyGrasping, follow_file(path), path.name)}


def of_run(transport: Transport, run: str, name: str) -> Loaders:
    """The newest policy of a run, pulled from its learner under this process's name on the wire."""
    return {
        "of the run": functools.partial(
            PolicyGrasping, follow_run(transport, run, name), f"the run '{run}'"
        )
    }


def _episodes(
    hand: Hand, task: TaskConfig, obj: GraspObject, request: GraspRequest
) -> tuple[RequestedEpisodes, np.ndarray]:
    """`ATTEMPTS` episodes, the first as drawn, and the distance (B,) of each from it, m."""
    rng = np.random.default_rng(0)
    drawn = repeated(hand, task, obj, request, ATTEMPTS)
    goal = drawn.goal
    others = np.arange(ATTEMPTS) > 0
    shift = (rng.normal(0.0, _ASIDE, (ATTEMPTS, 3)) * others[:, None]).astype(np.float32)
    tilt, roll = (rng.normal(0.0, sigma, ATTEMPTS) * others for sigma in (_TILT, _ROLL))
    direction, cross = goal["heading"].direction, goal["heading"].cross
    third = np.cross(direction, cross)
    way = rng.uniform(0.0, 2 * np.pi, ATTEMPTS)
    axis = np.cos(way)[:, None] * cross + np.sin(way)[:, None] * third
    turn = Rotation.from_rotvec(tilt[:, None] * axis + roll[:, None] * direction)
    turned = {
        "direction": turn.apply(direction).astype(np.float32),
        "cross": turn.apply(cross).astype(np.float32),
    }
    goal = goal.replace("heading", **turned)
    for constraint in known(task):
        if "position" in constraint.arrays:
            place = goal[constraint.name].position
            goal = goal.replace(
                constraint.name, position=place + shift.reshape(-1, *[1] * (place.ndim - 2), 3)
            )
    return drawn._replace(goal=goal), np.linalg.norm(shift, axis=-1)


def _best(outcome: Outcome, constraints: tuple[str, ...], removal: int, lift: float) -> int:
    """Index of the drawn grasp, or of a variation that clearly holds or meets the constraints
    better.
    """
    return int(
        np.argmin(costs(outcome, constraints, removal, lift) + _OTHER * (np.arange(ATTEMPTS) > 0))
    )


def _note(outcome: Outcome, index: int, aside: np.ndarray) -> str:
    """Reason why a variation is shown; empty if the drawn grasp is shown, or none held."""
    held = outcome.metrics["held"] > 0
    if held.any() and index:
        why = "is better than the drawn grasp" if held[0] else "holds; the drawn grasp does not"
        return (
            f"This variation, the best of {ATTEMPTS - 1}, {why}: it is {1000 * aside[index]:.0f} "
            f"mm away."
        )
    return ""


def why_nothing_held(
    episode: Message,
    request: GraspRequest,
    explanation: list[str],
    held: Held,
    *,
    attempts: int,
    drop_height: float,
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
    advice = (
        f"{explanation[0]} Try another {get_constraint(guides[-1] if guides else 'heading').title}."
    )
    return (
        f"{text} Leaving out any one constraint does not help. {advice}"
        if found
        else f"{text} {advice}"
    )


def _weaker(request: GraspRequest) -> Iterator[tuple[str, GraspRequest]]:
    """The request without one of its optional constraints, for each of them."""
    for name in request.constraints:
        if get_constraint(name).optional:
            kept = {other: fields for other, fields in request.constraints.items() if other != name}
            avoid = None if tool_of(get_constraint(name)) == "paint" else request.avoid
            yield name, dataclasses.replace(request, constraints=kept, avoid=avoid)
