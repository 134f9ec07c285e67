"""Validates the values of rollouts: every number is compared with the task's range, and names are a
closed set.

Values within these ranges are trusted. An actor whose rollout is refused must back off, longer each
time (`learner.hub.limits.PutOff`).

The ranges are computed by evaluating the task. Engines end environments that exceed `MAX_SPEED` or
`MAX_DISTANCE` (`common.ranges`). Observation and reward terms are evaluated in random states up to
these limits, where every clipped term reaches its bound. The ranges of external constraints and
terms therefore follow as well.
"""

import collections
import dataclasses
import functools
import threading
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common.config import CurriculumConfig
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.ranges import MAX_DISTANCE, MAX_SPEED
from congrasp.common.task import privileged
from congrasp.common.task.config import RewardWeights, TaskConfig
from congrasp.common.task.constraints import known
from congrasp.common.task.constraints.base import symbol_sizes
from congrasp.common.task.features import scene_of
from congrasp.common.task.grip import ObjectLoad
from congrasp.common.task.metrics import DIVERGED, FORCES, episode_fields
from congrasp.common.task.observation import observe
from congrasp.common.task.privileged import Parameters, observe_for_teacher
from congrasp.common.task.readings import Readings
from congrasp.common.task.reward import reward_terms
from congrasp.common.task.sensors import get_sensor
from congrasp.common.task.types import CONTACTS_PER_LINK, Goal, SceneState, Surface
from congrasp.common.wire.codec import Message
from congrasp.learner.hub.limits import PutOff

_DENSITY = (-100.0, 10.0)
"""Bounds of the log probability of each action, nats: the lower is reached 14 standard deviations
from the mean, the upper at the mean with a standard deviation of 2e-5."""
_ACTIONS = 256  # used if a rollout has a log probability but no action
_ROWS = 128
_NAMES = 1024  # actors for which refused rollouts are counted
_HALF_MAGNITUDE = 0x7FFF


class Ranges(NamedTuple):
    """Largest magnitudes that a task can produce (`task_ranges`)."""

    observation: np.ndarray
    """(D,)."""
    reward: float
    """Reward of a control step."""
    action: float
    """Action, in its units: targets are clipped far below."""
    episodes: dict[str, tuple[float, float]]
    """Least and largest value of each metric of an episode, by its name on the wire; other names
    are refused.
    """
    teacher_observation: np.ndarray = np.zeros(0)
    """(S,)."""
    privileged: np.ndarray = np.zeros(0)
    """(P,)."""


class Admission:
    """Compares the values of rollouts with a task's ranges, and defers offenders; thread-safe."""

    def __init__(self, ranges: Callable[[], Ranges] | None = None):
        """Gets the ranges from a function at the first rollout, whose reply waits for it; None
        accepts any values.
        """
        self._ranges = ranges
        self._lock = threading.Lock()
        self._put_off = PutOff()
        self._refused: collections.Counter[str] = collections.Counter()
        self.rejected = 0
        """Number of requests of deferred actors."""

    def check(self, message: Message) -> None:
        """Checks the values of a rollout of valid form; device arrays, which never left this
        process, are not checked.

        Raises:
          CongraspError: a value is out of range, or the task has no such metric; the message names
            it.
        """
        arrays = {
            name: array for name, array in message.arrays.items() if isinstance(array, np.ndarray)
        }
        if not arrays or self._ranges is None:
            return
        ranges = self._ranges()
        for name, array in arrays.items():
            if name.startswith(("episode/", "term/")):
                if name not in ranges.episodes:
                    raise CongraspError(
                        f"The rollout names {ascii(name)[:60]}, which is not a metric of the task."
                    )
                _within(name, array, *ranges.episodes[name])
            elif name in ("observation", "last_observation"):
                _check_observations(name, array, ranges.observation)
            elif name == "teacher_observation":
                _check_observations(name, array, ranges.teacher_observation)
            elif name in ("privileged", "last_privileged"):
                _check_observations(name, array, ranges.privileged)
            elif name == "reward":
                _within(name, array, -ranges.reward, ranges.reward)
            elif name == "action":
                _within(name, array, -ranges.action, ranges.action)
            elif name == "log_probability":
                actions = arrays["action"].shape[-1] if "action" in arrays else _ACTIONS
                _within(name, array, *(actions * bound for bound in _DENSITY))

    def accept(self, actor: str) -> None:
        """Records an accepted rollout of an actor."""
        with self._lock:
            self._put_off.forgive(actor)

    def refuse(self, actor: str) -> None:
        """Records a refused rollout, and defers the actor."""
        with self._lock:
            self._put_off.offend(actor)
            if actor in self._refused or len(self._refused) < _NAMES:
                self._refused[actor] += 1

    def retry_after(self, actor: str) -> float:
        """Seconds until the actor may send again, usually 0; counts earlier requests."""
        with self._lock:
            seconds = self._put_off.seconds(actor)
            self.rejected += seconds > 0
            return seconds

    def counts(self, actor: str) -> dict[str, int]:
        """Numbers of refused rollouts of an actor, for the status."""
        with self._lock:
            return {"refused": self._refused[actor]}


