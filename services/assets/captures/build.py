"""Builds objects and constraint sets from sequences, with a report of kept and dropped ones."""

import collections
import dataclasses
import pathlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Literal

import jax
import numpy as np
from scipy.spatial import cKDTree

from congrasp.common.errors import CongraspError
from congrasp.common.hands.closure import CENTER, outline
from congrasp.common.hands.files import HUMAN
from congrasp.common.hands.spec import Hand
from congrasp.common.io.inputs import distinct_names, safe_name
from congrasp.common.objects import store
from congrasp.common.objects.pool import object_scale
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.sampling.headings import Headings
from congrasp.common.task.sampling.object_headings import HEADINGS, headings_of
from congrasp.common.task.sampling.sets import for_training, set_of
from congrasp.common.task.sampling.table import (
    SOFT,
    above_table,
    clear_of_table,
    height_over_table,
)
from congrasp.common.wire.codec import Message
from congrasp.services.assets.captures.extract import BEYOND, Demonstration, Surface, extract
from congrasp.services.assets.captures.references import (
    check_reference,
    deepest,
    demonstrated_headings,
    separated,
    transferred,
)
from congrasp.services.assets.captures.sequence import Dropped, Sequence
from congrasp.services.assets.objects.affordance import near_points, relabelled, two_parts
from congrasp.services.assets.objects.assembly import UNLABELLED
from congrasp.services.assets.objects.meshes import import_sources
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.assets.objects.sources import Source, find_sources

Affordance = Literal["auto", "parts", "contacts", "none"]
_Shapes = dict[pathlib.Path, tuple[GraspObject, Surface] | CongraspError]
_AXES = ImportOptions(unit="m", up="z")
"""Captured poses refer to the axes of the mesh files."""
_TOUCHED = 0.03
"""Radius around touched points that counts as touched, m."""
IN_TABLE = 0.005
"""Tolerated depth of a captured hand in the table if no resting pose avoids it, m."""
_above_table = jax.jit(above_table)
_clear_of_table = jax.jit(clear_of_table, static_argnums=0)
_height_over_table = jax.jit(height_over_table, static_argnums=0)
_VERTICES = 3
"""Least number of contact points that makes a part of an object graspable."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Options for building sets."""

    headings: Literal["sampled", "demonstrated"] = "sampled"
    """sampled: 256 per object by the paper's rules; demonstrated: those of the captured grasps."""
    affordance: Affordance = "auto"
    """parts: labelled parts touched by fingers are graspable; contacts: the touched points; auto:
    parts if labelled.
    """
    beyond: float = BEYOND
    """Tolerance in rad of a captured joint beyond its limits; it is then clamped. Only for
    `human`.
    """
    waypoints: int = 15
    seed: int = 0
    """Seed of headings, and of the split of all sequences into training and held-out."""


@dataclasses.dataclass
class Report:
    """Outcome of each sequence."""

    kept: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    dropped: list[dict[str, str]] = dataclasses.field(default_factory=list)

    def drop(self, dropped: Dropped) -> None:
        """Records a dropped sequence."""
        self.dropped.append(
            {"sequence": dropped.name, "rule": dropped.rule, "reason": dropped.reason}
        )

    def rules(self) -> list[tuple[str, int, str]]:
        """Returns the name of each rule, the number of sequences it dropped, and the first
        reason.
        """
        counts = collections.Counter(row["rule"] for row in self.dropped)
        first = {
            row["rule"]: f"{row['sequence']}: {row['reason']}" for row in reversed(self.dropped)
        }
        return [(rule, count, first[rule]) for rule, count in counts.most_common()]


@dataclasses.dataclass
class _Group:
    """Demonstrations on one object with one partition."""

    obj: GraspObject
    demonstrations: list[Demonstration] = dataclasses.field(default_factory=list)
    training: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, bool))
    """(M,) bool, those for training."""


