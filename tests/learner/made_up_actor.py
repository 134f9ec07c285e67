"""An actor without physics: the learner's policy acts on random observations."""

import threading

import jax
import numpy as np

from congrasp.actors.process.link import ActorLink, RunFinished
from congrasp.common.errors import TransportError
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.wire.codec import Message

_PATIENCE = 300.0  # a learner may compile before it answers


class MadeUpActor(threading.Thread):
    """Sends rollouts of random observations until the run `t` ends; keeps the versions that it acted with."""

    def __init__(
        self, transport, name: str = "a", reward: float = 1.0, links: float = 3.0, seed: int = 0, journal=None
    ):
        super().__init__(daemon=True)
        self.versions: list[int] = []
        self.ended = ""
        self.stop = threading.Event()
        self._transport, self._actor, self.reward, self._links, self._seed = transport, name, reward, links, seed
        self._journal = journal
        self.start()

    def run(self) -> None:
        with ActorLink(self._transport, "t", self._actor, patience=_PATIENCE, journal=self._journal) as link:
            try:
                self._act(link, link.config(_PATIENCE).arrays)
            except (RunFinished, TransportError) as error:
                self.ended = str(error)

    def _act(self, link: ActorLink, names: tuple[str, ...]) -> None:
        rng, bundle = np.random.default_rng(self._seed), None
        while not self.stop.is_set():
            ticket = link.acquire_ticket(0.5)
            newer = link.weights(-1 if bundle is None else bundle.version)
            bundle = bundle if newer is None else PolicyBundle.from_message(newer)
            if ticket is None or bundle is None:
                continue
            shape = (5, 2, sum(size for _, size in bundle.spec.layout))
            observation = rng.uniform(-1.0, 1.0, shape).astype(np.float16)  # what every entry of a task can be
            action, log_probability = bundles.sample_action(
                bundle.spec.layout,
                bundle.inference_parameters,
                observation[:-1],
                jax.random.PRNGKey(len(self.versions)),
            )
            inputs = rng.uniform(0.0, 1.0, (5, 2, bundle.spec.privileged_size)).astype(np.float16)
            recorded = {
                "privileged": inputs[:-1],
                "last_privileged": inputs[-1],
                "observation": observation[:-1],
                "last_observation": observation[-1],
                "action": np.asarray(action),
                "log_probability": np.asarray(log_probability),
                "reward": self.reward * rng.normal(size=(4, 2)).astype(np.float32),
                "terminal": (terminal := rng.random((4, 2)) < 0.3),
                "truncated": terminal & (rng.random((4, 2)) < 0.5),
            }
            arrays = {name: recorded[name] for name in names} | {
                "episode/success": np.array([0.0, 1.0, 1.0, 1.0], np.float32),
                "episode/links_at_removal": np.full(4, self._links, np.float32),
            }
            meta = {"version": bundle.version, "schema": bundle.spec.schema, "steps": 8}
            link.upload(Message(arrays, meta), ticket)
            self.versions.append(bundle.version)
