"""A grasp motion for one object under constraints: several attempts at once, of which the best is kept."""

import collections
import dataclasses
import functools
import os
import pathlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from congrasp.actors.attempts import PLAIN, Attempts, Outcome, Phases
from congrasp.actors.initial import RequestedEpisodes
from congrasp.actors.stress import ASSESSED, SURVIVAL
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
from congrasp.common.runtime.parallel import cores
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import CONSTRAINTS, goal_of, optional, require_known
from congrasp.common.task.constraints.priority import contradictions, explain
from congrasp.common.task.types import Goal, Surface
from congrasp.common.wire.codec import Message
from congrasp.services.arm.robot import Infeasible
from congrasp.services.assets.objects.named import one_object
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.client.left import mirrored_request
from congrasp.services.export.motion_file import GraspMotion, motion_of_episode
from congrasp.services.grasp.approaches import headings, prescribed, valid_rests
from congrasp.services.grasp.parse import read_request
from congrasp.services.grasp.reach import NoReachError, with_planned_reach

if TYPE_CHECKING:
    from congrasp.services.arm.planner import ArmMotion, ArmPlanner

ATTEMPTS = 16
"""Number of grasps simulated in parallel."""
ROUNDS = 4
"""Maximum number of rounds; a round follows another while no attempt holds."""
_SCALES = {spec.name: spec.scale for constraint in CONSTRAINTS for spec in constraint.errors}
_SCALES |= {"moved_at_removal": 0.01, "force_link_max": 10.0, "slip": 0.02}
"""Scales that make costs of grasps that hold comparable: errors, displacement of the object before table removal (m),
force of the strongest link (N), and displacement after removal (m)."""
_FIRM = ("clean", *SURVIVAL)
"""Metrics that add a cost of 1 where they are zero."""
_UNLIKELY = 0.5
"""Cost of each resting pose that is preferred to a grasp's initial one, see `_places`."""
_LIGHTER, _SMALLER, _ENOUGH = 0.25, 0.7, 0.25
"""Factors of mass and of size by which the cause of failures is looked for, and the share of holds that shows it."""
_TOUCHED = 0.2
"""Share of contacts in the avoid region at and above which an attempt does not count as a hold."""

Progress = Callable[[str, int, int], None]
"""Called with the current activity, the completed steps and the number of steps."""


@dataclasses.dataclass(frozen=True, eq=False)
class Grasp:
    """The best of some attempts."""

    episode: Message
    """The whole episode, in the format of recordings."""
    motion: GraspMotion
    """Content of the NPZ."""
    attempts: int
    """Number of simulated attempts."""
    held: int
    """Number of those that held the object to the end."""
    rest: int
    """Index of the initial resting pose."""
    active: tuple[str, ...]
    """Active constraints and the reasons, in sentences."""
    arm: "ArmMotion | None" = None
    """The motion of the arm, if there is one."""
    cause: str = ""
    """Why no attempt holds the object, in a sentence, if it is its weight or its width."""

    @property
    def success(self) -> bool:
        """True if this attempt held the object to the end."""
        return self.motion.metrics["held"] > 0

    @property
    def sink(self) -> float:
        """Largest drop of the wrist during the hold, m."""
        height = self.motion.wrist_position[self.first("hold") :, 2]
        return float(max(height[0] - height.min(), 0.0))

    @property
    def shove(self) -> float:
        """Largest displacement of the object before it is lifted or the table is removed, m."""
        phase = "lift" if "lift" in self.motion.about["phases"] else "hold"
        moved = self.motion.object_position[: self.first(phase)] - self.motion.object_position[0]
        return float(np.linalg.norm(moved, axis=-1).max())

    def first(self, phase: str) -> int:
        """The first step of a phase."""
        begin = self.motion.about["phases"][phase]
        return min(int(np.searchsorted(self.motion.time, begin - 1e-6)), len(self.motion.time) - 1)

    def facts(self) -> dict[str, Any]:
        """Result, attempts and errors, for tables and files."""
        return {
            "object": self.motion.object,
            "hand": self.motion.hand,
            "success": self.success,
            "held_quarter_second": self.motion.success,
            "attempts": self.attempts,
            "attempts_held": self.held,
            **({"cause": self.cause} if self.cause else {}),
            "rest": self.rest + 1,
            "phases": self.motion.about.get("phases", {}),
            "constraints": list(self.motion.constraints),
            "sink_mm": 1e3 * self.sink,
            "shove_mm": 1e3 * self.shove,
            "links_at_removal": self.motion.metrics["links_at_removal"],
            **{name: value for name, value in self.motion.metrics.items() if name in ASSESSED},
            **{name: self.motion.metrics[name] for name in _errors_of(self.motion.constraints)},
            **(self.arm.facts() if self.arm else {}),
        }