def import_sets(
    sequences: Iterable[Sequence | Dropped],
    hand: Hand,
    options: Options,
    source: str,
    progress: Callable[[str], None] = lambda doing: None,
) -> tuple[list[GraspObject], list[Message], Report]:
    """Builds objects and their constraint sets.

    Args:
      sequences: sequences of an importer.
      hand: hand of the constraints; a hand other than the human one follows the demonstrations by
        its grasp axes.
      options: options for building.
      source: name of the data set.
      progress: called with a description of the current step.

    Returns:
      Objects and, in the same order, their sets; and the report.
    """
    report = Report()
    read = []
    for item in sequences:
        progress(f"Reading {item.name}")
        read.append(item)
    shapes = _shapes([item for item in read if isinstance(item, Sequence)], progress)
    groups: dict[tuple[str, bytes, bytes], _Group] = {}
    beyond, scale = (
        options.beyond if hand is HUMAN else np.inf,
        object_scale(hand, TaskConfig(hand=hand.name)),
    )
    for item in read:
        try:
            if isinstance(item, Dropped):
                raise item
            progress(f"Grasp of {item.name}")
            obj, surface = _shape(item, shapes)
            demonstration = extract(item, obj, surface, options.waypoints, beyond)
            check_reference(hand, demonstration, obj, scale)
            labelled = _labelled(item, obj, demonstration, options.affordance)
            key = labelled.name, labelled.labels.tobytes(), labelled.graspable.tobytes()
            groups.setdefault(key, _Group(labelled)).demonstrations.append(demonstration)
        except Dropped as dropped:
            report.drop(dropped)
    for group, name in zip(
        groups.values(), distinct_names(name for name, *_ in groups), strict=True
    ):
        group.obj = dataclasses.replace(group.obj, name=name)
    objects, sets = [], []
    # Sets may hold a single sequence each: 80 % refers to all sequences, not to each set.
    ends = np.cumsum([len(group.demonstrations) for group in groups.values()], dtype=int)
    masks = np.split(for_training(int(ends[-1]), options.seed), ends[:-1]) if len(ends) else []
    for number, (group, mask) in enumerate(zip(groups.values(), masks, strict=True)):
        group.training = mask
        try:
            made, given = _set(hand, group, options, number, source)
        except CongraspError as error:
            for demonstration in group.demonstrations:
                report.drop(Dropped(demonstration.name, "object out of reach", str(error)))
            continue
        objects.append(group.obj)
        sets.append(made)
        report.kept += _rows(hand, group, made, given)
    return objects, sets, report


def _rows(hand: Hand, group: _Group, made: Message, given: np.ndarray) -> Iterator[dict[str, Any]]:
    """Yields the outcome of each of M kept demonstrations on an object.

    Args:
      hand: hand of the set.
      group: the object and its demonstrations.
      made: the constraint set.
      given: (M, F) finger angles before fingers were separated.
    """
    usable, below = made.arrays["pose/allowed"].any((0, 1)), _from_below(hand, made)
    overlap, moved = (
        np.asarray(deepest(hand, given)),
        np.abs(made.arrays["pose/q"][0] - given).max(-1),
    )
    for m, demonstration in enumerate(group.demonstrations):
        yield {
            "sequence": demonstration.name,
            "object": group.obj.name,
            "frame": demonstration.frame,
            "frames_after_touch": demonstration.later,
            "first_frame": demonstration.start,
            "residual_rad": round(demonstration.fit.angle, 5),
            "residual_tip_m": round(demonstration.fit.tip, 5),
            "overlap_m": round(float(overlap[m]), 5),
            "moved_apart_rad": round(float(moved[m]), 5),
            "touched_points": len(demonstration.contact),
            "clear_of_table": bool(usable[m]),
            "from_below": bool(below[m]),
            "split": "training" if group.training[m] else "held-out",
        }


def _shapes(sequences: list[Sequence], progress: Callable[[str], None]) -> _Shapes:
    """Imports the sequences' meshes once each; returns objects and surfaces, or the reasons for
    failures.
    """
    names = {sequence.mesh: sequence.object_name for sequence in sequences}
    distinct = distinct_names(safe_name(name) for name in names.values())
    shapes, sources = _Shapes(), dict[pathlib.Path, Source]()
    for mesh, name in zip(names, distinct, strict=True):
        try:
            sources[mesh] = dataclasses.replace(_source(mesh), name=name)
        except CongraspError as error:
            shapes[mesh] = error
    paths = list(sources)
    for done, (i, obj) in enumerate(import_sources(list(sources.values()), _AXES), 1):
        progress(f"Mesh of {sources[paths[i]].name} ({done} of {len(paths)})")
        if not isinstance(obj, CongraspError):
            # Without labelled parts the whole surface is graspable.
            obj = dataclasses.replace(obj, graspable=np.ones_like(obj.graspable))
        shapes[paths[i]] = obj if isinstance(obj, CongraspError) else (obj, Surface(obj))
    return shapes


