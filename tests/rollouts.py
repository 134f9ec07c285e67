"""Small valid rollouts for tests of the wire."""

import numpy as np

from common.wire.codec import Message

OBSERVATION, ACTION, SCHEMA = 7, 3, "schema"


def rollout(actor: str = "a", incarnation: str = "1", sequence: int = 0, version: int = 0, epoch: str = "e") -> Message:
    """Four steps of two worlds."""
    rng = np.random.default_rng(sequence)
    steps, worlds = 4, 2
    arrays = {
        "observation": rng.normal(size=(steps, worlds, OBSERVATION)).astype(np.float16),
        "action": rng.normal(size=(steps, worlds, ACTION)).astype(np.float32),
        "log_probability": rng.normal(size=(steps, worlds)).astype(np.float32),
        "reward": rng.normal(size=(steps, worlds)).astype(np.float32),
        "terminal": np.zeros((steps, worlds), bool),
        "last_observation": rng.normal(size=(worlds, OBSERVATION)).astype(np.float16),
        "episode/success": np.ones(1, np.float32),
    }
    meta = {
        "actor": actor,
        "incarnation": incarnation,
        "sequence": sequence,
        "version": version,
        "epoch": epoch,
        "schema": SCHEMA,
        "steps": steps * worlds,
    }
    return Message(arrays, meta)


def bundle(version: int, epoch: str = "e") -> Message:
    """A policy bundle with one array."""
    meta = {
        "version": version,
        "epoch": epoch,
        "schema": SCHEMA,
        "hand": "human",
        "layout": [],
        "action_size": ACTION,
        "network": {},
        "task": {},
        "format": 1,
    }
    return Message({"actor/w": np.full(3, version, np.float32)}, meta)
