"""Upper limit of the force with which a link may press on the object (ours)."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.constraints.base import (
    Constraint,
    ErrorSpec,
    GoalArray,
    ObservationField,
    Option,
    Scene,
    Weight,
)
from congrasp.common.task.geometry import FORCE_SCALE
from congrasp.common.task.sampling.bank import Draw
from congrasp.common.task.settings import GRAVITY, TaskSettings
from congrasp.common.task.types import Array, Surface

LEAST, MOST = 1.0, 20.0
"""Limits drawn in training, N, as far as the object's weight allows."""
_LOWEST, _HIGHEST = 0.5, 50.0  # range of a request's limit, N
_FAR = 10.0  # N beyond the limit at which the cost saturates
_SUGGESTED = 5.0


class ForceGoal(NamedTuple):
    """The same limit for all links."""

    limit: Annotated[Array, GoalArray((), "N, upper limit of the force of each link")]


class Force(Constraint):
    """An upper limit on the net contact force of each link."""

    name, title, goal = "force", "force limit", ForceGoal
    blocks = ("force_limit",)
    weights = (
        Weight("force_over", 0.05, "Per newton beyond the limit, per link (at most 10 N each)."),
    )
    errors = (
        ErrorSpec(
            "force_ratio", "", "hold", 0.0, 0.1, "share of steps in which a link presses too hard"
        ),
    )
    options = (
        Option(
            "force", "Upper limit of each link's force in newtons, such as: 3. No limit by default."
        ),
        Option(
            "gentle", "Uses the lowest force limit that suits the object's weight.", switch=True
        ),
    )
    invalid = (
        f"The constraint 'force' takes a limit between {_LOWEST:g} and {_HIGHEST:g} N.",
        "Set 'force_limit'.",
    )

    def fields(self, hand: Hand, task: TaskSettings) -> tuple[tuple[ObservationField, ...], ...]:
        """Fields for the limit and each link's excess."""
        return (
            (
                ObservationField("force_limit", 1, f"the limit divided by {MOST:g} N"),
                ObservationField(
                    "force_over",
                    len(hand.links),
                    "e / (e + 5 N) for each link's excess e in N",
                    True,
                ),
            ),
        )

    def sample(self, hand: Hand, draw: Draw, uniform: Array) -> ForceGoal:
        """Samples log-uniformly between the least limit for the episode's object and 20 N."""
        low = jnp.log(least_force(draw.mass, draw.friction))
        return ForceGoal(jnp.exp(low + uniform[:, 0] * (jnp.log(MOST) - low)))

    def suggested(self, hand: Hand, task: TaskSettings) -> dict[str, np.ndarray]:
        """A limit of 5 N."""
        return {"limit": np.array(_SUGGESTED, np.float32)}

    def force_max(self, scene: Scene, most: Array) -> Array:
        """No force beyond the limit earns anything."""
        active = self.active(scene.goal)[:, None]
        return jnp.where(active, jnp.minimum(most, _limit(scene)), most)

    def observe(self, scene: Scene) -> tuple[list[Array], ...]:
        """The limit and the squashed excess of each link."""
        over = _excess(scene)
        return ([_limit(scene) / MOST, over / (over + FORCE_SCALE)],)

    def reward(self, scene: Scene) -> dict[str, Array]:
        """Cost of each newton beyond the limit."""
        return {
            "force_over": -scene.gate("force_limit")
            * jnp.sum(jnp.minimum(_excess(scene), _FAR), -1)
        }

    def measure(self, scene: Scene) -> dict[str, Array | tuple[Array, Array]]:
        """Steps in which at least one link presses harder than the limit, as a share of all
        steps.
        """
        beyond = jnp.any(_excess(scene) > 0.0, -1).astype(jnp.float32)
        return {"force_ratio": (beyond, jnp.ones_like(beyond))}

    def valid(self, surface: Surface, own: ForceGoal) -> Array:
        """True for a limit within the range that a hand can satisfy."""
        return (own.limit >= _LOWEST) & (own.limit <= _HIGHEST)

    def explain(self, overridden: Sequence[str], redirected: bool) -> list[str]:
        """The limit is compatible with every other constraint."""
        return ["No link may press harder than the force limit."]

    def parse(
        self, given: Mapping[str, Any], hand: Hand, obj: GraspObject
    ) -> dict[str, np.ndarray] | None:
        """Parses a number, or computes the least limit for the object's weight."""
        text = given["force"]
        if text and given["gentle"]:
            raise CongraspError("--force and --gentle both set the force limit.", "Leave one out.")
        if given["gentle"]:
            return {"limit": np.asarray(least_force(obj.mass, 1.0), np.float32)}
        if not text:
            return None
        try:
            limit = float(text)
        except ValueError:
            limit = np.nan
        if not _LOWEST <= limit <= _HIGHEST:
            span = f"{_LOWEST:g} and {_HIGHEST:g}"
            raise CongraspError(
                f"--force is '{text}', not a number between {span}.", "Write --force 3."
            )
        return {"limit": np.array(limit, np.float32)}


def least_force(mass: Array, friction: Array) -> Array:
    """Least sensible limit in N for objects of this mass (kg) with this friction: m g / (2 mu),
    between 1 and 20 N.

    Thumb and fingers press on opposite sides, each of which carries half of the weight by friction.
    The fingers share their side; the thumb carries the other.
    """
    return jnp.clip(mass * GRAVITY / (2.0 * friction), LEAST, MOST)


def _limit(scene: Scene) -> Array:
    """Limit (B, 1) in N, positive whether or not it is active."""
    return jnp.maximum(scene.goal["force"].limit, _LOWEST)[:, None]


def _excess(scene: Scene) -> Array:
    """Force (B, L) in N by which each link exceeds the limit."""
    return jnp.maximum(jnp.linalg.norm(scene.features.force, axis=-1) - _limit(scene), 0.0)
