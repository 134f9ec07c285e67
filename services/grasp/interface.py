"""Graspers by policy file or name of the hand, and the grasp of one object as a function."""

import functools
import os
import pathlib
from typing import Any

from congrasp.actors.attempts import PLAIN, Phases
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand, right_name
from congrasp.common.objects.spec import GraspObject
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import policy_file
from congrasp.common.runtime.engines import PhysicsName
from congrasp.common.runtime.entry import compiling_entry
from congrasp.common.runtime.progress import Progress, ignore_progress
from congrasp.services.arm import ArmOptions
from congrasp.services.assets.objects.named import one_object
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.grasp.grasper import ATTEMPTS, Grasper
from congrasp.services.grasp.motion import Grasp
from congrasp.services.grasp.parse import read_request


@compiling_entry
def open_grasper(
    policy: pathlib.Path | None,
    hand: str,
    attempts: int = ATTEMPTS,
    seed: int = 0,
    phases: Phases = PLAIN,
    arm: ArmOptions = ArmOptions(),  # noqa: B008
    physics: PhysicsName = "native",
) -> Grasper:
    """Returns a grasper with a policy file, or with the pretrained policy of a hand.

    Args:
      policy: the file, or None.
      hand: name of the hand; `human:left` is the left one of `human`.
      attempts: grasps simulated in parallel.
      seed: seed of the attempts.
      phases: approach, lift and hold.
      arm: the arm that carries the hand, if it names one.
      physics: engine, except `auto` and those that are compiled.

    Raises:
      CongraspError: there is no such policy, hand or arm, or the hand on the arm is a left one.
    """
    right, left = right_name(hand)
    if left and arm.arm:
        raise CongraspError("--arm supports right hands only.", "Leave out --arm or :left.")
    bundle = bundles.load(policy_file(policy, right))
    planner = None
    if arm.arm:
        from congrasp.services.arm.planner import ArmPlanner

        planner = ArmPlanner(arm, get_hand(bundle.spec.hand), seed)
    return Grasper(
        bundle,
        attempts=attempts,
        phases=phases,
        seed=seed,
        arm=planner,
        left=left,
        physics=physics,
    )


@compiling_entry
def grasp(
    mesh: str | os.PathLike[str] | GraspObject,
    *,
    policy: str | os.PathLike[str] | None = None,
    hand: str = "human",
    options: ImportOptions | None = None,
    attempts: int = ATTEMPTS,
    seed: int = 0,
    progress: Progress = ignore_progress,
    **constraints: Any,
) -> Grasp:
    """Returns the best grasp motion of an object under constraints; compiled programs are kept for
    the next call.

    Example:
      import congrasp

      mug = congrasp.grasp("mug:7", heading="above", attempts=8)
      print(mug.success, mug.held, "of", mug.attempts, "attempts hold it")

    Args:
      mesh: a mesh (STL, OBJ, PLY, GLB), an object file, FAMILY:SEED of the generator, or an object.
      policy: a policy file; the pretrained policy of the hand by default.
      hand: name of the hand; `human:left` is the left one of `human`.
      options: import options of a mesh.
      attempts: grasps simulated in parallel.
      seed: seed of the attempts.
      progress: called with the current activity, the completed steps and the number of its steps,
        0 of 0 without steps to count.
      **constraints: the options of `congrasp grasp`: heading, at, affordance, avoid, pose,
        trajectory, fingers, …; each is the text that the command line takes, or a sequence of its
        words or numbers.

    Raises:
      CongraspError: the object cannot be imported, or a constraint cannot be read or met.
    """
    file = policy_file(None if policy is None else pathlib.Path(policy), right_name(hand)[0])
    modified = file.stat().st_mtime_ns if file.exists() else 0
    grasper = _cached_grasper(file, modified, hand, attempts, seed)
    if isinstance(mesh, GraspObject):
        obj = mesh
    else:
        obj = one_object(pathlib.Path(mesh), options or ImportOptions("guess"))
    request = read_request(obj, grasper.hand, grasper.task.trajectory_points, **constraints)
    return grasper.grasp(obj, request, progress)


@functools.lru_cache(maxsize=2)
def _cached_grasper(
    file: pathlib.Path, modified: int, hand: str, attempts: int, seed: int
) -> Grasper:
    """The grasper of a policy file, by its time of modification in ns."""
    return open_grasper(file, hand, attempts, seed)
