"""The request of the studio's user: object, constraints, and the effects of the priority rules; without a browser."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.shapes import matrix
from congrasp.common.objects.spec import GraspObject
from congrasp.common.request import GraspRequest
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import get_constraint, goal_of, optional, require_known
from congrasp.common.task.constraints.priority import Resolution, explain, resolve
from congrasp.common.task.sampling.closed_poses import Poses, closed_poses
from congrasp.common.task.sampling.headings import BACK_OFF, INWARD
from congrasp.common.task.sampling.write_sets import make_sets
from congrasp.common.task.types import Goal, Surface
from congrasp.common.wire.codec import Message
from congrasp.services.grasp.grasper import with_avoid
from congrasp.services.studio.arrow import LARGEST, Arrow, arrow_of, from_above, vector
from congrasp.services.studio.canvas import Canvas, Paint

TOOLS = ("affordance", "pose", "trajectory")
"""Constraints with drawing tools; the page makes toggles for the flags of the others."""
_LEAST_PATH = 0.03  # m


class Path(NamedTuple):
    """Waypoints of the wrist in the object frame."""

    position: np.ndarray
    """(K, 3) m."""
    quaternion: np.ndarray
    """(K, 4) w x y z."""


class Edit(NamedTuple):
    """Everything that a user sets in a request for one object; immutable."""

    rest: int
    asked: frozenset[str]
    arrow: Arrow
    pose: Poses | None
    path: Path | None
    others: Mapping[str, Mapping[str, np.ndarray]]
    paint: Paint


class Studio:
    """One user's request. Its methods are the user's actions, and raise a CongraspError if they are impossible.

    Attributes:
      obj: the object, without paint.
      rest: index of its resting pose.
      asked: names of the optional constraints that are switched on.
      arrow: the heading.
      pose: the reference pose, or None.
      path: the wrist path, or None.
      others: flags of the constraints without drawing tools.
      canvas: the object's surface, with the painted avoid region.
    """

    def __init__(self, hand: Hand, task: TaskConfig, obj: GraspObject):
        """Begins with an object, and a heading from above."""
        self.hand, self.task = hand, dataclasses.replace(task, object_scale=1.0)  # objects keep their size
        self.take(obj)

    def take(self, obj: GraspObject) -> None:
        """Takes another object, and resets the request to a heading from above."""
        self.obj, self.rest = obj, 0
        self.asked: frozenset[str] = frozenset()
        self.canvas = Canvas(obj)
        self.pose: Poses | None = None
        self.path: Path | None = None
        self.others: Mapping[str, Mapping[str, np.ndarray]] = {
            c.name: c.suggested(self.hand, self.task) for c in optional(self.task) if c.name not in TOOLS
        }
        self._sets: tuple[bytes, Message] | None = None
        self._next = {"heading": 0, "pose": 0, "trajectory": 0}
        self.arrow = from_above(obj, self.rest)

    @property
    def edit(self) -> Edit:
        """Everything that the user has set; setting it restores another state."""
        return Edit(self.rest, self.asked, self.arrow, self.pose, self.path, self.others, self.canvas.paint)

    @edit.setter
    def edit(self, edit: Edit) -> None:
        self.rest, self.asked, self.arrow, self.pose, self.path, self.others, self.canvas.paint = edit

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
        if on and constraint == "affordance" and not self.canvas.avoid.any():
            self.canvas.take_parts()
        if on and constraint == "pose" and self.pose is None:
            self._close()
        if on and constraint == "trajectory" and self.path is None:
            self._suggest("trajectory")
        self._switch(constraint, on)

    def choose(self, constraint: str, field: str, values: Any) -> None:
        """Sets the flags of a constraint without drawing tools, and switches it on."""
        require_known([constraint], self.task)
        if constraint not in self.others or field not in get_constraint(constraint).labels(self.hand):
            raise CongraspError(f"There is nothing to choose for '{constraint}'.", f"Choose for: {list(self.others)}.")
        flags = self.others[constraint][field]
        if not isinstance(values, list) or len(values) != len(flags):
            raise CongraspError(f"'{constraint}' takes {len(flags)} flags.")
        chosen = {**self.others[constraint], field: np.array([bool(value) for value in values])}
        self.others = {**self.others, constraint: chosen}
        self._switch(constraint, True)

    def set_heading(self, position: Any, direction: Any, cross: Any = None) -> None:
        """Sets the heading.

        Args:
          position: (3,) target in the object frame, m.
          direction: (3,) of any length above zero.
          cross: (3,) along the cross-finger axis, made orthogonal; the current one by default.
        """
        self.arrow = arrow_of(position, direction, self.arrow.cross if cross is None else cross)

    def snap_heading(self, surface: Any, direction: Any) -> None:
        """Sets the heading through a point (3,) of the surface; its target is `INWARD` beyond it, as in training."""
        surface, direction = vector("point", surface), vector("arrow's direction", direction)
        self.set_heading(surface + INWARD * direction / max(1e-6, float(np.linalg.norm(direction))), direction)

    def set_roll(self, angle: float) -> None:
        """Sets the angle of the hand around the arrow, in rad; see `Arrow.roll`."""
        angle = float(vector("angle", [angle, 0.0, 0.0])[0])
        self.arrow = self.arrow.with_roll(angle, self.up)

    def paint(self, points: Any, radius: float, avoid: bool) -> None:
        """Adds the surface near points (N, 3) to the avoid region, or removes it; see `Canvas.brush`.

        The affordance is requested while there is paint.
        """
        self.canvas.brush(points, radius, avoid)
        self._repainted()

    def fill(self, avoid: bool) -> None:
        """Paints everything, or removes all paint if `avoid` is False."""
        self.canvas.fill(avoid)
        self._repainted()

    def close_hand(self) -> None:
        """Requests a reference pose: the hand at the arrow, closed around the object."""
        require_known(["pose"], self.task)
        self._close()
        self._switch("pose", True)

    def _close(self) -> None:
        """Sets the pose of `close_hand`."""
        arrow = (np.asarray(part, np.float32)[None] for part in self.arrow)
        pose = closed_poses(self.hand, np.asarray(self.obj.points), np.asarray(self.obj.normals), *arrow)
        self.pose = Poses(*(np.asarray(field)[0] for field in pose))

    def draw(self, points: Any) -> None:
        """Requests a wrist path through points (N, 3) of the object frame, from far to near.

        A displacement that grows along the path makes it end at the wrist of the reference pose, or of the hand closed
        at the arrow. The orientation of the wrist is that of the end throughout.
        """
        require_known(["trajectory"], self.task)
        drawn = np.asarray(points, float)
        if drawn.ndim != 2 or drawn.shape[1:] != (3,) or not 2 <= len(drawn) <= 2000 or not np.isfinite(drawn).all():
            raise CongraspError("A path must be 2 to 2000 points of three numbers.")
        if np.abs(drawn).max() > LARGEST:
            raise CongraspError(f"A path must be within {LARGEST:g} m of the object.")
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(drawn, axis=0), axis=-1))])
        if along[-1] < _LEAST_PATH:
            raise CongraspError(
                f"The path is {100 * along[-1]:.1f} cm long.", f"Draw {100 * _LEAST_PATH:.0f} cm or more."
            )
        if self.pose is None:
            self._close()
        assert self.pose is not None
        share = np.linspace(0.0, 1.0, self.task.trajectory_points)
        even = np.stack([np.interp(share * along[-1], along, drawn[:, i]) for i in range(3)], -1)
        position = even + share[:, None] * (self.pose.position - even[-1])
        self.path = Path(position, np.tile(self.pose.quaternion, (len(share), 1)))
        self._switch("trajectory", True)

    def suggest(self, constraint: str) -> None:
        """Requests the next heading, reference pose or wrist path that training would draw for this object.

        Raises:
          CongraspError: there are none in this resting pose.
        """
        if constraint not in self._next:
            raise CongraspError(f"Nothing can be suggested for '{constraint}'.", "Choose heading, pose or trajectory.")
        require_known([constraint], self.task)
        self._suggest(constraint)
        if get_constraint(constraint).optional:
            self._switch(constraint, True)

    def _suggest(self, constraint: str) -> None:
        """Sets the heading, pose or path of `suggest`."""
        sets = self._constraint_sets().arrays
        region = int("affordance" in self.asked and bool(self.canvas.avoid.any()))
        allowed = sets["heading/allowed" if constraint == "heading" else "pose/allowed"][region, self.rest]
        found = np.flatnonzero(allowed)
        if not len(found):
            raise CongraspError(
                f"The table leaves no room for a {constraint} in this resting pose.",
                "Take another resting pose, or paint less.",
            )
        pick = found[(self._next[constraint] * 7919) % len(found)]
        self._next[constraint] += 1
        at = (region, pick)
        if constraint == "heading":
            direction = sets["heading/direction"][at]
            position = sets["heading/position"][at] - sets["heading/back"][region, self.rest, pick] * direction
            self.set_heading(position, direction, sets["heading/cross"][at])
            return
        self.pose = Poses(*(sets[f"pose/{name}"][at] for name in Poses._fields))
        if constraint == "trajectory":
            self.path = Path(sets["trajectory/position"][at], sets["trajectory/quaternion"][at])

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
        """The request, whether or not it is possible."""
        given: dict[str, Mapping[str, np.ndarray]] = {"affordance": {}, **self.others}
        given |= {name: part._asdict() for name, part in (("pose", self.pose), ("trajectory", self.path)) if part}
        constraints: dict[str, Mapping[str, np.ndarray]] = {"heading": self.arrow._asdict()}
        constraints |= {c.name: given[c.name] for c in optional(self.task) if c.name in self.asked}
        avoid = self.canvas.avoid if "affordance" in self.asked else None
        return GraspRequest(constraints, avoid, rest=self.rest)

    @property
    def resolution(self) -> Resolution:
        """The request after the priority rules, without batch axes."""
        asked = {c.name: np.array([c.name in self.asked]) for c in optional(self.task)}
        goal = jax.tree.map(lambda array: np.asarray(array)[None], goal_of(self.hand, self.task, self._request()))
        surface = Surface(np.asarray(self.obj.points, np.float32)[None], self.canvas.avoid[None])
        found = _resolve(self.hand, surface, goal, asked)
        return Resolution(found.goal.row(0), np.asarray(found.redirected)[0], np.asarray(found.aligned)[0])

    @property
    def explanation(self) -> list[str]:
        """The effects of the priority rules, a sentence each, strongest constraint first."""
        return explain(self.asked, bool(self.resolution.redirected))

    @property
    def trouble(self) -> str:
        """Reason why the request is impossible, with a remedy; empty if it is possible."""
        if "affordance" in self.asked and (self.canvas.avoid.all() or not self.canvas.avoid.any()):
            what = "Everything is" if self.canvas.avoid.any() else "Nothing is"
            return f"{what} painted as avoid region. Paint a part of the object with the brush."
        for name in self.asked - {"affordance"}:
            own = jax.tree.map(
                lambda array: np.asarray(array)[None], goal_of(self.hand, self.task, self._request())[name]
            )
            if not get_constraint(name).valid(Surface(np.asarray(self.obj.points)[None], self.canvas.avoid[None]), own)[
                0
            ]:
                return " ".join(get_constraint(name).invalid)
        found = self.resolution
        if not found.aligned:
            return "The wrist path ends nearer to the avoid region. Draw another path, or paint elsewhere."
        heading = found.goal["heading"]
        start = self._world(heading.position - BACK_OFF * heading.direction)
        if "trajectory" not in self.asked and start[2] < 0:
            return "The approach begins under the table. Turn the arrow so that it comes from above."
        if "trajectory" in self.asked and min(self._world(p)[2] for p in found.goal["trajectory"].position) < 0:
            return "The wrist path goes through the table. Draw it higher, or take another suggestion."
        return ""

    def _repainted(self) -> None:
        """Requests the affordance if there is paint."""
        self._switch("affordance", bool(self.canvas.avoid.any()))

    def _switch(self, constraint: str, on: bool) -> None:
        """Switches a constraint on or off."""
        self.asked = self.asked | {constraint} if on else self.asked - {constraint}

    @property
    def up(self) -> np.ndarray:
        """(3,) unit, away from the table in the object frame."""
        return matrix(self.obj.rest_poses[self.rest][3:])[2]

    def _constraint_sets(self) -> Message:
        """The constraint set of the object with its current paint, generated on demand."""
        key = self.canvas.avoid.tobytes()
        if self._sets is None or self._sets[0] != key:
            self._sets = key, make_sets(self.hand, self.task, [self.labelled], seed=0)[0]
        return self._sets[1]

    def _world(self, point: np.ndarray) -> np.ndarray:
        """(3,) m, a point of the object frame in the world frame."""
        rest = self.obj.rest_poses[self.rest]
        return rest[:3] + matrix(rest[3:]) @ point


@functools.partial(jax.jit, static_argnums=0)
def _resolve(hand: Hand, surface: Surface, goal: Goal, asked: dict[str, jax.Array]) -> Resolution:
    """`resolve`, compiled."""
    return resolve(hand, surface, goal, asked)