def _source(mesh: pathlib.Path) -> Source:
    """Returns the files of the one object at a path."""
    sources = find_sources(mesh)
    if len(sources) > 1:
        raise CongraspError(
            f"{mesh} holds {len(sources)} objects.", "Pass the folder of one, or its file."
        )
    return sources[0]


def _shape(sequence: Sequence, shapes: _Shapes) -> tuple[GraspObject, Surface]:
    """Returns the object of a sequence's mesh and its surface."""
    found = shapes[sequence.mesh]
    if isinstance(found, CongraspError):
        raise Dropped(sequence.name, "unusable mesh", str(found))
    return found


def _labelled(
    sequence: Sequence, obj: GraspObject, demonstration: Demonstration, affordance: Affordance
) -> GraspObject:
    """Returns the object with the grasp's partition into graspable and avoid region, under a
    separate name.
    """
    names, clouds = _parts(sequence, obj)
    if affordance == "none" or (affordance == "auto" and not names):
        return obj
    if affordance == "contacts":
        touched = near_points(obj, demonstration.contact, _TOUCHED)
        return _with_region(
            sequence, lambda: two_parts(obj, touched, safe_name(f"{obj.name}-{sequence.name}"))
        )
    if not names:
        raise Dropped(
            sequence.name,
            "no labelled parts",
            f"the parts of '{sequence.object_name}' are not labelled",
        )
    labels = _nearest(clouds, obj.points)
    counts = np.bincount(_nearest(clouds, demonstration.contact), minlength=len(names))
    graspable = counts >= _VERTICES
    if not graspable.any():
        reason = f"fingers touch no part in {_VERTICES} points ({counts.max()} at most)"
        raise Dropped(sequence.name, "no part touched", reason)
    touched_names = [name for name, touched in zip(names, graspable, strict=True) if touched]
    name = obj.name if graspable.all() else safe_name("-".join([obj.name, *touched_names]))
    return _with_region(
        sequence, lambda: relabelled(obj, labels, names, [bool(part) for part in graspable], name)
    )


def _parts(sequence: Sequence, obj: GraspObject) -> tuple[list[str], list[np.ndarray]]:
    """Names and points (n, 3), in the object frame, of the parts labelled by the data set or the
    object's files.
    """
    if sequence.parts:
        return [part.name for part in sequence.parts], [
            part.points + obj.origin for part in sequence.parts
        ]
    if obj.part_names == UNLABELLED:
        return [], []
    return list(obj.part_names), [obj.points[obj.labels == i] for i in range(len(obj.part_names))]


def _with_region(sequence: Sequence, make: Callable[[], GraspObject]) -> GraspObject:
    """Returns the object of `make`; drops the sequence if its graspable region is too small."""
    try:
        return make()
    except CongraspError as error:
        raise Dropped(
            sequence.name, "graspable region too small", str(error).split(". ")[0]
        ) from None


def _nearest(clouds: list[np.ndarray], points: np.ndarray) -> np.ndarray:
    """Indices (n,) of the cloud nearest to each point (n, 3)."""
    if len(points) == 0:
        return np.zeros(0, int)
    return np.argmin([cKDTree(cloud).query(points)[0] for cloud in clouds], axis=0)


def _resting_poses(
    hand: Hand, q: np.ndarray, position: np.ndarray, quaternion: np.ndarray, rest: np.ndarray
) -> np.ndarray:
    """(M, R) bool: resting poses (R, 7) of the object in which each of M captured references is
    used.

    The wrist must stay above the table and the hand outside it, as for other references. If no
    resting pose allows that, because captured hands are off by some millimetres, the one with the
    least depth is used, up to `IN_TABLE`.

    Args:
      hand: hand of the references.
      q: (M, F) finger angles of the poses.
      position: (M, K, 3) wrist waypoints, in the object frame; the pose is the last one.
      quaternion: (M, K, 4) orientations of the waypoints.
      rest: (R, 7) resting poses.
    """
    rests = np.stack([rest] * len(position))
    clear = np.asarray(_clear_of_table(hand, quaternion[:, -1], position, rests))
    height = np.where(clear, _height_over_table(hand, q, position, quaternion, rests), -np.inf)
    return clear & (height >= np.clip(height.max(1, keepdims=True), -IN_TABLE, -SOFT))


