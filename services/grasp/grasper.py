"""Simulates several attempts at a grasp in parallel, and makes the best of them a motion."""

import collections
import dataclasses
import functools
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from congrasp.actors.attempts import PLAIN, Attempts, Outcome, Phases
from congrasp.actors.initial import RequestedEpisodes
from congrasp.common.episode.mirrored import mirrored_episode
from congrasp.common.errors import CongraspError, ContradictionError
from congrasp.common.hands import get_hand
from congrasp.common.hands.left import SIDE
from congrasp.common.objects.spec import GraspObject
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.request import GraspRequest
from congrasp.common.runtime.engines import PhysicsName
from congrasp.common.runtime.entry import compiling_entry
from congrasp.common.runtime.progress import Progress, ignore_progress
from congrasp.common.runtime.resources import cores
from congrasp.common.task.constraints import require_known
from congrasp.common.task.constraints.priority import contradictions, explain
from congrasp.common.wire.codec import encode
from congrasp.services.arm.robot import Infeasible
from congrasp.services.client.left_policy import mirrored_request
from congrasp.services.grasp.approaches import prescribed_path, surface_of, to_attempt, with_avoid
from congrasp.services.grasp.costs import costs, rest_ranks
from congrasp.services.grasp.motion import Grasp
from congrasp.services.grasp.reach import NoReachError, with_planned_reach

if TYPE_CHECKING:
    from congrasp.services.arm.planner import ArmPlanner

ATTEMPTS = 16
"""Number of grasps simulated in parallel."""
ROUNDS = 4
"""Maximum number of rounds; another one follows while no attempt holds."""
_UNLIKELY = 0.5
"""Cost of an attempt for each resting pose that `rest_ranks` prefers to its initial one."""
_LIGHTER = 0.25
"""Factor on the mass in the search for the cause of failures."""
_SMALLER = 0.7
"""Factor on the size in the search for the cause of failures."""
_ENOUGH_HOLDS = 0.25
"""Share of holds that confirms a cause."""
_TOUCHED = 0.2
"""Share of contacts in the avoid region at and above which an attempt does not count as a hold."""


class Round(NamedTuple):
    """Parallel attempts at an object; the first n of B are distinct."""

    obj: GraspObject
    """The object with the regions of the request."""
    request: GraspRequest
    episodes: RequestedEpisodes
    rests: np.ndarray
    """(B,) resting poses."""
    outcome: Outcome
    holds: np.ndarray
    """(n,) bool: held to the end."""

    @property
    def meets(self) -> np.ndarray:
        """(n,) bool: holds that meet the request; a hold by the avoid region does not."""
        if self.request.avoid is None:
            return self.holds
        touched = self.outcome.metrics["affordance_ratio"][: len(self.holds)]
        return self.holds & (touched < _TOUCHED)


class Attempted(NamedTuple):
    """Rounds of attempts at an object."""

    obj: GraspObject
    """The object with the regions of the request, mirrored for a left hand."""
    request: GraspRequest
    """The request, mirrored for a left hand."""
    rounds: tuple[Round, ...]

    @property
    def attempts(self) -> int:
        """Number of attempts."""
        return sum(len(one_round.holds) for one_round in self.rounds)

    @property
    def held(self) -> int:
        """Number of attempts that held the object to the end."""
        return sum(int(one_round.holds.sum()) for one_round in self.rounds)


def limiting_cause(
    obj: GraspObject,
    request: GraspRequest,
    attempt: Callable[[GraspObject, str], np.ndarray],
) -> str:
    """Returns a sentence on the cause of all failures if attempts hold a lighter or a smaller
    object, else "".

    The smaller object has the same mass. It is tried only if the request names no place in the
    object frame.

    Args:
      obj: the object that no attempt holds.
      request: the constraints.
      attempt: (changed object, activity for the progress) -> (n,) bool, which attempts hold it; a
        CongraspError skips the object.
    """
    lighter = dataclasses.replace(
        obj, mass=_LIGHTER * obj.mass, inertia=_LIGHTER * np.asarray(obj.inertia)
    )
    trials = [(lighter, "weight", f"a quarter of its {1000 * obj.mass:.0f} g")]
    if prescribed_path(request) is None and request.given("heading", "position") is None:
        smaller = obj.scaled(_SMALLER, constant_mass=True)
        trials.append((smaller, "width", f"{100 * _SMALLER:.0f} % of its size"))
    for changed, cause, change in trials:
        try:
            holds = attempt(changed, f"Checking whether its {cause} is the cause")
        except CongraspError:
            continue
        if holds.mean() >= _ENOUGH_HOLDS:
            return (
                f"Its {cause} is the cause: with {change} {holds.sum()} of {len(holds)} "
                f"attempts hold it."
            )
    return ""


