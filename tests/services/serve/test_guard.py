"""What reaches a robot while its policy answers, is silent, late, wrong or away."""

import dataclasses
import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from congrasp.common.errors import CongraspError, RefusedError, TransportError
from congrasp.common.request import GraspRequest
from congrasp.services.client.guard import Guard
from congrasp.services.client.limits import JointLimits
from congrasp.services.client.policy import Answer
from congrasp.services.client.query_thread import QueryThread
from congrasp.services.client.ticker import Ticker
from tests.waits import Clock, eventually

FINGERS = 2
OPEN = np.array([0.3, -0.3])
LIMITS = JointLimits(
    lower=np.append([-1.0, -0.4], np.full(6, -0.2)),
    upper=np.append([1.0, 0.4], np.full(6, 0.2)),
    speed=np.full(8, 5.0),
    torque=np.full(8, 1.0),
    kp=np.full(8, 2.0),
    kv=np.full(8, 0.1),
)
REST = np.array([0.0, 0.0, 0.05])
REQUEST = GraspRequest(q=np.zeros(FINGERS), object_pose=(REST, np.array([1.0, 0.0, 0.0, 0.0])))
STATE = {"q": np.zeros(FINGERS), "u": np.zeros(6), "object_position": REST}


def answer(value: object, wrist: object = None) -> Answer:
    wrist = np.zeros(6) if wrist is None else wrist
    return Answer(value, wrist, np.zeros(8), 1, (), 0.0, 0.0)  # type: ignore[arg-type]


class ScriptedPolicy:
    """Gives `outcome` (an answer, an exception or a function of the state), and keeps what it was
    asked.
    """

    def __init__(self, outcome):
        self.outcome = outcome
        self.states = []
        self.requests = []

    def reset(self, request):
        self.requests.append(request)

    def act(self, state):
        self.states.append(state)
        outcome = self.outcome(state) if callable(self.outcome) else self.outcome
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    def close(self):
        pass


def guarded(policy, clock, limits=LIMITS, request=REQUEST, **options):
    """A guard of a slow loop, so that the policy's thread has time to answer, in an episode."""
    guard = Guard(
        policy,
        limits,
        OPEN,
        period=0.5,
        wait=0.4,
        clock=clock,
        **{"stale": 0.6, "hold": 2.0, **options},
    )
    guard.reset(request)
    return guard


def test_answers_are_followed_from_the_targets_that_were_commanded():
    clock = Clock(100.0)
    policy = ScriptedPolicy(answer(np.array([0.9, 0.9])))
    with guarded(policy, clock) as guard:
        first = guard.step(STATE)
        clock.now += 0.01
        second = guard.step(STATE)
    assert first.mode == second.mode == "follow"
    assert second.answer is policy.outcome
    # 1 N.m over 2 N.m/rad ahead of the joint; its limit
    np.testing.assert_allclose(first.q_target, [0.5, 0.4])
    np.testing.assert_allclose(first.q_torque, [1.0, 0.8])
    np.testing.assert_array_equal(policy.states[0]["q_target"], np.zeros(FINGERS))
    np.testing.assert_array_equal(policy.states[1]["q_target"], first.q_target)
    assert policy.requests == [REQUEST]
    assert guard.counters.follow == guard.counters.answers == 2
    assert guard.counters.position == 2


