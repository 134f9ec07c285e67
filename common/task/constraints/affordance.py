"""Affordance: which region of the object may be grasped (O+ in the paper), and which must be avoided (O-)."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

from common import rotations
from common.hands.spec import Hand
from common.task.constraints.base import Constraint, ErrorSpec, ObservationField, Option, Relation, Scene, Weight
from common.task.geometry import FAR, flat, least_distance_to_segment, nearest_index, share, squash
from common.task.types import Array, Goal, Surface

if TYPE_CHECKING:
    from common.config import TaskConfig
    from common.task.bank import Draw
    from common.task.features import Contacts, Features

REACH = 0.15
"""Metres of approach before the heading position that are searched for the avoid region."""
MARGIN = 0.01
"""m, metres the fingers should keep from the avoid region."""
SHARPNESS = 0.002
"""tau, metres."""


class AffordanceGoal(NamedTuple):
    """Nothing of its own: the regions are the labels of the surface points (`common.task.types.Surface`)."""


class AffordanceFeatures(NamedTuple):
    """Geometry between the hand and the avoid region, in the wrist frame."""

    nearest: Array
    """(B, P, 3) d-: from each keypoint to the nearest point of the avoid region; zero where the object has none."""
    distance: Array
    """(B,) least distance from the fingers' skin to it, m; `FAR` where the object has none."""
    touching: Array
    """(B, L) bool: the link touches it."""
    touching_graspable: Array
    """(B, L) bool: the link touches the graspable region."""
    force: Array
    """(B, L, 3) f-: net force from the avoid region, N."""


