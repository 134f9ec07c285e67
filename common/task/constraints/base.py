"""Interface of a constraint: everything that the rest of the project derives from its file.

A constraint's module defines a subclass of `Constraint`, and `common.task.constraints.CONSTRAINTS`
contains an instance. All methods are pure functions of batched arrays (leading axis B) that may be
traced; the defaults do nothing.

Its markers are drawn in pictures, recordings and the studio; all of them are in the object frame.
"""

import dataclasses
import functools
import operator
from collections.abc import Collection, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple, get_type_hints

import jax.numpy as jnp
import numpy as np

from congrasp.common.errors import CongraspError, UnknownConstraintError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.grip import ObjectLoad
from congrasp.common.task.sampling.bank import ConstraintBank, Draw
from congrasp.common.task.sensing import Readings
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array, Contacts, Features, Goal, SceneState, Surface


class Arrow(NamedTuple):
    """A direction that ends at a point."""

    tip: np.ndarray
    """(3,) m."""
    direction: np.ndarray
    """(3,) unit vector."""


class Polyline(NamedTuple):
    """A sequence of connected points."""

    points: np.ndarray
    """(n, 3) m."""


class Ghost(NamedTuple):
    """A translucent hand."""

    position: np.ndarray
    """(3,) position of the wrist, m."""
    quaternion: np.ndarray
    """(4,) orientation of the wrist."""
    q: np.ndarray | None
    """(F,) finger angles, rad; None draws only the wrist's axes."""


class Paint(NamedTuple):
    """The avoid region, painted on the object."""


Marker = Arrow | Polyline | Ghost | Paint

Window = Literal["approach", "hold"]
"""Steps over which an error is averaged: before the table's removal, or in the `hold_steps` after
it.
"""


@dataclasses.dataclass(frozen=True)
class GoalArray:
    """A goal array of a constraint, as the annotation of its field in the NamedTuple."""

    shape: tuple[int | str, ...]
    """Shape without the batch axis; each entry is a symbol of `symbol_sizes` or a number."""
    meaning: str
    """Unit, frame and meaning."""
    kind: Literal["real", "position", "direction", "quaternion", "flag"] = "real"
    """Kind of value: positions, directions and quaternions are in the object frame, and the latter
    two must be unit vectors; flags are booleans."""
    neutral: tuple[float, ...] = ()
    """Last axis of the value used where no request gives one; zeros by default."""
    required: bool = True
    """True if a request for the constraint must include the array."""


class Weight(NamedTuple):
    """One term of the reward."""

    name: str
    """Name of the term and of its weight."""
    default: float
    meaning: str
    """Symbol in the paper, and unit."""


class ErrorSpec(NamedTuple):
    """Definition of an error of a constraint; the paper's definitions are in its section
    Metrics.
    """

    name: str
    """Name of the episode's metric, such as `heading_rad`."""
    unit: str
    """rad, m, or empty for a ratio."""
    window: Window
    tolerance: float
    """Largest error at which the constraint counts as met in one step."""
    scale: float
    """Scale that makes errors of different kinds comparable when grasps are compared."""
    meaning: str
    """Description of the compared quantity in displays."""
    column: str = ""
    """Name in tables and their JSON; `name` if empty."""
    block: str = ""
    """Block of the constraint without which the error is undefined, if its other blocks can be
    active alone.
    """


class ObservationField(NamedTuple):
    """A contiguous field of the observation."""

    name: str
    size: int
    meaning: str
    """Unit and frame; "wrist" is the wrist frame."""
    privileged: bool = False
    """True if only a simulator knows the values: a tracked observation lacks them."""


class Relation(NamedTuple):
    """Relation of a constraint to a weaker one when both are requested and cannot both be met."""

    weaker: str
    """Name of the other constraint."""
    settled: Literal["overridden", "redirected", "refused"]
    """Effect on the weaker constraint; a refused request is an error."""
    measure: Any
    """Function (hand, surface, goal) -> dict of arrays (B, ...), distances between the two."""
    contradicts: Any
    """measured -> (B,) bool."""
    message: Any
    """(hand, measurements of one environment, as NumPy) -> one or two sentences with the
    numbers.
    """


