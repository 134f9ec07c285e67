"""Affordance: the region of the object that may be grasped (O+ in the paper), and the one to avoid
(O-).
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from congrasp.common import rotations
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.lazy_jax import jax, jnp
from congrasp.common.task.constraints.base import Constraint
from congrasp.common.task.constraints.markers import Marker, Paint
from congrasp.common.task.constraints.redirect import REACH, redirected
from congrasp.common.task.constraints.specs import (
    ErrorSpec,
    ObservationField,
    Option,
    Part,
    Relation,
    Weight,
)
from congrasp.common.task.geometry import (
    NO_POINT_DISTANCE,
    flat,
    least_distance_to_segment,
    nearest_index,
    share,
    squash,
)
from congrasp.common.task.sampling.bank import Draw
from congrasp.common.task.scene import Scene
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array, Contacts, Features, Goal, Surface

MARGIN = 0.01
"""Distance that the fingers should keep from the avoid region (m in the paper), m."""
SHARPNESS = 0.002
"""tau, m."""
_MAX_COST_FORCE = 10.0
"""Force of a link on the avoid region at which the cost saturates, N."""
_PART_DISTANCE = 0.004
"""Distance from a part within which a surface point belongs to it, m."""


class AffordanceGoal(NamedTuple):
    """Empty: the regions are the labels of the surface points (`common.task.types.Surface`)."""


class AffordanceFeatures(NamedTuple):
    """Geometry between the hand and the avoid region, in the wrist frame."""

    nearest: Array
    """(B, P, 3) d-: from each keypoint to the nearest point of the avoid region; zero if the object
    has none.
    """
    distance: Array
    """(B,) least distance from the fingers' skin to the avoid region, m; `NO_POINT_DISTANCE` for an
    object without such a region.
    """
    touching: Array
    """(B, L) bool: the link touches the avoid region."""
    touching_graspable: Array
    """(B, L) bool: the link touches the graspable region."""
    force: Array
    """(B, L, 3) f-: net force from the avoid region, N."""


class Affordance(Constraint):
    """A partition of the object's surface (paper, section Constraint Formulation)."""

    name = "affordance"
    title = "affordance"
    goal = AffordanceGoal
    blocks = ("affordance",)
    region = 1
    weights = (
        Weight(
            "affordance_distance",
            0.05,
            "w_d: for each unit of softplus((m - d)/tau) near the avoid region.",
        ),
        Weight(
            "affordance_force",
            0.1,
            "w_f of the affordance term: per newton on the avoid region (clipped at 10 N per "
            "link).",
        ),
    )
    errors = (
        ErrorSpec(
            name="affordance_ratio",
            unit="",
            window="hold",
            tolerance=0.0,
            scale=0.05,
            meaning="share of touching links on the avoid region",
        ),
    )
    options = (
        Option(
            "affordance",
            "Part of the object to grasp: a mesh of the part in the coordinates of the object's "
            "file, or names of labelled parts.",
            "part",
        ),
        Option("avoid", "Part to avoid: a mesh file or part names, as in --affordance.", "part"),
    )
    needs = ("surface_avoid",)
    invalid = (
        "An affordance needs surface points to grasp and surface points to avoid.",
        "Set 'surface_avoid' to True for some points, and to False for others.",
    )

    def available(self, draw: Draw) -> Array:
        """True where the object has both regions, and its graspable one can be approached in the
        resting pose.
        """
        return draw.bank.has_affordance[draw.objects, draw.rests]

    def sample(self, hand: Hand, draw: Draw, uniform: Array) -> AffordanceGoal:
        """Regions of the object."""
        return AffordanceGoal()

    def override(
        self, hand: Hand, surface: Surface, requested: Mapping[str, Array], goal: Goal
    ) -> Goal:
        """Redirects a heading that passes nearer to the avoid region than to the graspable one.

        The new heading ends at a graspable surface point and is the smallest change that satisfies
        the rules of heading sets, see `redirected`. The cross-finger direction follows by the
        smallest rotation.
        """
        contradicts = _contradicts_heading(_apart_from_heading(hand, surface, goal))
        heading = redirected(hand, surface, goal["heading"])
        return goal.where(requested["affordance"] & contradicts, "heading", **heading._asdict())

    def explain(self, overridden: Sequence[str], redirected: bool) -> list[str]:
        """Effect of the affordance: it protects its avoid region unless a reference pose defines
        the contacts.
        """
        if overridden:
            return [
                "The affordance is overridden by the reference pose, which defines the contacts."
            ]
        sentences = ["The affordance keeps the fingers off the avoid region."]
        if redirected:
            sentences.append(
                "The heading passed nearer to the avoid region and was redirected to the graspable "
                "region."
            )
        return sentences

    def features(
        self, hand: Hand, contacts: Contacts, features: Features, goal: Goal
    ) -> AffordanceFeatures:
        """Distances, contacts and forces by region; the label of a contact is that of the nearest
        surface point.
        """
        surface = contacts.surface
        index = nearest_index(jnp.where(surface.avoid[..., None], contacts.squared, jnp.inf))
        on_avoid = jnp.take_along_axis(surface.avoid, flat(contacts.nearest), -1)
        on_avoid = on_avoid.reshape(contacts.nearest.shape)
        has_any = jnp.any(surface.avoid, -1)
        nearest = jnp.take_along_axis(surface.points, index[..., None], -2) - contacts.keypoints
        nearest = jnp.where(has_any[..., None, None], nearest, 0.0)
        skin = jnp.linalg.norm(nearest, axis=-1) - jnp.array(hand.keypoint_radii)
        return AffordanceFeatures(
            nearest=rotations.apply(rotations.to_matrix(features.object_quaternion), nearest),
            distance=jnp.where(has_any, jnp.min(skin[..., 1:], -1), NO_POINT_DISTANCE),
            touching=jnp.any(contacts.found & on_avoid, -1),
            touching_graspable=jnp.any(contacts.found & ~on_avoid, -1),
            force=jnp.sum(contacts.force * on_avoid[..., None], -2),
        )

    def fields(self, hand: Hand, task: TaskSettings) -> tuple[tuple[ObservationField, ...], ...]:
        """Nearest-point vectors and forces."""
        block = (
            ObservationField(
                "nearest_minus",
                3 * len(hand.keypoints),
                "m, from each keypoint to the nearest point of the avoid region",
            ),
            ObservationField(
                "force_minus",
                3 * len(hand.links),
                "as force, of contacts on the avoid region",
                privileged=True,
            ),
        )
        return (block,)

    def observe(self, scene: Scene) -> tuple[list[Array], ...]:
        """Nearest-point vectors to the avoid region, and squashed forces from it."""
        region = scene.features.by_constraint["affordance"]
        return ([flat(region.nearest), flat(squash(region.force))],)

    def cloud_labels(self, scene: Scene) -> Array | None:
        """One for points of the avoid region, while it is active."""
        return scene.surface.avoid * scene.gate("affordance")[:, None]

    def earning(self, scene: Scene, touching: Array, force: Array) -> tuple[Array, Array]:
        """Contacts on the graspable region only: pressing on the avoid region earns nothing."""
        active = scene.goal.active["affordance"][:, None]
        region = scene.features.by_constraint["affordance"]
        touching = jnp.where(active, touching & region.touching_graspable, touching)
        force = jnp.where(active[..., None], force - region.force, force)
        return touching, force

    def reward(self, scene: Scene) -> dict[str, Array]:
        """Reward term r^aff."""
        active = scene.gate("affordance")
        region = scene.features.by_constraint["affordance"]
        force = jnp.minimum(jnp.linalg.norm(region.force, axis=-1), _MAX_COST_FORCE)
        barrier = jax.nn.softplus((MARGIN - region.distance) / SHARPNESS)
        return {
            "affordance_distance": -active * barrier,
            "affordance_force": -active * jnp.sum(force, -1),
        }

    def measure(self, scene: Scene) -> dict[str, Array | tuple[Array, Array]]:
        """Links that touch the avoid region, as a share of all touching links (a link on both
        counts once).
        """
        region = scene.features.by_constraint["affordance"]
        return {"affordance_ratio": share(region.touching, scene.features.touching)}

    def parse(
        self, option_values: Mapping[str, Any], hand: Hand, obj: GraspObject
    ) -> dict[str, np.ndarray] | None:
        """Returns no arrays: an affordance consists of its avoid region."""
        if option_values["affordance"] or option_values["avoid"]:
            return {}
        return None

    def avoid_region(self, option_values: Mapping[str, Any], obj: GraspObject) -> np.ndarray | None:
        """Region of --avoid, or the complement of that of --affordance; points of both belong to
        the nearer part.
        """
        graspable = option_values["affordance"]
        avoid = option_values["avoid"]
        if graspable and avoid:
            return _region_between(graspable, avoid, obj.name)
        if avoid:
            return _region_of(avoid, obj.name)
        return _region_outside(graspable, obj.name)

    def valid(self, surface: Surface, values: AffordanceGoal) -> Array:
        """True if both regions have points."""
        return jnp.any(surface.avoid, -1) & ~jnp.all(surface.avoid, -1)

    def markers(self, values: AffordanceGoal, blocks: Collection[str]) -> tuple[Marker, ...]:
        """Marker of the avoid region."""
        return (Paint(),)