class Affordance(Constraint):
    """A partition of the object's surface (paper, section Constraint Formulation)."""

    name, title, goal = "affordance", "affordance", AffordanceGoal
    blocks = ("affordance",)
    region = 1
    weights = (
        Weight(
            "affordance_distance", 0.05, "w_d: for each unit of softplus((m - d)/tau) near the non-grasping region."
        ),
        Weight(
            "affordance_force",
            0.1,
            "w_f of the affordance term: per newton on the non-grasping region (clipped at 10 N per link).",
        ),
    )
    errors = (ErrorSpec("affordance_ratio", "", "hold", 0.0, 0.05, "share of touching links on the avoid region"),)
    options = (
        Option(
            "affordance",
            "What to grasp: a mesh of that part in the coordinates of the object's file, or names of its parts.",
        ),
        Option("avoid", "What not to touch, likewise."),
    )

    needs = ("surface_minus",)
    invalid = ("An affordance needs surface points on both sides.", "Set some of 'surface_minus'.")

    def fields(self, hand: Hand, task: "TaskConfig") -> tuple[tuple[ObservationField, ...], ...]:
        """Nearest-point vectors and forces."""
        vectors, forces = 3 * len(hand.keypoints), 3 * len(hand.links)
        block = (
            ObservationField(
                "nearest_minus", vectors, "m, from each keypoint to the nearest point that must not be touched"
            ),
            ObservationField("force_minus", forces, "as force, of contacts that must not be", privileged=True),
        )
        return (block,)

    def available(self, draw: "Draw") -> Array:
        """Where the object has both regions, and its graspable one can be approached in the resting pose."""
        return draw.bank.has_affordance[draw.objects, draw.rests]

    def sample(self, hand: Hand, draw: "Draw", key: Array) -> AffordanceGoal:
        """The object's own regions."""
        return AffordanceGoal()

    def override(self, hand: Hand, surface: Surface, asked: Mapping[str, Array], goal: Goal) -> Goal:
        """Redirects a heading that comes nearer to the avoid region than to the graspable one.

        It then leads from its start to the middle of the graspable region, and the hand turns with it by the least
        rotation, so that the cross-finger direction stays orthogonal however far the heading turns.
        """
        heading = goal["heading"]
        weights = (~surface.avoid)[..., None].astype(jnp.float32)
        middle = jnp.sum(surface.points * weights, 1) / jnp.maximum(jnp.sum(weights, 1), 1.0)
        towards = middle - (heading.position - REACH * heading.direction)
        towards = towards / jnp.linalg.norm(towards, axis=-1, keepdims=True)
        turned = asked["affordance"] & _contradicts_heading(_apart_from_heading(hand, surface, goal))
        cross = rotations.rotate(rotations.shortest(heading.direction, towards, heading.cross), heading.cross)
        return goal.where(turned, "heading", position=middle, direction=towards, cross=cross)

    def features(self, hand: Hand, contacts: "Contacts", features: "Features", goal: Goal) -> AffordanceFeatures:
        """Distances, contacts and forces by region: each contact has the label of the nearest surface point."""
        surface = contacts.surface
        index = nearest_index(jnp.where(surface.avoid[..., None], contacts.squared, jnp.inf))
        avoided = jnp.take_along_axis(surface.avoid, flat(contacts.nearest), -1).reshape(contacts.nearest.shape)
        has_any = jnp.any(surface.avoid, -1)
        nearest = jnp.take_along_axis(surface.points, index[..., None], -2) - contacts.keypoints
        nearest = jnp.where(has_any[..., None, None], nearest, 0.0)
        skin = jnp.linalg.norm(nearest, axis=-1) - jnp.array(hand.keypoint_radii)
        return AffordanceFeatures(
            nearest=rotations.apply(rotations.to_matrix(features.object_quaternion), nearest),
            distance=jnp.where(has_any, jnp.min(skin[..., 1:], -1), FAR),
            touching=jnp.any(contacts.found & avoided, -1),
            touching_graspable=jnp.any(contacts.found & ~avoided, -1),
            force=jnp.sum(contacts.force * avoided[..., None], -2),
        )

    def observe(self, scene: Scene) -> tuple[list[Array], ...]:
        """Nearest-point vectors to the avoid region, and squashed forces from it."""
        own = scene.features.of["affordance"]
        return ([flat(own.nearest), flat(squash(own.force))],)

    def earning(self, scene: Scene, touching: Array, force: Array) -> tuple[Array, Array]:
        """Only contacts on the graspable region: a link that presses on the other must not be paid for it."""
        active, own = scene.goal.active["affordance"][:, None], scene.features.of["affordance"]
        return (
            jnp.where(active, touching & own.touching_graspable, touching),
            jnp.where(active[..., None], force - own.force, force),
        )

    def reward(self, scene: Scene) -> dict[str, Array]:
        """r^aff."""
        own, active = scene.features.of["affordance"], scene.gate("affordance")
        pressed = jnp.sum(jnp.minimum(jnp.linalg.norm(own.force, axis=-1), 10.0), -1)
        return {
            "affordance_distance": -active * jax.nn.softplus((MARGIN - own.distance) / SHARPNESS),
            "affordance_force": -active * pressed,
        }

    def measure(self, scene: Scene) -> dict[str, Array | tuple[Array, Array]]:
        """Links that touch the avoid region, among all that touch (a link on both counts once)."""
        return {"affordance_ratio": share(scene.features.of["affordance"].touching, scene.features.touching)}

    def valid(self, surface: Surface, own: AffordanceGoal) -> Array:
        """Both regions have points."""
        return jnp.any(surface.avoid, -1) & ~jnp.all(surface.avoid, -1)

    def explain(self, overridden: Sequence[str], redirected: bool) -> list[str]:
        """It keeps the fingers off its region unless a reference pose names its own contacts."""
        if overridden:
            return ["The affordance is overridden by the reference pose, which names its own contacts."]
        turned = "The heading came nearer to the avoid region and was turned towards the graspable region."
        return ["The affordance keeps the fingers off the avoid region.", *([turned] if redirected else [])]


def _apart_from_heading(hand: Hand, surface: Surface, goal: Goal) -> dict[str, Array]:
    """Metres from the approach to either region."""
    heading = goal["heading"]
    start = heading.position - REACH * heading.direction
    return {
        "avoid": least_distance_to_segment(surface.points, surface.avoid, start, heading.position),
        "graspable": least_distance_to_segment(surface.points, ~surface.avoid, start, heading.position),
    }


def _contradicts_heading(apart: Mapping[str, Array]) -> Array:
    """(B,) bool: the approach comes nearer to the avoid region."""
    return apart["avoid"] < apart["graspable"]


def _heading_message(hand: Hand, apart: Mapping[str, Any]) -> str:
    return (
        f"The approach passes {100 * apart['avoid']:.1f} cm from what must not be touched, and "
        f"{100 * apart['graspable']:.1f} cm from what may be grasped. The affordance turns the heading towards the "
        "graspable part."
    )


Affordance.relations = (Relation("heading", "redirected", _apart_from_heading, _contradicts_heading, _heading_message),)
