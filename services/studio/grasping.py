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
from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.hands import get_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.policy.pretrained import hands_with_policy, policy_file
from congrasp.common.request import GraspRequest
from congrasp.common.runtime.resources import cores
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import get_constraint, known, require_known
from congrasp.common.task.constraints.priority import explain
from congrasp.common.transport.base import Transport
from congrasp.services.evaluate.pictures import cause
from congrasp.services.grasp.approaches import equal_episodes, surface_of
from congrasp.services.grasp.costs import costs
from congrasp.services.grasp.reach import with_planned_reach
from congrasp.services.serve.sources import Source, follow_file, follow_run
from congrasp.services.studio.state import tool_of

ATTEMPTS = 8
"""Number of parallel grasps: the drawn one, and variations of it."""
_SHIFT_SIGMA_M = 0.006
"""Standard deviation of a variation's position per axis."""
_TILT_SIGMA = np.radians(6.0)
"""Standard deviation of its tilt, rad."""
_ROLL_SIGMA = np.radians(10.0)
"""Standard deviation of its roll, rad."""
_COMPILING_S = 60
"""Time of the first grasp on two cores of a laptop, with an empty compilation cache."""
_VARIATION_COST = 2.0
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
                "Start the studio after the run has published a policy.",
            )
        self._source = source
        self._name = name
        self._policy = first
        self._trouble = ""
        self.hand = get_hand(first.spec.hand)
        self.task = first.task.evaluated()
        self._attempts = Attempts(self.hand, self.task, first, threads=cores())
        self._compiled = False
        self._free = threading.Lock()

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
    ) -> Episode:
        """Returns the episode of the drawn grasp, or of a variation that clearly holds or meets the
        constraints better.

        `note` in `about` names a variation, or explains why none held.

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
    ) -> Episode:
        """Does the work of `grasp`; the caller holds the lock."""
        self._attempts.phases = phases
        activity = "newest weights"
        if not self._compiled:
            activity = f"compiling, {SECONDS} s of about {_COMPILING_S}"
        progress(activity, 0.02)
        self.refresh()
        require_known(request.constraints, self.task)
        outcome, distances = self._attempt(obj, request, lambda share: progress("grasping", share))
        self._compiled = True
        removal = self.task.approach_steps - 1
        index = best_attempt(outcome, tuple(request.constraints), removal, phases.lift)
        about = {"actor": "studio", "note": variation_note(outcome, index, distances)}
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
            weaker_outcome, _ = self._attempt(obj, weaker, lambda share: progress(text, share))
            return int((weaker_outcome.metrics["held"] > 0).sum())

        requested = tuple(name for name in request.constraints if get_constraint(name).optional)
        explanation = explain(requested, bool(outcome.redirected[index]))
        note = why_nothing_held(
            episode,
            request,
            explanation,
            held,
            attempts=ATTEMPTS,
            drop_height=self.task.drop_height,
        )
        return dataclasses.replace(episode, about={**episode.about, "note": note})

    def _attempt(
        self, obj: GraspObject, request: GraspRequest, progress: Callable[[float], None]
    ) -> tuple[Outcome, np.ndarray]:
        """Outcome of a request and its variations, and the distance (B,) of each from the request,
        m.
        """
        episodes, distances = varied_episodes(self.hand, self.task, obj, request)
        steps = self._attempts.simulated_steps
        outcome = self._attempts.run(obj, episodes, lambda step: progress(step / steps))
        return outcome, distances


def pretrained() -> Loaders:
    """The pretrained and custom policies, by the names of their hands."""
    loaders: dict[str, Callable[[], PolicyGrasping]] = {}
    for name in hands_with_policy():
        source = follow_file(policy_file(None, name))
        loaders[name] = functools.partial(PolicyGrasping, source, "pretrained policy")
    return loaders


def of_file(path: pathlib.Path) -> Loaders:
    """The policy of a file, reread whenever it changes."""
    return {"of the policy": functools.partial(PolicyGrasping, follow_file(path), path.name)}


def of_run(transport: Transport, run: str, name: str) -> Loaders:
    """The newest policy of a run, pulled from its learner under this process's name on the wire."""
    source = follow_run(transport, run, name)
    return {"of the run": functools.partial(PolicyGrasping, source, f"the run '{run}'")}


