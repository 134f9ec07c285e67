"""A learner's end, and small valid messages for it."""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from congrasp.common.transport.base import Transport
from congrasp.common.wire.codec import Message
from congrasp.common.wire.messages import RolloutForm
from congrasp.learner.hub.admission import Admission
from congrasp.learner.hub.hub import LearnerHub
from congrasp.learner.hub.limits import Events
from congrasp.learner.hub.queue import RolloutContract, RolloutQueue
from congrasp.learner.hub.staleness import StalenessManager

FORM = RolloutForm(steps=20, worlds=16, observation=32, action=4, half=True)
RUN_ID = "e"
SCHEMA = "s"


def rollout(value: float = 0.0, form: RolloutForm = FORM, **meta: Any) -> Message:
    """A rollout whose numbers are all the same, so that a corrupted one shows."""
    arrays = form.zeros()
    for array in arrays.values():
        if array.dtype != bool:
            array.fill(value)
    return Message(
        arrays, {"version": 0, "schema": SCHEMA, "steps": form.steps * form.worlds, **meta}
    )


def bundle(
    version: int, run_id: str = RUN_ID, form: RolloutForm = FORM, parameters: int = 1000
) -> Message:
    """A policy whose parameters are its version."""
    shapes = {"observation": (form.observation,), "value": ()}
    arrays = {
        f"{kind}/{name}": np.zeros(shape)
        for (kind, shape), name in itertools.product(shapes.items(), ("mean", "m2"))
    }
    arrays |= {"observation/count": np.zeros(()), "value/count": np.zeros(())}
    arrays["actor/w"] = np.full(parameters, version, np.float32)
    meta = {
        "version": version,
        "run_id": run_id,
        "schema": SCHEMA,
        "hand": "human",
        "layout": [],
        "format": 1,
    }
    return Message(arrays, {**meta, "action_size": form.action})


class Learner(NamedTuple):
    """The learner's end of a run."""

    hub: LearnerHub
    rollouts: RolloutQueue


def learner_hub(  # noqa: PLR0913
    transport: Transport,
    run: str,
    *,
    schema: str = SCHEMA,
    form: RolloutForm = FORM,
    staleness: StalenessManager | None = None,
    config_json: str = "{}",
    run_id: str = RUN_ID,
    name: str = "0",
    on_event: Callable[[str, str], None] = lambda level, text: None,
    admission: Admission | None = None,
    **options: Any,
) -> Learner:
    """The learner's end of a run; options are those of `RolloutQueue`."""
    events = Events(transport, run, name, on_event)
    contract = RolloutContract(run_id, form, schema)
    rollouts = RolloutQueue(contract, staleness or StalenessManager(1, 2), events, **options)
    return Learner(LearnerHub(transport, rollouts, events, config_json, admission), rollouts)