class Grasper:
    """A policy that grasps one object after another; what it compiles serves all of them."""

    def __init__(
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
          rounds: maximum number of rounds; a round follows another while no attempt holds.
          phases: approach, lift and hold.
          threads: threads of the physics; 0 for one per core.
          seed: seed of the attempts.
          arm: the arm that must be able to execute the motion.
          left: grasps with the left hand; the policy's right hand grasps the mirrored object (`common.mirror`).
        """
        self._arm = arm
        self._hand, self._left = get_hand(policy.spec.hand), left
        self.hand = get_hand(self._hand.name + LEFT) if left else self._hand
        self.task = dataclasses.replace(policy.task, end_when_fallen=False)
        self._policy, self._attempts_count, self._rounds, self._seed = policy, attempts, rounds, seed
        self._compiled = False
        self._attempts = Attempts(self._hand, self.task, policy, threads=threads or cores(), phases=phases)

    def grasp(
        self, obj: GraspObject, request: GraspRequest | None = None, progress: Progress = lambda what, done, total: None
    ) -> Grasp:
        """The best grasp of some attempts.

        Args:
          obj: the object.
          request: constraints on the grasp; none by default.
          progress: called with the progress.

        Raises:
          UnknownConstraintError: the policy does not know one of the constraints.
          ContradictionError: two of them exclude each other.
          NoReachError: without an arm, no planned approach leads to the grasp.
          CongraspError: the table is in the way of all attempts, or the arm can do none that holds the object.
        """
        request = request or GraspRequest()
        require_known(request.constraints, self.task)
        if self._left:
            obj, request = obj.mirrored(), mirrored_request(request)
        best: tuple[float, Outcome, Goal, int, np.ndarray] | None = None
        refused: collections.Counter[str] = collections.Counter()
        held = attempted = 0
        for round_ in range(self._rounds):
            episodes, rests, different = self._episodes(obj, request, np.random.default_rng((self._seed, round_)))
            progress("Preparing" if self._compiled else "Compiling (kept for the next time)", 0, 1)
            self._compiled = True
            what = f"Attempting others ({round_ + 1})" if round_ else "Attempting"
            outcome = self._attempts.run(obj, episodes, functools.partial(self._attempting, progress, what))
            _check_aligned(outcome)
            removal = self.task.approach_steps - 1
            cost = costs(outcome, tuple(request.constraints), removal, self._attempts.phases.lift)
            cost = (cost + _UNLIKELY * _places(obj, rests, request))[:different]
            attempted += different
            holds = outcome.metrics["held"][:different] > 0
            held += int(holds.sum())
            if request.avoid is not None:  # a hold by the avoid region does not meet the request
                holds &= outcome.metrics["affordance_ratio"][:different] < _TOUCHED
            if self._arm:
                make = functools.partial(self._result, obj, request, outcome, episodes.goal, rests, attempted, held)
                order = [i for i in cost.argsort().tolist() if holds[i]]
                if (found := self._on_arm(self._arm, obj, make, order, refused, progress)) is not None:
                    return found
                if prescribed(request) is not None:  # further rounds would repeat these attempts
                    break
                continue
            index = int(cost.argmin())
            if best is None or cost[index] < best[0]:
                best = (float(cost[index]), outcome, episodes.goal, index, rests)
            if holds.any() or prescribed(request) is not None:
                break
        if self._arm:
            raise _no_motion(obj, self._arm.name, attempted, refused)
        assert best is not None
        _, outcome, wanted, index, rests = best
        cause = "" if held else self._cause(obj, request, progress)
        found = self._result(obj, request, outcome, wanted, rests, attempted, held, index)
        return dataclasses.replace(found, cause=cause)

    def close(self) -> None:
        """Ends the threads of the physics."""
        self._attempts.close()

    def _attempting(self, progress: Progress, what: str, step: int) -> None:
        """Reports a control step of attempts."""
        progress(what, step, self._attempts.steps)

    def _cause(self, obj: GraspObject, request: GraspRequest, progress: Progress) -> str:
        """A sentence on what makes every attempt fail, if attempts hold the object with one thing changed.

        Its mass is changed first, then its size, at the same mass and where the request names no place in its frame.
        """
        lighter = dataclasses.replace(obj, mass=_LIGHTER * obj.mass, inertia=_LIGHTER * np.asarray(obj.inertia))
        trials = [(lighter, "weight", f"a quarter of its {1000 * obj.mass:.0f} g")]
        if prescribed(request) is None and request.given("heading", "position") is None:
            smaller = obj.scaled(_SMALLER, constant_mass=True)
            trials.append((smaller, "width", f"{100 * _SMALLER:.0f} % of its size"))
        for changed, cause, how in trials:
            try:
                episodes, _, different = self._episodes(changed, request, np.random.default_rng(self._seed))
            except CongraspError:
                continue
            what = f"Looking whether its {cause} is the cause"
            outcome = self._attempts.run(changed, episodes, functools.partial(self._attempting, progress, what))
            holds = int((outcome.metrics["held"][:different] > 0).sum())
            if holds >= _ENOUGH * different:
                return f"Its {cause} is the cause: with {how} {holds} of {different} attempts hold it."
        return ""

    def _on_arm(
        self,
        arm: "ArmPlanner",
        obj: GraspObject,
        make: Callable[[int], Grasp],
        order: list[int],
        refused: collections.Counter[str],
        progress: Progress,
    ) -> Grasp | None:
        """The first attempt in `order` that the arm can do, made by `make`; counts the limits that forbid others."""
        for number, index in enumerate(order):
            progress(f"Moving {arm.name}", number + 1, len(order))
            try:
                found = make(index)
                planned = arm.plan(obj, found.motion)
                episode = planned.moved.recorded(found.episode)
                return dataclasses.replace(found, episode=episode, motion=motion_of_episode(episode), arm=planned)
            except Infeasible as limit:
                refused[str(limit)] += 1
            except NoReachError:
                refused["contact of every reach"] += 1
        return None

    def _episodes(
        self, obj: GraspObject, request: GraspRequest, rng: np.random.Generator
    ) -> tuple[RequestedEpisodes, np.ndarray, int]:
        """Attempts under the constraints, (B,) the resting pose of each, and how many of them are different."""
        batch = self._attempts_count
        labelled = obj if request.avoid is None else with_avoid(obj, request.avoid)
        episodes = repeated(self._hand, self.task, labelled, request, batch)
        path = prescribed(request)
        if path is None:
            position, direction, cross, rests = headings(self._hand, labelled, request, batch, rng)
            found = {"position": position, "direction": direction, "cross": cross}
            found = {name: value.astype(np.float32) for name, value in found.items()}
            episodes = episodes._replace(goal=episodes.goal.replace("heading", **found))
            different = batch
        else:
            reference = valid_rests(self._hand, obj, *path)
            if request.rest is not None:
                reference = reference[reference == request.rest]
            if not len(reference):
                raise CongraspError(
                    f"With this reference the hand would be in the table in resting pose {(request.rest or 0) + 1}.",
                    "Leave out --rest.",
                )
            rests, different = np.resize(reference, batch), min(batch, len(reference))
        return episodes._replace(rest=np.asarray(obj.rest_poses, np.float32)[rests]), rests, different

    def _result(
        self,
        obj: GraspObject,
        request: GraspRequest,
        outcome: Outcome,
        wanted: Goal,
        rests: np.ndarray,
        attempts: int,
        held: int,
        index: int,
    ) -> Grasp:
        """One attempt of an outcome, with its episode, motion and the constraints that were active."""
        labelled = obj if request.avoid is None else with_avoid(obj, request.avoid)
        about = {
            "actor": "grasp",
            "attempts": attempts,
            "attempts_held": held,
            "object_file_scale": obj.file_scale,
            "object_file_origin": [-x for x in obj.origin],
        }
        episode = self._attempts.episode(outcome, index, surface_of(self.task, labelled), obj, about)
        if approach := self._attempts.phases.approach:
            side = self._arm.side if self._arm else None
            episode = with_planned_reach(episode, self._hand, obj, approach, self._attempts.speed, side)
        if self._left:
            episode = _mirrored(episode, self.hand)
        asked = tuple(request.constraints)
        active = explain(asked, bool(outcome.redirected[index]))
        written = [name for name in asked if name != "heading" or "direction" in request.constraints[name]]
        avoid = labelled.non_graspable_points
        active += [found.message for found in contradictions(self._hand, obj.points, avoid, wanted.row(index), written)]
        return Grasp(episode, motion_of_episode(episode), attempts, held, int(rests[index]), tuple(active))


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
    """The best grasp motion of an object under constraints; compiled programs are kept for the next call.

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
      **constraints: the options of `congrasp grasp`: heading, at, affordance, avoid, pose, trajectory, fingers, …; each
        is the text that the command line takes, or a sequence of its words or numbers.

    Raises:
      CongraspError: the object cannot be imported, or a constraint cannot be read or kept.
    """
    right, left = right_name(hand)
    file = policy_file(None if policy is None else pathlib.Path(policy), right)
    grasper = _grasper(file, file.stat().st_mtime_ns, attempts, seed, left)
    obj = mesh if isinstance(mesh, GraspObject) else one_object(pathlib.Path(mesh), options or ImportOptions("guess"))
    request = read_request(obj, grasper.hand, grasper.task.trajectory_points, **constraints)
    return grasper.grasp(obj, request, progress)


@functools.lru_cache(maxsize=2)
def _grasper(file: pathlib.Path, changed: int, attempts: int, seed: int, left: bool) -> Grasper:
    """The grasper of a policy file, by its time of modification `changed`."""
    return Grasper(bundles.load(file), attempts=attempts, seed=seed, left=left)


def repeated(hand: Hand, task: TaskConfig, obj: GraspObject, request: GraspRequest, batch: int) -> RequestedEpisodes:
    """Request for a labelled object, repeated `batch` times, in the requested resting pose."""
    rest = np.asarray(obj.rest_poses[request.rest or 0], np.float32)
    goal, surface, rest = jax.tree.map(
        lambda array: np.broadcast_to(array, (batch, *np.shape(array))),
        (goal_of(hand, task, request), surface_of(task, obj), rest),
    )
    asked = {c.name: np.full(batch, c.name in request.constraints) for c in optional(task)}
    return RequestedEpisodes(goal, asked, surface, rest)


def surface_of(task: TaskConfig, obj: GraspObject) -> Surface:
    """Labelled points of an object, as many as the policy observes, with their normals if it observes them."""
    points = task.surface_points
    normals = np.asarray(obj.normals[:points], np.float32) if task.surface_normals else None
    return Surface(np.asarray(obj.points[:points], np.float32), obj.non_graspable_points[:points], normals)


def with_avoid(obj: GraspObject, avoid: np.ndarray) -> GraspObject:
    """The object with another avoid region, (512,) bool."""
    return dataclasses.replace(
        obj, part_names=("graspable", "non-graspable"), graspable=np.array([True, False]), labels=avoid.astype(np.int32)
    )


def _mirrored(episode: Message, hand: Hand) -> Message:
    """Returns the episode of the left hand, from one of the right hand with the mirrored object."""
    origin = mirror.vector(episode.meta["object_file_origin"]).tolist()
    meta = {**episode.meta, "hand": hand.reference, "object_file_origin": origin}
    return Message(mirror.fields(episode.arrays), meta)


def _errors_of(constraints: tuple[str, ...]) -> list[str]:
    """Names of the metrics that count under these constraints."""
    names = [spec.name for c in CONSTRAINTS if not c.optional or c.name in constraints for spec in c.errors]
    return [*names, "moved_at_removal", "force_link_max"]


def costs(outcome: Outcome, constraints: tuple[str, ...], removal: int, lift: float = 0.0) -> np.ndarray:
    """(B,) cost of each attempt: held to the end first, then held for a quarter of a second, then everything else.

    Args:
      outcome: outcome of the attempts.
      constraints: names of the requested constraints.
      removal: the last control step of the approach.
      lift: height by which the hand rises after the approach, m.
    """
    place = outcome.trace.object_position
    way = place[-1] - place[removal] - [0.0, 0.0, lift]
    values = {**outcome.metrics, "slip": np.linalg.norm(way, axis=-1)}
    cost = sum(np.minimum(values[name] / _SCALES[name], 10.0) for name in [*_errors_of(constraints), "slip"])
    cost += sum(values[name] == 0 for name in _FIRM)
    return np.asarray(cost) + 1e3 * (values["success"] == 0) + 1e4 * (values["held"] == 0)


def _no_motion(obj: GraspObject, arm: str, attempts: int, refused: collections.Counter[str]) -> CongraspError:
    """Error if an arm can execute no attempt that holds the object, with the limits that forbid them."""
    if not refused:
        return CongraspError(f"None of {attempts} attempts holds '{obj.name}'.", "Set more --attempts.")
    limits = ", ".join(f"{limit} {count}" for limit, count in refused.most_common())
    return CongraspError(
        f"{arm} can do none of the {refused.total()} attempts that hold '{obj.name}'. Forbidden by {limits}.",
        "Set another --base or --mount, or more --attempts.",
    )


def _places(obj: GraspObject, rests: np.ndarray, request: GraspRequest) -> np.ndarray:
    """(B,) ranks of the resting poses: upright first, then by likelihood; zeros if the request names one."""
    if request.rest is not None:
        return np.zeros_like(rests)
    upright = upright_rest(obj)
    return rests if upright is None else np.where(rests == upright, 0, rests + (rests < upright))


def _check_aligned(outcome: Outcome) -> None:
    """Raises a ContradictionError if trajectory and affordance exclude each other."""
    if not outcome.aligned.all():
        raise ContradictionError(
            "The trajectory ends nearer to the avoid region than to the graspable part.",
            "Let it end at the graspable part, or leave out --affordance and --avoid.",
        )