def varied_episodes(
    hand: Hand, task: TaskConfig, obj: GraspObject, request: GraspRequest
) -> tuple[RequestedEpisodes, np.ndarray]:
    """Returns `ATTEMPTS` episodes, the first as drawn and the others near it, and the distance (B,)
    of each from the drawn grasp, m.
    """
    rng = np.random.default_rng(0)
    drawn = equal_episodes(hand, task, obj, request, ATTEMPTS)
    goal = drawn.goal
    is_variation = np.arange(ATTEMPTS) > 0
    shift = rng.normal(0.0, _SHIFT_SIGMA_M, (ATTEMPTS, 3)) * is_variation[:, None]
    shift = shift.astype(np.float32)
    tilt = rng.normal(0.0, _TILT_SIGMA, ATTEMPTS) * is_variation
    roll = rng.normal(0.0, _ROLL_SIGMA, ATTEMPTS) * is_variation
    direction = goal["heading"].direction
    cross = goal["heading"].cross
    third = np.cross(direction, cross)
    azimuth = rng.uniform(0.0, 2 * np.pi, ATTEMPTS)
    tilt_axis = np.cos(azimuth)[:, None] * cross + np.sin(azimuth)[:, None] * third
    turn = Rotation.from_rotvec(tilt[:, None] * tilt_axis + roll[:, None] * direction)
    goal = goal.replace(
        "heading",
        direction=turn.apply(direction).astype(np.float32),
        cross=turn.apply(cross).astype(np.float32),
    )
    for constraint in known(task):
        if "position" not in constraint.arrays:
            continue
        position = goal[constraint.name].position
        along_path = [1] * (position.ndim - 2)
        shifted = position + shift.reshape(-1, *along_path, 3)
        goal = goal.replace(constraint.name, position=shifted)
    return drawn._replace(goal=goal), np.linalg.norm(shift, axis=-1)


def best_attempt(outcome: Outcome, constraints: tuple[str, ...], removal: int, lift: float) -> int:
    """Returns the index of the drawn grasp, or of a variation that clearly holds or meets the
    constraints better.

    Args:
      outcome: outcome of `ATTEMPTS` attempts, the drawn one first.
      constraints: names of the requested constraints.
      removal: control step of the table's removal.
      lift: height of the lift, m.
    """
    penalty = _VARIATION_COST * (np.arange(ATTEMPTS) > 0)
    return int(np.argmin(costs(outcome, constraints, removal, lift) + penalty))


def variation_note(outcome: Outcome, index: int, distances: np.ndarray) -> str:
    """Returns the reason why a variation is shown; empty if the drawn grasp is shown, or none held.

    Args:
      outcome: outcome of the attempts.
      index: index of the shown attempt.
      distances: (B,) distance of each attempt from the drawn grasp, m.
    """
    held = outcome.metrics["held"] > 0
    if index == 0 or not held.any():
        return ""
    why = "is better than the drawn grasp" if held[0] else "holds; the drawn grasp does not"
    return (
        f"This variation, the best of {ATTEMPTS - 1}, {why}: it is {1000 * distances[index]:.0f} "
        f"mm away."
    )


def why_nothing_held(
    episode: Episode,
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
    held_without = {name: held(weaker, name) for name, weaker in _weaker(request)}
    best = max(held_without, key=lambda name: held_without[name], default="")
    if best and held_without[best]:
        title = get_constraint(best).title
        return f"{text} The {title} decided: without it {held_without[best]} of {attempts} hold."
    guides = [name for name in request.constraints if "heading" in get_constraint(name).overrides]
    guide = guides[-1] if guides else "heading"
    advice = f"{explanation[0]} Try another {get_constraint(guide).title}."
    if not held_without:
        return f"{text} {advice}"
    return f"{text} Leaving out any one constraint does not help. {advice}"


def _weaker(request: GraspRequest) -> Iterator[tuple[str, GraspRequest]]:
    """The request without one of its optional constraints, for each of them."""
    for name in request.constraints:
        constraint = get_constraint(name)
        if constraint.optional:
            others = dict(request.constraints)
            del others[name]
            avoid = None if tool_of(constraint) == "paint" else request.avoid
            yield name, dataclasses.replace(request, constraints=others, avoid=avoid)
