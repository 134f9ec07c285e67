"""A layout for Foxglove that fits a recording: its actors in 3-D, its learning curves, its
events.
"""

import dataclasses
import pathlib
from collections.abc import Sequence

import foxglove.layouts as fl

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import parse_json
from congrasp.services.record.reader import Record, log_files, metrics_of, read_records
from congrasp.services.record.writer import flatten

CURVES = {
    "Success and return": ("episode/success", "episode/return"),
    "Throughput": ("steps_per_second",),
    "Staleness": ("staleness_mean", "staleness_max"),
    "Losses": ("policy_loss", "value_loss", "kl"),
}
"""Plots of a learner's metrics; those that the recording lacks are omitted."""
SIGNALS = {
    "Reward": ("reward.total", "reward.contact", "reward.distance"),
    "Contact": ("links_in_contact", "object_height"),
}
"""Plots of an actor's episodes, by the fields of `signals`."""
_TOPIC_PREFIXES = ("/episode/", "/metrics/learner/", "/events/")
_SCENE_TOPICS = ("scene", "contacts")
_MAX_VISIBLE_ACTORS = 4
"""Actors whose scenes are shown initially; the others can be enabled."""
_SCENE_SHARE = 3.0
"""Height of the 3-D panel, in heights of a plot."""


@dataclasses.dataclass
class _Contents:
    """Topics and fields of a recording that a layout can show."""

    signals: dict[str, set[str]] = dataclasses.field(default_factory=dict)
    """Fields of each actor's signals, their levels separated by slashes."""
    metrics: dict[str, set[str]] = dataclasses.field(default_factory=dict)
    """Metrics of each topic of a learner."""
    event_topic: str = ""
    """The first topic with events; empty if there is none."""


def export_layout(recording: pathlib.Path, path: pathlib.Path) -> int:
    """Writes a layout for a recording, to be opened with Foxglove's "Import from file".

    Args:
      recording: a file or a folder.
      path: the layout's file.

    Returns:
      The number of panels.

    Raises:
      CongraspError: there is nothing to show in the recording.
    """
    contents = _read_contents(recording)
    if not contents.signals and not contents.metrics:
        raise CongraspError(
            f"The recordings in {recording} hold neither episodes nor metrics of a learner."
        )
    columns: list[fl.SplitItem] = []
    if contents.signals:
        columns.append(fl.SplitItem(proportion=1.0, content=_episode_column(contents.signals)))
    learner_panels = _learner_panels(contents)
    if learner_panels:
        column = fl.SplitContainer(direction="column", items=learner_panels)
        columns.append(fl.SplitItem(proportion=1.0, content=column))
    layout = fl.Layout(content=fl.SplitContainer(direction="row", items=columns))
    text = layout.to_json()
    write_atomically(path, text.encode())
    return text.count('"panelType"')


def _read_contents(recording: pathlib.Path) -> _Contents:
    """Collects the topics of a recording and their fields."""
    contents = _Contents()
    for file in log_files(recording):
        for record in read_records(file, lambda topic: topic.startswith(_TOPIC_PREFIXES)):
            _add_topic(contents, record)
    return contents


def _add_topic(contents: _Contents, record: Record) -> None:
    """Adds the topic of a record and its fields to the contents."""
    kind, *levels = record.topic.strip("/").split("/")
    if kind == "episode":
        actor = levels[0]
        fields = contents.signals.setdefault(actor, set())
        if levels[1] == "signals":
            fields.update(flatten(parse_json(record.data, "A recording's signals")))
    elif kind == "metrics":
        names = contents.metrics.setdefault(record.topic, set())
        names.update(flatten(metrics_of(record)["values"]))
    elif not contents.event_topic:
        contents.event_topic = record.topic


def _episode_column(signals: dict[str, set[str]]) -> fl.SplitContainer:
    """The scenes of all actors above the signals of the first one."""
    actor = min(signals)
    items = [fl.SplitItem(proportion=_SCENE_SHARE, content=_scene(sorted(signals)))]
    for title, fields in SIGNALS.items():
        paths = []
        for field in fields:
            if field.replace(".", "/") in signals[actor]:
                paths.append(f"/episode/{actor}/signals.{field}")
        if paths:
            items.append(fl.SplitItem(proportion=1.0, content=_plot(title, paths)))
    return fl.SplitContainer(direction="column", items=items)


def _learner_panels(contents: _Contents) -> list[fl.SplitItem]:
    """The learner's curves, then the events."""
    items = []
    for title, names in CURVES.items():
        paths = _metric_paths(contents.metrics, names)
        if paths:
            items.append(fl.SplitItem(proportion=1.0, content=_plot(title, paths)))
    if contents.event_topic:
        config = fl.LogConfig(topic_to_render=contents.event_topic)
        panel = fl.LogPanel(title="Events", config=config)
        items.append(fl.SplitItem(proportion=1.0, content=panel))
    return items


def _metric_paths(metrics: dict[str, set[str]], names: Sequence[str]) -> list[str]:
    """Message paths of the named metrics in every topic that has them."""
    paths = []
    for topic, recorded in metrics.items():
        for name in names:
            if name in recorded:
                paths.append(f"{topic}.values.{name.replace('/', '.')}")
    return paths


def _plot(title: str, paths: Sequence[str]) -> fl.PlotPanel:
    """A plot with a curve for each message path, named by its last field."""
    series = []
    for path in paths:
        label = path.rpartition(".")[2]
        series.append(fl.PlotSeries(value=path, label=label, enabled=True))
    return fl.PlotPanel(title=title, config=fl.PlotConfig(paths=series, show_legend=True))


def _scene(actors: Sequence[str]) -> fl.ThreeDeePanel:
    """The 3-D panel with the actors' scenes."""
    topics = {}
    for number, actor in enumerate(actors):
        is_visible = number < _MAX_VISIBLE_ACTORS
        for name in _SCENE_TOPICS:
            settings = fl.BaseRendererSceneUpdateTopicSettings(visible=is_visible)
            topics[f"/episode/{actor}/{name}"] = settings
    frames = fl.BaseRendererTransforms(visible=False, show_label=False)
    camera = fl.ThreeDeeCameraState(
        distance=0.8,
        phi=65.0,
        theta_offset=45.0,
        target=(0.0, 0.0, 0.1),
        near=0.01,
    )
    config = fl.ThreeDeeConfig(
        camera_state=camera,
        fixed_frame="world",
        follow_mode="follow-none",
        scene=fl.BaseRendererSceneSettings(transforms=frames),
        topics=dict(topics),
    )
    return fl.ThreeDeePanel(title="Episodes", config=config)