class Scene(NamedTuple):
    """One control step, as input of a constraint's terms."""

    hand: Hand
    task: TaskSettings
    state: SceneState
    features: Features
    goal: Goal
    readings: "Readings | None" = None
    """Last control steps, if the policy observes them."""
    cloud: Surface | None = None
    """Cloud of the camera, world frame, if the policy has one."""
    load: ObjectLoad | None = None
    """Weight and friction of the objects, for the reward; None where they are not recorded."""

    def gate(self, block: str) -> Array:
        """(B,) 1 if a block is active, else 0."""
        return self.goal.active[block].astype(jnp.float32)


class Option(NamedTuple):
    """Option of `congrasp grasp` that requests a constraint."""

    name: str
    help: str
    kind: Literal["text", "direction", "place", "part", "pose", "path"] = "text"
    """Kind of the parsed value: a text; three numbers in the axes of the object's file, normalised;
    three numbers in the coordinates of the file, converted to a position (3,) in the object frame;
    a `Part`; a wrist pose with finger angles, or a wrist path of K waypoints, from a file: dicts of
    `q`, `position` and `quaternion`, object frame."""
    words: tuple[str, ...] = ()
    """Literal values accepted for any kind."""
    many: bool = False
    """Accepts several words, given as a tuple."""
    switch: bool = False
    """A flag without a value."""


class Part(NamedTuple):
    """A part of an object's surface, named by an option."""

    text: str
    """Text of the option."""
    distance: np.ndarray
    """(N,) distances from the object's surface points to the part, m."""


