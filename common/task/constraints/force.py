"""Upper limit of the force with which a link may press on the object (ours)."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.lazy_jax import jnp
from congrasp.common.task.constraints.base import Constraint
from congrasp.common.task.constraints.specs import (
    ErrorSpec,
    GoalArray,
    ObservationField,
    Option,
    Weight,
)
from congrasp.common.task.geometry import FORCE_SCALE
from congrasp.common.task.sampling.bank import Draw
from congrasp.common.task.scene import Scene
from congrasp.common.task.settings import GRAVITY, TaskSettings
from congrasp.common.task.types import Array, Surface

_MIN_DRAWN_LIMIT = 1.0
"""Lowest limit drawn in training, N; heavier objects need a higher one."""
_MAX_DRAWN_LIMIT = 20.0
"""Highest limit drawn in training, N."""
_MIN_REQUEST = 0.5
"""Lowest limit of a request, N."""
_MAX_REQUEST = 50.0
"""Highest limit of a request, N."""
_MAX_COST_EXCESS = 10.0
"""Excess of a link's force at which the cost saturates, N."""
_SUGGESTED = 5.0
"""Limit when a user switches the constraint on, N."""


class ForceGoal(NamedTuple):
    """The same limit for all links."""

    limit: Annotated[Array, GoalArray((), "N, upper limit of the force of each link")]


class Force(Constraint):
    """An upper limit on the net contact force of each link."""

    name = "force"
    title = "force limit"
    goal = ForceGoal
    blocks = ("force_limit",)
    weights = (
        Weight("force_over", 0.05, "Per newton beyond the limit, per link (at most 10 N each)."),
    )
    errors = (
        ErrorSpec(
            name="force_ratio",
            unit="",
            window="hold",
            tolerance=0.0,
            scale=0.1,
            meaning="share of steps in which a link presses too hard",
        ),
    )
    options = (
        Option(
            "force", "Upper limit of each link's force in newtons, such as: 3. No limit by default."
        ),
        Option("gentle", "Use the lowest force limit that suits the object's weight.", switch=True),
    )
    invalid = (
        f"The constraint 'force' takes a limit between {_MIN_REQUEST:g} and {_MAX_REQUEST:g} N.",
        "Set 'force_limit' to a value in this range.",
    )

    def sample(self, hand: Hand, draw: Draw, uniform: Array) -> ForceGoal:
        """Samples log-uniformly between the least limit for the episode's object and 20 N."""
        low = jnp.log(least_force(draw.mass, draw.friction))
        return ForceGoal(jnp.exp(low + uniform[:, 0] * (jnp.log(_MAX_DRAWN_LIMIT) - low)))

    def explain(self, overridden: Sequence[str], redirected: bool) -> list[str]:
        """The limit is compatible with every other constraint."""
        return ["No link may press harder than the force limit."]

    def fields(self, hand: Hand, task: TaskSettings) -> tuple[tuple[ObservationField, ...], ...]:
        """Fields for the limit and each link's excess."""
        block = (
            ObservationField("force_limit", 1, f"the limit divided by {_MAX_DRAWN_LIMIT:g} N"),
            ObservationField(
                "force_over",
                len(hand.links),
                "e / (e + 5 N) for each link's excess e in N",
                privileged=True,
            ),
        )
        return (block,)

    def observe(self, scene: Scene) -> tuple[list[Array], ...]:
        """The limit and the squashed excess of each link."""
        excess = _excess(scene)
        return ([_limit(scene) / _MAX_DRAWN_LIMIT, excess / (excess + FORCE_SCALE)],)

    def force_max(self, scene: Scene, most: Array) -> Array:
        """No force beyond the limit earns anything."""
        active = self.active(scene.goal)[:, None]
        return jnp.where(active, jnp.minimum(most, _limit(scene)), most)

    def reward(self, scene: Scene) -> dict[str, Array]:
        """Cost of each newton beyond the limit."""
        excess = jnp.minimum(_excess(scene), _MAX_COST_EXCESS)
        return {"force_over": -scene.gate("force_limit") * jnp.sum(excess, -1)}

    def measure(self, scene: Scene) -> dict[str, Array | tuple[Array, Array]]:
        """Steps in which at least one link presses harder than the limit, as a share of all
        steps.
        """
        beyond = jnp.any(_excess(scene) > 0.0, -1).astype(jnp.float32)
        return {"force_ratio": (beyond, jnp.ones_like(beyond))}

    def suggested(self, hand: Hand, task: TaskSettings) -> dict[str, np.ndarray]:
        """A limit of 5 N."""
        return {"limit": np.array(_SUGGESTED, np.float32)}

    def parse(
        self, option_values: Mapping[str, Any], hand: Hand, obj: GraspObject
    ) -> dict[str, np.ndarray] | None:
        """Parses a number, or computes the least limit for the object's weight."""
        text = option_values["force"]
        gentle = option_values["gentle"]
        if text and gentle:
            raise CongraspError("--force and --gentle both set the force limit.", "Leave one out.")
        if gentle:
            return {"limit": np.asarray(least_force(obj.mass, 1.0), np.float32)}
        if not text:
            return None
        return {"limit": np.array(_parsed_limit(text), np.float32)}

    def valid(self, surface: Surface, values: ForceGoal) -> Array:
        """True for a limit within the range that a hand can satisfy."""
        return (values.limit >= _MIN_REQUEST) & (values.limit <= _MAX_REQUEST)


def _parsed_limit(text: str) -> float:
    """Parses the value of --force.

    Raises:
      CongraspError: it is not a number, or out of range.
    """
    try:
        limit = float(text)
    except ValueError:
        limit = np.nan
    if not _MIN_REQUEST <= limit <= _MAX_REQUEST:
        raise CongraspError(
            f"--force is '{text}', not a number between {_MIN_REQUEST:g} and {_MAX_REQUEST:g}.",
            "Pass newtons, such as --force 3.",
        )
    return limit


def least_force(mass: Array, friction: Array) -> Array:
    """Least sensible limit in N for objects of this mass (kg) with this friction: m g / (2 mu),
    between 1 and 20 N.

    Thumb and fingers press on opposite sides, each of which carries half of the weight by friction.
    The fingers share their side; the thumb carries the other.
    """
    return jnp.clip(mass * GRAVITY / (2.0 * friction), _MIN_DRAWN_LIMIT, _MAX_DRAWN_LIMIT)


def _limit(scene: Scene) -> Array:
    """Limit (B, 1) in N, positive whether or not it is active."""
    return jnp.maximum(scene.goal["force"].limit, _MIN_REQUEST)[:, None]


def _excess(scene: Scene) -> Array:
    """Force (B, L) in N by which each link exceeds the limit."""
    return jnp.maximum(jnp.linalg.norm(scene.features.force, axis=-1) - _limit(scene), 0.0)
