"""Force: the most with which a link may press on the object (ours)."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import jax
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
from congrasp.common.task.types import Array, Surface

if TYPE_CHECKING:
    from congrasp.common.config import TaskConfig
    from congrasp.common.task.sampling.bank import Draw

LEAST, MOST = 1.0, 20.0
"""N: limits that training draws, as far as the object's weight allows."""
_GRAVITY = 9.81
_LOWEST, _HIGHEST = 0.5, 50.0  # N that a request may name
_FAR = 10.0  # N beyond the limit from which on more costs no more
_SUGGESTED = 5.0


class ForceGoal(NamedTuple):
    """The same limit for all links."""

    limit: Annotated[Array, GoalArray((), "N, the most with which a link may press")]


class Force(Constraint):
    """An upper limit on the net contact force of each link."""

    name, title, goal = "force", "force limit", ForceGoal
    blocks = ("force_limit",)
    weights = (Weight("force_over", 0.05, "Per newton beyond the limit, per link (at most 10 N each)."),)
    errors = (ErrorSpec("force_ratio", "", "hold", 0.0, 0.1, "share of steps in which a link presses too hard"),)
    options = (
        Option("force", "The most with which a link may press, in newtons, such as: 3. Free by default."),
        Option("gentle", "The lowest force limit that suits the object's weight.", switch=True),
    )
    invalid = (f"The constraint 'force' takes a limit between {_LOWEST:g} and {_HIGHEST:g} N.", "Set 'force_limit'.")

    def fields(self, hand: Hand, task: "TaskConfig") -> tuple[tuple[ObservationField, ...], ...]:
        """The limit, and each link's excess."""
        return (
            (
                ObservationField("force_limit", 1, f"the limit over {MOST:g} N"),
                ObservationField("force_over", len(hand.links), "e / (e + 5 N) of each link's e N too much", True),
            ),
        )

    def sample(self, hand: Hand, draw: "Draw", key: Array) -> ForceGoal:
        """Log-uniform between the least limit for the episode's object and 20 N."""
        low = jnp.log(jnp.minimum(draw.least_force, MOST))
        drawn = jax.random.uniform(key, draw.objects.shape)
        return ForceGoal(jnp.exp(low + drawn * (jnp.log(MOST) - low)))

    def suggested(self, hand: Hand, task: "TaskConfig") -> dict[str, np.ndarray]:
        """5 N."""
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
        """A price for each newton beyond the limit."""
        return {"force_over": -scene.gate("force_limit") * jnp.sum(jnp.minimum(_excess(scene), _FAR), -1)}

    def measure(self, scene: Scene) -> dict[str, Array | tuple[Array, Array]]:
        """Steps in which at least one link presses harder than the limit, among all steps."""
        beyond = jnp.any(_excess(scene) > 0.0, -1).astype(jnp.float32)
        return {"force_ratio": (beyond, jnp.ones_like(beyond))}

    def valid(self, surface: Surface, own: ForceGoal) -> Array:
        """A limit that a hand can keep to."""
        return (own.limit >= _LOWEST) & (own.limit <= _HIGHEST)

    def explain(self, overridden: Sequence[str], redirected: bool) -> list[str]:
        """It holds with every other constraint."""
        return ["No link may press harder than the force limit."]

    def parse(self, given: Mapping[str, Any], hand: Hand, obj: GraspObject) -> dict[str, np.ndarray] | None:
        """A number, or the least limit for the object's weight."""
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
            raise CongraspError(f"--force is '{text}', not a number of newtons between {span}.", "Write --force 3.")
        return {"limit": np.array(limit, np.float32)}


def least_force(mass: Array, friction: Array) -> Array:
    """N, the least sensible limit for objects of this mass (kg) under this friction: m g / (2 mu), 1 N at least.

    Thumb and fingers press on opposite sides, each of which carries half of the weight by friction. The fingers share
    their side; the thumb alone has the other one.
    """
    return jnp.clip(mass * _GRAVITY / (2.0 * friction), LEAST, MOST)


def _limit(scene: Scene) -> Array:
    """(B, 1) N, positive whether or not it is active."""
    return jnp.maximum(scene.goal["force"].limit, _LOWEST)[:, None]


def _excess(scene: Scene) -> Array:
    """(B, L) N by which each link presses harder than the limit."""
    return jnp.maximum(jnp.linalg.norm(scene.features.force, axis=-1) - _limit(scene), 0.0)