def test_velocities_that_are_not_measured_are_estimated_from_positions():
    """A wrist at 0.4 m/s: its servo is that far ahead that friction of 0.1 N s/m leaves 1 N, 2 N/m
    being its gain.
    """
    clock = Clock(100.0)
    policy = ScriptedPolicy(answer(np.zeros(FINGERS), np.array([5.0, 0, 0, 0, 0, 0])))
    limits = dataclasses.replace(
        LIMITS, upper=np.full(8, 9.0), lower=np.full(8, -9.0), speed=np.full(8, 50.0)
    )
    with guarded(policy, clock, limits) as guard:
        turned = np.array([3.1, 3.2 - 2 * np.pi, 3.2 - 2 * np.pi, 3.3 - 2 * np.pi])
        way = np.array([0.0, 0.2, 0.2, 0.4])
        fingers = np.linspace(0.0, 0.15, 4)  # measured at every step, unlike the wrist
        moving = [
            {**STATE, "q": np.full(FINGERS, q), "u": np.array([x, 0, 0, 0, 0, angle])}
            for q, x, angle in zip(fingers, way, turned, strict=True)
        ]
        reached = []
        for state in moving:
            reached.append(guard.step(state).u_target[0])
            clock.now += 0.5
    np.testing.assert_allclose(reached[0], 0.5)  # at rest: 1 N over 2 N/m
    np.testing.assert_allclose(reached[1:], [0.2 + 0.02 + 0.5, 0.2 + 0.02 + 0.5, 0.4 + 0.01 + 0.5])
    # The third measurement says nothing new; the last is 0.2 m in a second. Angles beyond a half
    # turn are near.
    seen = [state["u_velocity"] for state in policy.states]
    np.testing.assert_allclose([x[0] for x in seen], [0.0, 0.4, 0.4, 0.2])
    np.testing.assert_allclose([x[5] for x in seen], [0.0, 0.2, 0.2, 0.1])
    np.testing.assert_allclose(
        [state["q_velocity"] for state in policy.states], [[0.0] * 2, *[[0.1] * 2] * 3]
    )


@pytest.mark.parametrize("fallback", ["freeze", "open"])
def test_without_answers_the_hand_holds_and_then_falls_back_until_the_next_episode(fallback):
    clock = Clock(100.0)
    policy = ScriptedPolicy(answer(np.array([0.2, 0.1])))
    with guarded(policy, clock, fallback=fallback) as guard:
        guard.step(STATE)
        policy.outcome = TransportError("Nobody is there.")
        modes = []
        for _ in range(5):
            clock.now += 0.5
            command = guard.step(STATE)
            modes.append(command.mode)
        # 0.5 s is fresh still; 2 s have gone at the last
        assert modes == [
            "follow",
            "hold",
            "hold",
            "hold",
            fallback,
        ]
        assert guard.trouble == "Nobody is there."
        assert guard.counters.lost == 5
        np.testing.assert_allclose(command.q_target, OPEN if fallback == "open" else [0.2, 0.1])
        policy.outcome = answer(np.array([-0.5, 0.0]))
        clock.now += 0.5
        latched = guard.step(STATE)
        assert latched.mode == fallback
        assert guard.trouble == ""
        np.testing.assert_allclose(latched.q_target, command.q_target)
        guard.reset(REQUEST)
        assert guard.step(STATE).mode == "follow"


@pytest.mark.parametrize(
    ("changed", "mode"),
    [
        ({}, "open"),
        ({"object_position": np.array([0.0, 0.0, 0.069])}, "open"),
        ({"object_position": np.array([0.0, 0.0, 0.071])}, "freeze"),
        ({"table": np.asarray(False)}, "freeze"),
        ({"object_position": np.full(3, np.nan)}, "freeze"),
        ({"q": np.full(FINGERS, np.nan)}, "freeze"),
    ],
)
def test_a_possibly_held_object_is_dropped_only_by_open(changed, mode):
    clock = Clock(100.0)
    policy = ScriptedPolicy(answer(np.array([0.2, 0.1])))
    with guarded(policy, clock, fallback="open") as guard:
        guard.step({**STATE, **({} if "q" in changed or mode == "open" else changed)})
        policy.outcome = TransportError("Nobody is there.")
        clock.now += 2.5
        now = {**STATE, **(changed if "object_position" in changed or "q" in changed else {})}
        command = guard.step(now)
        assert command.mode == mode
        guard.open()
        clock.now += 0.5
        opened = guard.step(now)
        assert opened.mode == "open"
        np.testing.assert_allclose(
            opened.q_target, OPEN if "q" not in changed else command.q_target
        )
        guard.reset(REQUEST)
        assert guard.step(STATE).mode == "hold"


def test_a_frozen_hand_keeps_its_targets_while_the_policy_answers():
    clock = Clock(100.0)
    policy = ScriptedPolicy(answer(np.array([0.2, 0.1])))
    with guarded(policy, clock, fallback="open") as guard:
        command = guard.step(STATE)
        guard.freeze()
        policy.outcome = answer(np.array([0.9, 0.9]))
        clock.now += 0.5
        frozen = guard.step(STATE)
        assert command.mode == "follow"
        assert frozen.mode == "freeze"
        np.testing.assert_allclose(frozen.q_target, command.q_target)
        guard.open()
        clock.now += 0.5
        assert guard.step(STATE).mode == "open"


