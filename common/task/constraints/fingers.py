"""Fingers that may touch the object (ours). Thumb and index finger form a pinch, adding the middle
finger a tripod.
"""

import functools
from collections.abc import Collection, Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np

from congrasp.common import chance
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.lazy_jax import jax, jnp
from congrasp.common.task.constraints.base import Constraint
from congrasp.common.task.constraints.specs import (
    ErrorSpec,
    GoalArray,
    ObservationField,
    Option,
    Weight,
)
from congrasp.common.task.geometry import flat, share, squash
from congrasp.common.task.sampling.bank import Draw
from congrasp.common.task.scene import Scene
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array, Goal, Surface

MARGIN = 0.01
"""Distance that the skin of the other fingers should keep from the object, m."""
SHARPNESS = 0.003
"""Sharpness of the barrier at that distance, m."""
_MAX_ROOM = 0.1
"""Largest distance of a finger from the object in the observation, m."""
_FAVOURED = 0.5
"""Probability that an episode draws pinch, tripod or all fingers; otherwise all sets are equally
likely.
"""


class FingersGoal(NamedTuple):
    """Fingers in the order of `Hand.fingers`, thumb first."""

    allowed: Annotated[Array, GoalArray(("G",), "fingers that may touch the object", "flag")]


class Fingers(Constraint):
    """The thumb and one or more of the other fingers; the palm belongs to every set.

    The hand centre and the keypoints of the distance reward are those of the set only.
    """

    name = "fingers"
    title = "fingers"
    goal = FingersGoal
    blocks = ("fingers",)
    overridden_by = ("pose",)
    harvested = False
    weights = (
        Weight(
            "fingers_distance",
            0.02,
            "For each unit of softplus((margin - d)/sharpness), finger by finger.",
        ),
        Weight("fingers_contact", 0.3, "For each link of another finger that touches the object."),
    )
    errors = (
        ErrorSpec(
            name="fingers_ratio",
            unit="",
            window="hold",
            tolerance=0.0,
            scale=0.1,
            meaning="share of touching links of other fingers",
        ),
    )
    options = (
        Option(
            "fingers",
            "Fingers that may touch the object, such as: thumb index. All fingers by default.",
            many=True,
        ),
    )
    invalid = (
        "The constraint 'fingers' needs the thumb and another finger.",
        "Allow both.",
    )

    def sample(self, hand: Hand, draw: Draw, uniform: Array) -> FingersGoal:
        """Samples any set with the thumb; pinch, tripod and all fingers are more likely than
        others.
        """
        sets, probabilities = finger_sets(hand)
        index = chance.weighted(uniform[:, 0], probabilities)
        return FingersGoal(jnp.array(sets)[index])

    def explain(self, overridden: Sequence[str], redirected: bool) -> list[str]:
        """Effect of the choice: it keeps the other fingers away, unless a reference pose defines
        the contacts.
        """
        if overridden:
            return [
                "The choice of fingers is overridden by the reference pose, which defines the "
                "contacts."
            ]
        return ["Only the named fingers may touch the object."]

    def center_fingers(self, goal: Goal) -> Array | None:
        """The allowed fingers, where it is active."""
        return chosen_fingers(goal.values, goal)

    def fields(self, hand: Hand, task: TaskSettings) -> tuple[tuple[ObservationField, ...], ...]:
        """Fields for the set, the clearance of each other finger, and the forces on their links."""
        block = (
            ObservationField(
                "fingers_allowed",
                len(hand.fingers),
                "1 for each finger that may touch the object, thumb first",
            ),
            ObservationField(
                "fingers_room",
                len(hand.fingers),
                f"m, between the object and each other finger, at most {_MAX_ROOM:g}",
            ),
            ObservationField(
                "force_other",
                3 * len(hand.links),
                "as force, on links of the other fingers",
                privileged=True,
            ),
        )
        return (block,)

    def observe(self, scene: Scene) -> tuple[list[Array], ...]:
        """The set, the clipped distance of each finger outside it, and squashed forces on those
        fingers' links.
        """
        allowed = scene.goal["fingers"].allowed
        room = jnp.where(allowed, 0.0, jnp.minimum(_room(scene), _MAX_ROOM))
        other_force = scene.features.force * self.forbidden(scene)[..., None]
        return ([allowed.astype(jnp.float32), room, flat(squash(other_force))],)

    def forbidden(self, scene: Scene) -> Array:
        """Links of fingers outside the set; their contacts earn nothing."""
        finger_of_link = scene.hand.link_fingers
        return ~scene.goal["fingers"].allowed[:, finger_of_link] & (finger_of_link >= 0)

    def reward(self, scene: Scene) -> dict[str, Array]:
        """Terms for a barrier around the object for the other fingers, and for their contacts."""
        active = scene.gate("fingers")
        barrier = jax.nn.softplus((MARGIN - _room(scene)) / SHARPNESS)
        near = jnp.where(scene.goal["fingers"].allowed, 0.0, barrier)
        touching = scene.features.touching & self.forbidden(scene)
        return {
            "fingers_distance": -active * jnp.sum(near, -1),
            "fingers_contact": -active * jnp.sum(touching, -1),
        }

    def measure(self, scene: Scene) -> dict[str, Array | tuple[Array, Array]]:
        """Touching links of other fingers, as a share of all touching links."""
        touching = scene.features.touching
        return {"fingers_ratio": share(touching & self.forbidden(scene), touching)}

    def suggested(self, hand: Hand, task: TaskSettings) -> dict[str, np.ndarray]:
        """A pinch."""
        return {"allowed": np.arange(len(hand.fingers)) < 2}

    def parse(
        self, option_values: Mapping[str, Any], hand: Hand, obj: GraspObject
    ) -> dict[str, np.ndarray] | None:
        """Parses names of fingers."""
        words = option_values["fingers"]
        if not words:
            return None
        allowed = self.named_flags(
            "fingers", words, hand.fingers, f"the hand '{hand.name}' has no finger"
        )
        if allowed.sum() < 2:
            raise CongraspError(
                "--fingers has only one finger, which cannot hold an object.",
                "Pass at least two fingers.",
            )
        if not allowed[0]:
            thumb = hand.fingers[0]
            raise CongraspError(
                f"--fingers lacks the {thumb}, which every grasp needs.", f"Add {thumb}."
            )
        return {"allowed": allowed}

    def valid(self, surface: Surface, values: FingersGoal) -> Array:
        """True for the thumb with another finger."""
        return values.allowed[:, 0] & jnp.any(values.allowed[:, 1:], -1)


