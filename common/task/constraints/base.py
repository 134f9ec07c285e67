"""What a constraint is: everything that the rest of the project derives from its one file.

A constraint's module defines a subclass of `Constraint`, and `common.task.constraints.CONSTRAINTS` lists an instance.
All methods are pure functions of batched arrays (leading axis B) that may be traced; the defaults do nothing.
"""

import dataclasses
import functools
import operator
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, get_type_hints

import jax.numpy as jnp
import numpy as np

from congrasp.common.errors import CongraspError, UnknownConstraintError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.constraints.markers import Marker
from congrasp.common.task.types import Array, Goal, SceneState, Surface

if TYPE_CHECKING:
    from congrasp.common.config import TaskConfig
    from congrasp.common.task.features import Contacts, Features
    from congrasp.common.task.sampling.bank import ConstraintBank, Draw
    from congrasp.common.task.sensing import Readings

Window = Literal["approach", "hold"]
"""Over which steps an error is averaged: before the table's removal, or in the `hold_steps` after it."""


@dataclasses.dataclass(frozen=True)
class GoalArray:
    """One of a constraint's goal arrays, as the annotation of its field in the NamedTuple."""

    shape: tuple[int | str, ...]
    """Without the batch axis; a symbol of `symbol_sizes` or a number each."""
    meaning: str
    """Unit, frame, and what it says."""
    kind: Literal["real", "direction", "quaternion", "flag"] = "real"
    """Directions and quaternions must be unit vectors; flags are true or false."""
    neutral: tuple[float, ...] = ()
    """Last axis of what stands where nobody asks; zeros by default."""
    required: bool = True
    """Whether who asks for the constraint must give it."""


class Weight(NamedTuple):
    """One term of the reward."""

    name: str
    """Of the term and of its weight."""
    default: float
    meaning: str
    """Symbol in the paper, and unit."""


class ErrorSpec(NamedTuple):
    """How one error of a constraint is measured; the paper's definitions are in its section Metrics."""

    name: str
    """`heading_rad` and so on: of the episode's metric."""
    unit: str
    """rad, m, or empty for a ratio."""
    window: Window
    tolerance: float
    """Up to where the constraint counts as met in one step."""
    scale: float
    """Which error of this kind weighs as much as one of another, where grasps are compared."""
    meaning: str
    """What is met up to the tolerance, for people."""
    column: str = ""
    """Name in tables and their JSON; the same as `name` if empty."""
    block: str = ""
    """Block of the constraint without which it says nothing, where others of its blocks can be active alone."""


class ObservationField(NamedTuple):
    """Some numbers of the observation, one after the other."""

    name: str
    size: int
    meaning: str
    """Unit and frame; "wrist" is the wrist frame."""
    privileged: bool = False
    """Whether only a simulator knows them: a tracked observation lacks them."""


class Relation(NamedTuple):
    """How a constraint stands to a weaker one where both are asked for and cannot both be met."""

    weaker: str
    """Name of the other constraint."""
    settled: Literal["overridden", "redirected", "refused"]
    """What becomes of the weaker one; a refused request is an error."""
    measure: Any
    """(hand, surface, goal) -> dict of arrays (B, ...): how far the two are apart."""
    contradicts: Any
    """measured -> (B,) bool."""
    message: Any
    """(hand, measured of one environment, as NumPy) -> one or two sentences with the numbers."""


class Scene(NamedTuple):
    """One control step as the terms of a constraint see it."""

    hand: Hand
    task: "TaskConfig"
    state: SceneState
    features: "Features"
    goal: Goal
    readings: "Readings | None" = None
    """The last control steps, where the policy's observation shows them."""

    def gate(self, block: str) -> Array:
        """(B,) 1 where a block is active, else 0."""
        return self.goal.active[block].astype(jnp.float32)


class Option(NamedTuple):
    """What a person writes to ask for a constraint, as an option of `congrasp grasp`."""

    name: str
    help: str
    kind: Literal["text", "direction", "place", "part", "pose", "path"] = "text"
    """What it is read as: a text; three numbers in the axes of the object's file, made a unit vector; three numbers in
    the coordinates of the file, made a position (3,) in the object frame; a `Part`; a wrist pose with finger angles,
    or a wrist path of K waypoints, from a file: dicts of `q`, `position` and `quaternion`, object frame."""
    words: tuple[str, ...] = ()
    """Texts that stand for themselves, whatever the kind."""
    many: bool = False
    """Takes several words, which are a tuple."""
    switch: bool = False
    """Takes nothing: it is given or not."""


class Part(NamedTuple):
    """A part of an object's surface, as an option names it."""

    text: str
    """What was written."""
    distance: np.ndarray
    """(N,) m from the object's surface points to the part."""