def _set(
    hand: Hand, group: _Group, options: Options, number: int, source: str
) -> tuple[Message, np.ndarray]:
    """Returns the constraint set of an object scaled for the hand, and the initial finger angles
    (M, F).

    Args:
      hand: hand of the constraints.
      group: the object and its M demonstrations.
      options: options for building.
      number: number of the group, for its seed.
      source: name of the data set.

    Raises:
      CongraspError: the hand cannot approach the object in any resting pose.
    """
    task = TaskConfig(hand=hand.name, trajectory_points=options.waypoints)
    obj, demonstrations, seed = group.obj, group.demonstrations, (options.seed, number)
    scale = object_scale(hand, task)
    fitting = obj.scaled(scale)
    given = None
    if options.headings == "demonstrated":
        given = Headings(
            *(np.resize(x, (HEADINGS, 3)) for x in demonstrated_headings(demonstrations, scale))
        )
    # Human grasps are not tested against the hand's outline, since their table was elsewhere.
    fields = headings_of(task, fitting, seed, given, scale, CENTER if given else outline(hand))
    if hand is HUMAN:
        posed = tuple(
            np.stack([getattr(d, x) for d in demonstrations])
            for x in ("q", "position", "quaternion")
        )
    else:
        posed = transferred(hand, demonstrations, fitting, scale)
    given_q, position, quaternion = (values.astype(np.float32) for values in posed)
    q = separated(hand, given_q)
    clear = _resting_poses(hand, q, position, quaternion, fields["rest"])
    nearer = _ends_nearer_to_graspable(position[:, -1], fields["points"], fields["avoid"])
    row = ConstraintBank(
        **{
            name: value
            for name, value in fields.items()
            if name != "weight" and not name.startswith("chosen")
        },
        pose_q=_twice(q),
        pose_position=_twice(position[:, -1]),
        pose_quaternion=_twice(quaternion[:, -1]),
        trajectory_position=_twice(position),
        trajectory_quaternion=_twice(quaternion),
        pose_valid=np.stack([clear.T, (clear & nearer[:, None]).T]),
        weight=np.float32(1.0),  # people held it, however flat it lies
        mass=np.float32(fitting.mass),
        renewable=np.bool_(False),
        grasps=np.zeros(2, int),
    )
    about = {
        "source": source,
        "demonstrations": [demonstration.name for demonstration in demonstrations],
        "object_scale": scale,
        "object_digest": store.digest(obj),
    }
    # Demonstrated headings repeat, and each belongs to the split of its demonstration.
    own = np.resize(group.training, HEADINGS) if given else None
    made = set_of(
        hand, row, fitting, options.seed, about, pose_training=group.training, heading_training=own
    )
    return made, given_q


def _from_below(hand: Hand, made: Message) -> np.ndarray:
    """(M,) bool: demonstrations excluded in every resting pose, in one of them only by the approach
    from below.
    """
    names = "trajectory/position", "pose/quaternion", "rest"
    path, turn, rest = (made.arrays[name] for name in names)
    rests = np.stack([rest] * path.shape[1])
    clear = np.asarray(_clear_of_table(hand, turn[0], path[0], rests))
    return np.asarray(np.asarray(_above_table(path[0], rests)).any(-1) & ~clear.any(-1))


def _twice(values: np.ndarray) -> np.ndarray:
    """Repeats values for both regions (2, ...): the whole surface, and the graspable region."""
    return np.stack([values, values])


def _ends_nearer_to_graspable(
    wrist: np.ndarray, points: np.ndarray, avoid: np.ndarray
) -> np.ndarray:
    """(M,) bool: wrist positions (M, 3) agree with the affordance
    (`common.task.constraints.priority`).
    """
    away = np.linalg.norm(points[None] - wrist[:, None], axis=-1)
    return away[:, ~avoid].min(-1, initial=np.inf) < away[:, avoid].min(-1, initial=np.inf)
