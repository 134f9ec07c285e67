"""Dexterous grasps under constraints: what a program of one's own imports.

    import congrasp

    found = congrasp.grasp("mug.obj", heading="0 0 -1", fingers="thumb index")   # a motion for an object
    congrasp.save_motion("mug.npz", found.motion)

    with congrasp.PolicyClient("tcp/127.0.0.1:7457") as policy:                  # or congrasp.load_policy()
        policy.reset(congrasp.GraspRequest(...))
        answer = policy.act(state)

Names are imported when they are first used: the client and its errors need numpy and zenoh alone.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from common.errors import (
        CongraspError,
        ContradictionError,
        LateError,
        OverloadedError,
        PhysicsError,
        RefusedError,
        TransportError,
        UnknownConstraintError,
    )
    from common.request import GraspRequest
    from services.assets.objects.options import ImportOptions
    from services.export.motion_file import GraspMotion, load_motion, save_motion
    from services.grasp.grasper import Grasp, Grasper, grasp
    from services.serve.client import PolicyClient
    from services.serve.guard import Command, Guard
    from services.serve.limits import JointLimits
    from services.serve.local import load_policy
    from services.serve.policy import Answer, Policy
    from services.serve.ticker import Ticker

__all__ = [
    "Answer",
    "Command",
    "CongraspError",
    "ContradictionError",
    "Grasp",
    "GraspMotion",
    "GraspRequest",
    "Grasper",
    "Guard",
    "ImportOptions",
    "JointLimits",
    "LateError",
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
    "save_motion",
]

_MODULES = {
    "Answer": "services.serve.policy",
    "Command": "services.serve.guard",
    "Grasp": "services.grasp.grasper",
    "GraspMotion": "services.export.motion_file",
    "GraspRequest": "common.request",
    "Grasper": "services.grasp.grasper",
    "Guard": "services.serve.guard",
    "ImportOptions": "services.assets.objects.options",
    "JointLimits": "services.serve.limits",
    "Policy": "services.serve.policy",
    "PolicyClient": "services.serve.client",
    "Ticker": "services.serve.ticker",
    "grasp": "services.grasp.grasper",
    "load_motion": "services.export.motion_file",
    "load_policy": "services.serve.local",
    "save_motion": "services.export.motion_file",
}
"""Where each name is defined; the others are errors."""


def __getattr__(name: str) -> Any:
    """A public name, imported (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module 'congrasp' has no attribute '{name}'")
    globals()[name] = found = getattr(importlib.import_module(_MODULES.get(name, "common.errors")), name)
    return found


def __dir__() -> list[str]:
    return list(__all__)
