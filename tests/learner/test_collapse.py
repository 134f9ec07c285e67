"""Collapses are noticed, slow learning and noise are not."""

import pytest

from congrasp.learner.collapse import CollapseWatch


def first_alarm(success, links, patience=20):
    watch = CollapseWatch(patience)
    for update, (rate, touching) in enumerate(zip(success, links, strict=True), 1):
        if said := watch.add({"episode/success": rate, "episode/links_at_removal": touching}):
            return update, said
    return None


def test_a_fall_below_half_of_the_best_is_said_after_the_patience():
    # Ten updates at 80 % and then none: the mean of ten is below 40 % from the sixth on, so the twentieth is the 25th.
    update, said = first_alarm([0.8] * 10 + [0.0] * 60, [3.0] * 70)
    assert update == 10 + 6 + 19
    assert "fell from 80% to 0%" in said


def test_a_hand_that_never_touches_is_said():
    update, said = first_alarm([0.0] * 50, [0.05] * 50)
    assert update == 20 and "hardly touched" in said


@pytest.mark.parametrize(
    ("success", "links"),
    [
        ([0.01] * 200, [0.3] * 200),  # slow, but it touches
        ([0.8] * 30 + [0.1] * 18 + [0.8] * 30, [3.0] * 78),  # a dip that ends
        ([0.2] * 30 + [0.0] * 100, [3.0] * 130),  # nothing to lose yet
        ([0.0] * 19 + [0.1] + [0.0] * 19, [0.0] * 19 + [1.0] + [0.0] * 19),
    ],
)
def test_what_may_still_become_something_goes_on(success, links):
    assert first_alarm(success, links) is None


def test_without_patience_nothing_is_said():
    assert first_alarm([0.8] * 10 + [0.0] * 500, [0.0] * 510, patience=0) is None


def test_updates_without_episodes_do_not_count():
    assert CollapseWatch(1).add({"kl": 0.1}) is None
