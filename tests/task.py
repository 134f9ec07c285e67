"""The task of the suite: a module that needs another one says why.

Modules that share hand, task, policy and batch share compiled programs, in one process and through the disk's cache.
"""

import functools

from congrasp.common.config import NetworkConfig, RunConfig
from congrasp.common.hands import get_hand
from congrasp.common.objects import procedural
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.sampling.build import build_bank
from congrasp.services.train.command import untrained

HAND, TASK = get_hand("human"), TaskConfig()
OBJECTS = procedural.generate_many(4, 0, ("box", "cylinder", "mug", "hammer"))
BATCH = 8
CONFIG = RunConfig(task=TASK, network=NetworkConfig(hidden=(16,), encoder=4))
"""A run whose policy is tiny."""


@functools.cache
def bank() -> ConstraintBank:
    """The constraint bank of `OBJECTS`."""
    return build_bank(HAND, TASK, OBJECTS, 0)


@functools.cache
def policy() -> PolicyBundle:
    """The untrained policy of `CONFIG`."""
    return untrained(CONFIG)
