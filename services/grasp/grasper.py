"""A grasp motion for one object under constraints: several attempts at once, of which the best is
kept.
"""

import collections
import dataclasses
import functools
import os
import pathlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from congrasp.actors.attempts import PLAIN, Attempts, Outcome, Phases
from congrasp.actors.initial import RequestedEpisodes
from congrasp.common import mirror
from congrasp.common.errors import CongraspError, ContradictionError
from congrasp.common.hands import get_hand
from congrasp.common.hands.left import LEFT, right_name
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.resting import upright_rest
from congrasp.common.objects.spec import GraspObject
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.policy.pretrained import policy_file
from congrasp.common.request import GraspRequest
from congrasp.common.runtime.entry import compiling_entry
from congrasp.common.runtime.parallel import cores
from congrasp.common.task.constraints import require_known
from congrasp.common.task.constraints.priority import contradictions, explain
from congrasp.common.wire.codec import Message, encode
from congrasp.services.arm import ArmOptions
from congrasp.services.arm.robot import Infeasible
from congrasp.services.assets.objects.named import one_object
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.client.left_policy import mirrored_request
from congrasp.services.export.motion_file import motion_of_episode
from congrasp.services.grasp.approaches import prescribed, surface_of, to_attempt, with_avoid
from congrasp.services.grasp.motion import Grasp, costs
from congrasp.services.grasp.parse import read_request
from congrasp.services.grasp.reach import NoReachError, with_planned_reach

if TYPE_CHECKING:
    from congrasp.services.arm.planner import ArmPlanner

ATTEMPTS = 16
"""Number of grasps simulated in parallel."""
ROUNDS = 4
"""Maximum number of rounds; another one follows while no attempt holds."""
_UNLIKELY = 0.5
"""Cost of an attempt for each resting pose that `_places` prefers to its initial one."""
_LIGHTER, _SMALLER, _ENOUGH = 0.25, 0.7, 0.25
"""Factors on mass and size in the search for the cause of failures, and the share of holds that
confirms it.
"""
_TOUCHED = 0.2
"""Share of contacts in the avoid region at and above which an attempt does not count as a hold."""

Progress = Callable[[str, int, int], None]
"""Called with the current activity, the completed steps and the number of steps."""


