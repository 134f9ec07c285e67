import numpy as np
import pytest

from congrasp.common.wire.codec import Message
from congrasp.learner.statistics import CollapseWatch, Pace, overall, summary


def rollout(version: int = 0, steps: int = 1, **episodes: list[float]) -> Message:
    arrays = {
        name.replace("_", "/", 1): np.array(values, np.float32) for name, values in episodes.items()
    }
    return Message({**arrays, "reward": np.zeros((1, steps))}, {"version": version, "steps": steps})


def figures(*batches: list[Message]) -> dict[str, float]:
    summaries = []
    for messages in batches:
        lags = [9 - int(message.meta["version"]) for message in messages]
        summaries.append(summary(messages, lags))
    return overall(summaries)


def episode_means(messages: list[Message]) -> dict[str, float]:
    return {
        name: value for name, value in figures(messages).items() if not name.startswith("staleness")
    }


def test_means_are_over_episodes_and_not_over_rollouts():
    means = episode_means(
        [
            rollout(episode_return=[1, 0, 0], term_drop=[-1, -2, -3]),
            rollout(episode_return=[1], term_drop=[0]),
        ]
    )
    assert means == {"episode/return": 0.5, "term/drop": -1.5, "episodes": 4.0}


def test_rollouts_without_a_finished_episode_add_nothing():
    assert episode_means([rollout(episode_success=[])]) == {"episodes": 0.0}
    assert episode_means([rollout()]) == {"episodes": 0.0}


def test_errors_and_success_count_where_their_constraint_was_active():
    means = episode_means(
        [
            rollout(
                episode_success=[1, 0, 1, 0],
                episode_heading_rad=[0.1, 0.3, 9.0, 9.0],
                episode_pose_rad=[9.0, 9.0, 0.2, 0.4],
                episode_trajectory_m=[9.0, 9.0, 9.0, 0.5],
                episode_mask_affordance=[0, 0, 0, 0],
                episode_mask_pose_finger=[0, 0, 1, 1],
                episode_mask_pose_wrist=[0, 0, 1, 1],
                episode_mask_trajectory=[0, 0, 0, 1],
            )
        ]
    )
    expected = {
        "success/heading": 0.5,
        "success/pose": 0.5,
        "success/trajectory": 0.0,
        "episode/success": 0.5,
        "episode/heading_rad": 0.2,
        "episode/pose_rad": 0.3,
        "episode/trajectory_m": 0.5,
    }
    assert {name: means[name] for name in expected} == pytest.approx(expected)
    assert "success/affordance" not in means


def test_a_pose_with_a_trajectory_counts_for_both():
    """The fingers follow the pose; the distance of its wrist says nothing there."""
    means = episode_means(
        [
            rollout(
                episode_success=[1, 0],
                episode_pose_rad=[0.2, 0.4],
                episode_pose_m=[0.01, 9.0],
                episode_trajectory_m=[9.0, 0.5],
                episode_mask_pose_finger=[1, 1],
                episode_mask_pose_wrist=[1, 0],
                episode_mask_trajectory=[0, 1],
            )
        ]
    )
    expected = {"success/pose": 0.5, "success/trajectory": 0.0}
    expected |= {"episode/pose_rad": 0.3, "episode/pose_m": 0.01, "episode/trajectory_m": 0.5}
    assert {name: means[name] for name in expected} == pytest.approx(expected)
    assert "success/heading" not in means


def test_staleness_weighs_transitions():
    lags = figures([rollout(version=9, steps=300), rollout(version=7, steps=100)])
    assert lags == {"staleness_mean": 0.5, "staleness_max": 2.0, "episodes": 0.0}


def test_the_batches_of_several_ranks_count_as_one():
    """The error of a constraint is over the episodes that had it, whichever rank they were on."""

    def posed(version: int, steps: int, active: list[float], **episodes: list[float]) -> Message:
        bits = {"episode_mask_pose_finger": active, "episode_mask_pose_wrist": active}
        return rollout(version, steps, **episodes, **bits)

    first = [posed(7, 300, [1], episode_success=[1], episode_pose_rad=[0.1])]
    second = [
        posed(9, 100, [0, 1], episode_success=[0, 0], episode_pose_rad=[9.0, 0.4]),
        posed(9, 200, [0], episode_success=[1], episode_pose_rad=[9.0]),
    ]
    means = figures(first, second)
    joint = figures([*first, *second])
    assert means == pytest.approx(joint)
    expected = {
        "episode/success": 0.5,
        "episode/pose_rad": 0.25,
        "success/pose": 0.5,
        "episodes": 4.0,
    }
    expected |= {"staleness_mean": 1.0, "staleness_max": 2.0}
    assert {name: means[name] for name in expected} == pytest.approx(expected)


def test_pace_forgets_what_is_outside_its_window():
    now = iter([0.0, 10.0, 11.0, 12.0])
    pace = Pace(window=2, clock=lambda: next(now))
    assert pace.steps_per_second(100) == pytest.approx(10.0)
    assert pace.steps_per_second(100) == pytest.approx(200 / 11)
    assert pace.steps_per_second(100) == pytest.approx(100.0)


def first_alarm(success, links, patience=20):
    watch = CollapseWatch(patience)
    for update, (rate, touching) in enumerate(zip(success, links, strict=True), 1):
        if alarm := watch.add({"episode/success": rate, "episode/links_at_removal": touching}):
            return update, alarm
    return None


def test_a_fall_below_half_of_the_best_raises_an_alarm():
    # Ten updates at 80 % and then none: the mean of ten is below 40 % from the sixth on, so the
    # twentieth is the 25th.
    update, alarm = first_alarm([0.8] * 10 + [0.0] * 60, [3.0] * 70)
    assert update == 10 + 6 + 19
    assert "fell from 80% to 0%" in alarm


def test_a_hand_that_never_touches_raises_an_alarm():
    update, alarm = first_alarm([0.0] * 50, [0.05] * 50)
    assert update == 20
    assert "hardly touched" in alarm


@pytest.mark.parametrize(
    ("success", "links"),
    [
        ([0.01] * 200, [0.3] * 200),  # slow, but it touches
        ([0.8] * 30 + [0.1] * 18 + [0.8] * 30, [3.0] * 78),  # a dip that ends
        ([0.2] * 30 + [0.0] * 100, [3.0] * 130),  # nothing to lose yet
        ([0.0] * 19 + [0.1] + [0.0] * 19, [0.0] * 19 + [1.0] + [0.0] * 19),
    ],
)
def test_slow_starts_raise_no_alarm(success, links):
    assert first_alarm(success, links) is None


def test_without_patience_there_is_no_alarm():
    assert first_alarm([0.8] * 10 + [0.0] * 500, [0.0] * 510, patience=0) is None


def test_updates_without_episodes_do_not_count():
    assert CollapseWatch(1).add({"kl": 0.1}) is None