class Grasper:
    """Grasps one object after another with a policy; all of them share the compiled programs."""

    @compiling_entry
    def __init__(  # noqa: PLR0913
        self,
        policy: PolicyBundle,
        *,
        attempts: int = ATTEMPTS,
        rounds: int = ROUNDS,
        phases: Phases = PLAIN,
        threads: int = 0,
        seed: int = 0,
        arm: "ArmPlanner | None" = None,
        left: bool = False,
        physics: PhysicsName = "native",
    ):
        """Compiles nothing yet.

        Args:
          policy: the policy, which names the hand.
          attempts: grasps simulated in parallel, in each round.
          rounds: maximum number of rounds; another one follows while no attempt holds.
          phases: approach, lift and hold.
          threads: threads of the physics; 0 for one per core.
          seed: seed of the attempts.
          arm: the arm that must be able to execute the motion.
          left: grasps with the left hand; the policy's right hand grasps the mirrored object
            (`common.mirror`).
          physics: engine, except `auto` and those that are compiled.
        """
        if attempts < 1:
            raise CongraspError(f"attempts is {attempts}.", "It must be at least 1.")
        if seed < 0:
            raise CongraspError(f"The seed is {seed}.", "It must be at least 0.")
        self._arm = arm
        self._hand = get_hand(policy.spec.hand)
        self.left = left
        self.hand = get_hand(self._hand.name + SIDE) if left else self._hand
        self.task = policy.task.evaluated()
        self._policy = policy
        self._attempts_count = attempts
        self._rounds = rounds
        self._seed = seed
        self._compiled = False
        self.physics = physics
        self._attempts = Attempts(
            self._hand,
            self.task,
            policy,
            threads=threads or cores(),
            phases=phases,
            physics=physics,
        )

    @functools.cached_property
    def identity(self) -> tuple[Any, ...]:
        """Inputs of a grasp other than object and request."""
        policy = bundles.content_hash(encode(self._policy.to_message()))
        arm = self._arm.identity if self._arm else ""
        # Grasps of the default engine have the identity that they had before there was a choice.
        engine = () if self.physics == "native" else (self.physics,)
        return (
            policy,
            self._attempts_count,
            self._rounds,
            self._seed,
            *self._attempts.phases,
            self.left,
            arm,
            *engine,
        )

    @compiling_entry
    def grasp(
        self,
        obj: GraspObject,
        request: GraspRequest | None = None,
        progress: Progress = ignore_progress,
    ) -> Grasp:
        """Returns the best grasp of several attempts.

        Args:
          obj: the object.
          request: constraints on the grasp; none by default.
          progress: called with the progress.

        Raises:
          UnknownConstraintError: the policy does not know one of the constraints.
          ContradictionError: two of them exclude each other.
          NoReachError: without an arm, no planned approach leads to the grasp.
          CongraspError: the table obstructs all attempts, or the arm can execute none that holds
            the object.
        """
        attempted = self.attempt(obj, request or GraspRequest(), progress)
        return self.motion(attempted, progress)

    @compiling_entry
    def attempt(
        self, obj: GraspObject, request: GraspRequest, progress: Progress = ignore_progress
    ) -> Attempted:
        """Simulates rounds of attempts until one meets the request.

        Args:
          obj: the object.
          request: constraints on the grasp.
          progress: called with the progress.

        Raises:
          UnknownConstraintError: the policy does not know one of the constraints.
          ContradictionError: two of them exclude each other.
          CongraspError: the table obstructs all attempts, or the object is out of the arm's reach.
        """
        require_known(request.constraints, self.task)
        if self.left:
            obj = obj.mirrored()
            request = mirrored_request(request)
        if request.avoid is not None:
            obj = with_avoid(obj, np.asarray(request.avoid))
        if self._arm:
            self._arm.require_reach(obj)
        attempted = self._next_round(Attempted(obj, request, ()), progress)
        while not attempted.rounds[-1].meets.any() and self._may_retry(attempted):
            attempted = self._next_round(attempted, progress)
        return attempted

    @compiling_entry
    def motion(self, attempted: Attempted, progress: Progress = ignore_progress) -> Grasp:
        """Returns the best attempt as a motion; further rounds follow if an arm can execute none.

        Raises:
          NoReachError: without an arm, no planned approach leads to the grasp.
          CongraspError: the arm can execute no attempt that holds the object.
        """
        if self._arm:
            return self._motion_on_arm(self._arm, attempted, progress)
        attempts = min(attempted.rounds, key=lambda attempts: self._cost(attempts).min())
        index = int(self._cost(attempts).argmin())
        grasp = self._grasp_of(attempts, index, attempted)
        if attempted.held:
            return grasp
        cause = self._cause(attempted.obj, attempted.request, progress)
        return dataclasses.replace(grasp, cause=cause)

    def close(self) -> None:
        """Ends the threads of the physics."""
        self._attempts.close()

    def _may_retry(self, attempted: Attempted) -> bool:
        """True if another round is left, and would not repeat the same attempts."""
        if prescribed_path(attempted.request) is not None:
            return False
        return len(attempted.rounds) < self._rounds

    def _next_round(self, attempted: Attempted, progress: Progress) -> Attempted:
        """Adds a round of attempts.

        Raises:
          ContradictionError: the trajectory leads to the avoid region.
        """
        number = len(attempted.rounds)
        activity = f"Attempting, round {number + 1}" if number else "Attempting"
        attempts = self._attempt(
            attempted.obj, attempted.request, (self._seed, number), activity, progress
        )
        if not attempts.outcome.aligned.all():
            raise ContradictionError(
                "The trajectory ends nearer to the avoid region than to the graspable part.",
                "Let it end at the graspable part, or leave out --affordance and --avoid.",
            )
        return attempted._replace(rounds=(*attempted.rounds, attempts))

    def _attempt(
        self,
        obj: GraspObject,
        request: GraspRequest,
        seed: int | tuple[int, int],
        activity: str,
        progress: Progress,
    ) -> Round:
        """Runs a round of attempts; `activity` is its name in the progress."""
        rng = np.random.default_rng(seed)
        episodes, rests, distinct = to_attempt(
            self._hand, self.task, obj, request, self._attempts_count, rng
        )
        progress(self._preparation(), 0, 0)
        self._compiled = True
        steps = self._attempts.simulated_steps
        outcome = self._attempts.run(obj, episodes, lambda step: progress(activity, step, steps))
        holds = outcome.metrics["held"][:distinct] > 0
        return Round(
            obj=obj, request=request, episodes=episodes, rests=rests, outcome=outcome, holds=holds
        )

    def _preparation(self) -> str:
        """Name of the activity before the first step of a round."""
        if self._compiled:
            return "Preparing"
        if "JAX_COMPILATION_CACHE_DIR" in os.environ:
            return "Compiling (kept for the next time)"
        return "Compiling"

    def _cost(self, attempts: Round) -> np.ndarray:
        """(n,) cost of each attempt, including the cost of an unlikely resting pose."""
        removal = self.task.approach_steps - 1
        lift = self._attempts.phases.lift
        cost = costs(attempts.outcome, tuple(attempts.request.constraints), removal, lift)
        cost = cost + _UNLIKELY * rest_ranks(attempts.obj, attempts.rests, attempts.request)
        return cost[: len(attempts.holds)]

    def _cause(self, obj: GraspObject, request: GraspRequest, progress: Progress) -> str:
        """Returns a sentence on the cause of all failures; see `limiting_cause`."""

        def attempt(changed: GraspObject, activity: str) -> np.ndarray:
            return self._attempt(changed, request, self._seed, activity, progress).holds

        return limiting_cause(obj, request, attempt)

    def _motion_on_arm(self, arm: "ArmPlanner", attempted: Attempted, progress: Progress) -> Grasp:
        """Returns the best attempt that the arm can execute, from the first round with such an
        attempt.

        Raises:
          CongraspError: the arm can execute no attempt that holds the object.
        """
        refusals: collections.Counter[str] = collections.Counter()
        first = 0
        while True:
            for attempts in attempted.rounds[first:]:
                grasp = self._plan_round(arm, attempts, attempted, refusals, progress)
                if grasp is not None:
                    return grasp
            if not self._may_retry(attempted):
                raise _no_motion(attempted.obj, arm.name, attempted.attempts, refusals)
            first = len(attempted.rounds)
            attempted = self._next_round(attempted, progress)

    def _plan_round(
        self,
        arm: "ArmPlanner",
        attempts: Round,
        attempted: Attempted,
        refusals: collections.Counter[str],
        progress: Progress,
    ) -> Grasp | None:
        """Returns the best attempt of a round that the arm can execute; None if there is none.

        Args:
          arm: planner of the arm.
          attempts: the round.
          attempted: all rounds.
          refusals: counts the limits of the arm that exclude attempts.
          progress: called for each attempt.
        """
        order = [i for i in self._cost(attempts).argsort().tolist() if attempts.meets[i]]
        for number, index in enumerate(order):
            progress(f"Moving {arm.name}", number + 1, len(order))
            try:
                grasp = self._grasp_of(attempts, index, attempted)
                planned = arm.plan(attempts.obj, grasp.motion)
            except Infeasible as limit:
                refusals[str(limit)] += 1
                continue
            except NoReachError:
                refusals["contact of every reach"] += 1
                continue
            episode = dataclasses.replace(grasp.episode, arm=planned.moved)
            return dataclasses.replace(grasp, episode=episode, arm=planned)
        return None

    def _grasp_of(self, attempts: Round, index: int, attempted: Attempted) -> Grasp:
        """Returns an attempt with its episode and active constraints."""
        obj = attempts.obj
        about = {
            "actor": "grasp",
            "physics": self.physics,
            "attempts": attempted.attempts,
            "attempts_held": attempted.held,
        }
        surface = surface_of(self.task, obj)
        episode = self._attempts.episode(attempts.outcome, index, surface, obj, about)
        seconds = self._attempts.phases.approach
        if seconds:
            side = self._arm.side if self._arm else None
            episode = with_planned_reach(
                episode, self._hand, obj, seconds, self._attempts.speed, side
            )
        if self.left:
            episode = mirrored_episode(episode, self.hand)
        return Grasp(
            episode=episode,
            attempts=attempted.attempts,
            held=attempted.held,
            rest=int(attempts.rests[index]),
            active=self._active(attempts, index),
        )

    def _active(self, attempts: Round, index: int) -> tuple[str, ...]:
        """Active constraints of an attempt and their contradictions, in sentences."""
        obj = attempts.obj
        constraints = attempts.request.constraints
        sentences = explain(tuple(constraints), bool(attempts.outcome.redirected[index]))
        complete = [
            name
            for name in constraints
            if name != "heading" or "direction" in constraints["heading"]
        ]
        goal = attempts.episodes.goal.row(index)
        conflicts = contradictions(self._hand, obj.points, obj.non_graspable_points, goal, complete)
        return (*sentences, *(conflict.message for conflict in conflicts))


def _no_motion(
    obj: GraspObject, arm: str, attempts: int, refusals: collections.Counter[str]
) -> CongraspError:
    """Error if no attempt holds the object, or the arm can execute none that does.

    Args:
      obj: the object.
      arm: name of the arm.
      attempts: number of attempts.
      refusals: numbers of attempts that violate a limit of the arm, by the name of the limit.
    """
    if not refusals:
        return CongraspError(
            f"None of {attempts} attempts holds '{obj.name}'.", "Increase --attempts."
        )
    limits = ", ".join(f"{limit} {count}" for limit, count in refusals.most_common())
    return CongraspError(
        f"{arm} can execute none of the {refusals.total()} attempts that hold '{obj.name}'. "
        f"Reasons: {limits}.",
        "Set another --base or --mount, or increase --attempts.",
    )
