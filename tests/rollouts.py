"""Small valid messages for tests of the wire."""

import numpy as np

from congrasp.common.wire.codec import Message
from congrasp.common.wire.schema import RolloutForm

OBSERVATION, ACTION, SCHEMA = 7, 3, "schema"
FORM = RolloutForm(steps=4, worlds=2, observation=OBSERVATION, action=ACTION, half=True)


def random_arrays(form: RolloutForm, seed: int = 0) -> dict[str, np.ndarray]:
    """The arrays of a rollout with normal values; no episode ends."""
    rng = np.random.default_rng(seed)
    return {
        name: zeros if zeros.dtype == bool else rng.normal(size=zeros.shape).astype(zeros.dtype)
        for name, zeros in form.zeros().items()
    }


def rollout(
    actor: str = "a", incarnation: str = "1", sequence: int = 0, version: int = 0, run_id: str = "e"
) -> Message:
    """A rollout in which one episode ended."""
    arrays = {**random_arrays(FORM, sequence), "episode/success": np.ones(1, np.float32)}
    meta = {
        "actor": actor,
        "incarnation": incarnation,
        "sequence": sequence,
        "version": version,
        "run_id": run_id,
        "schema": SCHEMA,
        "steps": FORM.steps * FORM.worlds,
    }
    return Message(arrays, meta)


def bundle(version: int, run_id: str = "e") -> Message:
    """A policy bundle with one array."""
    meta = {
        "version": version,
        "run_id": run_id,
        "schema": SCHEMA,
        "hand": "human",
        "layout": [],
        "action_size": ACTION,
        "network": {},
        "task": {},
        "format": 1,
    }
    return Message({"actor/w": np.full(3, version, np.float32)}, meta)
