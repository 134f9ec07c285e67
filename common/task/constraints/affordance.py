"""Affordance: the region of the object that may be grasped (O+ in the paper), and the one to avoid
(O-).
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common import rotations
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.constraints.base import (
    Constraint,
    ErrorSpec,
    Marker,
    ObservationField,
    Option,
    Paint,
    Relation,
    Scene,
    Weight,
)
from congrasp.common.task.constraints.heading import HeadingGoal
from congrasp.common.task.geometry import (
    FAR,
    flat,
    least_distance_to_segment,
    nearest_index,
    share,
    squash,
)
from congrasp.common.task.sampling.bank import Draw
from congrasp.common.task.sampling.headings import INWARD, MAX_WIDTH
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array, Contacts, Features, Goal, Surface

REACH = 0.15
"""Length of the approach before the heading position that is checked against the avoid region,
m.
"""
MARGIN = 0.01
"""Distance that the fingers should keep from the avoid region (m in the paper), m."""
SHARPNESS = 0.002
"""tau, m."""
_NEAR = 0.004
"""Distance from a part within which a surface point belongs to it, m."""
_CANDIDATES = 24
"""Graspable surface points to which a heading may be redirected."""
_AS_A_RADIAN = 0.1
"""Distance between two heading positions that counts as much as a rotation by 1 rad, m."""
_WORST = 100.0
"""Greater than the cost of any change of a heading."""
_TUBE, _BREADTH, _BEYOND = 0.01, 0.03, 0.01
"""Lengths of `common.task.sampling.headings` in m: of the approach, and of the slab in which the
width is measured.
"""


class AffordanceGoal(NamedTuple):
    """Empty: the regions are the labels of the surface points (`common.task.types.Surface`)."""


class AffordanceFeatures(NamedTuple):
    """Geometry between the hand and the avoid region, in the wrist frame."""

    nearest: Array
    """(B, P, 3) d-: from each keypoint to the nearest point of the avoid region; zero if the object
    has none.
    """
    distance: Array
    """(B,) least distance from the fingers' skin to the avoid region, m; `FAR` if the object has
    none.
    """
    touching: Array
    """(B, L) bool: the link touches the avoid region."""
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
            "affordance_ratio", "", "hold", 0.0, 0.05, "share of touching links on the avoid region"
        ),
    )
    options = (
        Option(
            "affordance",
            "Part to grasp: a mesh of it in the coordinates of the object's file, or names of its "
            "parts.",
            "part",
        ),
        Option("avoid", "Part not to touch: a mesh or names of parts, likewise.", "part"),
    )

    needs = ("surface_avoid",)
    invalid = ("An affordance needs surface points on both sides.", "Set some of 'surface_avoid'.")

    def fields(self, hand: Hand, task: TaskSettings) -> tuple[tuple[ObservationField, ...], ...]:
        """Nearest-point vectors and forces."""
        vectors, forces = 3 * len(hand.keypoints), 3 * len(hand.links)
        block = (
            ObservationField(
                "nearest_minus",
                vectors,
                "m, from each keypoint to the nearest point of the avoid region",
            ),
            ObservationField(
                "force_minus", forces, "as force, of contacts on the avoid region", privileged=True
            ),
        )
        return (block,)

    def available(self, draw: Draw) -> Array:
        """True where the object has both regions, and its graspable one can be approached in the
        resting pose.
        """
        return draw.bank.has_affordance[draw.objects, draw.rests]

    def sample(self, hand: Hand, draw: Draw, uniform: Array) -> AffordanceGoal:
        """Regions of the object."""
        return AffordanceGoal()

    def override(
        self, hand: Hand, surface: Surface, asked: Mapping[str, Array], goal: Goal
    ) -> Goal:
        """Redirects a heading that passes nearer to the avoid region than to the graspable one.

        The new heading ends at a graspable surface point and is the smallest change that satisfies
        the rules of heading sets, see `redirected`. The cross-finger direction follows by the
        smallest rotation.
        """
        turned = asked["affordance"] & _contradicts_heading(
            _apart_from_heading(hand, surface, goal)
        )
        return goal.where(turned, "heading", **redirected(hand, surface, goal["heading"])._asdict())

    def features(
        self, hand: Hand, contacts: Contacts, features: Features, goal: Goal
    ) -> AffordanceFeatures:
        """Distances, contacts and forces by region; the label of a contact is that of the nearest
        surface point.
        """
        surface = contacts.surface
        index = nearest_index(jnp.where(surface.avoid[..., None], contacts.squared, jnp.inf))
        avoided = jnp.take_along_axis(surface.avoid, flat(contacts.nearest), -1).reshape(
            contacts.nearest.shape
        )
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

    def cloud_labels(self, scene: Scene) -> Array | None:
        """One for points of the avoid region, while it is active."""
        assert scene.cloud is not None, "a camera observation needs a cloud"
        return scene.cloud.avoid * scene.gate("affordance")[:, None]

    def earning(self, scene: Scene, touching: Array, force: Array) -> tuple[Array, Array]:
        """Contacts on the graspable region only: pressing on the avoid region earns nothing."""
        active, own = scene.goal.active["affordance"][:, None], scene.features.of["affordance"]
        return (
            jnp.where(active, touching & own.touching_graspable, touching),
            jnp.where(active[..., None], force - own.force, force),
        )

    def reward(self, scene: Scene) -> dict[str, Array]:
        """Reward term r^aff."""
        own, active = scene.features.of["affordance"], scene.gate("affordance")
        pressed = jnp.sum(jnp.minimum(jnp.linalg.norm(own.force, axis=-1), 10.0), -1)
        return {
            "affordance_distance": -active * jax.nn.softplus((MARGIN - own.distance) / SHARPNESS),
            "affordance_force": -active * pressed,
        }

    def measure(self, scene: Scene) -> dict[str, Array | tuple[Array, Array]]:
        """Links that touch the avoid region, as a share of all touching links (a link on both
        counts once).
        """
        return {
            "affordance_ratio": share(
                scene.features.of["affordance"].touching, scene.features.touching
            )
        }

    def valid(self, surface: Surface, own: AffordanceGoal) -> Array:
        """True if both regions have points."""
        return jnp.any(surface.avoid, -1) & ~jnp.all(surface.avoid, -1)

    def parse(
        self, given: Mapping[str, Any], hand: Hand, obj: GraspObject
    ) -> dict[str, np.ndarray] | None:
        """Returns no arrays: an affordance consists of its avoid region."""
        return {} if given["affordance"] or given["avoid"] else None

    def avoid_region(self, given: Mapping[str, Any], obj: GraspObject) -> np.ndarray | None:
        """Region of --avoid, or the complement of that of --affordance; points of both belong to
        the nearer part.
        """
        grasped, avoided = given["affordance"], given["avoid"]
        if grasped and avoided:
            region = avoided.distance < grasped.distance
            if not (grasped.distance < avoided.distance).any():
                raise CongraspError(
                    f"--affordance '{grasped.text}' and --avoid '{avoided.text}' contradict each "
                    f"other: all that "
                    f"may be grasped of '{obj.name}' must not be touched.",
                    "Leave one of them out, or name different parts.",
                )
        elif avoided:
            region = avoided.distance < _NEAR
        else:
            region = grasped.distance >= _NEAR
        if region.all() and not grasped:
            raise CongraspError(
                f"'{avoided.text}' covers all of '{obj.name}', so nothing may be touched.",
                "Avoid a part of it.",
            )
        if region.all():
            raise CongraspError(
                f"Nothing of '{grasped.text}' lies on the surface of '{obj.name}'.",
                "The part must be in the coordinates of the object's file. Pass it with "
                "--affordance.",
            )
        if not region.any():
            named = (grasped or avoided).text
            raise CongraspError(f"'{named}' excludes nothing: all of '{obj.name}' may be touched.")
        return np.asarray(region)

    def markers(self, own: AffordanceGoal, blocks: Collection[str]) -> tuple[Marker, ...]:
        """Marker of the avoid region."""
        return (Paint(),)

    def explain(self, overridden: Sequence[str], redirected: bool) -> list[str]:
        """Effect of the affordance: it protects its avoid region unless a reference pose defines
        the contacts.
        """
        if overridden:
            return [
                "The affordance is overridden by the reference pose, which defines the contacts."
            ]
        turned = (
            "The heading passed nearer to the avoid region and was redirected to the graspable "
            "region."
        )
        return [
            "The affordance keeps the fingers off the avoid region.",
            *([turned] if redirected else []),
        ]


def redirected(hand: Hand, surface: Surface, heading: HeadingGoal) -> HeadingGoal:
    """Redirects headings (B, ...) to graspable surface points.

    The candidates are surface points of the graspable region, each approached along the heading's
    direction and along the direction from the heading's start. The heading's position is 2 cm
    behind the point, times the hand's factor on objects. The result is the candidate that violates
    the fewest rules of `common.task.sampling.headings`, and among equals the one with the smallest
    change: a rotation by 1 rad counts as much as 10 cm between the positions. Rules:

    * No obstacle is in front of the point within 1 cm of the approach.
    * The approach stays 1 cm away from the avoid region, and ends nearer to the graspable one.
    * The object is no wider than 12 cm, times the same factor, along the cross-finger direction
      where fingers close.

    Args:
      hand: the hand.
      surface: labelled surface points.
      heading: headings to redirect.
    """
    chosen = _spread(~surface.avoid)
    targets = jnp.take_along_axis(surface.points, chosen[..., None], 1)
    own = jnp.broadcast_to(heading.direction[:, None], targets.shape)
    start = heading.position - REACH * heading.direction
    straight = targets - start[:, None]
    straight = straight / jnp.maximum(jnp.linalg.norm(straight, axis=-1, keepdims=True), 1e-6)
    direction = jnp.concatenate([own, straight], 1)
    position = jnp.concatenate([targets, targets], 1) + hand.object_scale * INWARD * direction
    given, across = (
        jnp.broadcast_to(axis[:, None], direction.shape)
        for axis in (heading.direction, heading.cross)
    )
    cross = rotations.rotate(rotations.shortest(given, direction, across), across)
    candidates = HeadingGoal(position, direction, cross)
    angle = jnp.arccos(jnp.clip(jnp.sum(direction * given, -1), -1.0, 1.0))
    change = angle + jnp.linalg.norm(position - heading.position[:, None], axis=-1) / _AS_A_RADIAN
    best = jnp.argmin(_WORST * _broken(hand, surface, candidates) + change, -1)[:, None, None]
    return HeadingGoal(*(jnp.take_along_axis(axis, best, 1)[:, 0] for axis in candidates))


def _spread(which: Array) -> Array:
    """Indices (B, n) of up to `_CANDIDATES` true flags (B, N), evenly spread over them."""
    count = jnp.cumsum(which, -1)
    rank = jnp.arange(_CANDIDATES) * count[:, -1:] // _CANDIDATES
    return jnp.argmax(count[:, None] > rank[..., None], -1)


def _broken(hand: Hand, surface: Surface, headings: HeadingGoal) -> Array:
    """Number (B, n) of rules that headings (B, n, 3) violate, see `redirected`."""
    # By coordinates, so that the loops over the surface points, the longest of a reset, run along
    # memory.
    offset = [
        point[:, None] - position[..., None]
        for point, position in zip(
            jnp.moveaxis(surface.points, -1, 0), jnp.moveaxis(headings.position, -1, 0), strict=True
        )
    ]
    depth, along = (
        sum(
            way * axis[..., None]
            for way, axis in zip(offset, jnp.moveaxis(axes, -1, 0), strict=True)
        )
        for axes in (headings.direction, headings.cross)
    )
    squared = sum(way * way for way in offset)
    from_line = squared - depth**2
    inward, avoid = hand.object_scale * INWARD, surface.avoid[:, None]
    before = (depth < -inward - 1.5 * _TUBE) & (depth > -REACH - inward)
    hidden = jnp.any(before & (from_line < _TUBE**2), -1)
    past = depth - jnp.clip(depth, -REACH, 0.0)
    near = jnp.min(jnp.where(avoid, from_line + past**2, jnp.inf), -1) < MARGIN**2
    to_avoid, to_graspable = (
        jnp.min(jnp.where(which, squared, jnp.inf), -1) for which in (avoid, ~avoid)
    )
    slab = (from_line - along**2 < _BREADTH**2) & (depth < _BEYOND)
    low = jnp.min(jnp.where(slab, along, jnp.inf), -1)
    wide = jnp.max(jnp.where(slab, along, -jnp.inf), -1) - low > hand.object_scale * MAX_WIDTH
    return hidden.astype(jnp.int32) + (near | (to_avoid < to_graspable)) + wide


def _apart_from_heading(hand: Hand, surface: Surface, goal: Goal) -> dict[str, Array]:
    """Distances in m from the approach to either region."""
    heading = goal["heading"]
    start = heading.position - REACH * heading.direction
    return {
        "avoid": least_distance_to_segment(surface.points, surface.avoid, start, heading.position),
        "graspable": least_distance_to_segment(
            surface.points, ~surface.avoid, start, heading.position
        ),
    }


def _contradicts_heading(apart: Mapping[str, Array]) -> Array:
    """(B,) bool: the approach passes nearer to the avoid region."""
    return apart["avoid"] < apart["graspable"]


def _heading_message(hand: Hand, apart: Mapping[str, Any]) -> str:
    return (
        f"The approach passes {100 * apart['avoid']:.1f} cm from the avoid region, and "
        f"{100 * apart['graspable']:.1f} cm from the graspable region. The affordance redirects "
        f"the heading to "
        "the graspable region."
    )


Affordance.relations = (
    Relation("heading", "redirected", _apart_from_heading, _contradicts_heading, _heading_message),
)
