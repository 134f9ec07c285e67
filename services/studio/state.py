"""The request of the studio's user: object, constraints, and the effects of the priority rules;
with undo and redo.
"""

import collections
import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.shapes import matrix
from congrasp.common.objects.spec import GraspObject
from congrasp.common.request import GraspRequest
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import (
    Constraint,
    get_constraint,
    goal_of,
    known,
    optional,
    require_known,
)
from congrasp.common.task.constraints.priority import Resolution, explain, resolve
from congrasp.common.task.sampling.closed_poses import Poses, closed_poses
from congrasp.common.task.sampling.headings import BACK_OFF
from congrasp.common.task.sampling.sets import make_sets
from congrasp.common.task.types import Goal, Surface
from congrasp.common.wire.codec import Message
from congrasp.services.grasp.approaches import with_avoid
from congrasp.services.studio.drawing import (
    Arrow,
    Canvas,
    Paint,
    arrow_through,
    from_above,
    stroke,
    vector,
)

Fields = Mapping[str, np.ndarray]
"""Goal arrays of a constraint by field, without batch axis."""
Tool = Literal["arrow", "paint", "hand", "path", ""]
_SHORTEST_PATH_M = 0.03
_MOST_EDITS = 100  # that can be undone
_SLOT_STRIDE = 7919
"""Prime step through the slots of a constraint set, so that successive suggestions differ."""


def tool_of(constraint: Constraint) -> Tool:
    """Tool that sets the goal arrays of a constraint; empty for flags and numbers."""
    if "surface_avoid" in constraint.needs:
        return "paint"
    if set(constraint.arrays) == set(Poses._fields):
        return "hand"
    position = constraint.arrays.get("position")
    if position is None:
        return ""
    return "path" if position.shape[0] == "K" else "arrow"


class Edit(NamedTuple):
    """Everything that a user sets in a request for one object; immutable."""

    rest: int
    asked: frozenset[str]
    fields: Mapping[str, Fields]
    paint: Paint


