"""Cache of constraint banks on disk."""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Sequence

import jax
import numpy as np

import congrasp.common
from congrasp.common.hands.spec import Hand
from congrasp.common.io.files import cache_folder, keep, read_kept, source_digest
from congrasp.common.objects import store
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling.bank import SHARED, ConstraintBank
from congrasp.common.wire.codec import Message

MIN_OBJECTS = 64
"""Pools of at least this size are cached."""
MAX_FILES = 8
"""Most banks in the cache; that of 800 objects takes about 50 MB."""
_IRRELEVANT = (
    "reward",
    "control",
    "mass_range",
    "friction_range",
    "gain_range",
    "hold_steps",
    "drop_height",
    "disturbed",
    "impratio",
    "p_",
    "observation",
    "history",
    "sensing",
    "surface_normals",
)
"""Prefixes of the settings that no bank depends on."""


def cached_bank(
    hand: Hand,
    task: TaskConfig,
    objects: Sequence[GraspObject],
    seed: int,
    build: Callable[[], ConstraintBank],
) -> ConstraintBank:
    """Returns the bank built by `build` from these arguments, from the cache on disk if possible.

    Only banks of large pools are cached: they depend on objects, hand and task, and take long to
    build.
    """
    if len(objects) < MIN_OBJECTS:
        return build()
    path = cache_folder("banks") / f"{_key(hand, task, objects, seed)}.safetensors"
    message = read_kept(path)
    if message and message.arrays.keys() == set(SHARED):
        return jax.device_put(ConstraintBank(**message.arrays))
    bank = build()
    arrays = {name: np.asarray(getattr(bank, name)) for name in SHARED}
    keep(path, Message(arrays), MAX_FILES)
    return bank


def _key(hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], seed: int) -> str:
    """File name from everything that a bank depends on, including the code and the device's
    arithmetic.
    """
    settings = dataclasses.asdict(task)
    relevant = {name: value for name, value in settings.items() if not name.startswith(_IRRELEVANT)}
    content = [
        source_digest(congrasp.common),
        jax.__version__,
        jax.local_devices()[0].device_kind,
        hand.reference,
        relevant,
        seed,
        [store.digest(obj) for obj in objects],
    ]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:32]
