"""An actor without physics: the learner's policy acts on random observations."""

import threading

import jax
import numpy as np

from congrasp.actors.link import ActorLink, RunFinished
from congrasp.common.errors import TransportError
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.wire.codec import Message

_PATIENCE = 300.0  # a learner may compile before it answers


def random_steps(
    rng, steps: int, worlds: int, observation: int, privileged: int
) -> dict[str, np.ndarray]:
    """All that is recorded of a rollout but the actions, with values that every entry of a task can
    have.
    """
    seen = rng.uniform(-1.0, 1.0, (steps + 1, worlds, observation)).astype(np.float16)
    inputs = rng.uniform(0.0, 1.0, (steps + 1, worlds, privileged)).astype(np.float16)
    terminal = rng.random((steps, worlds)) < 0.3
    return {
        "observation": seen[:-1],
        "last_observation": seen[-1],
        "privileged": inputs[:-1],
        "last_privileged": inputs[-1],
        "reward": rng.normal(size=(steps, worlds)).astype(np.float32),
        "terminal": terminal,
        "truncated": terminal & (rng.random((steps, worlds)) < 0.5),
    }


class MadeUpActor(threading.Thread):
    """Sends rollouts of random observations until the run `t` ends; keeps the versions that it
    acted with.
    """

    def __init__(
        self,
        transport,
        name: str = "a",
        reward: float = 1.0,
        links: float = 3.0,
        seed: int = 0,
        journal=None,
    ):
        super().__init__(daemon=True)
        self.versions: list[int] = []
        self.outcomes = []
        self.names = ()
        self.ended = ""
        """Futures of the uploads, names of the arrays that the learner takes, and how the run
        ended.
        """
        self.stop = threading.Event()
        self.rng = np.random.default_rng(seed)
        self.reward = reward
        self._transport = transport
        self._actor = name
        self._links = links
        self._journal = journal
        self.start()

    def run(self) -> None:
        with ActorLink(
            self._transport, "t", self._actor, patience=_PATIENCE, journal=self._journal
        ) as link:
            try:
                self.names = link.config(_PATIENCE).arrays
                self._act(link)
            except (RunFinished, TransportError) as error:
                self.ended = str(error)

    def _act(self, link: ActorLink) -> None:
        bundle = None
        while not self.stop.is_set():
            ticket = link.acquire_ticket(0.5)
            newer = link.weights(-1 if bundle is None else bundle.version)
            bundle = bundle if newer is None else PolicyBundle.from_message(newer)
            if ticket is None or bundle is None:
                continue
            arrays = self.rollout(bundle, jax.random.PRNGKey(len(self.versions)))
            meta = {
                "version": bundle.version,
                "schema": bundle.spec.schema,
                "steps": arrays["reward"].size,
            }
            self.outcomes.append(link.upload(Message(arrays, meta), ticket))
            self.versions.append(bundle.version)

    def rollout(self, bundle: PolicyBundle, key: jax.Array) -> dict[str, np.ndarray]:
        """Arrays of a rollout of 4 steps in 2 worlds."""
        spec = bundle.spec
        recorded = random_steps(
            self.rng, 4, 2, sum(size for _, size in spec.layout), spec.privileged_size
        )
        act = bundles.sample_action(
            spec.layout, bundle.inference_parameters, recorded["observation"], key
        )
        recorded["action"], recorded["log_probability"] = map(np.asarray, act)
        recorded["reward"] *= self.reward
        return {name: recorded[name] for name in self.names} | {
            "episode/success": np.array([0.0, 1.0, 1.0, 1.0], np.float32),
            "episode/links_at_removal": np.full(4, self._links, np.float32),
        }
