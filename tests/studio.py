"""A studio with a fake policy, and a run without a learner."""

import dataclasses
import functools
import json
import pathlib
import time
from collections.abc import Callable
from typing import Any

from congrasp.actors.attempts import Phases
from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.objects import procedural
from congrasp.common.objects.spec import GraspObject
from congrasp.common.request import GraspRequest
from congrasp.common.task.config import TaskConfig
from congrasp.common.transport.keys import Keys
from congrasp.common.wire.codec import Message
from congrasp.services.record.episode_entries import raw_entry, scene_entries
from congrasp.services.record.writer import JsonChannels, LogWriter
from congrasp.services.studio.catalogue import Catalogue
from congrasp.services.studio.grasping import Progress
from congrasp.services.studio.recordings import Recordings
from congrasp.services.studio.server import PageServer
from congrasp.services.studio.session import Session
from congrasp.services.studio.training import TrainingWindow
from tests.episodes import episode, episode_message

STEPS = 60
REMOVAL = 40
DIP = 30
"""The update at which the fake curve dips."""
BEGIN = 1_700_000_000.0
"""Time of the fake run's first update, s."""


class FakePolicy:
    """Answers every request with the fake episode, after a report of progress."""

    def __init__(self) -> None:
        self.hand = get_hand("human")
        self.task = TaskConfig()
        self.asked: list[tuple[GraspObject, GraspRequest, Phases]] = []
        self.fails = ""

    def newest(self) -> dict[str, Any]:
        return {"source": "fake", "version": 7, "trouble": ""}

    def grasp(
        self, obj: GraspObject, request: GraspRequest, phases: Phases, progress: Progress
    ) -> Episode:
        self.asked.append((obj, request, phases))
        progress("grasping", 0.5)
        if self.fails:
            raise RuntimeError(self.fails)
        drawn_episode = episode(
            STEPS,
            removal=REMOVAL,
            mask=tuple(
                int(name in request.constraints)
                for name in ("affordance", "pose", "pose", "trajectory")
            ),
        )
        metrics = {**drawn_episode.metrics, "held": 1.0}
        return dataclasses.replace(
            drawn_episode, metrics=metrics, about={**drawn_episode.about, "note": ""}
        )


def objects() -> Catalogue:
    makers: dict[str, Callable[[], GraspObject]] = {
        "mug": lambda: procedural.generate(1, "mug"),
        "box": lambda: procedural.generate(1, "box"),
    }
    return Catalogue(makers)


@functools.cache
def _short() -> Message:
    return episode_message(6, removal=4)


def actor_episode(number: int, success: bool = True) -> Message:
    """A short episode of an actor, whose number is in the name of the object."""
    meta = {
        **_short().meta,
        "actor": f"a{number:03d}",
        "object": f"thing-{number}",
        "success": success,
    }
    return Message(_short().arrays, meta)


def status(actors: int, version: int = 12) -> dict[str, Any]:
    """Status of a run with many actors."""
    roles = [
        {
            "role": "actor",
            "id": f"a{n:03d}",
            "incarnation": "i",
            "version": version - n % 3,
            "lag": n % 3,
            "rollouts": 5 * n,
            "rollouts_per_second": 0.5,
            "steps_per_second": 1000.0 + n,
        }
        for n in range(actors)
    ]
    ledger = {"granted": 3, "running": 1, "redeemed": 2, "returned": 0, "expired": 0}
    return {
        "run": "fake",
        "version": version,
        "run_id": "e",
        "finished": False,
        "roles": roles,
        "warnings": [],
        "rates": {"rollouts_per_second": 50.0, "steps_per_second": 123456.0},
        "queue": {"length": 1, "limit": 4},
        "counters": ledger,
    }


def metrics(update: int) -> Message:
    """A learner's figures; its success dips at `DIP`."""
    success = 0.1 if update == DIP else min(0.95, 0.02 * update)
    values = {
        "episode/success": success,
        "episode/return": 3.0 * update,
        "staleness_mean": 0.5,
        "steps_per_second": 1e5,
        "success/heading": success,
        "success/pose": 0.5,
    }
    return Message(
        {}, {"time": BEGIN + 10.0 * update, "update": update, "version": update, "values": values}
    )


def window(actors: int = 100, updates: int = 60) -> TrainingWindow:
    """Training window of a run with many actors after some updates."""
    training = TrainingWindow("fake")
    keys = Keys("fake")
    now = time.time()
    for update in range(updates):
        training.take(keys.log("metrics", "learner", "0"), metrics(update), now)
    training.take_status(status(actors), now)
    for number in range(actors):
        training.take(
            keys.log("episode", "actor", f"a{number:03d}"),
            actor_episode(number, number % 4 > 0),
            now,
        )
    return training


def record(folder: pathlib.Path, moments: list[tuple[float, int]]) -> None:
    """Recordings of episodes: times (s since 1970) and numbers of actors."""
    writer = LogWriter(folder, "log", run="fake")
    channels = JsonChannels()
    for when, number in moments:
        actor = f"a{number:03d}"
        message = actor_episode(number)
        start = int(1e9 * when)
        entries = scene_entries(actor, Episode.from_message(message), start, 0, channels)
        writer.write(raw_entry(actor, message, start), *entries)
    writer.close()


class FakeImporter:
    """Makes a bottle of every file: 6 x 6 x 20 cm, by default in m; `cm` is in cm, and `unknown` of
    ambiguous unit.
    """

    def sides(self, path: pathlib.Path) -> tuple[float, float, float]:
        if path.suffix != ".stl":
            raise CongraspError(f"{path} is not an STL file.", "Convert it.")
        return {"cm": (6.0, 6.0, 20.0), "unknown": (0.9, 0.9, 3.0)}.get(
            path.stem, (0.06, 0.06, 0.2)
        )

    def load(self, path: pathlib.Path, unit: str) -> tuple[GraspObject, list[str]]:
        factor = (
            max(self.sides(path)) * {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}[unit] / 0.2
        )
        return procedural.generate(5, "bottle").scaled(factor), ["It was a bit small"]


def session(grasping: FakePolicy | None = None, **more: Any) -> Session:
    policy = grasping or FakePolicy()
    return Session({"of the run": lambda: policy}, objects(), FakeImporter(), **more)


class Site:
    """A studio with its server, session and fake policy."""

    def __init__(self, folder: pathlib.Path):
        when = BEGIN + 10 * DIP
        record(folder, [(when - 100, 1), (when - 2, 2), (when + 3, 3), (when + 100, 4)])
        self.grasping = FakePolicy()
        self.window: TrainingWindow = window(100)
        self.window.recordings = Recordings(folder)
        self.session: Session = session(self.grasping, window=self.window)
        self.server = PageServer(lambda browser: self.session.routes, "127.0.0.1", 0)

    @property
    def studio(self) -> dict[str, Any]:
        return self.session.state()["studio"]

    def do(self, action: str, **values: Any) -> None:
        self.session.routes.posts["/api/do"]({}, json.dumps({"action": action, **values}).encode())