class Studio:
    """One user's request. Its methods are the user's actions, and raise a CongraspError if they are
    impossible.

    Attributes:
      obj: the object, without paint.
      rest: index of its resting pose.
      asked: names of the optional constraints that are switched on.
      fields: goal arrays of the constraints that have been set, on or off; those with flags have
        some from the start.
      canvas: the object's surface, with the painted avoid region.
    """

    def __init__(self, hand: Hand, task: TaskConfig, obj: GraspObject):
        """Begins with an object, and a heading from above."""
        self.hand = hand
        # Objects keep their size
        self.task = dataclasses.replace(task, object_scale=1.0)
        self.take(obj)

    def take(self, obj: GraspObject) -> None:
        """Takes another object, and resets the request to a heading from above."""
        self.obj = obj
        self.rest = 0
        self.asked: frozenset[str] = frozenset()
        self.canvas = Canvas(obj)
        fields: dict[str, Fields] = {}
        for constraint in optional(self.task):
            if not tool_of(constraint):
                fields[constraint.name] = constraint.suggested(self.hand, self.task)
        self.fields: Mapping[str, Fields] = fields
        self._sets: tuple[bytes, Message] | None = None
        self._suggested: collections.Counter[str] = collections.Counter()
        self.arrow = from_above(obj, self.rest)

    @property
    def edit(self) -> Edit:
        """Everything that the user has set; setting it restores another state."""
        return Edit(self.rest, self.asked, self.fields, self.canvas.paint)

    @edit.setter
    def edit(self, edit: Edit) -> None:
        self.rest = edit.rest
        self.asked = edit.asked
        self.fields = edit.fields
        self.canvas.paint = edit.paint

    @property
    def arrow(self) -> Arrow:
        """The heading."""
        return Arrow(**self.fields["heading"])

    @arrow.setter
    def arrow(self, arrow: Arrow) -> None:
        self._set("heading", arrow._asdict())

    def set_rest_pose(self, rest: int) -> None:
        """Sets the resting pose, and resets the heading to one from above."""
        if not isinstance(rest, int) or not 0 <= rest < len(self.obj.rest_poses):
            which = rest + 1 if isinstance(rest, int) else f"'{str(rest)[:20]}'"
            raise CongraspError(f"The object '{self.obj.name}' has no resting pose {which}.")
        self.rest = rest
        self.arrow = from_above(self.obj, rest)

    def ask(self, constraint: str, on: bool) -> None:
        """Switches an optional constraint on or off; suggests its missing parts."""
        require_known([constraint], self.task)
        if not get_constraint(constraint).optional:
            raise CongraspError(f"The {constraint} is always active.", "Set it with the arrow.")
        tool = tool_of(get_constraint(constraint))
        if on and tool == "paint" and not self.canvas.avoid.any():
            self.canvas.take_parts()
        elif on and tool == "hand" and constraint not in self.fields:
            self._set(constraint, self._closed_pose())
        elif on and tool == "path" and constraint not in self.fields:
            self._suggest(constraint)
        self._switch(constraint, on)

    def choose(self, constraint: str, field: str, values: Any) -> None:
        """Sets the flags of a constraint without a drawing tool, and switches it on."""
        require_known([constraint], self.task)
        spec = get_constraint(constraint)
        if tool_of(spec) or field not in spec.labels(self.hand):
            others = [c.name for c in optional(self.task) if not tool_of(c)]
            raise CongraspError(
                f"There is nothing to choose for '{constraint}'.", f"Choose for: {others}."
            )
        flags = self.fields[constraint][field]
        if not isinstance(values, list) or len(values) != len(flags):
            raise CongraspError(
                f"'{constraint}' takes {len(flags)} flags.", f"Pass {len(flags)} booleans."
            )
        chosen = np.array([bool(value) for value in values])
        self._set(constraint, {**self.fields[constraint], field: chosen})
        self._switch(constraint, True)

    def set_heading(self, surface: Any, direction: Any) -> None:
        """Sets the heading through a point (3,) of the surface in a direction (3,) of any length
        above zero.

        Its target is `INWARD` beyond the point, as in training, and its roll changes as little as
        possible.
        """
        self.arrow = arrow_through(surface, direction, self.arrow.cross)

    def set_roll(self, angle: float) -> None:
        """Sets the angle of the hand around the arrow, in rad; see `Arrow.roll`."""
        angle = float(vector("angle", [angle, 0.0, 0.0])[0])
        self.arrow = self.arrow.with_roll(angle, self.up)

    def paint(self, points: Any, radius: float, avoid: bool) -> None:
        """Adds the surface near points (N, 3) to the avoid region, or removes it; see
        `Canvas.brush`.

        The constraint on the region is requested while there is paint.
        """
        self.canvas.brush(points, radius, avoid)
        self._switch(self._drawn_by("paint"), bool(self.canvas.avoid.any()))

    def fill(self, avoid: bool) -> None:
        """Paints everything, or removes all paint if `avoid` is False."""
        self.canvas.fill(avoid)
        self._switch(self._drawn_by("paint"), bool(self.canvas.avoid.any()))

    def close_hand(self) -> None:
        """Requests a reference pose: the hand at the arrow, closed around the object."""
        name = self._drawn_by("hand")
        self._set(name, self._closed_pose())
        self._switch(name, True)

    def draw(self, points: Any) -> None:
        """Requests a wrist path through points (N, 3) of the object frame, from far to near.

        A displacement that grows along the path makes it end at the wrist of the reference pose, or
        of the hand closed at the arrow. The orientation of the wrist is that of the end throughout.
        """
        name = self._drawn_by("path")
        drawn = stroke("path", points)
        segments = np.linalg.norm(np.diff(drawn, axis=0), axis=-1)
        arc_length = np.concatenate([[0.0], np.cumsum(segments)])
        if arc_length[-1] < _SHORTEST_PATH_M:
            raise CongraspError(
                f"The path is {100 * arc_length[-1]:.1f} cm long.",
                f"Draw a path of at least {100 * _SHORTEST_PATH_M:.0f} cm.",
            )
        end = self._reference_pose()
        share = np.linspace(0.0, 1.0, self.task.trajectory_points)
        at = share * arc_length[-1]
        even = np.stack([np.interp(at, arc_length, drawn[:, axis]) for axis in range(3)], -1)
        position = even + share[:, None] * (end["position"] - even[-1])
        quaternion = np.tile(end["quaternion"], (len(share), 1))
        self._set(name, {"position": position, "quaternion": quaternion})
        self._switch(name, True)

    def _reference_pose(self) -> Fields:
        """The reference pose that has been set, else the hand closed at the arrow."""
        for constraint in known(self.task):
            if tool_of(constraint) == "hand" and constraint.name in self.fields:
                return self.fields[constraint.name]
        return self._closed_pose()

    def suggest(self, constraint: str) -> None:
        """Requests the next heading, reference pose or wrist path that training would draw for this
        object.

        Raises:
          CongraspError: there are none in this resting pose.
        """
        require_known([constraint], self.task)
        if tool_of(get_constraint(constraint)) in ("", "paint"):
            placed = [c.name for c in known(self.task) if tool_of(c) not in ("", "paint")]
            raise CongraspError(
                f"Nothing can be suggested for '{constraint}'.",
                f"Choose from: {', '.join(placed)}.",
            )
        self._suggest(constraint)
        if get_constraint(constraint).optional:
            self._switch(constraint, True)

    def _suggest(self, name: str) -> None:
        """Sets the goal arrays of `suggest`; those of a reference also for weaker constraints from
        references.
        """
        sets = self._constraint_sets().arrays
        reference = get_constraint(name).from_reference
        related = [c.name for c in known(self.task) if c.from_reference == reference]
        region = 0
        if self.canvas.avoid.any():
            region = max((get_constraint(asked).region for asked in self.asked), default=0)
        allowed = [sets[f"{c}/allowed"] for c in related if f"{c}/allowed" in sets]
        slots = np.flatnonzero(allowed[0][region, self.rest])
        if not len(slots):
            raise CongraspError(
                f"The table leaves no room for a {name} in this resting pose.",
                "Choose another resting pose, or paint a smaller region.",
            )
        slot = slots[(self._suggested[name] * _SLOT_STRIDE) % len(slots)]
        self._suggested[name] += 1
        for other in related[: related.index(name) + 1]:
            fields = {}
            for field in get_constraint(other).arrays:
                fields[field] = sets[f"{other}/{field}"][region, slot]
            if f"{other}/back" in sets:
                back_off = sets[f"{other}/back"][region, self.rest, slot]
                fields["position"] = fields["position"] - back_off * fields["direction"]
            self._set(other, fields)

    @property
    def labelled(self) -> GraspObject:
        """The object with the painted regions as its parts."""
        return with_avoid(self.obj, self.canvas.avoid)

    @property
    def request(self) -> GraspRequest:
        """Request for the policy.

        Raises:
          CongraspError: the request is impossible; see `trouble`.
        """
        if trouble := self.trouble:
            raise CongraspError(trouble)
        return self._request()

    def _request(self) -> GraspRequest:
        """The request, possible or not."""
        fields: dict[str, Fields] = {}
        avoid = None
        for constraint in known(self.task):
            if constraint.optional and constraint.name not in self.asked:
                continue
            fields[constraint.name] = self.fields.get(constraint.name, {})
            if tool_of(constraint) == "paint":
                avoid = self.canvas.avoid
        return GraspRequest(fields, avoid, rest=self.rest)

    @property
    def goal(self) -> Goal:
        """Goal arrays of the request before the priority rules, without batch axis."""
        return goal_of(self.hand, self.task, self._request())

    @property
    def resolution(self) -> Resolution:
        """The request after the priority rules, without batch axes."""
        requested = {c.name: np.array([c.name in self.asked]) for c in optional(self.task)}
        batch = _resolve(self.hand, self._surface, self._goal_batch(), requested)
        return Resolution(
            goal=batch.goal.row(0),
            redirected=np.asarray(batch.redirected)[0],
            aligned=np.asarray(batch.aligned)[0],
        )

    @property
    def explanation(self) -> list[str]:
        """The effects of the priority rules, a sentence each, strongest constraint first."""
        return explain(self.asked, bool(self.resolution.redirected))

    @property
    def trouble(self) -> str:
        """Reason why the request is impossible, with a remedy; empty if it is possible."""
        requested = [c for c in optional(self.task) if c.name in self.asked]
        trouble = self._constraint_trouble(requested)
        if trouble:
            return trouble
        resolution = self.resolution
        if not resolution.aligned:
            return (
                "The wrist path ends nearer to the avoid region. Draw another path, or paint "
                "elsewhere."
            )
        return self._table_trouble(requested, resolution.goal)

    def _constraint_trouble(self, requested: Sequence[Constraint]) -> str:
        """Reason why one of the requested constraints is invalid; empty without one."""
        goal = self._goal_batch()
        avoid = self.canvas.avoid
        for constraint in requested:
            if tool_of(constraint) == "paint" and (avoid.all() or not avoid.any()):
                painted = "Everything is" if avoid.any() else "Nothing is"
                return (
                    f"{painted} painted as avoid region. Paint a part of the object with the brush."
                )
            if not constraint.valid(self._surface, goal[constraint.name])[0]:
                return " ".join(constraint.invalid)
        return ""

    def _table_trouble(self, requested: Sequence[Constraint], goal: Goal) -> str:
        """Reason why the table is in the way of the wrist path or of the approach; else empty."""
        paths = [goal[c.name].position for c in requested if tool_of(c) == "path"]
        for path in paths:
            if any(self._world(point)[2] < 0 for point in path):
                return (
                    "The wrist path goes through the table. Draw it higher, or take another "
                    "suggestion."
                )
        heading = goal["heading"]
        approach_start = heading.position - BACK_OFF * heading.direction
        if not paths and self._world(approach_start)[2] < 0:
            return (
                "The approach begins under the table. Turn the arrow so that it comes from above."
            )
        return ""

    def _goal_batch(self) -> Goal:
        """Goal arrays before the priority rules, with a batch axis."""
        return jax.tree.map(lambda array: np.asarray(array)[None], self.goal)

    @property
    def up(self) -> np.ndarray:
        """(3,) unit, away from the table in the object frame."""
        return matrix(self.obj.rest_poses[self.rest][3:])[2]

    @property
    def _surface(self) -> Surface:
        """The labelled surface, with a batch axis."""
        return Surface(np.asarray(self.obj.points, np.float32)[None], self.canvas.avoid[None])

    def _drawn_by(self, tool: Tool) -> str:
        """Name of the constraint of a drawing tool; raises a CongraspError if the policy supports
        none.
        """
        for constraint in known(self.task):
            if tool_of(constraint) == tool:
                return constraint.name
        names = ", ".join(self.task.constraints)
        raise CongraspError(
            f"The policy supports no constraint of the tool '{tool}'.",
            f"Choose from its constraints: {names}.",
        )

    def _closed_pose(self) -> Fields:
        """Reference pose of the hand at the arrow, closed around the object."""
        arrow = (np.asarray(part, np.float32)[None] for part in self.arrow)
        pose = closed_poses(
            self.hand, np.asarray(self.obj.points), np.asarray(self.obj.normals), *arrow
        )
        return {name: np.asarray(field)[0] for name, field in pose._asdict().items()}

    def _set(self, constraint: str, fields: Fields) -> None:
        """Sets the goal arrays of a constraint."""
        self.fields = {**self.fields, constraint: fields}

    def _switch(self, constraint: str, on: bool) -> None:
        """Switches a constraint on or off."""
        self.asked = self.asked | {constraint} if on else self.asked - {constraint}

    def _constraint_sets(self) -> Message:
        """The constraint set of the object with its current paint, generated on demand."""
        key = self.canvas.avoid.tobytes()
        if self._sets is None or self._sets[0] != key:
            (sets,) = make_sets(self.hand, self.task, [self.labelled], seed=0)
            self._sets = (key, sets)
        return self._sets[1]

    def _world(self, point: np.ndarray) -> np.ndarray:
        """(3,) m, a point of the object frame in the world frame."""
        rest = self.obj.rest_poses[self.rest]
        return rest[:3] + matrix(rest[3:]) @ point


