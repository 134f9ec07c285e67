"""Episodes for the logs, put together from the traces of successive rollouts."""

import types

import numpy as np

from congrasp.actors.followed import Follower
from congrasp.actors.rollout import Trace
from congrasp.common.task.types import Surface


class Goal(str):
    """A goal with one row."""

    def row(self, index):
        return self


def state(name, obj=0):
    surface = Surface(np.zeros((1, 8, 3)), np.zeros((1, 8), bool))
    reset_state = types.SimpleNamespace(object_index=np.array([obj]))
    return types.SimpleNamespace(goal=Goal(name), surface=surface, reset_state=reset_state)


def rollout(*times, ended=()):
    """A trace whose wrist's height is the time in the episode."""
    fields = dict.fromkeys(Trace._fields, np.zeros((len(times), 2)))
    q = np.array(times, float)[:, None]
    return Trace(**{**fields, "q": q, "terminal": np.isin(np.arange(len(times)), ended)})


def test_an_episode_that_begins_within_a_rollout_is_followed_to_its_end():
    follower = Follower()
    # The first episode goes on from before, the next one begins with the third step.
    assert follower.add(rollout(8, 9, 0, ended=[1]), None, state("next", 3), due=True) is None
    assert follower.add(rollout(1, 2, 3), None, state("none"), due=False) is None
    found = follower.add(rollout(4, 5, 0, ended=[1]), None, state("other"), due=False)
    assert (found.goal, found.object_index) == ("next", 3)
    assert found.trace.q.ravel().tolist() == [0, 1, 2, 3, 4, 5]
    # It follows nothing then, until one is due again.
    assert follower.add(rollout(0, 1, 2, 3, 4, 5, ended=[5]), state("fresh"), state("none"), due=False) is None
    found = follower.add(rollout(0, 1, 2, 3, 4, 5, 0, ended=[5]), state("fresh", 2), state("none"), due=True)
    assert (found.goal, found.object_index, len(found.trace.q)) == ("fresh", 2, 6)
    # What a rollout says of its last episode is not said of another.
    assert follower.add(rollout(0, 1, 0, 1, 2, ended=[1, 4]), state("fresh"), state("none"), due=True) is None
    assert follower.add(rollout(0, 1, ended=[1]), state("last"), state("none"), due=True).goal == "last"


def test_what_ends_with_a_rollout_begins_nothing_in_it_and_what_is_forgotten_is_not_joined():
    follower = Follower()
    assert follower.add(rollout(7, 8, ended=[1]), None, state("none"), due=True) is None
    assert follower.add(rollout(0, 1), state("fresh"), state("none"), due=True) is None
    follower.forget()
    assert follower.add(rollout(2, 3), None, state("none"), due=True) is None
    assert follower.add(rollout(0, 1), state("again"), state("none"), due=True) is None
    assert follower.add(rollout(2, 3, ended=[1]), None, state("none"), due=True).goal == "again"
