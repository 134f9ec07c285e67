"""The policy of the studio: its newest weights, and the choice between the drawn grasp and its
variations.
"""

import dataclasses
import threading
from collections.abc import Callable

import numpy as np
import pytest

from congrasp.actors.attempts import Outcome
from congrasp.actors.stress import ASSESSED_NAMES
from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.services.studio import grasping
from congrasp.services.studio.grasping import ATTEMPTS, SECONDS, PolicyGrasping
from congrasp.services.studio.session import Jobs
from congrasp.services.studio.state import Studio
from tests import task
from tests.studio import objects

POLICY = task.policy()


class Source:
    """Returns what `next` returns."""

    def __init__(self) -> None:
        self.next: Callable[[], PolicyBundle | None] = lambda: POLICY

    def __call__(self, version: int) -> PolicyBundle | None:
        return self.next()


def outcome(held: list[int], error: list[float]) -> Outcome:
    names = ("success", "held", "heading_rad", "heading_m", "moved_at_removal", "force_link_max")
    metrics = {name: np.zeros(ATTEMPTS) for name in (*names, *ASSESSED_NAMES)}
    metrics["success"][held] = metrics["held"][held] = 1.0
    metrics["heading_rad"][: len(error)] = error

    class Trace:
        object_position = np.zeros((3, ATTEMPTS, 3))
        table = np.array([[1] * ATTEMPTS, [1] * ATTEMPTS, [0] * ATTEMPTS])

    none = np.zeros(ATTEMPTS, bool)
    return Outcome(None, none, ~none, metrics, Trace())  # type: ignore[arg-type]


def test_newer_weights_are_taken_and_those_that_do_not_fit_are_refused() -> None:
    source = Source()
    policy = PolicyGrasping(source, "the run 'r'")
    newer = dataclasses.replace(POLICY, version=POLICY.version + 5)
    source.next = lambda: newer
    policy.refresh()
    assert policy.newest() == {
        "source": "the run 'r'",
        "version": POLICY.version + 5,
        "trouble": "",
    }
    other = dataclasses.replace(newer, spec=dataclasses.replace(newer.spec, hand="allegro"))
    source.next = lambda: other
    policy.refresh()
    assert policy.newest()["version"] == newer.version
    assert "allegro" in policy.newest()["trouble"]

    def away() -> PolicyBundle | None:
        raise TransportError("nobody is there")

    source.next = away
    policy.refresh()
    assert "disconnected" in policy.newest()["trouble"]
    source.next = lambda: None
    policy.refresh()
    assert policy.newest()["trouble"] == ""
    with pytest.raises(CongraspError, match="no policy of the run 'r' yet"):
        PolicyGrasping(source, "the run 'r'")


def test_the_drawn_grasp_is_the_first_attempt_and_its_variations_are_near() -> None:
    policy = PolicyGrasping(Source(), "file")
    studio = Studio(policy.hand, policy.task, objects().get("mug"))
    episodes, aside = grasping.varied_episodes(
        policy.hand, policy.task, studio.labelled, studio.request
    )
    goal = episodes.goal["heading"]
    np.testing.assert_allclose(goal.position[0], studio.arrow.position, atol=1e-6)
    np.testing.assert_allclose(goal.direction[0], studio.arrow.direction, atol=1e-6)
    assert aside[0] == 0
    assert (aside[1:] > 0).all()
    assert aside.max() < 0.04
    cosine = goal.direction @ studio.arrow.direction
    assert (cosine > np.cos(0.5)).all()
    assert cosine[1:].max() < 1 - 1e-6
    np.testing.assert_allclose((goal.direction * goal.cross).sum(-1), 0.0, atol=1e-5)


@pytest.mark.parametrize(
    ("held", "error", "index", "says"),
    [
        ([0, 1, 2], [0.1, 0.0, 0.0], 0, ""),
        ([0, 1, 2], [1.5, 1.5, 0.0], 2, "is better than the drawn grasp: it is 4 mm"),
        ([3], [0.0], 3, "holds; the drawn grasp does not"),
        ([], [0.0], 0, ""),
    ],
)
def test_the_drawn_grasp_is_shown_unless_a_variation_is_clearly_better(held, error, index, says):
    attempts = outcome(held, error)
    removal = int(attempts.trace.table[:, 0].sum()) - 1
    assert grasping.best_attempt(attempts, (), removal, 0.0) == index
    assert says in grasping.variation_note(attempts, index, np.full(ATTEMPTS, 0.004))
    assert bool(says) == bool(grasping.variation_note(attempts, index, np.full(ATTEMPTS, 0.004)))


def test_a_job_shows_its_elapsed_seconds() -> None:
    jobs = Jobs()
    done = threading.Event()
    jobs.start(f"compiling, {SECONDS} s of about 60", lambda progress: done.wait(60) and None)
    assert jobs.state()["text"] == "compiling, 0 s of about 60"
    with pytest.raises(CongraspError, match="Please wait: compiling, 0 s"):
        jobs.require_idle()
    done.set()
    jobs.close()