@functools.partial(jax.jit, static_argnums=0)
def _resolve(hand: Hand, surface: Surface, goal: Goal, asked: dict[str, jax.Array]) -> Resolution:
    """`resolve`, compiled."""
    return resolve(hand, surface, goal, asked)


ACTIONS = {
    "set_rest_pose": "resting pose",
    "ask": "constraint on or off",
    "choose": "choice of flags",
    "set_heading": "heading",
    "set_roll": "roll",
    "paint": "brush stroke",
    "fill": "painting of everything",
    "close_hand": "reference pose",
    "draw": "wrist path",
    "suggest": "suggestion",
}
"""Methods of `Studio` that a page may call, with their arguments by name, and their labels on the
page.
"""


def _last_label(edits: Sequence[tuple[str, Edit]]) -> str:
    """Label of the last edit; empty if there is none."""
    if not edits:
        return ""
    action, _ = edits[-1]
    return ACTIONS[action]


class History:
    """Makes edits and undoes them one by one; an edit that fails changes nothing."""

    def __init__(self, studio: Studio):
        """Begins without edits."""
        self._studio = studio
        self._done: list[tuple[str, Edit]] = []
        self._undone: list[tuple[str, Edit]] = []
        self._gesture: Any = None

    def do(self, action: str, *, gesture: Any = None, **values: Any) -> None:
        """Calls one of `ACTIONS`. Successive calls of one gesture, such as dragging a slider, are
        one edit.

        Raises:
          CongraspError: the action fails.
        """
        before = self._studio.edit
        try:
            getattr(self._studio, action)(**values)
        except BaseException:
            self._studio.edit = before
            raise
        if gesture is None or gesture != self._gesture:
            self._done = [*self._done, (action, before)][-_MOST_EDITS:]
        self._gesture = gesture
        self._undone.clear()

    def undo(self) -> None:
        """Undoes the last edit, if there is one."""
        self._swap(self._done, self._undone)

    def redo(self) -> None:
        """Repeats the edit that was undone last, if no other followed."""
        self._swap(self._undone, self._done)

    def view(self) -> dict[str, str]:
        """Labels of the next undo and redo; empty if there is none."""
        return {"undo": _last_label(self._done), "redo": _last_label(self._undone)}

    def _swap(self, source: list[tuple[str, Edit]], target: list[tuple[str, Edit]]) -> None:
        """Restores the last edit of `source`, and keeps the current one in `target`."""
        self._gesture = None
        if source:
            action, edit = source.pop()
            target.append((action, self._studio.edit))
            self._studio.edit = edit