def _within(name: str, array: np.ndarray, least: float, most: float) -> None:
    """Raises a `CongraspError` for a number out of range."""
    if array.size and not (least <= (low := array.min()) and (high := array.max()) <= most):
        raise _outside(name, low if low < least else high, least, most)


def _check_observations(name: str, array: np.ndarray, most: np.ndarray) -> None:
    """Raises a `CongraspError` for an entry of observations (..., D) whose magnitude exceeds its
    bound (D,).
    """
    for rows, bounds in _magnitudes(array, most):
        if (rows > bounds).any():
            entry = int((rows > bounds).any(0).argmax())
            worst = np.abs(array[..., entry]).max()
            raise _outside(f"{name}[{entry}]", worst, -most[entry], most[entry])


def _magnitudes(array: np.ndarray, most: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields blocks of rows (n, D) and bounds (D,), ordered like magnitudes; half precision by its
    bits.
    """
    flat = array.reshape(-1, array.shape[-1])
    if array.dtype != np.float16:
        yield np.abs(flat), most.astype(array.dtype)
        return
    bits, bounds = flat.view(np.uint16), most.astype(np.float16).view(np.uint16)
    for start in range(0, len(bits), _ROWS):  # blocks that fit into the processor's cache
        yield bits[start : start + _ROWS] & _HALF_MAGNITUDE, bounds


def _outside(name: str, value: Any, least: float, most: float) -> CongraspError:
    """Error for a number that the task cannot produce."""
    return CongraspError(
        f"The rollout's array '{name}' holds {value:.4g}; the task's are within {least:.4g} and "
        f"{most:.4g}."
    )


_STATES = 128
_SLACK = 2.0
_BEYOND = 1.0  # rad by which a finger joint is pressed beyond its limits
_TURN = 2 * np.pi  # rad of a wrist hinge
_FORCE = 1e3  # N; terms and observations clip or squash forces far below this
_FLAGS = ("success", "held", DIVERGED)
_LARGEST = 1e6  # limit of an error or a force, in its unit
_ACTION = 1e3
_MASS = 1e3  # kg
_FEATHER = 1e-3  # N


@functools.lru_cache(maxsize=8)
def task_ranges(task: TaskConfig, curriculum: CurriculumConfig) -> Ranges:
    """Returns the ranges of a task under all reward weights of its curriculum."""
    hand = get_hand(task.hand)
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        evaluate = jax.jit(functools.partial(_evaluate, hand, task))
        *observed, terms = jax.device_get(evaluate(_extremes(hand, task)))
    weights = (
        [task.reward, curriculum.reward]
        if curriculum.ramp[1] > curriculum.ramp[0]
        else [task.reward]
    )
    most = {
        name: _SLACK
        * float(np.abs(values).max())
        * max(abs(getattr(each, name)) for each in weights)
        for name, values in terms.items()
    }
    reward = sum(most.values())
    steps = task.approach_steps + max(task.hold_steps, task.hold_steps_max)
    episodes = dict.fromkeys(episode_fields(task), (-_LARGEST, _LARGEST))
    episodes |= {f"term/{name}": (-bound * steps, bound * steps) for name, bound in most.items()}
    episodes |= {f"episode/{name}": (0.0, _LARGEST) for name in FORCES}
    episodes |= {
        "episode/return": (-reward * steps, reward * steps),
        "episode/length": (0.0, float(steps)),
    }
    episodes |= {
        name: (0.0, 1.0)
        for name in episodes
        if name.startswith("episode/mask_") or name in {f"episode/{flag}" for flag in _FLAGS}
    }
    # Some observations are zero in every state here, and rounding errors must not be refused.
    own, teacher, critic = (_SLACK * np.abs(found).max(0) + 1.0 for found in observed)
    return Ranges(own, reward, _ACTION, episodes, teacher, critic)


class _Extremes(NamedTuple):
    """Random control steps up to the engines' limits."""

    state: SceneState
    surface: Surface
    goal: Goal
    readings: Readings
    measured: dict[str, Any]
    """Further measurements of the sensor."""
    parameters: Parameters


def _evaluate(hand: Hand, task: TaskConfig, extremes: _Extremes) -> tuple[Any, Any, Any, Any]:
    """Evaluates observations (B, D), (B, S) of a teacher and (B, P) of the critic, and unweighted
    reward terms.
    """
    full = dataclasses.replace(task, observation="full")
    scene = scene_of(hand, full, extremes.state, extremes.surface, extremes.goal)
    parameters = extremes.parameters
    # An object that every contact carries, for the terms that depend on its weight.
    load = ObjectLoad(
        weight=jnp.full(scene.state.time.shape, _FEATHER), friction=parameters.friction
    )
    scene = scene._replace(load=load)
    ones = {field.name: 1.0 for field in dataclasses.fields(RewardWeights)}
    terms = reward_terms(scene, RewardWeights(**{**ones, "force_max": task.reward.force_max}))
    own = scene._replace(task=task, readings=extremes.readings, measured=extremes.measured)
    return (
        observe(own),
        observe_for_teacher(scene, own, task.control),
        privileged.observe(own, parameters),
        terms,
    )


def _extremes(hand: Hand, task: TaskConfig) -> _Extremes:
    """Random states up to the engines' limits, with random surfaces and goals in which everything
    is active.

    The readings before a state belong to other states.
    """
    rng = np.random.default_rng(0)
    fingers, contacts = len(hand.joints), (_STATES, len(hand.links), CONTACTS_PER_LINK)

    within, unit = functools.partial(_inside, rng), functools.partial(_unit, rng)

    def joints() -> np.ndarray:
        return rng.uniform(hand.lower - _BEYOND, hand.upper + _BEYOND, (_STATES, fingers)).astype(
            np.float32
        )

    reach = rng.choice([0.1, MAX_DISTANCE], (_STATES, 1))  # hand and object touch, or are far apart
    start = within(3)
    u = within(6, most=np.concatenate([reach, reach, reach, np.full((_STATES, 3), _TURN)], 1))
    state = SceneState(
        q=joints(),
        u=u,
        q_velocity=within(fingers, most=MAX_SPEED),
        u_velocity=within(6, most=MAX_SPEED),
        q_target=joints(),
        u_target=u + within(6, most=MAX_DISTANCE),
        object_position=start + within(3, most=reach),
        object_quaternion=unit(4),
        object_velocity=within(3, most=MAX_SPEED),
        object_angular_velocity=within(3, most=MAX_SPEED),
        contact_force=within(*contacts[1:], 3, most=_FORCE),
        contact_position=start[:, None, None] + within(*contacts[1:], 3, most=0.2),
        contact_found=rng.random(contacts) < 0.5,
        base_position=start + within(3, most=0.1),
        base_quaternion=unit(4),
        q_initial=joints(),
        object_position_initial=start,
        object_quaternion_initial=unit(4),
        wrist_load=within(6, most=MAX_SPEED),
        time=rng.integers(0, task.approach_steps + task.hold_steps_max + 1, _STATES).astype(
            np.float32
        ),
        table=rng.random(_STATES) < 0.5,
    )
    count = task.surface_points
    surface = Surface(within(count, 3, most=0.1), rng.random((_STATES, count)) < 0.5)
    if task.surface_normals:
        surface = surface._replace(normals=unit(count, 3))
    goal = _goal(hand, task, rng)
    others = rng.integers(0, _STATES, (_STATES, task.history))
    others[:, 0] = np.arange(_STATES)
    readings = Readings(*(getattr(state, name)[others] for name in Readings._fields))
    sensors = None
    if task.sensed:
        sensors = get_sensor(task).draw(task.sensing, task.control_dt, jax.random.key(0), _STATES)
    parameters = Parameters(
        mass=rng.uniform(0.0, _MASS, _STATES),
        friction=rng.uniform(*task.friction_range, _STATES),
        gain_scale=rng.uniform(*task.gain_range, _STATES),
        stationary=rng.random(_STATES) < 0.5,
        hold=rng.integers(0, max(task.hold_steps, task.hold_steps_max) + 1, _STATES),
        sensors=sensors,
    )
    measured = {}
    for name, shape in get_sensor(task).query(hand, task).items():
        measured[name] = within(*shape, most=MAX_DISTANCE)
    extremes = _Extremes(state, surface, goal, readings, measured, parameters)
    return jax.tree.map(jnp.asarray, extremes)


def _goal(hand: Hand, task: TaskConfig, rng: np.random.Generator) -> Goal:
    """Random goals in which every constraint is active."""
    symbols, values = symbol_sizes(hand, task), {}
    for constraint in known(task):
        made = {}
        for name, array in constraint.arrays.items():
            shape = tuple(symbols[size] if isinstance(size, str) else size for size in array.shape)
            if array.kind == "flag":
                made[name] = rng.random((_STATES, *shape)) < 0.5
            elif array.kind in ("real", "position"):
                made[name] = _inside(rng, *shape, most=0.3)
            else:
                made[name] = _unit(rng, *shape)
        values[constraint.name] = constraint.goal(**made)
    return Goal(
        values,
        {
            block: np.ones(_STATES, bool)
            for constraint in known(task)
            for block in constraint.blocks
        },
    )


def _inside(rng: np.random.Generator, *shape: int, most: Any = 1.0) -> np.ndarray:
    """Numbers (B, *shape) up to a magnitude; some at the bounds and some in the middle, where terms
    differ.
    """
    drawn = rng.uniform(-1.0, 1.0, (_STATES, *shape))
    towards = rng.choice([0.1, 1.0, 8.0], (_STATES, *[1] * len(shape)))
    return np.asarray(most * np.sign(drawn) * np.abs(drawn) ** towards, np.float32)


def _unit(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Unit vectors (B, *shape)."""
    drawn = rng.normal(size=(_STATES, *shape))
    return (drawn / np.linalg.norm(drawn, axis=-1, keepdims=True)).astype(np.float32)