@functools.cache
def finger_sets(hand: Hand) -> tuple[np.ndarray, np.ndarray]:
    """All sets (S, G) bool of the thumb with one or more of the other fingers, and their
    probabilities (S,).
    """
    count = len(hand.fingers) - 1
    # A set of the other fingers is a number whose bits are the fingers, the index finger first.
    numbers = np.arange(1, 2**count)
    others = (numbers[:, None] >> np.arange(count)) & 1 == 1
    all_others = 2**count - 1
    pinch = 0b1
    tripod = 0b11 & all_others
    favoured = np.isin(numbers, (pinch, tripod, all_others))
    probabilities = _FAVOURED * favoured / favoured.sum() + (1 - _FAVOURED) / len(others)
    return np.insert(others, 0, True, axis=1), probabilities.astype(np.float32)


def chosen_fingers(constraints: Collection[str], goal: Goal) -> Array | None:
    """(B, G) bool: fingers that define the hand centre, all where no set is active; None without
    the constraint.

    Args:
      constraints: names of the constraints supported by the task or the request.
      goal: goal after the priority rules.
    """
    if "fingers" not in constraints:
        return None
    return goal["fingers"].allowed | ~goal.active["fingers"][:, None]


def _room(scene: Scene) -> Array:
    """Distances (B, G) in m between the object and the skin of each finger at its keypoints."""
    hand = scene.hand
    skin = jnp.linalg.norm(scene.features.nearest, axis=-1) - jnp.array(hand.keypoint_radii)
    finger_of_keypoint = hand.link_fingers[hand.keypoint_links]
    distances = []
    for finger in range(len(hand.fingers)):
        skin_of_finger = jnp.where(finger_of_keypoint == finger, skin, jnp.inf)
        distances.append(jnp.min(skin_of_finger, -1))
    return jnp.stack(distances, -1)