def test_a_camera_policy_is_queried_without_object_pose():
    """Its hand opens after a silence, unless the table's absence says that something may be
    held.
    """
    state = {name: STATE[name] for name in ("q", "u")}
    for table, mode in ((True, "open"), (False, "freeze")):
        clock = Clock(100.0)
        policy = ScriptedPolicy(answer(np.array([0.2, 0.1])))
        with guarded(policy, clock, fallback="open") as guard:
            guard.reset(dataclasses.replace(REQUEST, object_pose=None, cloud=np.zeros((8, 3))))
            assert guard.step({**state, "table": table}).mode == "follow"
            policy.outcome = TransportError("Nobody is there.")
            clock.now += 2.5
            assert guard.step({**state, "table": table}).mode == mode
        assert policy.states[0].keys() == {
            "q",
            "u",
            "q_velocity",
            "u_velocity",
            "table",
            "q_target",
            "u_target",
        }


def test_a_lasting_nan_holds_and_then_freezes_with_the_torque_of_the_last_measurement():
    """2 N.m/rad from the joints at 0 to the targets at 0.2 and 0.1 rad."""
    clock = Clock(100.0)
    policy = ScriptedPolicy(answer(np.array([0.2, 0.1])))
    blind = {name: np.full_like(value, np.nan) for name, value in STATE.items()}
    with guarded(policy, clock, fallback="open") as guard:
        guard.step(STATE)
        policy.outcome = RefusedError("The field 'q' is not finite.")
        modes = []
        for _ in range(8):
            clock.now += 0.5
            command = guard.step(blind)
            modes.append(command.mode)
            np.testing.assert_allclose(command.q_target, [0.2, 0.1])
            np.testing.assert_allclose(command.q_torque, [0.4, 0.2])
    assert modes == ["follow", *["hold"] * 3, *["freeze"] * 4]


def test_limits_and_open_pose_are_those_of_the_policy_s_metadata():
    policy = ScriptedPolicy(answer(np.array([0.9, 0.9])))
    policy.metadata = lambda: {
        "hand": "two",
        "limits": LIMITS.as_lists(),
        "open_pose": OPEN.tolist(),
    }
    with Guard(policy, period=0.5, wait=0.4, stale=0.6, hold=2.0, clock=Clock(100.0)) as guard:
        guard.reset(REQUEST)
        np.testing.assert_allclose(guard.step(STATE).q_target, [0.5, 0.4])
        guard.open()
        np.testing.assert_allclose(guard.step(STATE).q_target, [0.5, 0.4])  # no time has passed
    policy.metadata = lambda: {"hand": "two", "limits": None, "open_pose": OPEN.tolist()}
    with pytest.raises(CongraspError, match="Joints of the hand 'two' share motors"):
        Guard(policy)


def test_the_palm_stays_above_the_table():
    """The base is 0.1 m above the table's top, turned by half about x: its z axis points down."""
    wrist = np.array([0.0, 0.0, 0.1]), np.array([0.0, 1.0, 0.0, 0.0])
    limits = dataclasses.replace(
        LIMITS, palm=np.array([[0.0, 0.0, 0.03, 0.02]]), speed=np.full(8, 100.0)
    )
    down = answer(np.zeros(2), np.array([0.1, 0.0, 0.15, 0.0, 0.0, 0.0]))
    request = dataclasses.replace(REQUEST, wrist=wrist)
    with guarded(ScriptedPolicy(down), Clock(100.0), limits, request) as guard:
        command = guard.step({**STATE, "u": down.u_target})
        np.testing.assert_allclose(command.u_target, [0.1, 0.0, 0.05, 0.0, 0.0, 0.0], atol=1e-9)
        assert guard.counters.table == 1
        for wrong in ((np.zeros(3), np.zeros(4)), (np.full(3, np.nan), wrist[1])):
            with pytest.raises(CongraspError, match="wrist's"):
                guard.reset(dataclasses.replace(REQUEST, wrist=wrong))
    with guarded(
        ScriptedPolicy(down), Clock(100.0), limits, request, table=(0.0, 0.0, 1.0, -1.0)
    ) as guard:
        np.testing.assert_allclose(guard.step({**STATE, "u": down.u_target}).u_target[2], 0.15)


