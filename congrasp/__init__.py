"""Dexterous grasps under constraints: the public Python interface.

A motion for an object, which is a generated one ("mug:7") or a file ("mug.obj")::

    import congrasp

    grasp = congrasp.grasp("mug:7", heading="above")
    congrasp.save_motion("mug.npz", grasp.motion)

Actions in a control loop, from a server or from `congrasp.load_policy()`::

    with congrasp.PolicyClient("tcp/127.0.0.1:7457") as policy:
        policy.reset(congrasp.GraspRequest(...))
        answer = policy.act(state)

Names are imported on first use: the client and its errors need only numpy and zenoh.
"""

import importlib
import os
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str
    from congrasp.common.episode.episode import Episode
    from congrasp.common.episode.motion_file import load_motion, save_motion
    from congrasp.common.errors import (
        CongraspError,
        ContradictionError,
        LateError,
        OverloadedError,
        PhysicsError,
        RefusedError,
        TransportError,
        UnknownConstraintError,
    )
    from congrasp.common.request import GraspRequest
    from congrasp.services.assets.objects.options import ImportOptions
    from congrasp.services.client.guard import Command, Guard
    from congrasp.services.client.left_policy import LeftPolicy
    from congrasp.services.client.limits import JointLimits
    from congrasp.services.client.policy import Answer, Policy
    from congrasp.services.client.policy_client import PolicyClient
    from congrasp.services.client.ticker import Ticker
    from congrasp.services.grasp.grasper import Grasper
    from congrasp.services.grasp.interface import grasp
    from congrasp.services.grasp.motion import Grasp
    from congrasp.services.gym.vector_env import make_vec
    from congrasp.services.serve.inference import load_policy

    GraspMotion = Episode

__all__ = [
    "Answer",
    "Command",
    "CongraspError",
    "ContradictionError",
    "Episode",
    "Grasp",
    "GraspRequest",
    "Grasper",
    "Guard",
    "ImportOptions",
    "JointLimits",
    "LateError",
    "LeftPolicy",
    "OverloadedError",
    "PhysicsError",
    "Policy",
    "PolicyClient",
    "RefusedError",
    "Ticker",
    "TransportError",
    "UnknownConstraintError",
    "grasp",
    "load_motion",
    "load_policy",
    "make_vec",
    "save_motion",
]

_MODULES = {
    "Answer": "congrasp.services.client.policy",
    "Command": "congrasp.services.client.guard",
    "Episode": "congrasp.common.episode.episode",
    "Grasp": "congrasp.services.grasp.motion",
    "GraspRequest": "congrasp.common.request",
    "Grasper": "congrasp.services.grasp.grasper",
    "Guard": "congrasp.services.client.guard",
    "ImportOptions": "congrasp.services.assets.objects.options",
    "JointLimits": "congrasp.services.client.limits",
    "LeftPolicy": "congrasp.services.client.left_policy",
    "Policy": "congrasp.services.client.policy",
    "PolicyClient": "congrasp.services.client.policy_client",
    "Ticker": "congrasp.services.client.ticker",
    "grasp": "congrasp.services.grasp.interface",
    "load_motion": "congrasp.common.episode.motion_file",
    "load_policy": "congrasp.services.serve.inference",
    "make_vec": "congrasp.services.gym.vector_env",
    "save_motion": "congrasp.common.episode.motion_file",
}
"""Where each name is defined; the others are errors."""
_OLDER_NAMES = {"GraspMotion": "Episode"}
"""Present names of older ones, which still work."""


def _public(name: str) -> Any:
    """A public name, imported (PEP 562), or the version of the installed distribution."""
    if name == "__version__":
        metadata = importlib.import_module("importlib.metadata")
        try:
            return metadata.version("congrasp")
        except metadata.PackageNotFoundError:
            return "not installed"
    name = _OLDER_NAMES.get(name, name)
    if name not in __all__:
        raise AttributeError(f"module 'congrasp' has no attribute '{name}'")
    errors = importlib.import_module("congrasp.common.errors")
    tolerance = importlib.import_module("congrasp.common.runtime.tolerance")
    try:
        with tolerance.tolerated_warnings():
            module = importlib.import_module(_MODULES.get(name, errors.__name__))
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package == "congrasp":
            raise
        raise errors.MissingPackageError(f"congrasp.{name}", package) from None
    value = getattr(module, name)
    globals()[name] = value
    return value


if not TYPE_CHECKING:
    # Type checkers report unknown names
    __getattr__ = _public


def __dir__() -> list[str]:
    return list(__all__)


def _before_fork() -> None:
    """Lets the fork know that the caller has started JAX, whose threads it will lack."""
    if "jax" in sys.modules:
        importlib.import_module("congrasp.common.runtime.forks").detect_jax()


if hasattr(os, "register_at_fork"):  # not on Windows, which has no forks
    os.register_at_fork(before=_before_fork)