def _region_between(graspable: Part, avoid: Part, name: str) -> np.ndarray:
    """(N,) bool, points of an object that are nearer to the part of --avoid.

    Raises:
      CongraspError: no point is nearer to the part of --affordance, or none to that of --avoid.
    """
    if not (graspable.distance < avoid.distance).any():
        raise CongraspError(
            f"--affordance '{graspable.text}' and --avoid '{avoid.text}' contradict each other: "
            f"the whole graspable region of '{name}' is to be avoided.",
            "Leave one of them out, or pass different parts.",
        )
    region = np.asarray(avoid.distance < graspable.distance)
    _check_region_not_empty(region, graspable, name)
    return region


def _region_of(avoid: Part, name: str) -> np.ndarray:
    """(N,) bool, points of an object on the part of --avoid.

    Raises:
      CongraspError: these are none or all points.
    """
    region = np.asarray(avoid.distance < _PART_DISTANCE)
    if region.all():
        raise CongraspError(
            f"'{avoid.text}' covers all of '{name}', so nothing may be touched.",
            "Pass a smaller part.",
        )
    _check_region_not_empty(region, avoid, name)
    return region


def _region_outside(graspable: Part, name: str) -> np.ndarray:
    """(N,) bool, points of an object that are not on the part of --affordance.

    Raises:
      CongraspError: these are none or all points.
    """
    region = np.asarray(graspable.distance >= _PART_DISTANCE)
    if region.all():
        raise CongraspError(
            f"'{graspable.text}' does not touch the surface of '{name}'.",
            "Pass a part in the coordinates of the object's file with --affordance.",
        )
    _check_region_not_empty(region, graspable, name)
    return region


