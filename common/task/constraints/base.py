"""Interface of a constraint: everything that the rest of the project derives from its file.

A constraint's module defines a subclass of `Constraint`, and `common.task.constraints.CONSTRAINTS`
contains an instance. The class attributes declare it (records in `constraints.specs`); the methods
are hooks, and by default have no effect. In the order of the class:

* sampling: arrays of the bank, and the goal of an episode
* priority rules: changes of weaker constraints, and their description
* start of an episode: fingers and wrist
* geometry of a control step, and guidance of the wrist
* observation: fields and their values
* reward: contacts that earn, and terms
* errors
* requests: parsed options, checks and defaults
* display: markers (`constraints.markers`)

Hooks that take batched arrays (leading axis B) are pure functions that may be traced.
"""

import functools
import operator
from collections.abc import Collection, Mapping, Sequence
from typing import Any, ClassVar, get_type_hints

import numpy as np

from congrasp.common.errors import CongraspError, UnknownConstraintError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.lazy_jax import jnp
from congrasp.common.task.constraints.markers import Marker
from congrasp.common.task.constraints.specs import (
    ErrorSpec,
    GoalArray,
    ObservationField,
    Option,
    Relation,
    Weight,
)
from congrasp.common.task.sampling.bank import ConstraintBank, Draw
from congrasp.common.task.scene import Scene
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array, Contacts, Features, Goal, Surface


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
    relations: ClassVar[tuple[Relation, ...]] = ()
    """Relations to weaker constraints."""
    guides: ClassVar[str] = ""
    """Block whose activity passes the wrist's guidance to `guidance`; empty if it does not guide
    the wrist.
    """

    finger_pose: ClassVar[str] = ""
    """Block whose activity requests the angles of all finger joints, so that natural postures
    (`common.task.posture`) count no longer; empty if it requests none.
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

    options: ClassVar[tuple[Option, ...]] = ()
    """Options of `congrasp grasp` that request it."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Fields of a query, in addition to its goal arrays, that a request for it must contain."""
    invalid: ClassVar[tuple[str, str]] = ("", "")
    """Fault of arrays that are not `valid`, and the remedy."""

    # Sampling.

    def columns(self, hand: Hand, bank: ConstraintBank) -> Any:
        """Pytree of arrays (N, ...) that `sample` needs of each object (`Draw.columns`), computed
        once; None for nothing.

        Headings, reference poses and trajectories, which constraints share, belong to the bank.
        """
        return None

    def joined(
        self, task: TaskSettings, active: Mapping[str, Array], uniform: Array
    ) -> Array | None:
        """(B,) bool: training episodes that request this constraint because of other constraints.

        None if other constraints do not matter.

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
        if self.from_reference:
            return jnp.any(self.allowed(draw), -1)
        return jnp.ones(draw.objects.shape, bool)

    def allowed(self, draw: Draw) -> Array:
        """(B, M) bool: references of the drawn objects from which a goal may be drawn.

        The default are the references clear of the table.

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

    # Priority rules.

    def override(
        self, hand: Hand, surface: Surface, requested: Mapping[str, Array], goal: Goal
    ) -> Goal:
        """Returns the goal, in which this constraint replaces arrays of weaker constraints.

        Args:
          hand: the hand.
          surface: surface points of the objects.
          requested: (B,) bool by the names of the constraints.
          goal: goal after the rules of weaker constraints; it changes where this one is requested.
        """
        return goal

    def explain(self, overridden: Sequence[str], redirected: bool) -> list[str]:
        """Describes the effect of the priority rules on it when it is requested, in sentences.

        Args:
          overridden: names of the requested stronger constraints that override it or one of its
            blocks.
          redirected: True if it changed the heading.
        """
        return []

    # Start of an episode.

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

    # Geometry of a control step, and guidance.

    def features(self, hand: Hand, contacts: Contacts, features: Features, goal: Goal) -> Any:
        """Geometry specific to the constraint that observation, reward and errors share, as a
        pytree (`Features.by_constraint`).
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

    # Observation.

    def fields(self, hand: Hand, task: TaskSettings) -> tuple[tuple[ObservationField, ...], ...]:
        """Fields of each of its blocks of the observation, in order."""
        return ()

    def observe(self, scene: Scene) -> tuple[Sequence[Array], ...]:
        """Values (B, ...) of the `fields` of each block; they are concatenated, then gated."""
        return ()

    def cloud_labels(self, scene: Scene) -> Array | None:
        """(B, N) labels of the points of a camera's cloud in the observation; None if it labels
        none.
        """
        return None

    # Reward.

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
        forbidden = self.forbidden(scene)
        if forbidden is None:
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

    # Errors.

    def measure(self, scene: Scene) -> dict[str, Array | tuple[Array, Array]]:
        """Errors (B,) of one step by the names of `errors`, active or not.

        A pair is numerator and denominator of a ratio; their sums over the window are divided.
        """
        return {}

    # Requests.

    def labels(self, hand: Hand) -> dict[str, tuple[str, ...]]:
        """Names of the elements of flag arrays by field, for pages and command lines; those of
        fingers by default.
        """
        return {
            name: hand.fingers
            for name, array in self.arrays.items()
            if array.kind == "flag" and array.shape == ("G",)
        }

    def suggested(self, hand: Hand, task: TaskSettings) -> dict[str, np.ndarray]:
        """Initial goal arrays by field, when a user switches it on."""
        return self.neutral(hand, task)._asdict()

    def parse(
        self, option_values: Mapping[str, Any], hand: Hand, obj: GraspObject
    ) -> dict[str, np.ndarray] | None:
        """Parses the values of `options` into goal arrays by field, without batch axis; None if no
        option is given.

        Args:
          option_values: values by option name, parsed by `kind`; None for an absent option.
          hand: the hand.
          obj: the object.

        Raises:
          CongraspError: the value of an option is not feasible.
        """
        return None

    def avoid_region(self, option_values: Mapping[str, Any], obj: GraspObject) -> np.ndarray | None:
        """(N,) bool, the avoid region requested by the options; None if they request none.

        Called if `parse` returned goal arrays; `option_values` as there.

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
                raise CongraspError(
                    f"--{option}: {lacks} '{word}'.", f"Choose from: {', '.join(names)}."
                )
        return np.isin(names, words)

    def valid(self, surface: Surface, values: Any) -> Array:
        """(B,) bool: the goal arrays, of valid shapes, finite and normalised, are consistent."""
        return jnp.ones(surface.points.shape[0], bool)

    def wrist_path(self, values: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray] | None:
        """Prescribed wrist positions (n, 3), object frame, and last orientation (4,); None if it
        prescribes none.

        Args:
          values: requested goal arrays by field, without batch axis.
        """
        return None

    # Display.

    def markers(self, values: Any, blocks: Collection[str]) -> tuple[Marker, ...]:
        """Markers for pictures, recordings and the studio, shown while it is active.

        Args:
          values: its goal arrays for one episode, as NumPy.
          blocks: active blocks of the observation.
        """
        return ()

    # Derived properties, which no constraint overrides.

    @property
    def optional(self) -> bool:
        """True if it may be inactive in an episode."""
        return bool(self.blocks)

    @property
    def arrays(self) -> dict[str, GoalArray]:
        """Goal arrays by field name."""
        hints = get_type_hints(self.goal, include_extras=True)
        names: tuple[str, ...] = self.goal._fields  # type: ignore[attr-defined]
        return {name: hints[name].__metadata__[0] for name in names}

    def neutral(self, hand: Hand, task: TaskSettings) -> Any:
        """Goal arrays, without batch axis, of an episode that does not request it."""
        sizes = symbol_sizes(hand, task)
        values = {}
        for name, array in self.arrays.items():
            shape = [sizes[axis] if isinstance(axis, str) else axis for axis in array.shape]
            kind = bool if array.kind == "flag" else np.float32
            last_axis = np.asarray(array.neutral or 0.0, np.float32)
            values[name] = np.broadcast_to(last_axis, shape).astype(kind)
        return self.goal(**values)

    def active(self, goal: Goal) -> Array:
        """(B,) bool: it is active, see `among`; always for one without blocks."""
        if not self.blocks:
            return jnp.ones(len(goal[self.name][0]), bool)
        return self.among(goal.active)

    def among(self, blocks: Mapping[str, Array]) -> Array:
        """(B,) bool: one of its blocks is active. Only optional constraints have blocks.

        A reference pose of which a trajectory keeps only the fingers is therefore active.
        """
        return functools.reduce(operator.or_, [blocks[block] for block in self.blocks])


def symbol_sizes(hand: Hand, task: TaskSettings) -> dict[str, int]:
    """Sizes of the symbols in goal arrays: F finger joints, G fingers, K waypoints."""
    return {"F": len(hand.joints), "G": len(hand.fingers), "K": task.trajectory_points}


def unknown_constraint(name: str, names: Sequence[str]) -> UnknownConstraintError:
    """Error for a request of an unknown constraint; `names` are the existing ones."""
    return UnknownConstraintError(
        f"There is no constraint '{name}'.", f"Choose from: {', '.join(names)}."
    )
