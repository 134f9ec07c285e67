"""Grasps in less simulated time, for tests of what comes before and after the simulation."""

import contextlib
from collections.abc import Iterator
from typing import Any
from unittest import mock

from congrasp.actors import stress
from congrasp.actors.attempts import Phases
from congrasp.services.grasp import interface
from congrasp.services.grasp.grasper import Grasper

HOLD_S = 0.25
PUSH_S = 0.02


def _short_grasper(policy: Any, **options: Any) -> Grasper:
    """A grasper of at most two rounds with a short hold."""
    return Grasper(policy, **{**options, "rounds": 2, "phases": Phases(hold=HOLD_S)})


@contextlib.contextmanager
def short_pushes() -> Iterator[None]:
    """Context in which each of the twelve pushes after a hold takes two control steps."""
    with mock.patch.object(stress, "PUSH_S", PUSH_S):
        yield


@contextlib.contextmanager
def short_grasps() -> Iterator[None]:
    """Context in which commands and functions grasp in at most two rounds of attempts, with a short
    hold and short pushes.
    """
    with short_pushes(), mock.patch.object(interface, "Grasper", _short_grasper):
        yield
