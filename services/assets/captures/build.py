"""Builds objects and constraint sets from sequences, with a report of kept and dropped ones."""

import dataclasses
import pathlib
from collections.abc import Callable, Iterable

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.files import HUMAN
from congrasp.common.hands.spec import Hand
from congrasp.common.io.inputs import distinct_names, safe_name
from congrasp.common.objects.pool import object_scale
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling.sets import for_training
from congrasp.common.wire.codec import Message
from congrasp.services.assets.captures.constraint_sets import Group, build_set, report_rows
from congrasp.services.assets.captures.extract import extract
from congrasp.services.assets.captures.options import Options
from congrasp.services.assets.captures.references import check_reference
from congrasp.services.assets.captures.regions import with_touched_region
from congrasp.services.assets.captures.report import Report
from congrasp.services.assets.captures.sequence import Dropped, Sequence
from congrasp.services.assets.captures.surface import Surface
from congrasp.services.assets.objects.meshes import import_sources
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.assets.objects.sources import Source, find_sources

_Progress = Callable[[str], None]
"""Function that is called with a description of the current step."""
Shapes = dict[pathlib.Path, tuple[GraspObject, Surface] | CongraspError]
"""Object and surface of each mesh, or the error of its import."""
_Key = tuple[str, bytes, bytes]
"""Name and partition of an object."""
_FILE_AXES = ImportOptions(unit="m", up="z")
"""Captured poses refer to the axes of the mesh files."""


def import_sets(
    sequences: Iterable[Sequence | Dropped],
    hand: Hand,
    options: Options,
    source: str,
    progress: _Progress = lambda doing: None,
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
    groups = _groups(read, hand, options, report, progress)
    objects = []
    messages = []
    for number, group in enumerate(groups):
        try:
            built = build_set(hand, group, options, number, source)
        except CongraspError as error:
            for demonstration in group.demonstrations:
                report.drop(Dropped(demonstration.name, "object out of reach", str(error)))
            continue
        objects.append(group.obj)
        messages.append(built.message)
        report.kept += report_rows(hand, group, built)
    return objects, messages, report


def _groups(
    items: list[Sequence | Dropped],
    hand: Hand,
    options: Options,
    report: Report,
    progress: _Progress,
) -> list[Group]:
    """Demonstrations of sequences by object and partition, with their split for training."""
    shapes = import_shapes([item for item in items if isinstance(item, Sequence)], progress)
    beyond = options.beyond if hand is HUMAN else np.inf
    scale = object_scale(hand, TaskConfig(hand=hand.name))
    groups: dict[_Key, Group] = {}
    for item in items:
        if isinstance(item, Dropped):
            report.drop(item)
            continue
        progress(f"Grasp of {item.name}")
        try:
            obj, surface = _shape(item, shapes)
            demonstration = extract(item, obj, surface, options.waypoints, beyond)
            check_reference(hand, demonstration, obj, scale)
            labelled = with_touched_region(item, obj, demonstration, options.affordance)
        except Dropped as dropped:
            report.drop(dropped)
            continue
        key = (labelled.name, labelled.labels.tobytes(), labelled.graspable.tobytes())
        group = groups.setdefault(key, Group(labelled))
        group.demonstrations.append(demonstration)
    names = distinct_names(name for name, *_ in groups)
    for group, name in zip(groups.values(), names, strict=True):
        group.obj = dataclasses.replace(group.obj, name=name)
    _split(list(groups.values()), options.seed)
    return list(groups.values())


def _split(groups: list[Group], seed: int) -> None:
    """Selects the demonstrations for training.

    Sets may hold a single sequence each: 80 % refers to all sequences, not to each set.
    """
    count = sum(len(group.demonstrations) for group in groups)
    if not count:
        return
    training = for_training(count, seed)
    start = 0
    for group in groups:
        end = start + len(group.demonstrations)
        group.training = training[start:end]
        start = end


def import_shapes(sequences: list[Sequence], progress: _Progress) -> Shapes:
    """Imports the sequences' meshes once each.

    Args:
      sequences: the sequences.
      progress: called with a description of the current step.
    """
    names = {sequence.mesh: sequence.object_name for sequence in sequences}
    distinct = distinct_names(safe_name(name) for name in names.values())
    shapes = Shapes()
    sources: dict[pathlib.Path, Source] = {}
    for mesh, name in zip(names, distinct, strict=True):
        try:
            sources[mesh] = dataclasses.replace(source_of(mesh), name=name)
        except CongraspError as error:
            shapes[mesh] = error
    meshes = list(sources)
    results = import_sources(list(sources.values()), _FILE_AXES)
    for done, (i, result) in enumerate(results, 1):
        mesh = meshes[i]
        progress(f"Mesh of {sources[mesh].name} ({done} of {len(meshes)})")
        if isinstance(result, CongraspError):
            shapes[mesh] = result
        else:
            # Without labelled parts the whole surface is graspable.
            obj = dataclasses.replace(result, graspable=np.ones_like(result.graspable))
            shapes[mesh] = (obj, Surface(obj))
    return shapes


def source_of(mesh: pathlib.Path) -> Source:
    """Returns the files of the one object at a path.

    Raises:
      CongraspError: there is none, or several.
    """
    sources = find_sources(mesh)
    if len(sources) > 1:
        raise CongraspError(
            f"{mesh} contains {len(sources)} objects.", "Pass the folder or the file of one object."
        )
    return sources[0]


def _shape(sequence: Sequence, shapes: Shapes) -> tuple[GraspObject, Surface]:
    """The object of a sequence's mesh and its surface."""
    shape = shapes[sequence.mesh]
    if isinstance(shape, CongraspError):
        raise Dropped(sequence.name, "unusable mesh", str(shape))
    return shape