class _Round(NamedTuple):
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
        return self.holds & (self.outcome.metrics["affordance_ratio"][: len(self.holds)] < _TOUCHED)


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
        """
        if attempts < 1:
            raise CongraspError(f"There are {attempts} attempts.", "Make one or more.")
        if seed < 0:
            raise CongraspError(f"The seed is {seed}.", "Use 0 or more.")
        self._arm = arm
        self._hand, self._left = get_hand(policy.spec.hand), left
        self.hand = get_hand(self._hand.name + LEFT) if left else self._hand
        self.task = policy.task.evaluated()
        self._policy, self._attempts_count, self._rounds, self._seed = (
            policy,
            attempts,
            rounds,
            seed,
        )
        self._compiled = False
        self._attempts = Attempts(
            self._hand, self.task, policy, threads=threads or cores(), phases=phases
        )

    @functools.cached_property
    def identity(self) -> tuple[Any, ...]:
        """Inputs of a grasp other than object and request."""
        policy = bundles.content_hash(encode(self._policy.to_message()))
        arm = self._arm.identity if self._arm else ""
        return (
            policy,
            self._attempts_count,
            self._rounds,
            self._seed,
            *self._attempts.phases,
            self._left,
            arm,
        )

    @compiling_entry
    def grasp(
        self,
        obj: GraspObject,
        request: GraspRequest | None = None,
        progress: Progress = lambda what, done, total: None,
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
        request = request or GraspRequest()
        require_known(request.constraints, self.task)
        if self._left:
            obj, request = obj.mirrored(), mirrored_request(request)
        obj = obj if request.avoid is None else with_avoid(obj, request.avoid)
        best: tuple[_Round, np.ndarray] | None = None
        refused: collections.Counter[str] = collections.Counter()
        held = attempts = 0
        for number in range(self._rounds):
            what = f"Attempting, round {number + 1}" if number else "Attempting"
            tried = self._attempt(obj, request, (self._seed, number), what, progress)
            if not tried.outcome.aligned.all():
                raise ContradictionError(
                    "The trajectory ends nearer to the avoid region than to the graspable part.",
                    "Let it end at the graspable part, or leave out --affordance and --avoid.",
                )
            cost = self._cost(tried)
            attempts, held = attempts + len(tried.holds), held + int(tried.holds.sum())
            if self._arm:
                found = self._on_arm(self._arm, tried, cost, attempts, held, refused, progress)
                if found is not None:
                    return found
            elif best is None or cost.min() < best[1].min():
                best = tried, cost
            if prescribed(request) is not None or (best is not None and tried.meets.any()):
                break  # another round would repeat these attempts, or is not needed
        if self._arm:
            raise _no_motion(obj, self._arm.name, attempts, refused)
        assert best is not None
        found = self._motion(best[0], int(best[1].argmin()), attempts, held)
        return (
            found if held else dataclasses.replace(found, cause=self._cause(obj, request, progress))
        )

    def close(self) -> None:
        """Ends the threads of the physics."""
        self._attempts.close()

    def _attempt(
        self,
        obj: GraspObject,
        request: GraspRequest,
        seed: int | tuple[int, int],
        what: str,
        progress: Progress,
    ) -> _Round:
        """Runs a round of attempts; `what` is its name in the progress."""
        rng, count = np.random.default_rng(seed), self._attempts_count
        episodes, rests, different = to_attempt(self._hand, self.task, obj, request, count, rng)
        progress("Preparing" if self._compiled else "Compiling (kept for the next time)", 0, 1)
        self._compiled = True
        outcome = self._attempts.run(
            obj, episodes, lambda step: progress(what, step, self._attempts.steps)
        )
        holds = outcome.metrics["held"][:different] > 0
        return _Round(
            obj=obj, request=request, episodes=episodes, rests=rests, outcome=outcome, holds=holds
        )

    def _cost(self, tried: _Round) -> np.ndarray:
        """(n,) cost of each attempt, with that of its resting pose."""
        removal, lift = self.task.approach_steps - 1, self._attempts.phases.lift
        cost = costs(tried.outcome, tuple(tried.request.constraints), removal, lift)
        return (cost + _UNLIKELY * _places(tried.obj, tried.rests, tried.request))[
            : len(tried.holds)
        ]

    def _cause(self, obj: GraspObject, request: GraspRequest, progress: Progress) -> str:
        """Returns a sentence on the cause of all failures if attempts hold a lighter or a smaller
        object, else "".

        The smaller object has the same mass. It is tried only if the request names no place in the
        object frame.
        """
        lighter = dataclasses.replace(
            obj, mass=_LIGHTER * obj.mass, inertia=_LIGHTER * np.asarray(obj.inertia)
        )
        trials = [(lighter, "weight", f"a quarter of its {1000 * obj.mass:.0f} g")]
        if prescribed(request) is None and request.given("heading", "position") is None:
            smaller = obj.scaled(_SMALLER, constant_mass=True)
            trials.append((smaller, "width", f"{100 * _SMALLER:.0f} % of its size"))
        for changed, cause, how in trials:
            what = f"Checking whether its {cause} is the cause"
            try:
                holds = self._attempt(changed, request, self._seed, what, progress).holds
            except CongraspError:
                continue
            if holds.mean() >= _ENOUGH:
                return (
                    f"Its {cause} is the cause: with {how} {holds.sum()} of {len(holds)} attempts "
                    f"hold it."
                )
        return ""

    def _on_arm(
        self,
        arm: "ArmPlanner",
        tried: _Round,
        cost: np.ndarray,
        attempts: int,
        held: int,
        refused: collections.Counter[str],
        progress: Progress,
    ) -> Grasp | None:
        """Returns the best attempt that the arm can execute; `refused` counts the limits that
        exclude better ones.
        """
        order = [i for i in cost.argsort().tolist() if tried.meets[i]]
        for number, index in enumerate(order):
            progress(f"Moving {arm.name}", number + 1, len(order))
            try:
                found = self._motion(tried, index, attempts, held)
                planned = arm.plan(tried.obj, found.motion)
                episode = planned.moved.recorded(found.episode)
                return dataclasses.replace(
                    found, episode=episode, motion=motion_of_episode(episode), arm=planned
                )
            except Infeasible as limit:
                refused[str(limit)] += 1
            except NoReachError:
                refused["contact of every reach"] += 1
        return None

    def _motion(self, tried: _Round, index: int, attempts: int, held: int) -> Grasp:
        """Returns an attempt with its episode, motion and active constraints."""
        obj, given = tried.obj, tried.request.constraints
        about = {
            "actor": "grasp",
            "attempts": attempts,
            "attempts_held": held,
            "object_file_scale": obj.file_scale,
            "object_file_origin": [-x for x in obj.origin],
        }
        episode = self._attempts.episode(
            tried.outcome, index, surface_of(self.task, obj), obj, about
        )
        if approach := self._attempts.phases.approach:
            side = self._arm.side if self._arm else None
            episode = with_planned_reach(
                episode, self._hand, obj, approach, self._attempts.speed, side
            )
        if self._left:
            episode = _mirrored(episode, self.hand)
        active = explain(tuple(given), bool(tried.outcome.redirected[index]))
        written = [name for name in given if name != "heading" or "direction" in given[name]]
        goal = tried.episodes.goal.row(index)
        against = contradictions(self._hand, obj.points, obj.non_graspable_points, goal, written)
        active += [found.message for found in against]
        rest = int(tried.rests[index])
        return Grasp(episode, motion_of_episode(episode), attempts, held, rest, tuple(active))


@compiling_entry
def open_grasper(
    policy: pathlib.Path | None,
    hand: str,
    attempts: int = ATTEMPTS,
    seed: int = 0,
    phases: Phases = PLAIN,
    arm: ArmOptions = ArmOptions(),  # noqa: B008
) -> Grasper:
    """Returns a grasper with a policy file, or with the pretrained policy of a hand.

    Args:
      policy: the file, or None.
      hand: name of the hand; `human:left` is the left one of `human`.
      attempts: grasps simulated in parallel.
      seed: seed of the attempts.
      phases: approach, lift and hold.
      arm: the arm that carries the hand, if it names one.

    Raises:
      CongraspError: there is no such policy, hand or arm, or the hand on the arm is a left one.
    """
    right, left = right_name(hand)
    if left and arm.arm:
        raise CongraspError("Arms carry right hands only.", "Leave out --arm or :left.")
    bundle, planner = bundles.load(policy_file(policy, right)), None
    if arm.arm:
        from congrasp.services.arm.planner import ArmPlanner

        planner = ArmPlanner(arm, get_hand(bundle.spec.hand), seed)
    return Grasper(bundle, attempts=attempts, phases=phases, seed=seed, arm=planner, left=left)


@compiling_entry
def grasp(
    mesh: str | os.PathLike[str] | GraspObject,
    *,
    policy: str | os.PathLike[str] | None = None,
    hand: str = "human",
    options: ImportOptions | None = None,
    attempts: int = ATTEMPTS,
    seed: int = 0,
    progress: Progress = lambda what, done, total: None,
    **constraints: Any,
) -> Grasp:
    """Returns the best grasp motion of an object under constraints; compiled programs are kept for
    the next call.

    Example:
      import congrasp

      found = congrasp.grasp("mug:7", heading="above", attempts=8)
      print(found.success, found.held, "of", found.attempts, "attempts hold it")

    Args:
      mesh: a mesh (STL, OBJ, PLY, GLB), an object file, FAMILY:SEED of the generator, or an object.
      policy: a policy file; the pretrained policy of the hand by default.
      hand: name of the hand; `human:left` is the left one of `human`.
      options: import options of a mesh.
      attempts: grasps simulated in parallel.
      seed: seed of the attempts.
      progress: called with the progress.
      **constraints: the options of `congrasp grasp`: heading, at, affordance, avoid, pose,
        trajectory, fingers, …; each is the text that the command line takes, or a sequence of its
        words or numbers.

    Raises:
      CongraspError: the object cannot be imported, or a constraint cannot be read or met.
    """
    file = policy_file(None if policy is None else pathlib.Path(policy), right_name(hand)[0])
    grasper = _grasper(file, file.stat().st_mtime_ns if file.exists() else 0, hand, attempts, seed)
    obj = (
        mesh
        if isinstance(mesh, GraspObject)
        else one_object(pathlib.Path(mesh), options or ImportOptions("guess"))
    )
    request = read_request(obj, grasper.hand, grasper.task.trajectory_points, **constraints)
    return grasper.grasp(obj, request, progress)


@functools.lru_cache(maxsize=2)
def _grasper(file: pathlib.Path, changed: int, hand: str, attempts: int, seed: int) -> Grasper:
    """The grasper of a policy file, by its time of modification `changed`."""
    return open_grasper(file, hand, attempts, seed)


def _mirrored(episode: Message, hand: Hand) -> Message:
    """Returns the episode of the left hand, from one of the right hand with the mirrored object."""
    origin = mirror.vector(episode.meta["object_file_origin"]).tolist()
    meta = {**episode.meta, "hand": hand.reference, "object_file_origin": origin}
    return Message(mirror.fields(episode.arrays), meta)


def _no_motion(
    obj: GraspObject, arm: str, attempts: int, refused: collections.Counter[str]
) -> CongraspError:
    """Error if an arm can execute no attempt that holds the object, with the limits that forbid
    them.
    """
    if not refused:
        return CongraspError(
            f"None of {attempts} attempts holds '{obj.name}'.", "Set more --attempts."
        )
    limits = ", ".join(f"{limit} {count}" for limit, count in refused.most_common())
    return CongraspError(
        f"{arm} can execute none of the {refused.total()} attempts that hold '{obj.name}'. "
        f"Reasons: {limits}.",
        "Set another --base or --mount, or more --attempts.",
    )


def _places(obj: GraspObject, rests: np.ndarray, request: GraspRequest) -> np.ndarray:
    """(B,) ranks of the resting poses: upright first, then by likelihood; zeros if the request
    names one.
    """
    if request.rest is not None:
        return np.zeros_like(rests)
    upright = upright_rest(obj)
    return rests if upright is None else np.where(rests == upright, 0, rests + (rests < upright))