def _check_region_not_empty(region: np.ndarray, part: Part, name: str) -> None:
    """Raises a CongraspError for a part of an object that leaves no point to avoid."""
    if not region.any():
        raise CongraspError(
            f"'{part.text}' has no effect: the whole surface of '{name}' may be touched.",
            "Pass another part, or leave the option out.",
        )


def _apart_from_heading(hand: Hand, surface: Surface, goal: Goal) -> dict[str, Array]:
    """Distances in m from the approach to either region."""
    end = goal["heading"].position
    start = end - REACH * goal["heading"].direction
    return {
        "avoid": least_distance_to_segment(surface.points, surface.avoid, start, end),
        "graspable": least_distance_to_segment(surface.points, ~surface.avoid, start, end),
    }


def _contradicts_heading(apart: Mapping[str, Array]) -> Array:
    """(B,) bool: the approach passes nearer to the avoid region."""
    return apart["avoid"] < apart["graspable"]


def _heading_message(hand: Hand, apart: Mapping[str, Any]) -> str:
    """Message for a heading that the affordance redirects."""
    return (
        f"The approach passes {100 * apart['avoid']:.1f} cm from the avoid region, and "
        f"{100 * apart['graspable']:.1f} cm from the graspable region. The affordance redirects "
        f"the heading to the graspable region."
    )


Affordance.relations = (
    Relation(
        weaker="heading",
        settled="redirected",
        measure=_apart_from_heading,
        contradicts=_contradicts_heading,
        message=_heading_message,
    ),
)