def test_an_episode_starts_from_the_last_finger_targets_unless_moved():
    clock = Clock(100.0)
    policy = ScriptedPolicy(TransportError("Nobody is there."))
    elsewhere = GraspRequest(q=np.array([-0.6, 0.2]))
    with guarded(policy, clock) as guard:
        guard.reset(elsewhere)
        np.testing.assert_array_equal(guard.step({}).q_target, np.zeros(FINGERS))
        guard.reset(elsewhere, moved=True)
        np.testing.assert_array_equal(guard.step({}).q_target, elsewhere.q)


def test_the_hand_follows_again_when_answers_return():
    clock = Clock(100.0)
    policy = ScriptedPolicy(TransportError("Nobody is there."))
    with guarded(policy, clock) as guard:
        assert guard.step(STATE).mode == "hold"
        policy.outcome = answer(np.array([0.1, 0.1]))
        clock.now += 1.0
        assert guard.step(STATE).mode == "follow"
    assert len(policy.requests) == 2  # the first episode had not begun there


def test_an_answer_to_an_old_state_is_thrown_away():
    clock = Clock(100.0)

    def late(state):
        clock.now += 0.7
        return answer(np.array([0.2, 0.2]))

    with guarded(ScriptedPolicy(late), clock) as guard:
        command = guard.step(STATE)
    assert command.mode == "hold"
    assert guard.counters.stale == 1
    np.testing.assert_array_equal(command.q_target, np.zeros(FINGERS))


def test_a_late_answer_does_not_replace_the_next_one():
    done = threading.Event()

    def act(state):
        done.wait(20.0)
        return answer(state["q"])

    queries = QueryThread(ScriptedPolicy(act))
    queries.begin(REQUEST)
    assert queries.exchange(STATE, 0.0, timeout=0.0) is None
    done.set()
    eventually(lambda: not queries.is_busy)
    outcome = queries.exchange({**STATE, "q": np.full(2, 0.1)}, 1.0, timeout=20.0)
    queries.close()
    assert outcome.state_time == 1.0
    assert outcome.answer.q_target[0] == 0.1


def test_a_hanging_policy_does_not_block_the_loop():
    release, policy = (
        threading.Event(),
        ScriptedPolicy(lambda state: (release.wait(20.0), answer(np.ones(2)))[1]),
    )
    guard = Guard(
        policy, LIMITS, OPEN, period=0.01, wait=0.005, stale=0.02, hold=0.05, fallback="freeze"
    )
    guard.reset(REQUEST)
    modes = []
    while not modes or modes[-1] != "freeze":
        modes.append(guard.step(STATE).mode)
    assert len(policy.states) == 1
    assert guard.counters.late == len(modes)
    assert set(modes[:-1]) == {"hold"}
    guard.reset(REQUEST)
    release.set()  # what comes back now is of the episode before
    guard.step(STATE)
    assert guard.counters.answers <= 1
    assert not guard.counters.stale
    guard.close()


def test_missing_measurements_are_nan_in_the_query():
    """A client's query would have zeros there."""
    policy = ScriptedPolicy(answer(np.zeros(FINGERS)))
    with guarded(policy, Clock(100.0)) as guard:
        guard.step({"u": np.zeros(6)})
    (state,) = policy.states
    assert {name: value.shape for name, value in state.items() if np.isnan(value).all()} == {
        "q": (FINGERS,),
        "object_position": (3,),
        "object_quaternion": (4,),
    }


@pytest.mark.parametrize(
    ("outcome", "counter"),
    [
        (answer(np.array([np.nan, 0.0])), "invalid"),
        (answer(np.zeros(3)), "invalid"),
        (answer(np.zeros(2), np.full(6, np.inf)), "invalid"),
        (RefusedError("No."), "refused"),
        (TransportError("Away."), "lost"),
        (ValueError("a fault"), "lost"),
        (None, "lost"),
    ],
)
def test_an_invalid_answer_is_counted_and_holds(outcome, counter):
    with guarded(ScriptedPolicy(outcome), Clock(100.0)) as guard:
        command = guard.step(STATE)
    assert command.mode == "hold"
    assert getattr(guard.counters, counter) == 1
    assert guard.counters.answers == 0
    np.testing.assert_array_equal(command.q_target, np.zeros(FINGERS))