class Constraint:
    """One constraint; subclasses set the attributes and override what they need."""

    name: ClassVar[str]
    title: ClassVar[str]
    """For people, in lower case."""
    goal: ClassVar[type]
    """NamedTuple of the goal arrays; its fields are annotated with `GoalArray`."""
    blocks: ClassVar[tuple[str, ...]] = ()
    """Blocks of the observation that it gates, each with a bit of its own; the heading, always active, has none."""
    overrides: ClassVar[tuple[str, ...]] = ()
    """Weaker constraints, or single blocks of theirs, that are inactive where this one is asked for."""
    overridden_by: ClassVar[tuple[str, ...]] = ()
    """Constraints where this one is inactive, as far as they do not say so themselves."""
    guides: ClassVar[str] = ""
    """Block whose activity hands the wrist's guidance to `guidance`; empty if it leads no wrist."""
    region: ClassVar[int] = 0
    """Region of the constraint bank that its episodes draw from: 0 the whole surface, 1 the graspable region."""
    from_reference: ClassVar[bool] = False
    """Whether it is drawn from reference grasps."""
    harvested: ClassVar[bool] = True
    """Whether successful grasps under it may become references."""
    weights: ClassVar[tuple[Weight, ...]] = ()
    errors: ClassVar[tuple[ErrorSpec, ...]] = ()
    relations: ClassVar[tuple[Relation, ...]] = ()
    options: ClassVar[tuple[Option, ...]] = ()
    needs: ClassVar[tuple[str, ...]] = ()
    """Fields of a query, beside its goal arrays, that who asks for it must give."""
    invalid: ClassVar[tuple[str, str]] = ("", "")
    """What is wrong with arrays that are not `valid`, and the remedy."""

    def fields(self, hand: Hand, task: "TaskConfig") -> tuple[tuple[ObservationField, ...], ...]:
        """What stands in each of its blocks of the observation, in order."""
        return ()

    def labels(self, hand: Hand) -> dict[str, tuple[str, ...]]:
        """Names of the elements of flag arrays, by field, for pages and command lines: those of fingers, by default."""
        return {
            name: hand.fingers for name, array in self.arrays.items() if array.kind == "flag" and array.shape == ("G",)
        }

    # Sampling and the start of an episode.

    def columns(self, hand: Hand, bank: "ConstraintBank") -> Any:
        """A pytree of arrays (N, ...) that `sample` needs of each object (`Draw.own`), made once; None for nothing.

        Headings, reference poses and trajectories, which constraints share, are the bank's own.
        """
        return None

    def available(self, draw: "Draw") -> Array:
        """(B,) bool: whether the drawn objects, in their resting poses and regions, allow it.

        By default where one of the references does, if it is drawn from them, and else everywhere.
        """
        return jnp.any(self.allowed(draw), -1) if self.from_reference else jnp.ones(draw.objects.shape, bool)

    def allowed(self, draw: "Draw") -> Array:
        """(B, M) bool: references of the drawn objects from which it may be drawn: by default those clear of the table.

        Nothing is drawn of them yet: `draw` has no `reference`.
        """
        return draw.allowed

    def sample(self, hand: Hand, draw: "Draw", key: Array) -> Any:
        """Its goal arrays for the drawn episodes, whether or not they ask for it."""
        raise NotImplementedError

    def override(self, hand: Hand, surface: Surface, asked: Mapping[str, Array], goal: Goal) -> Goal:
        """The goal with what this constraint, where it is asked for, puts in the place of weaker ones' arrays."""
        return goal

    def initial_fingers(self, goal: Goal) -> tuple[Array, Array] | None:
        """(B,) bool where an episode begins with other finger angles than the open hand's, and these (B, F)."""
        return None

    def initial_wrist(self, hand: Hand, back_off: Array, goal: Goal, q: Array) -> tuple[Array, Array, Array] | None:
        """(B,) bool where it says at which wrist pose an episode begins, and the pose (B, 3), (B, 4), object frame.

        Args:
          hand: the hand.
          back_off: (B,) m from the aligned wrist back, where nothing else says where the wrist begins.
          goal: after the priority rules.
          q: (B, F) finger angles at the start.
        """
        return None

    def suggested(self, hand: Hand, task: "TaskConfig") -> dict[str, np.ndarray]:
        """Goal arrays by field to begin with, where a person switches it on."""
        return self.neutral(hand, task)._asdict()

    def wrist_path(self, own: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray] | None:
        """Wrist positions (n, 3), object frame, and last orientation (4,) that it prescribes; None if it does not."""
        return None

    # One control step.

    def features(self, hand: Hand, contacts: "Contacts", features: "Features", goal: Goal) -> Any:
        """Geometry of its own that observation, reward and errors share, as a pytree."""
        return ()

    def guidance(self, scene: Scene, *, current: bool) -> tuple[Array, Array]:
        """World wrist pose (B, 3), (B, 4) that it leads to, on the object's current or initial pose."""
        raise NotImplementedError

    def observe(self, scene: Scene) -> tuple[Sequence[Array], ...]:
        """For each block its `fields` (B, ...), which are laid side by side; they are gated afterwards."""
        return ()

    def forbidden(self, scene: Scene) -> Array | None:
        """(B, L) bool: links that must not touch the object, whether or not it is active; None if it names none."""
        return None

    def earning(self, scene: Scene, touching: Array, force: Array) -> tuple[Array, Array]:
        """Contacts that earn the grasp reward: what it leaves of flags (B, L) and forces (B, L, 3) of the links.

        By default those of all links that it does not forbid.
        """
        if (forbidden := self.forbidden(scene)) is None:
            return touching, force
        lost = forbidden & self.active(scene.goal)[:, None]
        return touching & ~lost, jnp.where(lost[..., None], 0.0, force)

    def force_max(self, scene: Scene, most: Array) -> Array:
        """Force (B, 1) or () of each link beyond which nothing is earned, N: what it leaves of `most`."""
        return most

    def reward(self, scene: Scene) -> dict[str, Array]:
        """Terms (B,) by the names of `weights`, signed, before the weight, zero where it is inactive."""
        return {}

    def measure(self, scene: Scene) -> dict[str, Array | tuple[Array, Array]]:
        """Errors (B,) of one step by the names of `errors`, active or not.

        A pair is numerator and denominator of a ratio, whose sums over the window are divided.
        """
        return {}

    # What people see.

    def markers(self, own: Any, blocks: Collection[str]) -> tuple[Marker, ...]:
        """How pictures, recordings and the studio show it where it is active.

        Args:
          own: its goal arrays of one episode, as NumPy.
          blocks: active blocks of the observation.
        """
        return ()

    def valid(self, surface: Surface, own: Any) -> Array:
        """(B,) bool: whether goal arrays of the right shapes, finite and unit, make sense together."""
        return jnp.ones(surface.points.shape[0], bool)

    def explain(self, overridden: Sequence[str], redirected: bool) -> list[str]:
        """What the priority rules do with it where it is asked for, in sentences.

        Args:
          overridden: names of the stronger constraints that are asked for and override it or one of its blocks.
          redirected: whether it turned the heading.
        """
        return []

    def parse(self, given: Mapping[str, Any], hand: Hand, obj: GraspObject) -> dict[str, np.ndarray] | None:
        """Goal arrays by field (without batch axis) from what a person wrote for `options`; None if nothing.

        Args:
          given: by the names of options, read by their `kind`; None where nothing was written.
          hand: the hand.
          obj: the object.

        Raises:
          CongraspError: an option says nothing that can be done.
        """
        return None

    def avoid_region(self, given: Mapping[str, Any], obj: GraspObject) -> np.ndarray | None:
        """(N,) bool, the avoid region that `parse`d options ask for; None if they say nothing of it.

        Raises:
          CongraspError: all or nothing would have to be avoided.
        """
        return None

    @staticmethod
    def named_flags(option: str, words: Sequence[str], names: Sequence[str], lacks: str) -> np.ndarray:
        """(len(names),) bool: which of the names are among the words of an option.

        Args:
          option: its name.
          words: what a person wrote.
          names: all that may be written.
          lacks: what is said of another word, such as "the hand has no finger".

        Raises:
          CongraspError: a word is none of the names.
        """
        for word in words:
            if word not in names:
                raise CongraspError(f"--{option}: {lacks} '{word}'.", f"Known: {', '.join(names)}.")
        return np.isin(names, words)

    # What follows from the above.

    @property
    def optional(self) -> bool:
        """Whether an episode can be without it."""
        return bool(self.blocks)

    @property
    def arrays(self) -> dict[str, GoalArray]:
        """The goal arrays by field name."""
        hints = get_type_hints(self.goal, include_extras=True)
        return {name: hints[name].__metadata__[0] for name in self.goal._fields}  # type: ignore[attr-defined]

    def neutral(self, hand: Hand, task: "TaskConfig") -> Any:
        """Goal arrays (without batch axis) that stand where nobody asks."""
        symbols = symbol_sizes(hand, task)
        made = {}
        for name, array in self.arrays.items():
            shape = tuple(symbols[n] if isinstance(n, str) else n for n in array.shape)
            fill = np.asarray(array.neutral or 0.0, np.float32)
            made[name] = np.broadcast_to(fill, shape).astype(bool if array.kind == "flag" else np.float32)
        return self.goal(**made)

    def active(self, goal: Goal) -> Array:
        """(B,) bool: whether it is active, see `among`."""
        return self.among(goal.active)

    def among(self, blocks: Mapping[str, Array]) -> Array:
        """(B,) bool by which blocks are active: any of its own is, and only optional constraints have any.

        So a reference pose of which a trajectory leaves only the fingers is active.
        """
        return functools.reduce(operator.or_, (blocks[block] for block in self.blocks))


def symbol_sizes(hand: Hand, task: "TaskConfig") -> dict[str, int]:
    """Sizes that the symbols of goal arrays stand for: F finger joints, G fingers, K waypoints."""
    return {"F": len(hand.joints), "G": len(hand.fingers), "K": task.trajectory_points}


def unknown_constraint(name: str, known: Sequence[str]) -> UnknownConstraintError:
    """The error of someone who asks for a constraint that is not there."""
    return UnknownConstraintError(f"There is no constraint '{name}'.", f"Choose from: {', '.join(known)}.")