class Constraint:
    """A constraint; subclasses set the attributes and override methods as needed."""

    name: ClassVar[str]
    """Name in training (`--task.p-NAME`, metric `success/NAME`), rows of evaluations, queries,
    files and the studio.
    """
    title: ClassVar[str]
    """Display name, in lower case."""
    goal: ClassVar[type]
    """NamedTuple of the goal arrays, whose fields are annotated with `GoalArray`; `NAME_FIELD` in
    queries and files.
    """
    blocks: ClassVar[tuple[str, ...]] = ()
    """Blocks of the observation that it gates, each with its mask bit; the heading, always active,
    has none.
    """
    overrides: ClassVar[tuple[str, ...]] = ()
    """Weaker constraints, or blocks of them, that are inactive when this one is requested."""
    overridden_by: ClassVar[tuple[str, ...]] = ()
    """Stronger constraints that make this one inactive without listing it in their `overrides`."""
    guides: ClassVar[str] = ""
    """Block whose activity passes the wrist's guidance to `guidance`; empty if it does not guide
    the wrist.
    """
    region: ClassVar[int] = 0
    """Region of the constraint bank from which its episodes are drawn (0 the whole surface, 1 the
    graspable region).
    """
    from_reference: ClassVar[bool] = False
    """True if it is drawn from reference grasps."""
    harvested: ClassVar[bool] = True
    """True if successful grasps under it may become references."""
    weights: ClassVar[tuple[Weight, ...]] = ()
    """Terms of the reward, each with a setting `--task.reward.TERM`."""
    errors: ClassVar[tuple[ErrorSpec, ...]] = ()
    """Errors, each with a metric `episode/ERROR`, a column in tables and a lane in the studio."""
    relations: ClassVar[tuple[Relation, ...]] = ()
    """Relations to weaker constraints."""
    options: ClassVar[tuple[Option, ...]] = ()
    """Options of `congrasp grasp` that request it."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Fields of a query, in addition to its goal arrays, that a request for it must contain."""
    invalid: ClassVar[tuple[str, str]] = ("", "")
    """Fault of arrays that are not `valid`, and the remedy."""

    def fields(self, hand: Hand, task: TaskSettings) -> tuple[tuple[ObservationField, ...], ...]:
        """Fields of each of its blocks of the observation, in order."""
        return ()

    def labels(self, hand: Hand) -> dict[str, tuple[str, ...]]:
        """Names of the elements of flag arrays by field, for pages and command lines; those of
        fingers by default.
        """
        return {
            name: hand.fingers
            for name, array in self.arrays.items()
            if array.kind == "flag" and array.shape == ("G",)
        }

    # Sampling and the start of an episode.

    def columns(self, hand: Hand, bank: ConstraintBank) -> Any:
        """Pytree of arrays (N, ...) that `sample` needs of each object (`Draw.own`), computed once;
        None for nothing.

        Headings, reference poses and trajectories, which constraints share, belong to the bank.
        """
        return None

    def joined(
        self, task: TaskSettings, active: Mapping[str, Array], uniform: Array
    ) -> Array | None:
        """(B,) bool: training episodes that request it because of others; None for none.

        Args:
          task: the task.
          active: (B,) bool by block, active blocks of the constraints requested so far.
          uniform: (B,) random numbers in [0, 1).
        """
        return None

    def available(self, draw: Draw) -> Array:
        """(B,) bool: the drawn objects allow it, in their resting poses and regions.

        The default is True where a reference allows it if it is drawn from references, and True
        everywhere otherwise.
        """
        return (
            jnp.any(self.allowed(draw), -1)
            if self.from_reference
            else jnp.ones(draw.objects.shape, bool)
        )

    def allowed(self, draw: Draw) -> Array:
        """(B, M) bool: references of the drawn objects from which it may be drawn; by default those
        clear of the table.

        `draw` has no `reference` at this point.
        """
        return draw.allowed

    def numbers(self, hand: Hand, task: TaskSettings) -> int:
        """Number U of random numbers that `sample` uses for an episode."""
        return 1

    def sample(self, hand: Hand, draw: Draw, uniform: Array) -> Any:
        """Samples its goal arrays for the drawn episodes, whether or not they request it.

        Args:
          hand: the hand.
          draw: the drawn episodes.
          uniform: (B, U) independent random numbers in [0, 1), which depend on no other constraint.
        """
        raise NotImplementedError

    def override(
        self, hand: Hand, surface: Surface, asked: Mapping[str, Array], goal: Goal
    ) -> Goal:
        """Returns the goal with the arrays of weaker constraints that this one replaces, where it
        is requested.
        """
        return goal

    def initial_fingers(self, goal: Goal) -> tuple[Array, Array] | None:
        """(B,) bool where an episode begins with other finger angles than the open hand's, and
        these angles (B, F).
        """
        return None

    def initial_wrist(
        self, hand: Hand, back_off: Array, goal: Goal, q: Array
    ) -> tuple[Array, Array, Array] | None:
        """(B,) bool where it sets the initial wrist pose of an episode, and the pose (B, 3), (B,
        4), object frame.

        Args:
          hand: the hand.
          back_off: (B,) distance back from the aligned wrist, used where no constraint sets the
            initial pose, m.
          goal: goal after the priority rules.
          q: (B, F) initial finger angles.
        """
        return None

    def suggested(self, hand: Hand, task: TaskSettings) -> dict[str, np.ndarray]:
        """Initial goal arrays by field, when a user switches it on."""
        return self.neutral(hand, task)._asdict()

    def wrist_path(self, own: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray] | None:
        """Prescribed wrist positions (n, 3), object frame, and last orientation (4,); None if it
        prescribes none.
        """
        return None

    # One control step.

    def features(self, hand: Hand, contacts: Contacts, features: Features, goal: Goal) -> Any:
        """Geometry specific to the constraint that observation, reward and errors share, as a
        pytree.
        """
        return ()

    def center_fingers(self, goal: Goal) -> Array | None:
        """(B, G) bool: fingers that define the hand centre and the distance reward; None for
        all.
        """
        return None

    def guidance(self, scene: Scene, *, current: bool) -> tuple[Array, Array]:
        """World wrist pose (B, 3), (B, 4) to which it guides, relative to the object's current or
        initial pose.
        """
        raise NotImplementedError

    def observe(self, scene: Scene) -> tuple[Sequence[Array], ...]:
        """Values (B, ...) of the `fields` of each block; they are concatenated, then gated."""
        return ()

    def cloud_labels(self, scene: Scene) -> Array | None:
        """(B, N) labels of the points of a camera's cloud in the observation; None if it labels
        none.
        """
        return None

    def forbidden(self, scene: Scene) -> Array | None:
        """(B, L) bool: links that must not touch the object, whether or not it is active; None for
        no restriction.
        """
        return None

    def earning(self, scene: Scene, touching: Array, force: Array) -> tuple[Array, Array]:
        """Filters the contacts that earn the grasp reward: flags (B, L) and forces (B, L, 3) of the
        links.

        By default those of all links that it does not forbid.
        """
        if (forbidden := self.forbidden(scene)) is None:
            return touching, force
        lost = forbidden & self.active(scene.goal)[:, None]
        return touching & ~lost, jnp.where(lost[..., None], 0.0, force)

    def force_max(self, scene: Scene, most: Array) -> Array:
        """Filters the force (B, 1) or () of each link beyond which nothing more is earned, N."""
        return most

    def reward(self, scene: Scene) -> dict[str, Array]:
        """Terms (B,) by the names of `weights`, signed, before the weight; zero where it is
        inactive.
        """
        return {}

    def measure(self, scene: Scene) -> dict[str, Array | tuple[Array, Array]]:
        """Errors (B,) of one step by the names of `errors`, active or not.

        A pair is numerator and denominator of a ratio; their sums over the window are divided.
        """
        return {}

    # Display.

    def markers(self, own: Any, blocks: Collection[str]) -> tuple[Marker, ...]:
        """Markers for pictures, recordings and the studio, shown while it is active.

        Args:
          own: its goal arrays for one episode, as NumPy.
          blocks: active blocks of the observation.
        """
        return ()

    def valid(self, surface: Surface, own: Any) -> Array:
        """(B,) bool: the goal arrays, of valid shapes, finite and normalised, are consistent."""
        return jnp.ones(surface.points.shape[0], bool)

    def explain(self, overridden: Sequence[str], redirected: bool) -> list[str]:
        """Describes the effect of the priority rules on it when it is requested, in sentences.

        Args:
          overridden: names of the requested stronger constraints that override it or one of its
            blocks.
          redirected: True if it changed the heading.
        """
        return []

    def parse(
        self, given: Mapping[str, Any], hand: Hand, obj: GraspObject
    ) -> dict[str, np.ndarray] | None:
        """Parses the values of `options` into goal arrays by field, without batch axis; None if no
        option is given.

        Args:
          given: values by option name, parsed by `kind`; None for an absent option.
          hand: the hand.
          obj: the object.

        Raises:
          CongraspError: the value of an option is not feasible.
        """
        return None

    def avoid_region(self, given: Mapping[str, Any], obj: GraspObject) -> np.ndarray | None:
        """(N,) bool, the avoid region requested by the options; None if they request none.

        Raises:
          CongraspError: the region would be empty or the whole surface.
        """
        return None

    @staticmethod
    def named_flags(
        option: str, words: Sequence[str], names: Sequence[str], lacks: str
    ) -> np.ndarray:
        """(len(names),) bool: names that are among the words of an option.

        Args:
          option: name of the option.
          words: words given by the user.
          names: valid words.
          lacks: beginning of the error for any other word, such as "the hand has no finger".

        Raises:
          CongraspError: a word is not one of the names.
        """
        for word in words:
            if word not in names:
                raise CongraspError(f"--{option}: {lacks} '{word}'.", f"Known: {', '.join(names)}.")
        return np.isin(names, words)

    # Derived properties.

    @property
    def optional(self) -> bool:
        """True if it may be inactive in an episode."""
        return bool(self.blocks)

    @property
    def arrays(self) -> dict[str, GoalArray]:
        """Goal arrays by field name."""
        hints = get_type_hints(self.goal, include_extras=True)
        return {name: hints[name].__metadata__[0] for name in self.goal._fields}  # type: ignore[attr-defined]

    def neutral(self, hand: Hand, task: TaskSettings) -> Any:
        """Goal arrays, without batch axis, of an episode that does not request it."""
        symbols = symbol_sizes(hand, task)
        made = {}
        for name, array in self.arrays.items():
            shape = tuple(symbols[n] if isinstance(n, str) else n for n in array.shape)
            fill = np.asarray(array.neutral or 0.0, np.float32)
            made[name] = np.broadcast_to(fill, shape).astype(
                bool if array.kind == "flag" else np.float32
            )
        return self.goal(**made)

    def active(self, goal: Goal) -> Array:
        """(B,) bool: it is active, see `among`; always for one without blocks."""
        return self.among(goal.active) if self.blocks else jnp.ones(len(goal[self.name][0]), bool)

    def among(self, blocks: Mapping[str, Array]) -> Array:
        """(B,) bool: one of its blocks is active. Only optional constraints have blocks.

        A reference pose of which a trajectory keeps only the fingers is therefore active.
        """
        return functools.reduce(operator.or_, (blocks[block] for block in self.blocks))


def symbol_sizes(hand: Hand, task: TaskSettings) -> dict[str, int]:
    """Sizes of the symbols in goal arrays: F finger joints, G fingers, K waypoints."""
    return {"F": len(hand.joints), "G": len(hand.fingers), "K": task.trajectory_points}


def unknown_constraint(name: str, known: Sequence[str]) -> UnknownConstraintError:
    """Error for a request of an unknown constraint."""
    return UnknownConstraintError(
        f"There is no constraint '{name}'.", f"Choose from: {', '.join(known)}."
    )