NUMBERS = st.one_of(st.floats(allow_nan=True, allow_infinity=True), st.floats(-2.0, 2.0))
ARRAYS = st.one_of(
    st.lists(NUMBERS, min_size=FINGERS, max_size=FINGERS).map(np.array),
    st.lists(NUMBERS, min_size=6, max_size=6).map(np.array),
    st.sampled_from([None, "x", np.zeros((2, 2)), np.zeros(0)]),
)
OUTCOMES = st.one_of(
    st.builds(answer, ARRAYS, ARRAYS),
    st.sampled_from([TransportError("away"), KeyError("q"), None]),
)
STATES = st.dictionaries(
    st.sampled_from(["q", "u", "q_velocity", "u_velocity", "object_position"]), ARRAYS
)
TIMES = st.one_of(st.floats(-0.1, 1.0), st.just(float("nan")))


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.tuples(OUTCOMES, STATES, TIMES, st.booleans()), min_size=1, max_size=12),
    st.sampled_from(["freeze", "open"]),
)
def test_no_command_ever_leaves_the_limits(steps, fallback):
    clock = Clock(100.0)
    policy = ScriptedPolicy(None)
    with guarded(policy, clock, fallback=fallback) as guard:
        last = np.zeros(FINGERS + 6)
        has_floor = False
        for outcome, state, passed, begins in steps:
            policy.outcome = outcome
            if begins:
                guard.reset(
                    GraspRequest(
                        q=np.full(FINGERS, 9.0), wrist=(np.zeros(3), np.array([1.0, 0, 0, 0]))
                    )
                )
                last[FINGERS:] = 0.0
                has_floor = True
            clock.now += passed
            command = guard.step(state)
            target = np.append(command.q_target, command.u_target)
            assert (target >= LIMITS.lower).all()
            assert (target <= LIMITS.upper).all()
            assert (np.abs(target - last) <= LIMITS.speed * 0.5 + 1e-12).all()
            assert (np.abs(np.append(command.q_torque, command.u_torque)) <= LIMITS.torque).all()
            assert command.u_target[2] >= -1e-9 or not has_floor
            last = target
    assert guard.counters.steps == len(steps)


def test_invalid_guard_options_are_refused():
    for wrong in (
        {"wait": 0.01},
        {"stale": 0.0},
        {"hold": 0.01},
        {"fallback": "wave"},
        {"stale": float("nan")},
    ):
        with pytest.raises(CongraspError):
            Guard(ScriptedPolicy(None), LIMITS, OPEN, **wrong)
    with pytest.raises(CongraspError, match="open pose"):
        Guard(ScriptedPolicy(None), LIMITS, np.zeros(3))
    with Guard(ScriptedPolicy(None), LIMITS, OPEN) as guard:
        with pytest.raises(RefusedError, match="no episode"):
            guard.step(STATE)
        with pytest.raises(CongraspError, match="finite"):
            guard.reset(GraspRequest())


@pytest.mark.parametrize("name", ["wrist", "object_pose"])
def test_a_pose_that_is_no_pair_is_refused(name):
    with Guard(ScriptedPolicy(None), LIMITS, OPEN) as guard:
        with pytest.raises(CongraspError, match=f"'{name}' must be a"):
            guard.reset(dataclasses.replace(REQUEST, **{name: (REST,)}))
        with pytest.raises(RefusedError, match="no episode"):
            guard.step(STATE)


def test_a_ticker_counts_the_ticks_that_it_leaves_out():
    ticker = Ticker(100.0)
    first = ticker.wait()
    time.sleep(0.055)
    late = ticker.wait()
    assert late - first >= 0.055
    assert ticker.ticks == 2
    assert ticker.missed >= 4
    assert ticker.longest_ms >= 40.0
    assert ticker.jitter_ms(100) == ticker.longest_ms
    assert ticker.wait() > late  # at the next multiple of the period, not at once
    with pytest.raises(CongraspError, match="100 Hz"):
        Ticker(200.0)
